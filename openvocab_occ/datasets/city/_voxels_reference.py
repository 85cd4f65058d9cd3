"""What voxels triangles pass through, from the definition: many random points on each."""

import numpy as np
from jaxtyping import Float, Int


def areas_reference(
    corners: Float[np.ndarray, "f 3 3"], labels: Int[np.ndarray, " f"], shape: tuple[int, int, int, int], samples: int
) -> Float[np.ndarray, "x y z c"]:
    """Estimate the area of each class in each voxel; corners are in voxels."""
    rng = np.random.default_rng(0)
    area = np.zeros(shape)
    for (a, b, c), label in zip(corners, labels, strict=True):
        u, v = rng.random((2, samples, 1))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        cells = np.floor(a + u * (b - a) + v * (c - a)).astype(int)
        cells = cells[((cells >= 0) & (cells < shape[:3])).all(axis=1)]
        size = np.linalg.norm(np.cross(b - a, c - a)) / 2
        np.add.at(area, (*cells.T, np.full(len(cells), label)), size / samples)
    return area
