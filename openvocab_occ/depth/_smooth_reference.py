"""First crossing of a trilinear field by marching in small steps through SciPy's interpolation."""

import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import map_coordinates


def first_crossing(
    origin: Float[np.ndarray, " 3"],
    direction: Float[np.ndarray, " 3"],
    field: Float32[np.ndarray, "x y z"],
    t_max: float,
    step: float,
) -> float:
    """Return the first i step, i = 0, 1, ..., below t_max at which the field is 0.5 or more; t_max if there is none.

    In units of voxels: the field has value [i, j, k] at (i + 0.5, j + 0.5, k + 0.5), and 0 one voxel outside.
    """
    t = np.arange(0.0, t_max, step)
    points = origin + t[:, None] * direction + 0.5
    values = map_coordinates(np.pad(field.astype(np.float64), 1), points.T, order=1, mode="constant", cval=0.0)
    above = np.flatnonzero(values >= 0.5)
    return float(t[above[0]]) if len(above) else t_max
