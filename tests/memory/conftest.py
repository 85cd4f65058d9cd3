"""Small maps and random windows."""

from pathlib import Path

import jaxtyping
import numpy as np
import pytest

from openvocab_occ.geometry import GridSpec, matrix_from_wxyz
from openvocab_occ.memory import TileMap
from openvocab_occ.memory.layer import TileKey
from openvocab_occ.memory.schema import CELLS, TILE

NAMES = ("car", "manmade", "vegetation", "free")
SPEC = GridSpec((-4.0, -4.8, -1.0), 0.4, (20, 24, 8))


@pytest.fixture
def city(tmp_path: Path) -> TileMap:
    return TileMap.create(tmp_path / "city.tiles", NAMES, heights=8)


@pytest.fixture
def unchecked(monkeypatch):
    """Shape checks off: bad input meets our own errors, as in a user's hands."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def random_pose(rng: np.random.Generator, *, tilt: float = 0.05, reach: float = 60.0) -> np.ndarray:
    """A pose anywhere within `reach` metres, turned to any side and tilted a little."""
    yaw = rng.uniform(-np.pi, np.pi)
    axis = np.array([*rng.uniform(-tilt, tilt, 2), 1.0])
    T = np.eye(4)
    T[:3, :3] = matrix_from_wxyz([np.cos(yaw / 2), *(np.sin(yaw / 2) * axis / np.linalg.norm(axis))])
    T[:3, 3] = [*rng.uniform(-reach, reach, 2), rng.uniform(-0.5, 0.5)]
    return T


def random_logits(rng: np.random.Generator, spec: GridSpec = SPEC, classes: int = len(NAMES)) -> np.ndarray:
    return rng.normal(0, 2, (*spec.shape, classes)).astype(np.float32)


def probabilities(logits: np.ndarray) -> np.ndarray:
    e = np.exp(logits.astype(np.float64) - logits.max(axis=-1, keepdims=True))
    return e / e.sum(axis=-1, keepdims=True)


def centred(logits: np.ndarray) -> np.ndarray:
    return logits - logits.mean(axis=-1, keepdims=True)


def write(city, logits, mask, T, *, spec=SPEC, stamp=100.0, agent="a", log="one", **more):
    return city.write(logits, mask, T, spec, stamp=stamp, agent=agent, log=log, **more)


def contents(city: TileMap) -> dict[TileKey, bytes]:
    return {key: tile.record.tobytes() for key, tile in city.tiles() if tile.stamps.any()}


def voxel_centers(city: TileMap, key: TileKey) -> np.ndarray:
    """World coordinates [cells, heights, 3] of the voxels of a tile."""
    h, cell = city.schema.heights, city.schema.cell
    x, y, z = np.meshgrid(np.arange(TILE), np.arange(TILE), np.arange(h), indexing="ij")
    index = np.stack([x, y, z], -1) + np.array([key.x * TILE, key.y * TILE, key.floor * h]) + 0.5
    return (index * cell + [0, 0, city.schema.z0]).reshape(CELLS, h, 3)
