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
    logits: np.ndarray, known: np.ndarray, low: np.ndarray, T_world_ego: np.ndarray, spec: GridSpec, z0: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return what a dense map in memory, of cells of 0.4 m with voxel `low` first, knows of a grid."""
    index = np.stack(np.meshgrid(*(np.arange(n) for n in spec.shape), indexing="ij"), axis=-1)
    world = transform(T_world_ego, np.asarray(spec.centers(index)))
    where = np.floor((world - [0, 0, z0]) / 0.4 + FACE).astype(int) - low
    inside = np.asarray(((where >= 0) & (where < known.shape)).all(axis=-1))
    x, y, z = np.moveaxis(np.where(inside[..., None], where, 0), -1, 0)
    seen = inside & known[x, y, z]
    return np.where(seen[..., None], logits[x, y, z], 0), seen
