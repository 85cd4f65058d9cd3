"""Rays through a lattice, by cutting every ray with every voxel. Slow, short, and without any walking."""

import numpy as np
from jaxtyping import Bool, Float


def intervals(
    origin: Float[np.ndarray, " 3"], direction: Float[np.ndarray, " 3"], shape: tuple[int, int, int], t_max: float
) -> tuple[Float[np.ndarray, "x y z"], Float[np.ndarray, "x y z"]]:
    """Return when the ray enters and leaves each voxel, within [0, t_max]; it is in those that have t_in < t_out.

    The slab test of each axis. Voxel (i, j, k) fills [i, i + 1) x [j, j + 1) x [k, k + 1).
    """
    t_in, t_out = np.zeros(shape), np.full(shape, t_max, dtype=np.float64)
    for axis, n in enumerate(shape):
        o, d = origin[axis], direction[axis]
        if d == 0.0:
            inside = np.floor(o) == np.arange(n)
            lower, upper = np.where(inside, -np.inf, np.inf), np.where(inside, np.inf, -np.inf)
        else:
            with np.errstate(over="ignore"):
                planes = (np.arange(n + 1) - o) / d
            lower, upper = np.minimum(planes[:-1], planes[1:]), np.maximum(planes[:-1], planes[1:])
        along = tuple(slice(None) if a == axis else None for a in range(3))
        t_in, t_out = np.maximum(t_in, lower[along]), np.minimum(t_out, upper[along])
    return t_in, t_out


def first_hit(
    origin: Float[np.ndarray, " 3"],
    direction: Float[np.ndarray, " 3"],
    occupied: Bool[np.ndarray, "x y z"],
    t_max: float,
) -> tuple[float, int]:
    """Return t and flat index where the ray enters its first occupied voxel, or t_max and -1."""
    t_in, t_out = intervals(origin, direction, occupied.shape, t_max)
    t_in = np.where(occupied & (t_in < t_out), t_in, np.inf)
    first = int(t_in.argmin())
    return (float(t_in.flat[first]), first) if np.isfinite(t_in.flat[first]) else (t_max, -1)
