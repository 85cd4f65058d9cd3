"""Rays that are torch tensors: walked where they are, on a GPU by a Triton kernel."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int32

from openvocab_occ.errors import ConfigError, DataError, MissingExtraError, ShapeError
from openvocab_occ.geometry import invert

if TYPE_CHECKING:
    from openvocab_occ.occupancy.grid import OccupancyGrid
    from openvocab_occ.occupancy.pixel_rays import PixelRays


@runtime_checkable
class Tensor(Protocol):
    """What tells a torch.Tensor from an array, without loading torch."""

    def data_ptr(self) -> int:
        """Return where the first element is."""
        ...

    def detach(self) -> Any:
        """Return it without its gradient."""
        ...


@dataclass(frozen=True, eq=False)
class TensorHits:
    """Where rays first enter an occupied voxel, as tensors on the device of the rays."""

    distance: Any
    """f32[n], metres along the normalised direction; max_range where there is no hit."""
    voxel: Any
    """i32[n], flat C-order index of the voxel; -1 where there is no hit."""


def lattice_tensors(grid: "OccupancyGrid", origins: Any, directions: Any) -> tuple[Any, Any]:
    """Check rays that are tensors, and return them in units of voxels, f64, with directions of 1 m."""
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ShapeError("ray directions has the wrong shape", expected="(any, 3)", got=tuple(directions.shape))
    starts = origins.detach().double().reshape(-1, 3) if origins.shape[-1:] == (3,) else origins
    if len(starts) not in (1, len(directions)) or starts.shape[-1:] != (3,):
        raise ShapeError("ray origins has the wrong shape", expected=tuple(directions.shape), got=tuple(origins.shape))
    if starts.device != directions.device:
        raise DataError("rays are on two devices", expected=directions.device, got=starts.device)
    rays = directions.detach().double()
    largest = rays.abs().amax(1, keepdim=True)
    bad = int(((largest == 0.0) | largest.isinf()).sum())
    if bad or not bool(starts.isfinite().all()):
        raise DataError("rays are not rays", expected="finite origins; finite directions that are not zero", got=bad)
    rays = rays / largest
    rays = rays / rays.norm(dim=1, keepdim=True)
    T = invert(grid.T_world_grid)
    to_lattice = starts.new_tensor(T[:3, :3] / grid.spec.size[:, None])
    shift = starts.new_tensor((T[:3, 3] - np.asarray(grid.spec.origin)) / grid.spec.size)
    return starts @ to_lattice.T + shift, rays @ to_lattice.T


def cast_tensors(grid: "OccupancyGrid", origins: Any, directions: Any, max_range: float = math.inf) -> TensorHits:
    """Cast rays that are on a GPU; the rules are those of `cast_rays`.

    Raises:
        MissingExtraError: Triton is not installed; it comes with torch's builds for GPUs.
    """
    return TensorHits(*_walk(grid, *lattice_tensors(grid, origins, directions), max_range))


def trace_on(
    device: str, grid: "OccupancyGrid", rays: "PixelRays | tuple[np.ndarray, np.ndarray]", t_max: float
) -> tuple[Float32[np.ndarray, " n"], Int32[np.ndarray, " n"]]:
    """Do as `rays.trace_lattice` on a device, for rays of a pinhole camera or any that are in units of voxels.

    Raises:
        ConfigError: There is no such device.
        MissingExtraError: Triton is not installed.
    """
    triton = _triton()
    try:
        place = triton.torch.empty(0, device=device).device
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(
            "torch cannot use this device", expected="a GPU and a build of torch for it", got=device, fix="leave it out"
        ) from error
    if isinstance(rays, tuple):
        starts, steps = (triton.torch.from_numpy(a).to(place) for a in rays)
    else:
        starts = triton.torch.from_numpy(rays.origin[None]).to(place)
        steps = triton.pixel_rays(rays.lens.tolist(), rays.R.tolist(), rays.size, place)
    t, voxel = _walk(grid, starts, steps, t_max)
    return t.cpu().numpy(), voxel.cpu().numpy()


def _walk(grid: "OccupancyGrid", starts: Any, steps: Any, t_max: float) -> tuple[Any, Any]:
    triton = _triton()
    occupied = starts.new_tensor(grid.occupied.view(np.uint8), dtype=triton.torch.uint8)
    return triton.first_hits(starts, steps, occupied, t_max)


def _triton() -> Any:
    try:
        from openvocab_occ.occupancy import _rays_triton
    except ImportError as error:
        raise MissingExtraError(
            "Triton is not installed", fix="pip install triton, or stay on the processor"
        ) from error
    return _rays_triton
