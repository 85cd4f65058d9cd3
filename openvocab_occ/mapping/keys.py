"""Keys: which cube of the endless world lattice a point lies in, and how a key is packed into one integer."""

import numpy as np
from jaxtyping import Bool, Float, Int32, Int64

from openvocab_occ.errors import DataError

_FACE_TOLERANCE = 1e-6
"""Voxels: a point this little below a face counts as above it. Centres of a grid whose origin lies half a voxel off the
lattice (Occ3D's z from -1 m in steps of 0.4 m) fall on faces, and rounding would merge layers at random."""
_Y_BITS, _Z_BITS = 24, 16
_LOWER = np.array([-(2**23), -(2**23), -(2**15)])
_UPPER = -_LOWER - 1


def keys_of(points: Float[np.ndarray, "n 3"], voxel_size: float) -> Int32[np.ndarray, "n 3"]:
    """Return floor(p / voxel_size) of points in the world.

    Points further out than 2^23 voxels along x or y, or 2^15 along z, or not finite, raise DataError.
    """
    cells = np.floor(points.astype(np.float64) / voxel_size + _FACE_TOLERANCE)
    if not ((cells >= _LOWER) & (cells <= _UPPER)).all():
        reach = tuple(float(x) for x in -_LOWER * voxel_size)
        raise DataError(
            "points lie outside the reach of the voxel map",
            expected=f"finite, within {reach[0]:g} m of the origin along x and y, {reach[2]:g} m along z",
            got=f"{np.abs(points).max(axis=0).tolist()}",
            fix="subtract a local origin from the poses",
        )
    return cells.astype(np.int32)


def packable(keys: Int32[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Tell which keys fit into a packed integer."""
    ok = np.ones(len(keys), dtype=bool)
    for axis in range(3):
        ok &= (keys[:, axis] >= _LOWER[axis]) & (keys[:, axis] <= _UPPER[axis])
    return ok


def pack(keys: Int32[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """Put x, y, z into 24 + 24 + 16 bits; the integers sort as the keys do, x first."""
    return pack_axes(keys[:, 0], keys[:, 1], keys[:, 2])


def pack_axes(
    x: Int32[np.ndarray, " n"], y: Int32[np.ndarray, " n"], z: Int32[np.ndarray, " n"]
) -> Int64[np.ndarray, " n"]:
    """Pack keys given by axis."""
    packed = x.astype(np.int64)
    packed <<= _Y_BITS
    packed += y  # adding the offsets below makes the lower parts positive
    packed <<= _Z_BITS
    packed += z
    packed += (-int(_LOWER[1]) << _Z_BITS) - int(_LOWER[2])
    return packed


def unpack(packed: Int64[np.ndarray, " n"]) -> Int32[np.ndarray, "n 3"]:
    """Return the keys of packed integers."""
    x = packed >> (_Y_BITS + _Z_BITS)  # arithmetic: keeps the sign
    y = ((packed >> _Z_BITS) & (2**_Y_BITS - 1)) + _LOWER[1]
    z = (packed & (2**_Z_BITS - 1)) + _LOWER[2]
    return np.stack([x, y, z], axis=1).astype(np.int32)
