"""Looks: what the pixels of a thing itself show, told from what is seen past it.

An occupancy voxel is far thicker than a lamp post, so most pixels that see its voxels show what is behind it. How much
of the outer layer of voxels is filled nobody knows: only what lies more than a voxel inside a silhouette surely shows
the thing. Nearer to its edge those pixels count that look unlike what surrounds it, for what is seen past a thing is
seen beside it too.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64, UInt8

from openvocab_occ.mapping import NO_LABEL
from openvocab_occ.objects.frame_voxels import FrameVoxels, PixelRows

_RING = 4
"""Cells around a silhouette, beside those that a voxel spans, that count as its surroundings."""
_LIKE = 0.1
"""A cell is as like its surroundings as it is, in the mean, like this share of them: the share most like it."""
_MOST = 256
"""Cells of the surroundings that are looked at."""
_FAR = 40.0
"""Metres at which a view counts half, as in the lift."""
_FLOOR = 1e-3
"""Least weight of a pixel, so that what looks like its surroundings all over still looks like something."""
_STEPS = 8
"""Of a channel of colour."""
_COLORS = 32
"""Colours that are kept of a thing."""


@dataclass(frozen=True, eq=False)
class Look:
    """What one or more views show of a thing."""

    feature_sum: Float32[np.ndarray, " c"]
    """Features of cells added up by weight."""
    color_sum: Float32[np.ndarray, "512 4"]
    """Weight, and red, green and blue times weight, of the pixels of each colour: sRGB in eight steps a channel."""

    def __add__(self, other: "Look") -> "Look":
        """Return what both show."""
        return Look(self.feature_sum + other.feature_sum, self.color_sum + other.color_sum)


def added(a: Look | None, b: Look | None) -> Look | None:
    """Return two looks as one; None where there is neither."""
    if a is None or b is None:
        return b if a is None else a
    return a + b


def palette(look: Look) -> Float32[np.ndarray, "k 4"]:
    """Return the commonest colours of a look: share of all, and mean sRGB from 0 to 255."""
    weight = look.color_sum[:, 0].astype(np.float64)
    order = np.argsort(-weight, kind="stable")[:_COLORS]
    order = order[weight[order] > 0]
    mean = look.color_sum[order, 1:] / weight[order, None]
    return np.concatenate([weight[order, None] / max(float(weight.sum()), 1e-12), mean], axis=1).astype(np.float32)


def looks_of(frame: FrameVoxels, groups: Sequence[Int64[np.ndarray, " _"]]) -> list[Look | None]:
    """Return what the views show of groups of seen voxels, positions in `frame.seen`; None where no cell tells."""
    found: list[Look | None] = [None] * len(groups)
    number = np.zeros(len(frame.seen) + 1, dtype=np.int32)  # the last stands for pixels that see nothing
    for i, rows in enumerate(groups, start=1):
        number[rows] = i
    labels = np.append(frame.labels[frame.seen], np.uint8(NO_LABEL))
    for view in frame.views:
        if view.sight is not None:
            sight = _Sight.of(view, number, labels, frame)
            for i, look in sight.looks():
                found[i - 1] = added(found[i - 1], look)
    return found


@dataclass(frozen=True, eq=False, kw_only=True)
class _Sight:
    """A view, pixel by pixel and cell by cell."""

    ids: Int32[np.ndarray, "h w"]
    """Group of each pixel, from 1; 0 for none."""
    cell: Int64[np.ndarray, "h w"]
    """Flat index of its cell."""
    depth: Float[np.ndarray, "h w"]
    """Metres; infinite where nothing is seen."""
    image: UInt8[np.ndarray, "h w 3"]
    inside: Float64[np.ndarray, "h w"]
    """0 up to one voxel inside a silhouette, 1 from two on."""
    pixels: float
    """Of these to a cell."""
    span: float
    """Cells that a voxel spans at one metre."""
    cells: Float32[np.ndarray, "n c"]
    unit: Float32[np.ndarray, "n c"]
    """Cells as unit vectors."""
    grid: tuple[int, int]
    """Rows and columns of cells."""
    owner: Int32[np.ndarray, " n"]
    """Group, class and depth of a pixel of each cell."""
    label: UInt8[np.ndarray, " n"]
    far: Float[np.ndarray, " n"]
    voxel_size: float

    @classmethod
    def of(
        cls, view: PixelRows, number: Int32[np.ndarray, " s"], labels: UInt8[np.ndarray, " s"], frame: FrameVoxels
    ) -> "_Sight":
        sight = view.sight
        assert sight is not None, "asked of views with features"
        height, width, dim = sight.features.cells.shape
        ids, stride = number[view.rows], view.stride
        x, y = (
            np.clip(np.rint(scale * stride * np.arange(size) + offset), 0, cells - 1).astype(np.int64)
            for scale, offset, size, cells in zip(
                sight.features.scale, sight.features.offset, ids.shape[::-1], (width, height), strict=True
            )
        )
        cell = y[:, None] * width + x[None]
        depth = np.where(view.rows < len(number) - 1, sight.depth, np.inf)
        voxel = np.where(np.isfinite(depth), frame.voxel_size * sight.focal / np.maximum(depth, 1e-3), 0.0)
        owner, label = np.zeros(height * width, np.int32), np.full(height * width, NO_LABEL, np.uint8)
        far = np.full(height * width, np.inf)
        owner[cell], label[cell], far[cell] = ids, labels[view.rows], depth
        cells = sight.features.cells.reshape(-1, dim)
        u, v = abs(sight.features.scale[0]), abs(sight.features.scale[1])
        return cls(
            ids=ids, cell=cell, depth=depth, image=sight.image, inside=_inside(ids, voxel / stride),
            pixels=1 / max(u * v * stride**2, 1e-9), span=frame.voxel_size * sight.focal * u, cells=cells,
            unit=np.sqrt(np.maximum(cells, 0)) if frame.contract == "logits" else cells, grid=(height, width),
            owner=owner, label=label, far=far, voxel_size=frame.voxel_size,
        )  # fmt: skip

    def looks(self) -> Iterator[tuple[int, Look]]:
        """Yield each group that shows, and its look."""
        from scipy.ndimage import find_objects

        for i, where in enumerate(find_objects(self.ids), start=1):
            if where is not None:
                yield i, self._look(i, where, self.ids[where] == i)

    def _look(self, i: int, where: tuple[slice, ...], mine: Bool[np.ndarray, "a b"]) -> Look:
        cell, at, count = np.unique(self.cell[where][mine], return_inverse=True, return_counts=True)
        depth = self.depth[where][mine]
        trust = np.bincount(at, self.inside[where][mine]) / count
        unlike = np.ones(len(cell))
        if trust.min() < 1:
            around = self._around(i, cell, depth)
            if len(around):
                near = self.unit[cell] @ self.unit[around].T
                most = max(int(np.ceil(_LIKE * near.shape[1])), min(3, near.shape[1]))
                unlike = np.clip(1 - np.partition(near, -most, axis=1)[:, -most:].mean(axis=1), 0, 1) ** 2
        own = np.maximum(trust + (1 - trust) * unlike, _FLOOR)
        own *= np.minimum(count / self.pixels, 1) / (1 + (float(np.median(depth)) / _FAR) ** 2)  # a pixel's weight
        rgb = self.image[where][mine]
        step = (rgb // (256 // _STEPS)).astype(np.int64) @ (_STEPS**2, _STEPS, 1)
        columns = [own[at], *(own[at] * rgb[:, channel] for channel in range(3))]
        colors = np.stack([np.bincount(step, column, minlength=_STEPS**3) for column in columns], axis=1)
        return Look(((own * count) @ self.cells[cell]).astype(np.float32), colors.astype(np.float32))

    def _around(self, i: int, cell: Int64[np.ndarray, " k"], depth: Float[np.ndarray, " p"]) -> Int64[np.ndarray, " m"]:
        """Return cells about a silhouette that may show what is seen past it.

        Left out are what is in front of it, and its like beside it.
        """
        from scipy.ndimage import maximum_filter

        reach = int(np.ceil(self.span / max(float(np.median(depth)), 1e-3))) + _RING
        y, x = np.divmod(cell, self.grid[1])
        low = np.maximum([y.min() - reach, x.min() - reach], 0)
        high = np.minimum([y.max() + reach + 1, x.max() + reach + 1], self.grid)
        mask = np.zeros(high - low, dtype=bool)
        mask[y - low[0], x - low[1]] = True
        down, across = np.nonzero(maximum_filter(mask, 2 * reach + 1) & ~mask)
        ring = (down + low[0]) * self.grid[1] + across + low[1]
        kind = np.bincount(self.label[cell]).argmax()
        beside = (self.label[ring] == kind) & (self.far[ring] <= depth.max() + 2 * self.voxel_size)
        ring = ring[(self.owner[ring] != i) & (self.far[ring] >= depth.min() - self.voxel_size) & ~beside]
        return ring[np.linspace(0, len(ring) - 1, _MOST).astype(int)] if len(ring) > _MOST else ring


def _inside(ids: Int32[np.ndarray, "h w"], voxel: Float[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    """Return 0 for pixels up to one voxel's width from the edge of their silhouette, 1 from two on.

    The image's border is no edge.
    """
    from scipy.ndimage import distance_transform_edt

    edge = np.zeros(ids.shape, dtype=bool)
    across, down = ids[:, 1:] != ids[:, :-1], ids[1:] != ids[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    if not edge.any():
        return np.ones(ids.shape)
    deep: Float64[np.ndarray, "h w"] = distance_transform_edt(~edge)  # pyright: ignore[reportAssignmentType]
    return np.clip(deep / np.maximum(voxel, 1e-9) - 1, 0, 1)
