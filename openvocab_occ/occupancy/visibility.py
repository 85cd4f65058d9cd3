"""Which voxels cameras see: the masks that keep what was not observed out of a map (LMPOcc, section III-D)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, UInt8

from openvocab_occ._jit import in_slices
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import Camera, transform
from openvocab_occ.occupancy._rays_kernels import centers_in_view, mark_reached, mark_seen
from openvocab_occ.occupancy.grid import OccupancyGrid
from openvocab_occ.occupancy.pixel_rays import PixelRays
from openvocab_occ.occupancy.rays import lattice_rays

Mode = Literal["center", "pixel", "frustum"]
_GRAIN = 2048  # rays worth a thread


@dataclass(frozen=True, eq=False)
class Visibility:
    """What cameras see of a grid, and by which rule: masks of different rules must not be mixed unknowingly."""

    mask: Bool[np.ndarray, "x y z"]
    """True where a voxel is seen."""
    mode: Mode
    """The rule; see `observe`."""
    max_hits: int
    """Occupied voxels after which a ray of mode `pixel` ends."""
    stride: int | None
    """Pixels from one ray of mode `pixel` to the next, as it was asked for."""


def visibility_mask(
    grid: OccupancyGrid,
    cameras: Camera | Sequence[Camera],
    *,
    mode: Mode = "center",
    max_hits: int = 1,
    stride: int | None = None,
) -> Bool[np.ndarray, "x y z"]:
    """Tell which voxels at least one camera sees: the mask of `observe`, without the record of how it was made."""
    return observe(grid, cameras, mode=mode, max_hits=max_hits, stride=stride).mask


def observe(
    grid: OccupancyGrid,
    cameras: Camera | Sequence[Camera],
    *,
    mode: Mode = "center",
    max_hits: int = 1,
    stride: int | None = None,
) -> Visibility:
    """Find the voxels, free or occupied, that at least one camera sees, and record by which rule.

    Voxels that are not known hide nothing and are never seen. No rule gives the published masks of Occ3D: the file
    in hand agrees best with `pixel` and max_hits=8.

    Args:
        grid: What is seen.
        cameras: From where. A camera in an occupied voxel sees no other.
        mode: `center`, the paper's text: a voxel is seen when its centre is on an image and no other occupied voxel is
            on the line to it. `pixel`: when a ray through a pixel is in it for some length, up to and with the first
            occupied voxel. `frustum`: when its centre is on an image.
        max_hits: Of mode `pixel`: rays go on to the so-many-th occupied voxel.
        stride: Of mode `pixel`: rays through every so-many-th pixel in both directions. By default as many as keep
            neighbouring rays within a voxel of each other as far as the grid reaches: 8 in Occ3D's grid and images of
            1600 pixels. Fewer find more of what is seen at a slant; cost goes with the number of rays.
    """
    if mode not in get_args(Mode):
        raise ConfigError("visibility mode is not known", expected=" or ".join(get_args(Mode)), got=mode)
    for value, name in ((max_hits, "max_hits"), (stride, "stride")):
        if value is not None and value < 1:
            raise ConfigError(f"{name} counts nothing", expected="1 or more", got=value)
    bordered = np.pad(grid.occupied.view(np.uint8), 1, constant_values=4)
    seen = np.zeros(grid.spec.shape, dtype=np.uint8)
    for camera in [cameras] if isinstance(cameras, Camera) else cameras:
        if mode == "pixel":
            _mark_along_pixels(grid, camera, max_hits, stride or _stride(grid, camera), bordered)
        elif mode == "frustum":
            seen |= _in_view(grid, camera)
        else:
            _mark_centers(grid, camera, seen)
    if mode == "pixel":
        seen = bordered[1:-1, 1:-1, 1:-1] & 2
    mask = seen != 0 if grid.known is None else (seen != 0) & grid.known
    return Visibility(mask, mode, max_hits, stride)


def _stride(grid: OccupancyGrid, camera: Camera) -> int:
    """Return the pixels in which rays come a voxel apart at the far end of the grid."""
    corners = np.array(list(np.ndindex(2, 2, 2))) * grid.spec.shape
    places = transform(grid.T_world_grid, corners * grid.spec.size + np.asarray(grid.spec.origin))
    far = float(np.linalg.norm(places - camera.position, axis=1).max())
    return max(1, int(float(grid.spec.size.min()) * min(camera.K[0, 0], camera.K[1, 1]) / far))


def _mark_along_pixels(
    grid: OccupancyGrid, camera: Camera, max_hits: int, stride: int, out: UInt8[np.ndarray, "x y z"]
) -> None:
    """Cast rays through the middles of stride x stride pixels, and mark what they see in a bordered grid."""
    rows, columns = (np.arange(min(stride // 2, n - 1), n, stride) for n in (camera.height, camera.width))
    v, u = np.meshgrid(rows, columns, indexing="ij")
    if camera.lens == "pinhole":
        view = PixelRays.of(camera, grid)
        origin, directions = view.origin, view.directions((v * camera.width + u).ravel())
    else:
        rays = camera.unproject(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64))
        origins, directions = lattice_rays(grid, camera.position[None], rays @ camera.T_world_cam[:3, :3].T)
        origin = origins[0]
    in_slices(
        lambda start, stop: mark_seen(origin, directions, max_hits, start, stop, out),
        len(directions),
        grain=_GRAIN,
    )


def _in_view(grid: OccupancyGrid, camera: Camera) -> UInt8[np.ndarray, "x y z"]:
    """Return 1 where a voxel's centre is on the image."""
    if camera.lens == "pinhole":
        out = np.empty(grid.spec.shape, dtype=np.uint8)
        view = PixelRays.of(camera, grid)
        P = np.linalg.inv(view.M)
        in_slices(
            lambda start, stop: centers_in_view(P, view.origin, camera.width, camera.height, start, stop, out),
            grid.spec.shape[0],
            grain=8,
        )
        return out
    pixels, _ = camera.project(grid.centers(np.arange(grid.spec.num_voxels)))
    return camera.inside(pixels).reshape(grid.spec.shape).astype(np.uint8)  # NaN pixels are not inside


def _mark_centers(grid: OccupancyGrid, camera: Camera, seen: UInt8[np.ndarray, "x y z"]) -> None:
    candidates, occupied = _in_view(grid, camera), grid.occupied
    if grid.known is not None:
        candidates &= grid.known
    origin = lattice_rays(grid, camera.position[None], np.zeros((0, 3)))[0][0]
    in_slices(
        lambda start, stop: mark_reached(origin, candidates, occupied, start, stop, seen), grid.spec.shape[0], grain=4
    )
