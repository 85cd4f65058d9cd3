"""The same as `_tiles_kernels`, from the definitions: whole-array numpy and Python's own order of tuples."""

import numpy as np

from openvocab_occ.geometry import GridSpec, invert, transform

FACE = 1e-6  # voxels below a face that count as above it


def rows_of_voxels(centers: np.ndarray, T_world_ego: np.ndarray, spec: GridSpec, rows: np.ndarray) -> np.ndarray:
    """Return rows[x, y, z] of the grid voxel that holds each world point, -1 where none does."""
    index = spec.index(transform(invert(T_world_ego), centers) + FACE * spec.size)
    inside = np.asarray(spec.contains(index))
    found = np.full(inside.shape, -1)
    found[inside] = rows[tuple(index[inside].T)]
    return found


def greatest(records: list[tuple[int, int, bytes]]) -> tuple[int, int, bytes]:
    """Return the record that a voxel keeps of all that were written to it in any order; (0, 0, b"") if none."""
    return max(records, default=(0, 0, b""))


def window(
    voxels: dict[tuple[int, int, int], np.ndarray], T_world_ego: np.ndarray, spec: GridSpec, cell: float, z0: float
) -> dict[tuple[int, int, int], np.ndarray]:
    """Return the logits of the map voxel nearest to each grid voxel's centre, where there is one."""
    index = np.stack(np.meshgrid(*(np.arange(n) for n in spec.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    world = transform(T_world_ego, np.asarray(spec.centers(index)))
    keys = np.floor((world - [0, 0, z0]) / cell + FACE).astype(int)
    pairs = zip(map(tuple, index.tolist()), map(tuple, keys.tolist()), strict=True)
    return {where: voxels[key] for where, key in pairs if key in voxels}  # pyright: ignore
