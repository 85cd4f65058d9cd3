"""The surface of a grid: exposed voxel faces, merged into rectangles."""

import numpy as np
from jaxtyping import Bool, Int32, UInt64

from openvocab_occ._jit import in_slices
from openvocab_occ.occupancy import _faces_kernels


def exposed_faces(occupied: Bool[np.ndarray, "x y z"]) -> Int32[np.ndarray, "n 6"]:
    """Return the faces between an occupied voxel and a free one or the outside, as few rectangles.

    Columns are kind, plane, a0, a1, b0, b1. kind = 2 axis + side; side 1 faces up the axis. The rectangle lies at index
    `plane` of its axis and covers [a0, a1) x [b0, b1) voxels of the two other axes, in their order. No two overlap.
    Rectangles end at multiples of 64 voxels along z (along y for faces across z). Sorted by kind.
    """
    X, Y, Z = occupied.shape
    columns: UInt64[np.ndarray, "x y c"] = np.empty((X, Y, (Z + 63) // 64), np.uint64)
    in_slices(lambda a, b: _faces_kernels.pack_columns(occupied[a:b], columns[a:b]), X, grain=64)
    found: list[np.ndarray] = [np.empty((0, 6), np.int32)] * 6

    def of_kind(kind: int) -> None:
        axis, side = divmod(kind, 2)
        out = np.empty((1 << 14, 6), np.int32)
        while True:
            if axis == 0:
                n = _faces_kernels.faces_x(columns, side, out)
            elif axis == 1:
                n = _faces_kernels.faces_y(columns, side, out)
            else:
                n = _faces_kernels.faces_z(columns, Z, side, out)
            if n <= len(out):
                found[kind] = out[:n]
                return
            out = np.empty((n, 6), np.int32)  # the count was right though the room was not

    def of_kinds(start: int, stop: int) -> None:
        for kind in range(start, stop):
            of_kind(kind)

    in_slices(of_kinds, 6)
    return np.concatenate(found)
