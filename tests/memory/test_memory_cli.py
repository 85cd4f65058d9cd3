"""The commands of the global map, and what they draw."""

import json

import numpy as np
import pytest

from openvocab_occ.cli import main
from openvocab_occ.datasets import load_sequence
from openvocab_occ.io.images import read_image
from openvocab_occ.memory import TileMap
from openvocab_occ.memory.observe import observe
from openvocab_occ.occupancy import OCC3D_CLASSES


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    path = tmp_path_factory.mktemp("maps") / "street.tiles"
    assert (
        main(["memory", "build", "street", "any", "--out", str(path), "--frames", "2", "--agent", "car-1", "--json"])
        == 0
    )
    return path


def run(capsys, *arguments) -> dict:
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return json.loads(out)


def test_build_writes_what_is_seen(driven, capsys):
    frame = load_sequence("street", None)[1]
    prior = TileMap.open(driven).read(frame.occupancy.T_world_grid, frame.occupancy.spec)
    seen = observe(frame).mask
    assert prior.known[seen].mean() > 0.97  # centres of turned lattices differ
    agree = prior.logits.argmax(-1) == frame.occupancy.labels
    assert agree[seen & prior.known].mean() > 0.9
    road = seen & (frame.occupancy.labels == OCC3D_CLASSES.index("driveable surface"))
    assert road.sum() > 500, "the street is seen, not only what stands on it"
    info = run(capsys, "memory", "info", driven)
    assert info["agents"] == {"car-1": None}
    assert info["journal_entries"] == 2
    assert info["tile_bytes"] > 1000


def test_read_write_diff(driven, tmp_path, capsys):
    report = run(capsys, "memory", "read", driven, "--at", 8, 0, 0, "--out", tmp_path / "p.npz")
    with np.load(tmp_path / "p.npz") as data:
        assert data["known"].mean() == pytest.approx(report["known"])
        logits, known = data["logits"], data["known"]
    window = {"logits": logits, "mask": known, "T_world_ego": np.eye(4), "origin": (-40, -40, -1.0), "voxel_size": 0.4}
    np.savez(tmp_path / "w.npz", **window)
    copy = TileMap.create(tmp_path / "copy.tiles", OCC3D_CLASSES)
    written = run(
        capsys, "memory", "write", copy.store.name, tmp_path / "w.npz", "--stamp", 9, "--agent", "b", "--log", "l"
    )
    assert written["voxels"] == written["changed"] == known.sum()
    changes = run(capsys, "memory", "diff", driven, copy.store.name)
    assert changes["compared"] > 1000
    assert main(["memory", "diff", str(driven)]) == 2
    assert "nothing to compare with" in capsys.readouterr().err
    assert (
        main(["memory", "write", str(driven), str(driven / "zarr.json"), "--stamp", "1", "--agent", "b", "--log", "l"])
        == 2
    )
    assert "is no window" in capsys.readouterr().err


def test_merge_of_maps_is_the_map_of_both(driven, tmp_path, capsys):
    other = tmp_path / "other.tiles"
    both = tmp_path / "both.tiles"
    for path in (other, both):
        run(capsys, "memory", "build", "street", "any", "--out", path, "--frames", 1, "--agent", "car-2", "--log", "b")
    run(capsys, "memory", "merge", other, driven)
    run(capsys, "memory", "build", "street", "any", "--out", both, "--frames", 2, "--agent", "car-1")
    a, b = TileMap.open(other), TileMap.open(both)
    assert {k: t.record.tobytes() for k, t in a.tiles()} == {k: t.record.tobytes() for k, t in b.tiles()}
    assert a.agents() == b.agents()
    assert a.logs() == b.logs()
    run(capsys, "memory", "rebuild", other, "--without", "car-1")
    assert TileMap.open(other).agents()["car-1"] == "left out by rebuild"


def test_verify_and_repair(tmp_path, capsys):
    path = tmp_path / "m.tiles"
    run(capsys, "memory", "build", "street", "any", "--out", path, "--frames", 1)
    chunk = next((path / "logs/synthetic-street-0").glob("c.*"))
    chunk.write_bytes(chunk.read_bytes()[:-20])
    assert main(["memory", "verify", str(path)]) == 2
    assert "--repair" in capsys.readouterr().err
    assert run(capsys, "memory", "verify", path, "--repair")["repaired"] == 1
    assert run(capsys, "memory", "verify", path)["damaged"] == {}


@pytest.mark.parametrize("name", ["map.png", "map.npz", "map.ply"])
def test_export(driven, tmp_path, capsys, name):
    report = run(capsys, "memory", "export", driven, "--out", tmp_path / name, "--by", "agent")
    assert report["voxels"] > 500
    if name.endswith("png"):
        image = read_image(tmp_path / name)
        assert ((image == (214, 69, 80)).all(-1) | (np.ptp(image.astype(int), axis=-1) > 60)).sum() > 1000
    elif name.endswith("ply"):
        o3d = pytest.importorskip("open3d")
        assert len(o3d.io.read_point_cloud(str(tmp_path / name)).points) == report["voxels"]


def test_three_agents_at_once_make_the_serial_map(tmp_path, capsys):
    report = run(capsys, "crowdsource", "street", "any", "--frames", 3, "--out", tmp_path / "crowd")
    assert report["equal_to_serial"] is True
    assert len(report["ground_m2_by_first_agent"]) == 3
    for name in ("stages.png", "classes.png", "coverage.png"):
        assert read_image(tmp_path / "crowd" / name).std() > 10
