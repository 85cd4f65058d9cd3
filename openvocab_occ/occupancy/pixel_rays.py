"""The rays of a pinhole camera in the lattice of a grid, by one formula for all who need their exact bits."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from openvocab_occ.geometry import Camera
from openvocab_occ.occupancy.grid import OccupancyGrid
from openvocab_occ.occupancy.rays import lattice_rays


@dataclass(frozen=True, eq=False)
class PixelRays:
    """A pinhole camera in the lattice of a grid: lengths are voxels, per axis, but depth stays z-depth in metres.

    The ray of pixel (u, v) at depth t is origin + t d, d = (R0 x + R1 y) + R2 with y = (v - cy) / fy and
    x = ((u - cx) - skew y) / fx, in this order of float64 operations. Kernels repeat it, so that all agree to the bit;
    rays along an axis come out as such.
    """

    lens: Float[np.ndarray, " 5"]
    """fx, skew, cx, fy, cy."""
    R: Float[np.ndarray, "3 3"]
    """Camera axes, in voxels a metre."""
    origin: Float[np.ndarray, " 3"]
    """The camera."""
    size: tuple[int, int]
    """Height and width of the image."""

    @classmethod
    def of(cls, camera: Camera, grid: OccupancyGrid) -> "PixelRays":
        """Express the camera in the lattice of the grid."""
        origin, axes = lattice_rays(grid, camera.position[None], np.ascontiguousarray(camera.T_world_cam[:3, :3].T))
        K = camera.K
        lens = np.array([K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2]])
        return cls(lens, np.ascontiguousarray(axes.T), origin[0], (camera.height, camera.width))

    def directions(self, pixels: Int[np.ndarray, " pixels"]) -> Float[np.ndarray, "pixels 3"]:
        """Return the rays of pixels given by flat index, of z-depth 1."""
        fx, skew, cx, fy, cy = self.lens
        v, u = np.divmod(pixels, self.size[1])
        y = (v - cy) / fy
        x = ((u - cx) - skew * y) / fx
        return np.stack([(row[0] * x + row[1] * y) + row[2] for row in self.R], axis=1)

    @property
    def M(self) -> Float[np.ndarray, "3 3"]:
        """Pixel (u, v, 1) to its ray, up to rounding."""
        fx, skew, cx, fy, cy = self.lens
        return self.R @ np.linalg.inv(np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]))

    @property
    def longest(self) -> float:
        """Length of the longest ray of z-depth 1 m, in voxels: convex in the pixel, so greatest at a corner."""
        height, width = self.size
        corners = np.array([0, width - 1, (height - 1) * width, height * width - 1])
        return float(np.linalg.norm(self.directions(corners), axis=1).max())
