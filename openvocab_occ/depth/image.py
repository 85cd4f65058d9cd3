"""Depth images."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32


@dataclass(frozen=True, eq=False)
class DepthImage:
    """What a camera sees of a grid."""

    depth: Float32[np.ndarray, "h w"]
    """z-depth in metres; max_depth where nothing is seen."""
    voxel: Int32[np.ndarray, "h w"]
    """Flat C-order index of the voxel that is seen; -1 where there is none."""
