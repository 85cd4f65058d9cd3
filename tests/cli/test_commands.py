"""Commands: what they print for programs, and what they say of input that cannot be used."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from openvocab_occ.cli import COMMANDS, main
from openvocab_occ.segmentation.card_files import SHIPPED
from openvocab_occ.segmentation.demo_models import demo_model, street_model


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A saved map of the synthetic street."""
    path = tmp_path_factory.mktemp("maps") / "street.ovmap"
    assert main(["map", "street", "any", "--encoder", str(street_model()), "--out", str(path), "--frames", "3"]) == 0
    return path


def printed(capsys: pytest.CaptureFixture[str]) -> dict:
    out, err = capsys.readouterr()
    assert err == ""
    assert out.count("\n") == 1
    return json.loads(out)


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main([str(a) for a in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    return err


def test_help_lists_every_command(capsys):
    assert main([]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*name.split(), "--help"])
    assert stop.value.code == 0
    assert "--json" in capsys.readouterr().out


def test_unknown_command(capsys):
    assert "no command 'mop'" in refused(capsys, "mop")


def test_map_find_export_print_json(street, tmp_path, capsys):
    capsys.readouterr()
    assert main(["find", str(street), "trucks", "--json"]) == 0
    answer = printed(capsys)
    assert answer["verdict"] == "found"
    assert answer["hits"]
    assert main(["export", str(street), "--query", "trucks", "--out", str(tmp_path / "view"), "--json"]) == 0
    report = printed(capsys)
    assert "view.json" in report["files"]
    assert report["answer"]["hits"] == answer["hits"]
    out = ["--out", str(tmp_path / "a.ovmap"), "--frames", "1", "--json"]
    assert main(["map", "street", "any", "--encoder", str(street_model()), *out]) == 0
    report = printed(capsys)
    assert report["frames"] == 1
    assert report["synthetic"] is True
    assert report["voxels"] > 0


def test_maps_of_the_shipped_model_are_asked_without_naming_it(tmp_path, capsys):
    path = tmp_path / "street.ovmap"
    arguments = ["map", "street", "any", "--encoder", str(demo_model()), "--out", str(path), "--frames", "1", "--json"]
    assert main(arguments) == 0
    capsys.readouterr()
    assert main(["find", str(path), "trees", "--json"]) == 0
    alone = printed(capsys)
    assert main(["find", str(path), "trees", "--encoder", str(demo_model()), "--json"]) == 0
    assert printed(capsys)["hits"] == alone["hits"]
    manifest = json.loads((path / "manifest.json").read_text())
    manifest["encoder"]["fingerprint"] = "0" * 64
    (path / "manifest.json").write_text(json.dumps(manifest))
    assert "--encoder FILE" in refused(capsys, "find", path, "trees")


def test_people_get_text(street, capsys):
    assert main(["find", str(street), "unicorns"]) == 0
    assert "not understood" in capsys.readouterr().out


@pytest.mark.data
def test_own_occupancy_joins_from_the_command_line(keyframe, tmp_path, capsys):
    """Grids of the user's own replace the LiDAR's: a lone wall ahead is all that the map holds."""
    labels = np.full((200, 200, 16), 17, np.uint8)
    labels[130, 60:140] = 15
    np.savez(tmp_path / "0.npz", semantics=labels)
    assert main(["map", "nuscenes-infos", str(keyframe / "info.json"), "--occupancy", str(tmp_path / "{index}.npz"),
                 "--encoder", str(street_model()), "--out", str(tmp_path / "a.ovmap"), "--json"]) == 0  # fmt: skip
    assert 0 < printed(capsys)["voxels"] <= 80 * 16 * 1.3  # the wall is turned against the map


class TestBadInput:
    """Each refusal is one line that says what was wrong; nothing is left behind."""

    def test_missing_map(self, tmp_path, capsys):
        assert "not found" in refused(capsys, "find", tmp_path / "no.ovmap", "trucks")

    def test_not_a_map(self, tmp_path, capsys):
        (tmp_path / "other").mkdir()
        assert "manifest.json" in refused(capsys, "find", tmp_path / "other", "trucks")

    def test_missing_model(self, tmp_path, capsys):
        message = refused(
            capsys, "map", "street", "any", "--encoder", tmp_path / "no.onnx", "--out", tmp_path / "a.ovmap"
        )
        assert "no.onnx" in message
        assert not list(tmp_path.iterdir())

    def test_unknown_kind(self, tmp_path, capsys):
        message = refused(capsys, "map", "kitty", tmp_path, "--encoder", street_model(), "--out", tmp_path / "a.ovmap")
        assert "nuscenes-infos" in message

    def test_empty_question(self, street, capsys):
        assert "empty" in refused(capsys, "find", street, "  ")

    def test_output_that_is_not_ours(self, tmp_path, capsys):
        (tmp_path / "a.ovmap").mkdir()
        (tmp_path / "a.ovmap" / "holiday.jpg").write_bytes(b"x")
        message = refused(capsys, "map", "street", "any", "--encoder", street_model(), "--frames", "1", "--out",
                          tmp_path / "a.ovmap")  # fmt: skip
        assert "not ours" in message
        assert (tmp_path / "a.ovmap" / "holiday.jpg").read_bytes() == b"x"

    def test_output_that_cannot_be_written_is_said_before_the_work(self, tmp_path, capsys):
        (tmp_path / "file").touch()
        message = refused(
            capsys, "map", "street", "any", "--encoder", "no.onnx", "--out", tmp_path / "file" / "a.ovmap"
        )
        assert "cannot be written" in message

    @pytest.mark.data
    def test_model_against_its_card(self, data, tmp_path, capsys):
        model = data / "onnx" / "deeplabv3" / "deeplab_v3_voc.onnx"
        card = tmp_path / "wrong.card.yaml"
        shipped = next(SHIPPED.glob("deeplab*.card.yaml")).read_text()
        card.write_text(shipped.replace("bus, car, cat", "bus, cat").replace("- car\n", ""))
        message = refused(capsys, "map", "street", "any", "--encoder", model, "--card", card, "--out", tmp_path / "a")
        assert "20" in message
        assert "21" in message

    @pytest.mark.data
    def test_missing_sweep(self, keyframe, tmp_path, capsys):
        for file in [keyframe / "info.json", *keyframe.glob("*.jpg")]:
            shutil.copy(file, tmp_path / file.name)
        message = refused(capsys, "map", "nuscenes-infos", tmp_path / "info.json", "--encoder", street_model(), "--out",
                          tmp_path / "a.ovmap")  # fmt: skip
        assert ".pcd.bin" in message
        assert not (tmp_path / "a.ovmap").exists()
