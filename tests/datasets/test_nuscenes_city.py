"""The tree that the made-up city writes, through the reader of real nuScenes."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from openvocab_occ.datasets import load_sequence
from openvocab_occ.geometry import invert, transform
from openvocab_occ.pipeline.doctor import examine

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    root = tmp_path_factory.mktemp("city") / "tree"
    options = ["--routes", "1", "--traversals", "1", "--frames", "2", "--size", "192", "72", "--out", str(root)]
    subprocess.run([sys.executable, "-m", "openvocab_occ", "city", *options], cwd=ROOT, check=True, capture_output=True)
    return root


def test_tree_reads_as_nuscenes(tree):
    sequence = load_sequence("nuscenes", tree)
    assert sequence.synthetic
    assert len(sequence) == 2
    for frame in sequence:
        assert len(frame.views) == 6
        assert frame.views[0].image.shape == (72, 192, 3)
        assert {"lidar", "lidar_ego", "cam_front_left_ego"} <= set(frame.poses)
        # LiDAR and labels were made of the same meshes: returns lie in labelled voxels, or beside one
        grid = frame.occupancy
        index = grid.spec.index(transform(invert(grid.T_world_grid), transform(frame.T_world_ego, frame.points)))
        index = index[grid.spec.contains(index)]
        near = np.zeros(len(index), bool)
        for step in np.ndindex(3, 3, 3):
            near |= (grid.labels != grid.free_label)[
                tuple(np.clip(index + step - 1, 0, np.array(grid.spec.shape) - 1).T)
            ]
        assert near.mean() > 0.95


def test_doctor_finds_nothing_wrong(tree):
    diagnosis = examine(load_sequence("nuscenes", tree))
    assert diagnosis.clean, [f for f in diagnosis.findings if f.level in ("warning", "error")]
    assert any(f.check == "grid axes" and f.level == "ok" for f in diagnosis.findings)
