"""Depth images of an occupancy grid (LMPOcc, section III-E)."""

import math
from collections.abc import Sequence
from typing import Literal, get_args, overload

import numpy as np
from jaxtyping import Float, Float32, Int, Int32

from openvocab_occ._jit import in_slices
from openvocab_occ.depth._sampling_kernels import first_samples, samples_from_entry
from openvocab_occ.depth.image import DepthImage as DepthImage
from openvocab_occ.depth.raster import can_raster, raster
from openvocab_occ.depth.smooth import trace_surface
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import Camera
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.occupancy.pixel_rays import PixelRays
from openvocab_occ.occupancy.rays import lattice_rays, trace_lattice
from openvocab_occ.occupancy.tensor_rays import trace_on

_GRAIN = 2048  # rays worth a thread


Surface = Literal["voxel", "smooth"]
_Pixels = Int[np.ndarray, " pixels"]


@overload
def render_depth(
    grid: OccupancyGrid,
    camera: Camera,
    *,
    max_depth: float = ...,
    step: float | None = ...,
    surface: Surface = ...,
    device: str | None = ...,
) -> DepthImage: ...
@overload
def render_depth(
    grid: OccupancyGrid,
    camera: Sequence[Camera],
    *,
    max_depth: float = ...,
    step: float | None = ...,
    surface: Surface = ...,
    device: str | None = ...,
) -> list[DepthImage]: ...
def render_depth(
    grid: OccupancyGrid,
    camera: Camera | Sequence[Camera],
    *,
    max_depth: float = 100.0,
    step: float | None = None,
    surface: Surface = "voxel",
    device: str | None = None,
) -> DepthImage | list[DepthImage]:
    """Render the z-depth of the first occupied voxel in each pixel; several cameras give a list.

    The ray of a pixel runs from the camera's position through the pixel's centre, forward only. Voxels that are not
    known are transparent, and pixels without a ray (beyond a distorted lens) see nothing.

    Args:
        grid: What is seen.
        camera: From where; inside, outside or beside the grid.
        max_depth: Metres. An exact entry counts when it lies before it, a sample when i step <= max_depth in float64.
        step: None for the exact depth at which the ray enters the voxel (0 when the camera is inside it), by the rules
            of `cast_rays`. Else the paper's sampling (Eq. 5-9): the smallest i step, i = 1, 2, ..., whose point lies in
            an occupied voxel. It is late by up to one step, and misses corners thinner than that.
        surface: `voxel`: the faces of voxels, a staircase. `smooth`: where `grid.probability`, trilinear between the
            centres of voxels, first reaches 0.5 (0 where the camera is above it); the voxel is the one of the eight
            around the point that adds most to it. It has logits to go by, or else smoothed labels.
        device: A GPU, as torch names it (`cuda`, `cuda:1`), where exact depth of voxels is walked by Triton and from
            where it is copied back; the same voxels as by the processor but for rays within rounding of an edge.
    """
    _check_length(max_depth, "max_depth")
    if step is not None:
        _check_length(step, "step")
    if surface not in get_args(Surface):
        raise ConfigError("surface is not known", expected=" or ".join(get_args(Surface)), got=surface)
    if surface == "smooth" and step is not None:
        raise ConfigError("a smooth surface is not sampled", expected="step=None", got=step)
    if device is not None and (surface == "smooth" or step is not None):
        raise ConfigError("a GPU renders exact depth of voxels only", expected='surface="voxel", step=None', got=device)
    cameras = [camera] if isinstance(camera, Camera) else list(camera)
    if device is not None:
        images = [_walked_on(device, grid, one, float(max_depth)) for one in cameras]
    elif surface == "smooth":
        images = [_smooth(grid, one, float(max_depth)) for one in cameras]
    elif step is None:
        images = [image for image, _ in _exact(grid, cameras, float(max_depth))]
    else:
        images = _sampled(grid, cameras, float(max_depth), float(step))
    return images[0] if isinstance(camera, Camera) else images


def _check_length(value: float, name: str) -> None:
    if not 0.0 < value < math.inf:
        raise ConfigError(f"{name} is not a length", expected="metres above 0", got=value)


def _exact(grid: OccupancyGrid, cameras: Sequence[Camera], max_depth: float) -> list[tuple[DepthImage, _Pixels | None]]:
    """Render exact depth, with the pixels in doubt of each camera that was rasterised, None for one that was walked."""
    views = [PixelRays.of(camera, grid) for camera in cameras]
    fit = [can_raster(camera, view, grid.occupied) for camera, view in zip(cameras, views, strict=True)]
    rastered = iter(raster(grid, [view for view, one in zip(views, fit, strict=True) if one], max_depth))
    images: list[tuple[DepthImage, _Pixels | None]] = []
    for camera, one in zip(cameras, fit, strict=True):
        if one:
            images.append(next(rastered))
            continue
        depth, voxel = trace_lattice(grid, *_rays(grid, camera), max_depth)
        size = (camera.height, camera.width)
        images.append((DepthImage(depth.reshape(size), voxel.reshape(size)), None))
    return images


def _rays(grid: OccupancyGrid, camera: Camera) -> tuple[Float[np.ndarray, "1 3"], Float[np.ndarray, "n 3"]]:
    """Return position and pixel rays of z-depth 1 in the lattice."""
    if camera.lens == "pinhole":
        view = PixelRays.of(camera, grid)
        return view.origin[None], view.directions(np.arange(camera.height * camera.width))
    rays = camera.rays().reshape(-1, 3) @ camera.T_world_cam[:3, :3].T
    return lattice_rays(grid, camera.position[None], rays)


def _walked_on(device: str, grid: OccupancyGrid, camera: Camera, max_depth: float) -> DepthImage:
    rays = PixelRays.of(camera, grid) if camera.lens == "pinhole" else _rays(grid, camera)
    depth, voxel = trace_on(device, grid, rays, max_depth)
    size = (camera.height, camera.width)
    return DepthImage(depth.reshape(size), voxel.reshape(size))


def _smooth(grid: OccupancyGrid, camera: Camera, max_depth: float) -> DepthImage:
    origins, directions = _rays(grid, camera)
    depth, voxel = trace_surface(grid, origins[0], directions, max_depth)
    size = (camera.height, camera.width)
    return DepthImage(depth.reshape(size), voxel.reshape(size))


def _sampled(grid: OccupancyGrid, cameras: Sequence[Camera], max_depth: float, step: float) -> list[DepthImage]:
    """Sample each ray from where it enters a voxel on, and from the camera on where that is in doubt."""
    count = num_samples(max_depth, step)
    images: list[DepthImage] = []
    for camera, (image, doubt) in zip(cameras, _exact(grid, cameras, max_depth * (1.0 + 1e-6)), strict=True):
        depth, voxel = image.depth.reshape(-1), image.voxel.reshape(-1)
        if doubt is None:
            origins, directions = _rays(grid, camera)
            _sample(grid, origins[0], directions, step, count, depth, voxel)
        else:
            _sample_from_entry(grid, PixelRays.of(camera, grid), doubt, step, count, image)
        depth[voxel < 0] = max_depth
        images.append(image)
    return images


def _sample_from_entry(
    grid: OccupancyGrid, view: PixelRays, doubt: _Pixels, step: float, count: int, image: DepthImage
) -> None:
    depth, voxel, occupied = image.depth, image.voxel, grid.occupied
    in_slices(
        lambda start, stop: samples_from_entry(
            view.lens, view.R, view.origin, occupied, step, count, start, stop, depth, voxel
        ),
        view.size[0],
    )
    t, hit = np.empty(len(doubt), np.float32), np.empty(len(doubt), np.int32)
    _sample(grid, view.origin, view.directions(doubt), step, count, t, hit)
    depth.reshape(-1)[doubt], voxel.reshape(-1)[doubt] = t, hit


def _sample(
    grid: OccupancyGrid,
    origin: Float[np.ndarray, " 3"],
    directions: Float[np.ndarray, "n 3"],
    step: float,
    count: int,
    out_t: Float32[np.ndarray, " n"],
    out_voxel: Int32[np.ndarray, " n"],
) -> None:
    occupied = grid.occupied
    in_slices(
        lambda start, stop: first_samples(origin, directions, occupied, step, count, start, stop, out_t, out_voxel),
        len(directions),
        grain=_GRAIN,
    )


def num_samples(max_depth: float, step: float) -> int:
    """Return the largest i with i step <= max_depth, as float64 sees it (1000 samples of 0.1 m in 100 m)."""
    count = int(max_depth / step)
    while (count + 1) * step <= max_depth:
        count += 1
    while count * step > max_depth:
        count -= 1
    return count
