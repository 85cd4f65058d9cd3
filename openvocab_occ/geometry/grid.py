"""The lattice of a voxel grid: which metre belongs to which voxel."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from openvocab_occ.arrays import ArrayLike, as_floats
from openvocab_occ.errors import GridError

MAX_VOXELS = 2**31 - 1  # a voxel's flat index is an int32


@dataclass(frozen=True)
class GridSpec:
    """Where a grid lies in its own frame. Voxel i covers [origin + i s, origin + (i + 1) s) along each axis."""

    origin: tuple[float, float, float]
    """Lower corner of voxel (0, 0, 0), metres."""
    voxel_size: float | tuple[float, float, float]
    """Edge of a voxel, metres; three numbers where the axes differ."""
    shape: tuple[int, int, int]
    """Voxels along x, y, z."""

    def __post_init__(self) -> None:
        origin = as_floats(np.asarray(self.origin), (3,), "grid origin")
        sizes = np.asarray(self.voxel_size, dtype=np.float64)
        if sizes.shape not in ((), (3,)) or not np.isfinite(sizes).all() or (sizes <= 0).any():
            raise GridError("voxel size is not usable", expected="one or three lengths above 0 m", got=self.voxel_size)
        shape = np.asarray(self.shape)
        if shape.shape != (3,) or not np.issubdtype(shape.dtype, np.integer) or (shape <= 0).any():
            raise GridError("grid shape is not usable", expected="three positive integers (x, y, z)", got=self.shape)
        if shape.astype(np.float64).prod() > MAX_VOXELS:
            raise GridError(
                "grid is too large",
                expected=f"at most {MAX_VOXELS} voxels",
                got=tuple(shape.tolist()),
                fix="split it into tiles",
            )
        object.__setattr__(self, "origin", tuple(origin.tolist()))
        object.__setattr__(self, "voxel_size", float(sizes) if sizes.ndim == 0 else tuple(sizes.tolist()))
        object.__setattr__(self, "shape", tuple(int(n) for n in shape))

    @property
    def size(self) -> Float[np.ndarray, " 3"]:
        """Edge lengths of a voxel along x, y, z, metres, float64."""
        return np.broadcast_to(np.asarray(self.voxel_size, dtype=np.float64), (3,)).copy()

    @property
    def num_voxels(self) -> int:
        """How many voxels there are."""
        return self.shape[0] * self.shape[1] * self.shape[2]

    @property
    def bounds(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Lower and upper corner of the grid, metres, in its own frame."""
        lower = np.asarray(self.origin)
        return lower, lower + self.size * self.shape

    def centers(self, index: Int[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Return the centres of voxels given by their x, y, z indices, metres."""
        return np.asarray(self.origin) + (index + 0.5) * self.size

    def index(self, points: ArrayLike) -> Int[np.ndarray, "*n 3"]:
        """Return the x, y, z indices of the voxels that hold the points; outside the grid they are out of range."""
        return np.floor((np.asarray(points, dtype=np.float64) - np.asarray(self.origin)) / self.size).astype(np.int64)

    def contains(self, index: Int[np.ndarray, "*n 3"]) -> np.ndarray:
        """Tell which indices lie in the grid, bool[*n]."""
        return np.asarray(((index >= 0) & (index < np.asarray(self.shape))).all(axis=-1))

    def flat(self, index: Int[np.ndarray, "*n 3"]) -> Int[np.ndarray, "*n"]:
        """Return the flat C-order index of each voxel, -1 outside the grid."""
        flat = (index[..., 0] * self.shape[1] + index[..., 1]) * self.shape[2] + index[..., 2]
        return np.where(self.contains(index), flat, -1)

    def unflat(self, flat: Int[np.ndarray, "*n"]) -> Int[np.ndarray, "*n 3"]:
        """Return the x, y, z indices of flat indices."""
        return np.stack(np.unravel_index(flat, self.shape), axis=-1)
