"""Exact depth of pinhole cameras by rasterising the faces of a grid: far faster than walking a ray for each pixel."""

import numpy as np
from jaxtyping import Bool, Float, Int, Int32

from openvocab_occ._jit import in_slices, num_threads
from openvocab_occ.depth import _raster_kernels
from openvocab_occ.depth.image import DepthImage
from openvocab_occ.geometry import Camera
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.occupancy._rays_kernels import first_hits
from openvocab_occ.occupancy.pixel_rays import PixelRays

MIN_CLEARANCE = 0.02
"""Voxels from the camera to the nearest occupied one. Nearer, or inside, faces fill the view edge-on."""
# Where float64 no longer keeps projected corners within a small part of a pixel: voxels to the camera, pixels of focal
# length, length of a ray a depth of 1 (89.9 degrees off the axis).
_MAX_DISTANCE, _MAX_FOCAL, _MAX_SLANT = 1e5, 1e5, 600.0
_DOUBTS = 16  # one pixel in this many may be in doubt before a band of rows is walked as a whole


def can_raster(camera: Camera, rays: PixelRays, occupied: Bool[np.ndarray, "x y z"]) -> bool:
    """Tell whether the rasteriser is exact for this camera; else its rays have to be walked."""
    fx, _, _, fy, _ = rays.lens
    slant = rays.longest / float(np.linalg.norm(rays.R, axis=0).min())
    return (
        camera.lens == "pinhole"
        and max(fx, fy) < _MAX_FOCAL
        and slant < _MAX_SLANT
        and float(np.abs(rays.origin).max()) < _MAX_DISTANCE
        and clearance(occupied, rays.origin) >= MIN_CLEARANCE
    )


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
    grid: OccupancyGrid, views: list[PixelRays], max_depth: float
) -> list[tuple[DepthImage, Int[np.ndarray, " pixels"]]]:
    """Render cameras for which `can_raster`; with each image the pixels that were in doubt.

    In doubt is a pixel whose ray comes within about a millionth of a pixel of the outline of a face, or of the border
    between two voxels of one, where rounding, or the rule for rays that touch an edge, decides. Those rays are walked,
    so that the image is the walk's throughout. A picture is cut into bands of rows so that one camera, too, keeps all
    threads busy; the result does not depend on it.
    """
    if not views:
        return []
    faces, occupied = grid.faces, grid.occupied
    images = [DepthImage.empty(*v.size) for v in views]
    bands = -(-2 * num_threads() // len(views)) if num_threads() > 1 else 1
    doubts: list[Int[np.ndarray, " pixels"]] = [np.empty(0, np.int64)] * (len(views) * bands)

    def work(start: int, stop: int) -> None:
        for job in range(start, stop):
            rays, image = views[job // bands], images[job // bands]
            top, bottom = (rays.size[0] * (job % bands + k) // bands for k in (0, 1))
            doubts[job] = _band(faces, occupied, rays, max_depth, image, top, bottom)

    in_slices(work, len(views) * bands)
    return [(image, np.concatenate(doubts[k * bands : (k + 1) * bands])) for k, image in enumerate(images)]


def _band(
    faces: Int32[np.ndarray, "n 6"],
    occupied: Bool[np.ndarray, "x y z"],
    rays: PixelRays,
    max_depth: float,
    image: DepthImage,
    top: int,
    bottom: int,
) -> Int[np.ndarray, " pixels"]:
    """Render rows top..bottom, and return the flat indices of the pixels that had to be walked."""
    width = rays.size[1]
    depth, voxel = image.depth[top:bottom], image.voxel[top:bottom]
    M, near = rays.M, 0.999 * clearance(occupied, rays.origin) / rays.longest
    doubt = np.empty(depth.size // _DOUBTS + 64, np.int32)
    found = _raster_kernels.raster(faces, M, np.linalg.inv(M), rays.origin, near, max_depth, top, doubt, depth, voxel)
    if found <= len(doubt):
        found = _raster_kernels.resolve(
            faces, rays.lens, rays.R, rays.origin, occupied.shape, max_depth, top, found, doubt, depth, voxel
        )
    if found <= len(doubt):
        pixels = np.unique(doubt[:found]).astype(np.int64) + top * width
    else:
        pixels = np.arange(top * width, bottom * width)
    directions = rays.directions(pixels)
    t, hit = np.empty(len(pixels), np.float32), np.empty(len(pixels), np.int32)
    first_hits(rays.origin[None], directions, occupied, max_depth, 0, len(pixels), t, hit)
    image.depth.ravel()[pixels], image.voxel.ravel()[pixels] = t, hit
    return pixels
