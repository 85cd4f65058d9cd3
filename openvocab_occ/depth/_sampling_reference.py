"""LMPOcc Eq. 5-9 as printed: sample, look up, take the nearest."""

import numpy as np
from jaxtyping import Bool, Float


def first_sample(
    origin: Float[np.ndarray, " 3"],
    direction: Float[np.ndarray, " 3"],
    occupied: Bool[np.ndarray, "x y z"],
    step: float,
    count: int,
) -> tuple[float, int]:
    """Return i step and the flat index of the voxel, for the first of samples 1..count in an occupied one.

    Where there is none: NaN and -1. In units of voxels: voxel i covers [i, i + 1).
    """
    t = np.arange(1, count + 1) * step
    index = np.floor(origin + t[:, None] * direction)
    inside = ((index >= 0) & (index < occupied.shape)).all(axis=1)
    flat = np.full(count, -1)
    flat[inside] = np.ravel_multi_index(tuple(index[inside].astype(np.int64).T), occupied.shape)
    hit = inside & occupied.ravel()[flat]
    return (float(t[hit][0]), int(flat[hit][0])) if hit.any() else (np.nan, -1)
