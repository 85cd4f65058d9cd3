"""What one frame says about voxels, after all its cameras are lifted: the ground segments are made on."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Float32, Int32, Int64, UInt8

from openvocab_occ.datasets.frame import Frame
from openvocab_occ.mapping import NO_LABEL, Cover, Lifted, cover_grid
from openvocab_occ.mapping.keys import pack
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.segmentation.encoder import Contract, FeatureMap

_PIXELS = 60_000  # of a view, enough to tell where in it a segment lies


@dataclass(frozen=True, eq=False)
class PixelSight:
    """What the pixels of a view show, as thinned as its `PixelRows`."""

    image: UInt8[np.ndarray, "h w 3"]
    depth: Float32[np.ndarray, "h w"]
    """z-depth, metres."""
    focal: float
    """Of the whole image, pixels."""
    features: FeatureMap
    """Of the whole image."""


@dataclass(frozen=True, eq=False)
class PixelRows:
    """Which voxel of a frame each pixel of a view sees, thinned to a few pixels."""

    view: str
    rows: Int32[np.ndarray, "h w"]
    """Position in `FrameVoxels`; -1 for none."""
    stride: int
    """Every how many pixels along both axes."""
    sight: "PixelSight | None" = None
    """None where the model puts out masks."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameVoxels:
    """Voxels that a frame sees, each once, sorted by key; and those its grid holds but no camera sees."""

    index: int
    timestamp: float
    T_world_ego: Float[np.ndarray, "4 4"]
    voxel_size: float
    contract: Contract
    packed: Int64[np.ndarray, " n"] = field(repr=False)
    """Packed keys, ascending; the seen and the hidden together."""
    seen: Int64[np.ndarray, " s"] = field(repr=False)
    """Positions in `packed` of the voxels that a camera sees."""
    features: Float32[np.ndarray, "s c"] = field(repr=False)
    """Of the seen voxels: unit vectors, or distributions over the labels."""
    weight: Float32[np.ndarray, " s"] = field(repr=False)
    """Pixels that see each."""
    labels: UInt8[np.ndarray, " n"] = field(repr=False)
    """Occupancy class of every voxel; 255 where none was named."""
    window: OccupancyGrid | None = field(default=None, repr=False)
    """The frame's grid, which tells where its knowledge ends."""
    views: tuple[PixelRows, ...] = field(default=(), repr=False)
    masks: Int32[np.ndarray, " s"] | None = field(default=None, repr=False)
    """Of the seen voxels, where a model puts out masks: view * 65536 + number of the mask; -1 for none."""


def gather(
    views: Sequence[tuple[str, Int32[np.ndarray, "h w"], int]],
    cover: Cover,
    labels: UInt8[np.ndarray, " m"],
    lifted: Lifted,
    *,
    frame: Frame,
    voxel_size: float,
    contract: Contract,
    grid: OccupancyGrid | None = None,
    sights: Sequence[tuple[Float32[np.ndarray, "h w"], FeatureMap | None]] = (),
) -> FrameVoxels:
    """Put the views of a frame together: rows of different cameras that share a voxel become one.

    Args:
        views: Name, row of each pixel (-1 for none), and number of rows of each view.
        cover: The voxels of all views' rows, one view after the other.
        labels: Occupancy class of each row.
        lifted: What each row was given.
        frame: Where index, time and pose come from.
        voxel_size: Metres.
        contract: Of the encoder.
        grid: The frame's grid. Its occupied voxels that no camera sees are kept as hidden ones where it names classes;
            they tell that a car behind a pole is one thing, and where the far side of a truck is.
        sights: Depth and features of each view; no features of a model that puts out masks.
    """
    share = lifted.weight[cover.row] * cover.share
    used = share > 0
    row, share = cover.row[used], share[used]
    packed, inverse = np.unique(pack(cover.keys[used]), return_inverse=True)
    order = np.argsort(inverse, kind="stable")
    starts = np.searchsorted(inverse[order], np.arange(len(packed)))
    parts = lifted.sums[row] * cover.share[used][:, None]
    total = np.add.reduceat(parts[order], starts, axis=0) if len(packed) else parts
    norm = total.sum(axis=1) if contract == "logits" else np.linalg.norm(total, axis=1)
    features = np.divide(total, norm[:, None], out=np.zeros_like(total), where=norm[:, None] > 0)
    named = np.full(len(packed), NO_LABEL, np.uint8)
    light_first = np.argsort(share, kind="stable")  # of several rows the one with the most pixels names the voxel
    named[inverse[light_first]] = labels[row[light_first]]
    at = np.full(len(labels) + 1, -1, dtype=np.int32)  # the voxel a pixel of each row is about; the last row is none
    at[row[light_first]] = inverse[light_first]
    masks = None
    if lifted.mask is not None:
        masks = np.full(len(packed), -1, dtype=np.int32)
        masks[inverse[light_first]] = lifted.mask[row[light_first]]
    everything, everywhere = packed, named
    if grid is not None and len(grid.class_names) > 2:
        hidden, classes = _hidden(grid, packed, voxel_size)
        order = np.argsort(np.concatenate([packed, hidden]), kind="stable")
        everything = np.concatenate([packed, hidden])[order]
        everywhere = np.concatenate([named, classes])[order]
    return FrameVoxels(
        index=frame.index,
        timestamp=frame.timestamp,
        T_world_ego=frame.T_world_ego,
        voxel_size=voxel_size,
        contract=contract,
        packed=everything,
        seen=np.searchsorted(everything, packed),
        features=features.astype(np.float32),
        weight=np.bincount(inverse, share, minlength=len(packed)).astype(np.float32),
        labels=everywhere,
        window=grid,
        views=tuple(_pixel_rows(views, at, frame, sights)),
        masks=masks,
    )


def _pixel_rows(
    views: Sequence[tuple[str, Int32[np.ndarray, "h w"], int]],
    at: Int32[np.ndarray, " m"],
    frame: Frame,
    sights: Sequence[tuple[Float32[np.ndarray, "h w"], FeatureMap | None]],
) -> Iterator[PixelRows]:
    """Yield which voxel every so many pixels of each view are about."""
    first = 0
    for n, (name, rows, count) in enumerate(views):
        stride = max(1, round((rows.size / _PIXELS) ** 0.5))
        thin = rows[::stride, ::stride]
        found = PixelRows(name, at[np.where(thin >= 0, thin + first, len(at) - 1)], stride)
        if sights:
            view, (depth, features) = frame.views[n], sights[n]
            if features is not None:
                thin = (slice(None, None, stride), slice(None, None, stride))
                found = replace(
                    found, sight=PixelSight(view.image[thin], depth[thin], float(view.camera.K[0, 0]), features)
                )
        yield found
        first += count


def _hidden(
    grid: OccupancyGrid, seen: Int64[np.ndarray, " s"], voxel_size: float
) -> tuple[Int64[np.ndarray, " m"], UInt8[np.ndarray, " m"]]:
    """Return keys and classes of the grid's occupied voxels that no camera sees."""
    flat = np.flatnonzero(grid.occupied)
    cover = cover_grid(flat, grid, voxel_size)
    packed, first = np.unique(pack(cover.keys), return_index=True)
    new = ~np.isin(packed, seen, assume_unique=True)
    return packed[new], grid.labels.reshape(-1)[flat[cover.row[first[new]]]]
