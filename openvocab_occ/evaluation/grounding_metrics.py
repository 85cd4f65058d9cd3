"""Numbers that say how good answers are. Every choice that changes a number is an argument."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int, Int64

from openvocab_occ.errors import DataError
from openvocab_occ.objects.box import Box


def box_iou(a: Box, b: Box) -> float:
    """Return the volume that two upright boxes share over the volume of both together."""
    height = min(a.center[2] + a.size[2] / 2, b.center[2] + b.size[2] / 2) - max(
        a.center[2] - a.size[2] / 2, b.center[2] - b.size[2] / 2
    )
    if height <= 0:
        return 0.0
    shared = _area(_clipped(a.corners[:4, :2], b.corners[:4, :2])) * float(height)
    whole = a.volume + b.volume - shared
    return shared / whole if whole > 0 else 0.0


def average_precision(correct: Bool[np.ndarray, " n"], total: int) -> float:
    """Return the mean of the precisions at each correct item of a ranking, over all `total` correct items there are."""
    if total < 1:
        raise DataError("average precision needs something to find", expected="total of at least 1", got=total)
    hits = np.cumsum(correct)
    return float((hits / np.arange(1, len(correct) + 1))[correct].sum() / total) if len(correct) else 0.0


def calibration_error(
    probability: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"], *, bins: int = 15
) -> float:
    """Return the expected calibration error: mean |confidence - accuracy| over bins of equal width, by their size."""
    if not len(probability):
        return 0.0
    at = np.minimum((probability * bins).astype(np.int64), bins - 1)
    size = np.bincount(at, minlength=bins)
    gap = np.abs(np.bincount(at, probability, bins) - np.bincount(at, correct.astype(np.float64), bins))
    return float(gap.sum() / size.sum())


def confusion(truth: Int[np.ndarray, " n"], found: Int[np.ndarray, " n"], classes: int) -> Int64[np.ndarray, "k k1"]:
    """Count points by true class (rows) and found class; the last column is of those found nowhere (-1)."""
    found = np.where(found < 0, classes, found)
    return np.bincount(truth * (classes + 1) + found, minlength=classes * (classes + 1)).reshape(classes, classes + 1)


@dataclass(frozen=True, kw_only=True)
class SegmentationScores:
    """Shares in 0..1."""

    miou: float
    fmiou: float
    """Weighted by how many points have the class."""
    macc: float
    accuracy: float
    """Of all points; the frequency-weighted mean accuracy."""
    classes: int
    """Over how many classes the means go."""


def segmentation_scores(
    counts: Int64[np.ndarray, "k k1"],
    *,
    ignored: Sequence[int] = (),
    mean_over: str = "truth",
    drop_missing: bool = False,
) -> SegmentationScores:
    """Return IoU and accuracy of a confusion matrix.

    Args:
        counts: By `confusion`.
        ignored: True classes whose points are left out.
        mean_over: Classes that the means go over: `truth` (those with points), `either` (also those only found) or
            `all`, where a class that is nowhere counts as 0.
        drop_missing: Leave out points that were found nowhere, instead of counting them as wrong.
    """
    if mean_over not in ("truth", "either", "all"):
        raise DataError("mean_over is not known", expected="truth, either or all", got=mean_over)
    kept = np.setdiff1d(np.arange(len(counts)), ignored)
    counts = counts.copy()
    counts[list(ignored)] = 0
    if drop_missing:
        counts[:, -1] = 0
    hit = np.diag(counts[:, :-1]).astype(np.float64)
    true, found = counts.sum(axis=1), counts[:, :-1].sum(axis=0)
    iou = hit / np.maximum(true + found - hit, 1)
    acc = hit / np.maximum(true, 1)
    chosen = {"truth": true > 0, "either": (true + found) > 0, "all": np.ones(len(true), dtype=bool)}[mean_over]
    chosen = kept[chosen[kept]]
    share = true / max(int(true.sum()), 1)
    return SegmentationScores(
        miou=float(iou[chosen].mean()) if len(chosen) else 0.0,
        fmiou=float((share * iou).sum()),
        macc=float(acc[chosen].mean()) if len(chosen) else 0.0,
        accuracy=float((share * acc).sum()),
        classes=len(chosen),
    )


def auc_top_k(scores: Float[np.ndarray, "n k"], truth: Int[np.ndarray, " n"], *, step: int = 1) -> float:
    """Return the area under "the true name is among the best k" over k / names (HOV-SG's AUC with step 10).

    Trapezia between k = 0, step, 2 step ... and all names: 1 minus half a step where the truth always comes first.
    """
    n, names = scores.shape
    own = scores[np.arange(n), truth][:, None]
    rank = (scores > own).sum(axis=1)  # names ahead of the true one
    ks = np.unique(np.append(np.arange(0, names, step), names))
    accuracy = (rank[None] < ks[:, None]).mean(axis=1)
    return float(np.trapezoid(accuracy, ks / names))


def top_n_categories(
    ranked: Int[np.ndarray, "n m"],
    categories: Sequence[Mapping[str, frozenset[int]]],
    owner: Int[np.ndarray, " n"],
    *,
    n: int,
    missing: Bool[np.ndarray, " n"] | None = None,
    order: Sequence[str] = ("synonyms", "depictions", "vis_sim", "clutter"),
) -> dict[str, float]:
    """Return OpenLex3D's top-N frequencies: by what of its object's names a point is called; objects weigh equally.

    Args:
        ranked: For each true point the names of its prediction, best first.
        categories: For each object its names by category.
        owner: Object of each point.
        n: How many of the best names count; the first category in `order` that one of them is in is the point's.
        missing: Points without a prediction near enough.
        order: Categories, best first; names in none of them are `incorrect`.
    """
    missing = np.zeros(len(owner), dtype=bool) if missing is None else missing
    result = dict.fromkeys([*order, "missing", "incorrect"], 0.0)
    objects = np.unique(owner)
    for item in objects:
        points = np.flatnonzero(owner == item)
        for point in points:
            best = set(ranked[point, :n].tolist())
            name = next((c for c in order if best & categories[item].get(c, frozenset())), "incorrect")
            result["missing" if missing[point] else name] += 1 / len(points)
    return {name: value / max(len(objects), 1) for name, value in result.items()}


def _area(polygon: Float64[np.ndarray, "n 2"]) -> float:
    if len(polygon) < 3:
        return 0.0
    x, y = polygon.T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)


def _clipped(polygon: Float64[np.ndarray, "n 2"], by: Float64[np.ndarray, "m 2"]) -> Float64[np.ndarray, "_ 2"]:
    """Return the part of a convex polygon inside another, both counter-clockwise (Sutherland and Hodgman 1974)."""
    for start, end in zip(by, np.roll(by, -1, axis=0), strict=True):
        edge = end - start
        side = edge[0] * (polygon[:, 1] - start[1]) - edge[1] * (polygon[:, 0] - start[0])
        kept: list[np.ndarray] = []
        for i, point in enumerate(polygon):
            before = i - 1
            if (side[i] >= 0) != (side[before] >= 0):
                t = side[before] / (side[before] - side[i])
                kept.append(polygon[before] + t * (point - polygon[before]))
            if side[i] >= 0:
                kept.append(point)
        if not kept:
            return np.zeros((0, 2))
        polygon = np.array(kept)
    return polygon
