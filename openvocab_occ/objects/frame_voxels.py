"""What one frame says about voxels, after all its cameras are lifted: the ground segments are made on."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Float32, Int32, Int64, UInt8

from openvocab_occ.mapping import NO_LABEL, Lifted, keys_of
from openvocab_occ.mapping.keys import pack
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.segmentation.encoder import Contract

_PIXELS = 60_000  # of a view, enough to tell where in it a segment lies


@dataclass(frozen=True, eq=False)
class PixelRows:
    """Which voxel of a frame each pixel of a view sees, thinned to a few pixels."""

    view: str
    rows: Int32[np.ndarray, "h w"]
    """Position in `FrameVoxels`; -1 for none."""
    stride: int
    """Every how many pixels along both axes."""


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


def gather(
    seen: Sequence[tuple[Int32[np.ndarray, "h w"], Int32[np.ndarray, "m 3"], UInt8[np.ndarray, " m"]]],
    lifted: Sequence[Lifted],
    *,
    names: Sequence[str],
    index: int,
    timestamp: float,
    T_world_ego: Float[np.ndarray, "4 4"],
    voxel_size: float,
    contract: Contract,
    grid: OccupancyGrid | None = None,
) -> FrameVoxels:
    """Put the views of a frame together: rows of different cameras that share a voxel become one.

    Args:
        seen: Of each view, the row of each pixel, and key and occupancy class of each row.
        lifted: Of each view, what its rows were given.
        names: Of the views.
        index: Of the frame.
        timestamp: Of the frame, seconds.
        T_world_ego: Where the ego is.
        voxel_size: Metres.
        contract: Of the encoder.
        grid: The frame's grid. Its occupied voxels that no camera sees are kept as hidden ones where it names classes;
            they tell that a car behind a pole is one thing, and where the far side of a truck is.
    """
    keys = np.concatenate([part[1] for part in seen])
    labels = np.concatenate([part[2] for part in seen])
    sums = np.concatenate([part.sums for part in lifted])
    weight = np.concatenate([part.weight for part in lifted])
    packed, inverse = np.unique(pack(keys), return_inverse=True)
    total = np.zeros((len(packed), sums.shape[1]), np.float32)
    np.add.at(total, inverse, sums)
    pixels = np.bincount(inverse, weight, minlength=len(packed)).astype(np.float32)
    norm = total.sum(axis=1) if contract == "logits" else np.linalg.norm(total, axis=1)
    features = np.divide(total, norm[:, None], out=np.zeros_like(total), where=norm[:, None] > 0)
    named = np.full(len(packed), NO_LABEL, np.uint8)
    order = np.argsort(weight, kind="stable")  # of several rows the one with the most pixels names the voxel
    named[inverse[order]] = labels[order]
    start, views = 0, []
    for (rows, part, _), name in zip(seen, names, strict=True):
        stride = max(1, round((rows.size / _PIXELS) ** 0.5))
        thin = rows[::stride, ::stride]
        place = np.append(inverse[start : start + len(part)], -1).astype(np.int32)
        views.append(PixelRows(name, place[thin], stride))
        start += len(part)
    everything, everywhere = packed, named
    if grid is not None and len(grid.class_names) > 2:
        hidden, classes = _hidden(grid, packed, voxel_size)
        order = np.argsort(np.concatenate([packed, hidden]), kind="stable")
        everything = np.concatenate([packed, hidden])[order]
        everywhere = np.concatenate([named, classes])[order]
    return FrameVoxels(
        index=index,
        timestamp=timestamp,
        T_world_ego=T_world_ego,
        voxel_size=voxel_size,
        contract=contract,
        packed=everything,
        seen=np.searchsorted(everything, packed),
        features=features,
        weight=pixels,
        labels=everywhere,
        window=grid,
        views=tuple(views),
    )


def _hidden(
    grid: OccupancyGrid, seen: Int64[np.ndarray, " s"], voxel_size: float
) -> tuple[Int64[np.ndarray, " m"], UInt8[np.ndarray, " m"]]:
    """Return keys and classes of the grid's occupied voxels that no camera sees."""
    occupied = grid.labels != grid.free_label
    if grid.known is not None:
        occupied &= grid.known
    flat = np.flatnonzero(occupied)
    packed, first = np.unique(pack(keys_of(grid.centers(flat), voxel_size)), return_index=True)
    new = ~np.isin(packed, seen, assume_unique=True)
    return packed[new], grid.labels.reshape(-1)[flat[first[new]]]
