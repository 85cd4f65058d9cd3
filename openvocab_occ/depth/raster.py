"""Exact depth of pinhole cameras by rasterising the faces of a grid: far faster than walking a ray for each pixel."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int32

from openvocab_occ._jit import in_slices, num_threads
from openvocab_occ.depth import _raster_kernels
from openvocab_occ.depth.image import DepthImage
from openvocab_occ.geometry import Camera, GridSpec, invert

# A camera nearer than this to an occupied voxel, in voxels, is left to the ray walk: its faces fill the view edge-on.
MIN_CLEARANCE = 1e-3


@dataclass(frozen=True)
class PixelRays:
    """A pinhole camera in the lattice of a grid: lengths are voxels, per axis, and depth stays z-depth in metres."""

    M: Float[np.ndarray, "3 3"]
    """Pixel (u, v, 1) to the ray's motion a metre of z-depth."""
    P: Float[np.ndarray, "3 3"]
    """Offset from the camera to homogeneous pixel times z-depth; the inverse of M."""
    origin: Float[np.ndarray, " 3"]
    """The camera."""
    stretch: float
    """Longest ray a metre of z-depth, over the pixels, in voxels."""

    @classmethod
    def of(cls, camera: Camera, spec: GridSpec, T_world_grid: Float[np.ndarray, "4 4"]) -> "PixelRays":
        """Express the camera in the lattice."""
        T_grid_cam = invert(T_world_grid) @ camera.T_world_cam
        M = T_grid_cam[:3, :3] @ np.linalg.inv(camera.K) / spec.size[:, None]
        P = camera.K @ T_grid_cam[:3, :3].T * spec.size
        origin = (T_grid_cam[:3, 3] - spec.origin) / spec.size
        # the length of an affine function is convex: greatest at a corner of the image
        corners = np.array([[u, v, 1.0] for u in (0, camera.width - 1) for v in (0, camera.height - 1)])
        return cls(M, P, origin, float(np.linalg.norm(corners @ M.T, axis=1).max()))


def clearance(occupied: Bool[np.ndarray, "x y z"], origin: Float[np.ndarray, " 3"]) -> float:
    """Return the distance from a point to the nearest occupied voxel in voxels, at most 1; 0 inside or touching."""
    cell = np.floor(origin).astype(int)
    low = np.clip(cell - 1, 0, occupied.shape)
    high = np.clip(cell + 2, 0, occupied.shape)
    corners = np.argwhere(occupied[low[0] : high[0], low[1] : high[1], low[2] : high[2]]) + low
    if not len(corners):
        return 1.0
    gap = np.maximum(np.maximum(corners - origin, origin - corners - 1.0), 0.0)
    return min(1.0, float(np.linalg.norm(gap, axis=1).min()))


def raster(
    faces: Int32[np.ndarray, "n 6"], shape: tuple[int, int, int], views: list[tuple[Camera, PixelRays, float]], max_depth: float
) -> list[DepthImage]:
    """Render cameras, each with its clearance, of at least MIN_CLEARANCE.

    A picture is cut into bands of rows so that one camera, too, keeps all threads busy; the result does not depend on it.
    """
    images = [
        DepthImage(np.empty((c.height, c.width), np.float32), np.empty((c.height, c.width), np.int32)) for c, _, _ in views
    ]
    bands = -(-2 * num_threads() // len(views)) if num_threads() > 1 else 1
    extent = np.array(shape)

    def work(start: int, stop: int) -> None:
        for job in range(start, stop):
            (camera, rays, gap), image = views[job // bands], images[job // bands]
            top, bottom = (camera.height * (job % bands + k) // bands for k in (0, 1))
            depth, voxel = image.depth[top:bottom], image.voxel[top:bottom]
            near = 0.999 * gap / rays.stretch
            _raster_kernels.raster(faces, rays.M, rays.P, rays.origin, near, max_depth, top, depth, voxel)
            _raster_kernels.resolve(faces, rays.M, rays.origin, extent, max_depth, top, depth, voxel)

    in_slices(work, len(views) * bands)
    return images
