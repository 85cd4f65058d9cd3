"""Segments: connected voxels of one frame that look alike, cut where features, classes or space part them.

Graph-based segmentation (Felzenszwalb and Huttenlocher 2004) on the graph of touching voxels. Space cuts by itself:
voxels on two sides of a depth edge do not touch. Segments are made after all cameras are lifted, so a thing across the
border of two cameras is one segment.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float32, Float64, Int64

from openvocab_occ._jit import in_slices
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import invert, transform
from openvocab_occ.mapping import NO_LABEL
from openvocab_occ.mapping.keys import pack, unpack
from openvocab_occ.objects import _segments_kernels as kernels
from openvocab_occ.objects.frame_voxels import FrameVoxels, PixelRows
from openvocab_occ.objects.kinds import Kind, kinds_of
from openvocab_occ.objects.looks import Look, looks_of
from openvocab_occ.occupancy import OccupancyGrid

_FORWARD = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)])[14:]
_STEPS = (pack(_FORWARD.astype(np.int32)) - pack(np.zeros((1, 3), np.int32))).astype(np.int64)
"""Differences of packed keys of half of the 26 neighbours."""
_TOLERANCE = 1e-6  # metres: centres on a face of the grid are of the voxel below, as in `cover_grid`
MIN_PIXELS = 8
"""Fewer pixels of a view are no crop."""


@dataclass(frozen=True, kw_only=True)
class SegmentConfig:
    """How voxels become segments."""

    scale: float = 0.4
    """The k of the segmentation: a component of n voxels bears edges k / n above its heaviest."""
    class_penalty: float = 0.5
    """Added to the distance of neighbours of which occupancy names different classes; 0 ignores classes."""
    mask_penalty: float = 0.5
    """Added to the distance of neighbours in different masks of one view, where a model puts out masks."""
    join: float = 0.75
    """Touching components of one class whose mean features are no further apart than this are one: a wall is one wall
    though its windows differ. Of things that can move any distance will do: cab and box are one truck."""
    gap: int = 3
    """Voxels along any axis between neighbours in an image that still touch: far surfaces are hit here and there only.
    Of things that can move one less, for those park close."""
    unknown: int = 2
    """Layers of voxels of which the grid knows nothing, between two of one class above one another that still touch."""
    reach: int = 24
    """Voxels between a hidden voxel and what is seen of its thing, at most."""
    cut: float = 0.9
    """No edge above this joins anything: of unit features, 1 - cosine; of distributions, half their difference."""
    min_voxels: int = 2
    """Fewer seen voxels go to the neighbour most like them, or are dropped where there is none."""
    flat_area: float = 30.0
    """Square metres from which a segment at most two voxels high is ground, where no class tells."""

    def __post_init__(self) -> None:
        for name in ("scale", "class_penalty", "mask_penalty", "join", "cut", "flat_area"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ConfigError(f"segment option {name} is not usable", expected=">= 0", got=getattr(self, name))
        if self.min_voxels < 1:
            raise ConfigError("segment option min_voxels is not usable", expected="at least 1", got=self.min_voxels)


@dataclass(frozen=True, eq=False, kw_only=True)
class Crop:
    """Where a view shows a segment."""

    frame: int
    view: str
    box: tuple[int, int, int, int]
    """Left, top, right, bottom pixel, inclusive."""
    pixels: int
    """About how many of its pixels are the segment's."""
    score: float
    """How good a picture of it this is: the root of its pixels, halved where the image cuts it off."""
    feature: Float32[np.ndarray, " c"] = field(repr=False)
    """Mean feature of the segment in this frame, not normalised."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Segment:
    """One connected piece of one frame."""

    seen: Int64[np.ndarray, " s"] = field(repr=False)
    """Packed keys of the voxels that a camera sees, ascending."""
    body: Int64[np.ndarray, " b"] = field(repr=False)
    """Packed keys of all its voxels, the hidden ones included, ascending."""
    feature_sum: Float32[np.ndarray, " c"] = field(repr=False)
    """Voxel features added up by weight."""
    weight: float
    """Pixels that see it."""
    class_votes: Float32[np.ndarray, " k"] = field(repr=False)
    """Pixels by class of evidence: the occupancy's, else the model's own labels."""
    low: Float64[np.ndarray, " 3"]
    """Lower corner of its voxels, metres, world."""
    high: Float64[np.ndarray, " 3"]
    cut_off: bool
    """True where the grid ends at it: its far side is not known."""
    crops: tuple[Crop, ...] = field(default=(), repr=False)
    look: Look | None = field(default=None, repr=False)
    """What its own pixels show; None where no cell tells."""

    @property
    def center(self) -> Float64[np.ndarray, " 3"]:
        """Middle of its bounds, metres, world."""
        return (self.low + self.high) / 2

    @property
    def feature(self) -> Float32[np.ndarray, " c"]:
        """Mean feature as a unit vector."""
        return (self.feature_sum / max(float(np.linalg.norm(self.feature_sum)), 1e-12)).astype(np.float32)


def segment_frame(frame: FrameVoxels, names: Sequence[str] = (), config: SegmentConfig | None = None) -> list[Segment]:
    """Return the segments of things in a frame; ground and sky are left out.

    `names` are the classes of `frame.labels`, or for a labelled model without occupancy classes its own labels. Largest
    first, then by lowest key.
    """
    config = config or SegmentConfig()
    classes = evidence_classes(frame, names)
    kinds = kinds_of(names)[classes]
    use = np.flatnonzero((kinds != Kind.GROUND) & (kinds != Kind.NOTHING))
    row = np.full(len(frame.packed), -1, dtype=np.int64)
    row[frame.seen] = np.arange(len(frame.seen))
    packed, classes, row = frame.packed[use], classes[use], row[use]
    component = _components(packed, classes, row, frame, config, kinds_of(names) == Kind.MOVABLE)
    order = np.argsort(component, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(component[order])) + 1) if len(order) else []
    groups = [g for g in groups if (row[g] >= 0).sum() >= config.min_voxels]
    groups.sort(key=lambda g: (-len(g), packed[g[0]]))
    crops = _crops(frame, [row[g][row[g] >= 0] for g in groups])
    looks = looks_of(frame, [row[g][row[g] >= 0] for g in groups])
    size = max(len(names), 1)
    segments = [
        replace(_segment(frame, packed[g], row[g], classes[g], crops[n], size), look=looks[n])
        for n, g in enumerate(groups)
    ]
    return [s for s in segments if names or not _is_ground(s, frame, config)]


def evidence_classes(frame: FrameVoxels, names: Sequence[str]) -> np.ndarray:
    """Return each voxel's class: the occupancy's; for a frame without one and a labelled model, its best label."""
    classes = frame.labels.copy()
    if frame.contract == "logits" and len(names) == frame.features.shape[1] and frame.window is None:
        classes[frame.seen] = frame.features.argmax(axis=1)
    if not names:
        classes[:] = NO_LABEL
    return classes


def neighbour_pairs(packed: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, "p 2"]:
    """Return pairs of positions of voxels that touch, each pair once; `packed` ascends."""
    out = np.empty((len(packed) * len(_STEPS), 2), dtype=np.int64)
    return out[: kernels.pair_neighbours(packed, _STEPS, out)]


def _components(
    packed: Int64[np.ndarray, " n"],
    classes: np.ndarray,
    row: Int64[np.ndarray, " n"],
    frame: FrameVoxels,
    config: SegmentConfig,
    movable: np.ndarray,
) -> Int64[np.ndarray, " n"]:
    """Return each voxel's component, -1 for hidden ones that belong to nothing seen."""
    pairs = np.concatenate([
        neighbour_pairs(packed), _column_pairs(packed, classes, frame, config),
        _image_pairs(packed, classes, row, frame, config, movable),
    ])  # fmt: skip
    a, b = pairs.T
    named = (classes[a] != NO_LABEL) & (classes[b] != NO_LABEL)
    same = named & (classes[a] == classes[b])
    shown = (row[a] >= 0) & (row[b] >= 0)
    # what is seen: by features, with classes as evidence
    place = np.cumsum(row >= 0) - 1
    edges = np.ascontiguousarray(row[pairs[shown]])
    weights = _by_masks(_distances(frame, edges), frame, edges, config.mask_penalty)
    weights = weights + config.class_penalty * (named & ~same)[shown]
    keep = weights <= config.cut
    edges, weights = np.ascontiguousarray(place[pairs[shown][keep]]), weights[keep]
    seen = np.empty(int((row >= 0).sum()), dtype=np.int64)
    kernels.merge_edges(edges, weights, np.argsort(weights, kind="stable"), config.scale, config.min_voxels, seen)
    # what is hidden belongs to the nearest of its class, and shows which pieces of it hang together
    component = np.full(len(packed), -1, dtype=np.int64)
    component[row >= 0] = seen
    kernels.flood(pairs, same, config.reach, component)
    touching = same & (component[a] >= 0) & (component[b] >= 0) & (component[a] != component[b])
    return _joined(component, pairs[touching], classes, row, frame, config, movable)


def _column_pairs(
    packed: Int64[np.ndarray, " n"], classes: np.ndarray, frame: FrameVoxels, config: SegmentConfig
) -> Int64[np.ndarray, "p 2"]:
    """Return pairs of voxels of one class, one above the other, between which the grid knows nothing.

    The beams of a LiDAR are further apart than voxels are high, so the voxels it tells of come in layers.
    """
    grid = frame.window
    if grid is None or grid.known is None or not len(packed):
        return np.empty((0, 2), dtype=np.int64)
    found, T_grid_world = [], invert(grid.T_world_grid)
    for gap in range(2, config.unknown + 2):
        at = np.minimum(np.searchsorted(packed, packed + gap), len(packed) - 1)
        low = np.flatnonzero((packed[at] == packed + gap) & (classes[at] == classes))
        between = unpack(packed[low])[:, None] + np.arange(1, gap)[:, None] * np.array([0, 0, 1])
        centers = transform(T_grid_world, (between.reshape(-1, 3) + 0.5) * frame.voxel_size)
        index = grid.spec.index(centers - _TOLERANCE)
        inside = grid.spec.contains(index)
        blind = np.zeros(len(index), dtype=bool)
        blind[inside] = ~grid.known[tuple(index[inside].T)]
        low = low[blind.reshape(len(low), gap - 1).all(axis=1)]
        found.append(np.stack([low, at[low]], axis=1))
    return np.concatenate(found)


def _image_pairs(
    packed: Int64[np.ndarray, " n"],
    classes: np.ndarray,
    row: Int64[np.ndarray, " n"],
    frame: FrameVoxels,
    config: SegmentConfig,
    movable: np.ndarray,
) -> Int64[np.ndarray, "p 2"]:
    """Return pairs of voxels of one class that are neighbours in an image without a depth edge between."""
    place = np.full(len(frame.seen) + 1, -1, dtype=np.int64)  # the last stands for pixels that see nothing
    place[row[row >= 0]] = np.flatnonzero(row >= 0)
    codes = []
    for view in frame.views:
        image = place[view.rows]
        for a, b in ((image[:, 1:], image[:, :-1]), (image[1:], image[:-1])):
            edge = (a != b) & (a >= 0) & (b >= 0)
            a, b = a[edge], b[edge]
            codes.append(np.minimum(a, b) * len(packed) + np.maximum(a, b))
    code = np.unique(np.concatenate([np.empty(0, np.int64), *codes]))
    pairs = np.stack([code // max(len(packed), 1), code % max(len(packed), 1)], axis=1)
    keys = unpack(packed)
    off = np.abs(keys[pairs[:, 0]] - keys[pairs[:, 1]]).max(axis=1)
    a, b = classes[pairs].T
    keep = (a == b) & (off > 1) & (off <= config.gap - movable[a])
    return np.ascontiguousarray(pairs[keep])


def _joined(
    component: Int64[np.ndarray, " n"],
    pairs: Int64[np.ndarray, "p 2"],
    classes: np.ndarray,
    row: Int64[np.ndarray, " n"],
    frame: FrameVoxels,
    config: SegmentConfig,
    movable: np.ndarray,
) -> Int64[np.ndarray, " n"]:
    """Join touching components of one class whose mean features are near."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(pairs):
        return component
    shown = np.flatnonzero(row >= 0)
    numbers, inverse = np.unique(component[shown], return_inverse=True)
    order = np.argsort(inverse, kind="stable")
    starts = np.searchsorted(inverse[order], np.arange(len(numbers)))
    weight = frame.weight[row[shown]]
    means = np.add.reduceat((frame.features[row[shown]] * weight[:, None])[order], starts, axis=0)
    norm = means.sum(axis=1) if frame.contract == "logits" else np.linalg.norm(means, axis=1)
    means /= np.maximum(norm, 1e-12)[:, None]
    ends = np.searchsorted(numbers, component[pairs])
    ends, first = np.unique(np.sort(ends, axis=1), axis=0, return_index=True)
    a, b = means[ends[:, 0]], means[ends[:, 1]]
    apart = 1 - np.einsum("pc,pc->p", a, b) if frame.contract == "dense" else np.abs(a - b).sum(axis=1) / 2
    ends = ends[(apart <= config.join) | movable[classes[pairs[first, 0]]]]
    graph = coo_array((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(len(numbers),) * 2)
    _, part = connected_components(graph, directed=False)
    result = component.copy()
    held = component >= 0
    result[held] = part[np.searchsorted(numbers, component[held])]
    return result


def _by_masks(
    distance: Float32[np.ndarray, " e"], frame: FrameVoxels, edges: Int64[np.ndarray, "e 2"], penalty: float
) -> Float32[np.ndarray, " e"]:
    """Return distances that heed masks: none within one, more between two of one view."""
    if frame.masks is None:
        return distance
    a, b = frame.masks[edges].T
    both = (a >= 0) & (b >= 0)
    distance = np.where(both & (a == b), np.float32(0), distance)
    return (distance + np.float32(penalty) * (both & (a != b) & (a >> 16 == b >> 16))).astype(np.float32)


def _distances(frame: FrameVoxels, edges: Int64[np.ndarray, "e 2"]) -> Float32[np.ndarray, " e"]:
    """Return how much the features of seen voxels differ, 0 for the same."""
    distance = np.empty(len(edges), dtype=np.float32)
    features, cosine = np.ascontiguousarray(frame.features), frame.contract == "dense"
    in_slices(
        lambda start, stop: kernels.feature_distances(features, edges, cosine, start, stop, distance),
        len(edges),
        grain=4096,
    )
    return np.maximum(distance, 0.0)


def _segment(
    frame: FrameVoxels, packed: np.ndarray, row: np.ndarray, classes: np.ndarray, crops: tuple[Crop, ...], size: int
) -> Segment:
    shown = row >= 0
    weight = frame.weight[row[shown]]
    feature_sum = weight @ frame.features[row[shown]]
    named = classes[shown] < size
    keys = unpack(packed)
    low, high = keys.min(axis=0) * frame.voxel_size, (keys.max(axis=0) + 1) * frame.voxel_size
    return Segment(
        seen=packed[shown],
        body=packed,
        feature_sum=feature_sum.astype(np.float32),
        weight=float(weight.sum()),
        class_votes=np.bincount(classes[shown][named], weight[named], minlength=size).astype(np.float32),
        low=low.astype(np.float64),
        high=high.astype(np.float64),
        cut_off=frame.window is not None and _at_edge(frame.window, keys, frame.voxel_size),
        crops=crops,
    )


def _at_edge(window: OccupancyGrid, keys: np.ndarray, voxel_size: float) -> bool:
    """Tell whether voxels reach the sides of the grid."""
    T = window.T_world_grid
    local = ((keys + 0.5) * voxel_size - T[:3, 3]) @ T[:3, :2] - window.spec.origin[:2]
    upper = np.asarray(window.spec.shape[:2]) * window.spec.size[:2]
    return bool((local < 1.5 * voxel_size).any() or (local > upper - 1.5 * voxel_size).any())


def _is_ground(segment: Segment, frame: FrameVoxels, config: SegmentConfig) -> bool:
    """Tell a wide flat piece from a thing."""
    extent = segment.high - segment.low
    area = len(np.unique(segment.body >> 16)) * frame.voxel_size**2
    return bool(extent[2] <= 2.01 * frame.voxel_size and area >= config.flat_area)


def _crops(frame: FrameVoxels, groups: Sequence[np.ndarray]) -> list[tuple[Crop, ...]]:
    """Return where each group of seen voxels shows, view by view."""
    from scipy.ndimage import find_objects

    number = np.full(len(frame.seen) + 1, 0, dtype=np.int32)  # the last stands for pixels that see nothing
    for i, rows in enumerate(groups, start=1):
        number[rows] = i
    crops: list[list[Crop]] = [[] for _ in groups]
    features = [frame.features[rows].mean(axis=0) for rows in groups]
    for view in frame.views:
        image = number[view.rows]
        counts = np.bincount(image.reshape(-1), minlength=len(groups) + 1)
        for i, where in enumerate(find_objects(image, max_label=len(groups))):
            pixels = int(counts[i + 1]) * view.stride**2
            if where is not None and pixels >= MIN_PIXELS:
                crops[i].append(_crop(frame.index, view, where, pixels, features[i]))
    return [tuple(found) for found in crops]


def _crop(frame: int, view: PixelRows, where: tuple[slice, ...], pixels: int, feature: np.ndarray) -> Crop:
    rows, columns = where
    height, width = view.rows.shape
    whole = rows.start > 0 and columns.start > 0 and rows.stop < height and columns.stop < width
    box = (columns.start * view.stride, rows.start * view.stride, columns.stop * view.stride - 1,
           rows.stop * view.stride - 1)  # fmt: skip
    score = float(pixels) ** 0.5 * (1.0 if whole else 0.5)
    return Crop(frame=frame, view=view.view, box=box, pixels=pixels, score=score, feature=feature.astype(np.float32))
