"""What is known of each voxel, by row in order of arrival: a record of numbers, class counts, the summed feature."""

from collections.abc import Iterator, Mapping
from itertools import pairwise

import numpy as np
from jaxtyping import Float32, Int, UInt8, UInt16

from openvocab_occ.mapping._hash_kernels import add_shares
from openvocab_occ.mapping.cover import Cover
from openvocab_occ.mapping.lift import Lifted

NO_LABEL = 255
"""Label of a voxel that no occupancy grid named."""
RECORD = np.dtype(
    [
        ("weight", np.float32),
        ("color_sum", np.float32, 3),
        ("color_weight", np.float32),
        ("normal_sum", np.float32, 3),
        ("count", np.int32),
        ("first_seen", np.float64),
        ("last_seen", np.float64),
        ("label", np.uint8),
        ("label_time", np.float64),
        ("label_pixels", np.int32),
        ("view_frame", np.int32),
        ("view", np.int16),
        ("view_box", np.int16, 4),
        ("view_score", np.float32),
    ]
)
BLOCK = 1 << 12
"""Rows kept together."""
_VIEW = ("view_frame", "view", "view_box", "view_score")
_LABEL = ("label", "label_time", "label_pixels")


class FeatureSums:
    """Feature sums by row, in blocks of fixed size: growing copies nothing, however large the map is."""

    def __init__(self, dim: int) -> None:
        self.dim = dim
        self._blocks: list[np.ndarray] = []
        self._count = 0

    def reserve(self, count: int) -> None:
        """Make room for rows up to `count`; new ones are zero, and take no memory before they are written."""
        while len(self._blocks) * BLOCK < count:
            self._blocks.append(np.zeros((BLOCK, self.dim), dtype=np.float32))
        self._count = max(self._count, count)

    def add(
        self,
        rows: Int[np.ndarray, " p"],
        source: Int[np.ndarray, " p"],
        share: Float32[np.ndarray, " p"],
        sums: Float32[np.ndarray, "m c"],
    ) -> None:
        """Add share[i] sums[source[i]] to each row[i]."""
        order = np.argsort(rows // BLOCK, kind="stable")
        block = rows[order] // BLOCK
        for start, stop in _runs(block):
            part = order[start:stop]
            add_shares(rows[part] % BLOCK, source[part], share[part], sums, self._blocks[int(block[start])])

    def add_all(self, rows: Int[np.ndarray, " p"], other: "FeatureSums") -> None:
        """Add row i of another to row rows[i]."""
        for start in range(0, len(rows), BLOCK):
            part = rows[start : start + BLOCK]
            source = np.arange(len(part), dtype=np.int32)
            self.add(part, source, np.ones(len(part), dtype=np.float32), other.rows(source.astype(np.int64) + start))

    def parts(self, order: Int[np.ndarray, " n"]) -> Iterator[Float32[np.ndarray, "m c"]]:
        """Yield the rows in this order, some at a time."""
        for start in range(0, len(order), 4 * BLOCK):
            yield self.rows(order[start : start + 4 * BLOCK])

    def rows(self, order: Int[np.ndarray, " n"]) -> Float32[np.ndarray, "n c"]:
        """Return the rows in this order."""
        result = np.empty((len(order), self.dim), dtype=np.float32)
        by_block = np.argsort(order // BLOCK, kind="stable")
        block = order[by_block] // BLOCK
        for start, stop in _runs(block):
            part = by_block[start:stop]
            result[part] = self._blocks[int(block[start])][order[part] % BLOCK]
        return result


class Records:
    """Records and class counts by row."""

    def __init__(self, num_classes: int) -> None:
        self.values = np.zeros(0, dtype=RECORD)
        self.histogram = np.zeros((0, num_classes), dtype=np.uint16)

    def add(
        self,
        rows: Int[np.ndarray, " m"],
        records: np.ndarray,
        before: int,
        counts: UInt16[np.ndarray, "m k"] | None = None,
    ) -> None:
        """Combine different rows with what is there; rows from `before` on are new.

        Without `counts` each record counts the class that it names once.
        """
        if not len(rows):
            return
        self._reserve(int(rows.max()) + 1)
        known = rows < before
        self.values[rows[known]] = combined(self.values[rows[known]], records[known])
        self.values[rows[~known]] = records[~known]
        if not self.histogram.shape[1]:
            return
        if counts is None:
            named = records["label"] != NO_LABEL
            counts = np.zeros((len(rows), self.histogram.shape[1]), dtype=np.uint16)
            counts[np.flatnonzero(named), records["label"][named]] = 1
        old = self.histogram[rows]
        self.histogram[rows] = old + np.minimum(counts, np.uint16(65535) - old)

    def _reserve(self, count: int) -> None:
        """Make room, doubling, so that a long drive copies each record a few times only."""
        have = len(self.values)
        if count <= have:
            return
        values = np.zeros(max(count, 2 * have), dtype=RECORD)
        histogram = np.zeros((len(values), self.histogram.shape[1]), dtype=np.uint16)
        values[:have], histogram[:have] = self.values, self.histogram
        self.values, self.histogram = values, histogram


def records_of(
    lifted: Lifted, cover: Cover, *, time: float, labels: UInt8[np.ndarray, " m"] | None, frame: int
) -> np.ndarray:
    """Return a record for each pair of the cover."""
    records = np.zeros(len(cover.row), dtype=RECORD)
    share = cover.share
    records["weight"] = lifted.weight[cover.row] * share
    records["count"] = 1
    records["first_seen"] = records["last_seen"] = time
    if lifted.color_sum is not None:
        records["color_sum"] = lifted.color_sum[cover.row] * share[:, None]
        records["color_weight"] = records["weight"]
    if lifted.normal_sum is not None:
        records["normal_sum"] = lifted.normal_sum[cover.row] * share[:, None]
    records["label"], records["label_time"] = NO_LABEL, -np.inf
    if labels is not None:
        label = labels[cover.row]
        named = label != NO_LABEL
        records["label"] = label
        records["label_time"][named] = time
        records["label_pixels"][named] = np.rint(lifted.pixels[cover.row] * share)[named]
    records["view_frame"], records["view"], records["view_score"] = -1, -1, -1.0
    if lifted.box is not None and lifted.view is not None and lifted.score is not None:
        records["view_frame"], records["view"] = frame, lifted.view[cover.row]
        records["view_box"], records["view_score"] = lifted.box[cover.row], lifted.score[cover.row] * share
    return records


def records_from(columns: Mapping[str, np.ndarray], count: int) -> np.ndarray:
    """Return the records of columns as `VoxelMap.columns` gives them."""
    records = np.zeros(count, dtype=RECORD)
    records["view_frame"], records["view"], records["view_score"] = -1, -1, -1.0
    for name in ("weight", "color_weight", "count", "first_seen", "last_seen", "label_time", "label_pixels", *_VIEW):
        if name in columns:
            records[name] = columns[name]
    records["label"] = columns["labels"]
    records["color_sum"] = columns["colors"] * columns["color_weight"][:, None]
    if "normals" in columns:
        records["normal_sum"] = columns["normals"] * columns["weight"][:, None]
    return records


def reduced(rows: Int[np.ndarray, " p"], records: np.ndarray) -> tuple[Int[np.ndarray, " m"], np.ndarray]:
    """Return the different rows, sorted, and one record each: records of one frame that share a row count once."""
    if not len(rows):
        return rows, records
    order = np.lexsort((records["label"], -records["label_pixels"], rows))  # the first of a row names the label
    rows, records = rows[order], records[order]
    starts = np.concatenate([[0], np.flatnonzero(np.diff(rows)) + 1])
    result = records[starts]
    for name in ("weight", "color_sum", "color_weight", "normal_sum"):
        result[name] = np.add.reduceat(records[name], starts, axis=0)
    best = np.lexsort((records["view"], -records["view_score"], rows))[starts]
    for name in _VIEW:
        result[name] = records[name][best]
    return rows[starts], result


def combined(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Combine records of the same voxels; commutative and associative, so that no order of frames is special."""
    result = a.copy()
    for name in ("weight", "color_sum", "color_weight", "normal_sum", "count"):
        result[name] += b[name]
    result["first_seen"] = np.minimum(a["first_seen"], b["first_seen"])
    result["last_seen"] = np.maximum(a["last_seen"], b["last_seen"])
    later = _greater(b, a, ("label_time", "label_pixels"), ("label",))
    better = _greater(b, a, ("view_score",), ("view_frame", "view"))
    for names, chosen in ((_LABEL, later), (_VIEW, better)):
        for name in names:
            result[name][chosen] = b[name][chosen]
    return result


def _greater(b: np.ndarray, a: np.ndarray, most: tuple[str, ...], least: tuple[str, ...]) -> np.ndarray:
    """Tell where b comes before a: by the greatest of some fields, then the least of others."""
    greater, equal = np.zeros(len(a), dtype=bool), np.ones(len(a), dtype=bool)
    for name in (*most, *least):
        first, second = (b[name], a[name]) if name in most else (a[name], b[name])
        greater |= equal & (first > second)
        equal &= first == second
    return greater


def _runs(values: Int[np.ndarray, " n"]) -> Iterator[tuple[int, int]]:
    """Yield where each run of equal values begins and ends."""
    if len(values):
        edges = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
        yield from pairwise(edges)
