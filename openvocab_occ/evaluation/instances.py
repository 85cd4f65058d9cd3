"""How well predicted sets of voxels match true ones, whatever they are called."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

Keys = Int64[np.ndarray, " _"]


@dataclass(frozen=True, kw_only=True)
class InstanceScores:
    """Class-agnostic instance scores. All are 1 when the prediction is the truth; 0 where nothing is there to match."""

    true_objects: int
    predicted_objects: int
    """That do not lie on ignored truth."""
    ap25: float
    """Average precision at an IoU of 0.25, over all recalls."""
    ap50: float
    precision50: float
    recall50: float
    odr: float
    """Predicted objects per true object that any prediction lies on (the duplicates of OpenLex3D)."""
    mean_iou: float
    """Of the best prediction of each true object."""


def overlaps(
    predicted: Sequence[Keys], true: Sequence[Keys]
) -> tuple[Float64[np.ndarray, "p t"], Float64[np.ndarray, "p t"]]:
    """Return intersection over union, and the share of each prediction that lies on each true set."""
    keys = np.unique(np.concatenate([*true, np.empty(0, np.int64)]))
    intersection = np.zeros((len(predicted), len(true)))
    homes: list[list[int]] = [[] for _ in keys]
    for number, members in enumerate(true):
        for at in np.searchsorted(keys, members):
            homes[at].append(number)
    for row, members in enumerate(predicted):
        at = np.minimum(np.searchsorted(keys, members), max(len(keys) - 1, 0))
        for i in at[keys[at] == members] if len(keys) else []:
            for number in homes[i]:
                intersection[row, number] += 1
    mine = np.array([len(p) for p in predicted], dtype=np.float64)[:, None]
    yours = np.array([len(t) for t in true], dtype=np.float64)[None]
    union = mine + yours - intersection
    iou = np.divide(intersection, union, out=np.zeros_like(intersection), where=union > 0)
    return iou, np.divide(intersection, mine, out=np.zeros_like(intersection), where=mine > 0)


def score_instances(
    predicted: Sequence[Keys], scores: Sequence[float], true: Sequence[Keys], ignored: Sequence[bool]
) -> InstanceScores:
    """Score predictions, each with how sure it is, against true sets; `ignored` ones are neither missed nor hit.

    A prediction that matches no counted truth and lies with more than half on ignored sets is left out.
    """
    iou, share = overlaps(predicted, true)
    counted = ~np.asarray(ignored, dtype=bool)
    on_ignored = share[:, ~counted].sum(axis=1) > 0.5
    hits25, hits50 = (_matches(iou[:, counted], scores, t) for t in (0.25, 0.5))
    keep = ~on_ignored | (iou[:, counted].max(axis=1, initial=0.0) >= 0.25)
    order = sorted(np.flatnonzero(keep).tolist(), key=lambda i: (-scores[i], i))
    total = int(counted.sum())
    lies_on = share[:, counted].argmax(axis=1) if total else np.zeros(len(predicted), int)
    lies = keep & (share[:, counted].max(axis=1, initial=0.0) > 0.5)
    touched = np.bincount(lies_on[lies], minlength=total)
    tp = sum(hits50[i] for i in order)
    return InstanceScores(
        true_objects=total,
        predicted_objects=len(order),
        ap25=average_precision([hits25[i] for i in order], total),
        ap50=average_precision([hits50[i] for i in order], total),
        precision50=tp / len(order) if order else 0.0,
        recall50=tp / total if total else 0.0,
        odr=float(touched.sum() / (touched > 0).sum()) if touched.any() else 0.0,
        mean_iou=float(iou[:, counted].max(axis=0, initial=0.0).mean()) if total else 0.0,
    )


def average_precision(hits: Sequence[bool], total: int) -> float:
    """Return the area under the curve of precision over recall, precision made to fall (as VOC 2010 and COCO do)."""
    if not hits or not total:
        return 0.0
    tp = np.cumsum(np.asarray(hits, dtype=np.float64))
    precision = tp / np.arange(1, len(hits) + 1)
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    recall = tp / total
    return float(np.sum(np.diff(np.concatenate([[0.0], recall])) * precision))


def _matches(iou: Float64[np.ndarray, "p t"], scores: Sequence[float], threshold: float) -> list[bool]:
    """Tell which predictions are hits: the surest first, each takes the true object it fits best among those left."""
    free = np.ones(iou.shape[1], dtype=bool)
    hits = [False] * len(iou)
    for i in sorted(range(len(iou)), key=lambda i: (-scores[i], i)):
        left = np.where(free, iou[i], -1.0)
        best = int(left.argmax()) if len(left) else -1
        if best >= 0 and left[best] >= threshold:
            hits[i], free[best] = True, False
    return hits
