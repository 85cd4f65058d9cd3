"""Commands that render a map and tell what comes."""

import json

import pytest

from openvocab_occ.cli import main


@pytest.fixture(scope="module")
def saved(street, tmp_path_factory):
    return str(street.save(tmp_path_factory.mktemp("maps") / "street.ovmap"))


@pytest.mark.parametrize(("words", "bundles", "method"), [
    ([], 1, "frame"), (["--place", "front", "--frame", "2"], 1, "frame"), (["--place", "rig"], 1, "frame"),
    (["--place", "trajectory", "--metres", "10"], 2, "trajectory"), (["--place", "ahead", "--metres", "8"], 1, "ahead"),
    (["--place", "route", "--metres", "30"], 2, "ahead"), (["--place", "object", "--object", "7"], 1, "object"),
    (["--place", "hits", "--query", "trucks"], 2, "cover"),
])  # fmt: skip
def test_views_from_every_place(saved, tmp_path, capsys, words, bundles, method):
    out = str(tmp_path / "out")
    assert main(["export", "views", saved, "--out", out, "--size", "256", "144", "--json", *words]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [one["viewpoint"]["method"] for one in report["bundles"]] == [method] * bundles
    for one in report["bundles"]:
        assert one["folder"].startswith(out)


def test_parts_left_out_and_words_for_a_person(saved, tmp_path, capsys):
    words = ["--leave-out", "marks", "bev", "--size", "256", "144"]
    assert main(["export", "views", saved, "--out", str(tmp_path / "out"), *words]) == 0
    assert "CAM_FRONT of frame 1" in capsys.readouterr().out
    assert not (tmp_path / "out" / "view_marked.png").exists()
    assert (tmp_path / "out" / "view_clean.png").exists()


@pytest.mark.parametrize(("words", "message"), [
    (["--place", "object"], "which object is not said: expected --object ID"),
    (["--place", "hits"], "there are no hits to show"),
    (["--place", "rig", "--frame", "77"], "no keyframe with cameras has this index"),
    (["--place", "ahead", "--metres", "4000"], "the way ahead does not reach so far"),
])  # fmt: skip
def test_what_cannot_be_shown_is_told(saved, tmp_path, capsys, words, message):
    assert main(["export", "views", saved, "--out", str(tmp_path / "out"), *words]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_brief(saved, capsys):
    assert main(["brief", saved, "--length", "50", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {one["label"] for one in told["objects"]} >= {"car", "truck"}
    assert main(["brief", saved, "--length", "50"]) == 0
    assert told["text"].splitlines()[0] in capsys.readouterr().out
