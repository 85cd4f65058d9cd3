"""Small maps of both contracts."""

import sys
from pathlib import Path

import jaxtyping
import numpy as np
import pytest

from openvocab_occ.geometry import pose
from openvocab_occ.mapping import Lifted, VoxelMap
from openvocab_occ.objects import EncoderInfo, KeyFrame, NamedCamera, Provenance, SceneMap, group_objects

sys.path.append(str(Path(__file__).parent))  # for block_frames


@pytest.fixture
def unchecked(monkeypatch):
    """Shape checks off, as in a user's hands."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def scene_of(contract, *, seed=0):
    """Three blocks of voxels of different features, seen by two frames."""
    rng = np.random.default_rng(seed)
    blocks = [
        np.argwhere(np.ones(size)) + np.array(at)
        for size, at in [((6, 5, 1), (-3, 0, 0)), ((2, 2, 3), (8, 8, 1)), ((3, 1, 2), (0, 20, 0))]
    ]
    keys = np.concatenate(blocks).astype(np.int32)
    kind = np.repeat([0, 1, 2], [len(b) for b in blocks])
    cells = np.eye(3)[kind] * 0.8 + rng.random((len(keys), 3)) * 0.1
    cells /= cells.sum(1, keepdims=True) if contract == "logits" else np.linalg.norm(cells, axis=1, keepdims=True)
    pixels = rng.integers(1, 9, len(keys)).astype(np.int32)
    sums = (cells * pixels[:, None]).astype(np.float32)
    colors = (rng.integers(0, 256, (len(keys), 3)) * pixels[:, None]).astype(np.float32)
    voxels = VoxelMap(0.4, 3, contract=contract)
    for time in (10.0, 11.5):
        lifted = Lifted(sums, pixels.astype(np.float32), pixels, colors)
        voxels.integrate(keys, lifted, time=time, labels=kind.astype(np.uint8))
    labels = ("road", "truck", "traffic cone") if contract == "logits" else ()
    encoder = EncoderInfo(name="toy", contract=contract, dim=3, labels=labels, fingerprint="ab" * 32)
    K = np.array([[100.0, 0, 32], [0, 100.0, 24], [0, 0, 1]])
    cameras = (
        NamedCamera(K, 64, 48, pose(np.array([1.0, 2.0, 3.0])), name="FRONT"),
        NamedCamera(K, 64, 48, distortion=(0.1, 0.0, 0.0, 0.0), lens="fisheye", name="SIDE"),
    )
    frames = (KeyFrame(0, 10.0, pose(np.array([5.0, 0.0, 0.0])), cameras), KeyFrame(3, 11.5, np.eye(4)))
    names = ("flat", "vehicle", "thing", "free")
    objects = group_objects(voxels, labels=labels, class_names=names)
    made = Provenance(source="test", name="blocks", synthetic=True, options={"max_depth": 60.0}, date="2026-11-22")
    return SceneMap(voxels, objects, encoder, frames, made, names)


@pytest.fixture(params=["logits", "dense"])
def scene(request):
    return scene_of(request.param)
