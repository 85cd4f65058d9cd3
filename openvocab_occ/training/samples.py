"""From frames of any drive to what a network learns from: fitted images, labels on its voxels, what cameras saw."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from openvocab_occ.datasets.frame import Frame
from openvocab_occ.errors import DataError, GridError, ShapeError
from openvocab_occ.geometry import GridSpec
from openvocab_occ.networks.flashocc import FlashOccConfig
from openvocab_occ.networks.predictor import FittedViews, fit_views
from openvocab_occ.occupancy import OCC3D_CLASSES, OccupancyGrid, visibility_mask

CameraMasks = Callable[[Frame], Bool[np.ndarray, "x y z"] | None]
"""Gives a frame its published mask, such as Occ3D's `mask_camera`; None computes one."""
_SAME = 1e-6  # voxels; by which lattices that agree may differ


@dataclass(frozen=True, eq=False)
class Sample:
    """One frame."""

    views: FittedViews
    labels: UInt8[np.ndarray, "x y z"]
    mask: Bool[np.ndarray, "x y z"]
    """What the cameras see: the voxels that count in losses and scores."""
    T_world_ego: Float64[np.ndarray, "4 4"]
    stamp: float
    """Unix seconds."""
    origin: Float64[np.ndarray, " 3"]
    """Where the LiDAR stands in the ego frame, metres: RayIoU's rays begin there."""


def sample_of(frame: Frame, config: FlashOccConfig, *, masks: CameraMasks | None = None) -> Sample:
    """Make a sample of a frame with occupancy; its whole grid is pooled to voxels of the network's size.

    Raises:
        DataError: The frame has no views, or its images are blank or of too little size.
        GridError: It has no occupancy, or that cannot be pooled to the network's voxels.
    """
    if frame.occupancy is None:
        raise GridError(f"frame {frame.index} has no occupancy", expected="labels to learn from")
    check_images(frame, config)
    grid = pool_grid(frame.occupancy, _pooled_spec(frame.occupancy.spec, config.cell))
    seen = None if masks is None else masks(frame)
    if seen is None:
        seen = visibility_mask(grid, [view.camera for view in frame.views], mode="pixel", stride=_stride(frame))
    else:
        seen = pool_any(seen, _factor(frame.occupancy.spec, grid.spec))
        if grid.known is not None:
            seen &= grid.known
    lidar = frame.poses.get("lidar")
    origin = np.array([0.94, 0.0, 1.84]) if lidar is None else (np.linalg.inv(frame.T_world_ego) @ lidar)[:3, 3]
    return Sample(fit_views(frame, config), grid.labels, seen, frame.T_world_ego, float(frame.timestamp), origin)


def check_images(frame: Frame, config: FlashOccConfig, *, cameras: int | None = None) -> None:
    """Refuse what a network would silently turn into noise.

    Raises:
        DataError: There are no views or fewer than `cameras`, or an image is far smaller than the network's input.
    """
    if not frame.views or (cameras is not None and len(frame.views) < cameras):
        raise DataError(
            f"frame {frame.index} lacks cameras", expected=f"{cameras or 'at least 1'} views", got=len(frame.views),
            fix="train and predict with the cameras that there are, or drop the frame",
        )  # fmt: skip
    height, width = config.image_size
    for view in frame.views:
        if view.camera.height * 4 < height or view.camera.width * 4 < width:
            raise DataError(
                f"view {view.name!r} is too small for the network", expected=f"about {width} x {height} pixels",
                got=f"{view.camera.width} x {view.camera.height}", fix="give larger images",
            )  # fmt: skip


def network_spec(config: FlashOccConfig) -> GridSpec:
    """Return the grid of a network's logits, in the ego frame."""
    return GridSpec(config.lower, config.cell, config.shape)


def pool_grid(grid: OccupancyGrid, spec: GridSpec) -> OccupancyGrid:
    """Return a grid on a coarser lattice with the same corner, or itself; see `pool_labels`.

    Raises:
        GridError: The lattices do not fit, or the classes are not Occ3D's.
    """
    if grid.class_names != OCC3D_CLASSES:
        raise GridError("the grid has other classes than the network", expected=", ".join(OCC3D_CLASSES),
                        got=", ".join(grid.class_names), fix="map them to Occ3D's first")  # fmt: skip
    factor = _factor(grid.spec, spec)
    if factor == 1:
        return grid
    known = None if grid.known is None else pool_any(grid.known, factor)
    labels = grid.labels if grid.known is None else np.where(grid.known, grid.labels, np.uint8(grid.free_label))
    return OccupancyGrid(pool_labels(labels, factor, grid.free_label), spec, grid.T_world_grid, known=known)


def pool_labels(labels: UInt8[np.ndarray, "x y z"], factor: int, free: int) -> UInt8[np.ndarray, "x2 y2 z2"]:
    """Give each block of voxels the class most frequent among its occupied ones (the lowest of equals); free if none.

    One occupied voxel makes the block occupied: surfaces a voxel thick stay whole.
    """
    blocks = _blocks(labels, factor)
    best = np.full(blocks.shape[:3], free, np.uint8)
    most = np.zeros(blocks.shape[:3], np.int32)
    for label in np.unique(labels):
        if label != free:
            count = (blocks == label).sum(axis=-1, dtype=np.int32)
            better = count > most
            best[better], most[better] = label, count[better]
    return best


def pool_any(mask: Bool[np.ndarray, "x y z"], factor: int) -> Bool[np.ndarray, "x2 y2 z2"]:
    """Tell which blocks have a voxel in the mask."""
    return np.asarray(_blocks(mask, factor).any(axis=-1))


def spread(labels: UInt8[np.ndarray, "x y z"], factor: int) -> UInt8[np.ndarray, "x2 y2 z2"]:
    """Repeat each voxel in all directions: the other way of `pool_labels`."""
    for axis in range(3):
        labels = labels.repeat(factor, axis=axis)
    return labels


def crop(spec: GridSpec, inner: GridSpec) -> tuple[slice, slice, slice]:
    """Return which voxels of a grid make up an inner one with voxels of the same size.

    Raises:
        GridError: It does not lie inside, or between the voxels.
    """
    start = (np.asarray(inner.origin) - np.asarray(spec.origin)) / spec.size
    first = np.round(start).astype(int)
    ends = first + inner.shape
    fits = np.allclose(spec.size, inner.size, atol=_SAME) and np.allclose(start, first, atol=1e-3)
    if not fits or (first < 0).any() or (ends > spec.shape).any():
        raise GridError("the labels do not cover the network's grid", expected=inner, got=spec,
                        fix="make the drives anew for this network")  # fmt: skip
    x, y, z = (slice(int(a), int(b)) for a, b in zip(first, ends, strict=True))
    return x, y, z


def _pooled_spec(spec: GridSpec, cell: float) -> GridSpec:
    factor = round(cell / float(spec.size[0]))
    shape = tuple(n // max(factor, 1) for n in spec.shape)
    return GridSpec(spec.origin, (cell, cell, cell), (shape[0], shape[1], shape[2]))


def _blocks(array: np.ndarray, factor: int) -> np.ndarray:
    """[x, y, z] to [x / f, y / f, z / f, f f f]."""
    if any(n % factor for n in array.shape):
        raise ShapeError("the grid cannot be split into blocks", expected=f"multiples of {factor}", got=array.shape)
    x, y, z = (n // factor for n in array.shape)
    return array.reshape(x, factor, y, factor, z, factor).transpose(0, 2, 4, 1, 3, 5).reshape(x, y, z, factor**3)


def _factor(fine: GridSpec, coarse: GridSpec) -> int:
    ratio = np.asarray(coarse.size) / np.asarray(fine.size)
    factor = round(float(ratio[0]))
    fits = (
        factor >= 1
        and np.allclose(ratio, factor, atol=_SAME)
        and np.allclose(fine.origin, coarse.origin, atol=_SAME)
        and tuple(n * factor for n in coarse.shape) == tuple(fine.shape)
    )
    if not fits:
        raise GridError("the grid cannot be pooled to the network's voxels", expected=coarse, got=fine,
                        fix="give grids of the same box whose voxels divide the network's")  # fmt: skip
    return factor


def _stride(frame: Frame) -> int:
    """Pixels between rays: about as dense as one ray a pixel of a 128-pixel image, which 0.8 m voxels need."""
    return max(1, min(view.camera.width for view in frame.views) // 176)
