"""`occ train`, `eval` and `predict` on a tree in nuScenes' and Occ3D's format, as docs/reproduce.md calls them."""

import json

import numpy as np
import pytest

from openvocab_occ.cli import main
from openvocab_occ.datasets import load_sequence
from openvocab_occ.datasets.city.writer import CityOptions, write_city
from openvocab_occ.networks.flashocc import MICRO
from openvocab_occ.occupancy import OCC3D_FREE
from openvocab_occ.training.drives import by_place
from openvocab_occ.training.samples import pool_any
from openvocab_occ.training.sources import drives_of

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    root = tmp_path_factory.mktemp("nuscenes") / "tree"
    write_city(root, CityOptions(seed=811, routes=1, traversals=2, frames=2, size=(192, 72)))
    return root


@pytest.fixture(scope="module")
def scenes(tree):
    lists = json.loads((tree / "annotations.json").read_text())
    return lists["train_split"] + lists["val_split"]


def test_samples_are_the_trees(tree, scenes, tmp_path):
    masks = f"{tree}/gts/{{scene}}/{{token}}/labels.npz"
    sequences = [lambda name=name: load_sequence("nuscenes", tree, scene=name) for name in reversed(scenes)]
    drives = drives_of(sequences, MICRO, tmp_path, masks=masks)
    places = by_place(drives)
    assert list(places) == ["synthetic-city-811"]
    assert [d.info.scene for d in places["synthetic-city-811"]] == scenes  # in order of time
    assert len({d.info.log for d in drives}) == 2
    for drive in drives:
        assert drive.images.shape == (2, 6, 48, 128, 3)
        assert drive.labels.shape == (2, *MICRO.shape)
        for f, frame in enumerate(load_sequence("nuscenes", tree, scene=drive.info.scene)):
            with np.load(tree / "gts" / drive.info.scene / frame.token / "labels.npz") as held:
                seen = pool_any(held["mask_camera"].astype(bool), 2)[25:75, 25:75]
                full = pool_any((held["semantics"] != OCC3D_FREE) & held["mask_lidar"].astype(bool), 2)[25:75, 25:75]
            assert (drive.mask[f] <= seen).all()
            assert drive.mask[f].sum() > 0.9 * seen.sum()
            np.testing.assert_array_equal(drive.labels[f] != OCC3D_FREE, full)
            np.testing.assert_allclose(drive.poses[f], frame.T_world_ego)


def test_commands_run_on_the_tree(tree, scenes, tmp_path, capsys):
    def run(*words: str) -> dict:
        assert main(["occ", *map(str, words), "--network", "flashocc-micro", "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    masks = ("--masks", f"{tree}/gts/{{scene}}/{{token}}/labels.npz", "--drives", tmp_path / "samples")
    every = [word for scene in scenes for word in ("--scene", scene)]
    base = run(
        "train", "nuscenes", tree, "--split", "train", *masks, "--out", tmp_path / "b", "--steps", 2, "--batch", 2
    )
    assert (base["drives"], base["places"], base["synthetic"]) == (1, 1, True)
    more = ("--base", base["weights"], "--prior-from", "all", "--steps", 2, "--batch", 2)
    lmop = run("train", "nuscenes", tree, *every, *masks, "--out", tmp_path / "m", *more)
    assert lmop["drives"] == 2
    found = run("eval", "nuscenes", tree, *every, *masks, "--weights", lmop["weights"], "--prior-from", "other_logs")
    assert found["frames"] == 4
    assert found["with_prior"]["mIoU"] >= 0
    assert set(found["by_condition"]) <= {"clear", "rain", "night"}
    assert found["by_condition"]
    for scene in scenes:
        written = run("predict", "nuscenes", tree, "--scene", scene, "--weights", lmop["weights"], "--out",
                      tmp_path / "pred", "--memory", tmp_path / "c.tiles")  # fmt: skip
        assert written["files"] == 2
    back = load_sequence("nuscenes", tree, scene=scenes[0], occupancy=str(tmp_path / "pred" / "{token}.npz"))
    assert all(frame.occupancy.labels.shape == (200, 200, 16) for frame in back)
