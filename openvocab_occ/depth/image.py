"""Depth images."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32

_HUGE_PAGE = 1 << 21


@dataclass(frozen=True, eq=False)
class DepthImage:
    """What a camera sees of a grid."""

    depth: Float32[np.ndarray, "h w"]
    """z-depth in metres; max_depth where nothing is seen."""
    voxel: Int32[np.ndarray, "h w"]
    """Flat C-order index of the voxel that is seen; -1 where there is none."""

    @classmethod
    def empty(cls, height: int, width: int) -> "DepthImage":
        """Make room for an image, on whole huge pages where it is large enough: thousands of page faults are saved."""
        size = height * width * 4
        memory = np.empty(2 * size + (_HUGE_PAGE if size >= _HUGE_PAGE else 0), np.uint8)
        start = -memory.ctypes.data % _HUGE_PAGE if size >= _HUGE_PAGE else 0
        depth = memory[start : start + size].view(np.float32).reshape(height, width)
        return cls(depth, memory[start + size : start + 2 * size].view(np.int32).reshape(height, width))
