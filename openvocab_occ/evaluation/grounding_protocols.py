"""Published protocols of segmentation by words, as data: what each of them leaves unsaid, said."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from openvocab_occ.errors import ConfigError
from openvocab_occ.evaluation.grounding_metrics import SegmentationScores, confusion, segmentation_scores

_STRUCTURE = ("wall", "floor", "ceiling", "door", "window")


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """The choices that change a number."""

    points: Literal["same", "nearest", "majority of 5", "nearest within"]
    """How true points get a prediction: point by point, that of the nearest predicted point, of most of the 5 nearest,
    or of the nearest one if it is near enough."""
    radius: float = float("inf")
    """Metres, for `nearest within`."""
    ignored: tuple[str, ...] = ()
    """Classes whose true points do not count."""
    mean_over: Literal["truth", "either", "all"] = "truth"
    """Classes that means go over: those with true points, those with true or found points, or all of the vocabulary."""
    per_scene: bool = False
    """Mean of scenes' means; else one confusion matrix of all scenes."""
    drop_missing: bool = False
    """Leave out points without a prediction, instead of counting them as wrong."""
    template: str = "{}"
    """Sentence that a class name is put into."""
    scene_vocabulary: bool = False
    """Only classes that occur in the scene are asked for."""


PRESETS = {
    "conceptgraphs": Protocol(
        points="nearest", ignored=("other", *_STRUCTURE), template="an image of {}", scene_vocabulary=True
    ),
    "hovsg": Protocol(
        points="majority of 5", ignored=(*_STRUCTURE, "background"), per_scene=True,
        template="There is the {} in the scene.",
    ),
    "openscene": Protocol(points="same", mean_over="all", drop_missing=True, template="a {} in a scene"),
    "rayfronts": Protocol(points="majority of 5", ignored=(*_STRUCTURE, "background"), per_scene=True),
    "openlex3d": Protocol(points="nearest within", radius=0.05),
    "occ3d": Protocol(points="same", ignored=("free",)),
    "semantickitti": Protocol(points="same", ignored=("unlabeled",), mean_over="all"),
    "strict": Protocol(points="nearest within", radius=0.4),
}  # fmt: skip
"""By the code and papers of their authors. `strict` is ours: nothing ignored, all scenes in one matrix, points without
a prediction are wrong."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LabelledScene:
    """True and predicted points with classes, numbers of a shared vocabulary; -1 is none."""

    points: Float[np.ndarray, "n 3"]
    truth: Int[np.ndarray, " n"]
    found_points: Float[np.ndarray, "m 3"]
    found: Int[np.ndarray, " m"]


def evaluate_segmentation(
    scenes: Sequence[LabelledScene], names: Sequence[str], protocol: Protocol
) -> SegmentationScores:
    """Judge predicted classes of points by a protocol; true points of class -1 never count."""
    if not scenes:
        raise ConfigError("there is nothing to judge", expected="at least 1 scene", got=0)
    ignored = [i for i, name in enumerate(names) if name in protocol.ignored]
    matrices = []
    for scene in scenes:
        known = scene.truth >= 0
        matched = matched_classes(scene, protocol)[known]
        matrices.append(confusion(scene.truth[known], matched, len(names)))
    scores = [
        segmentation_scores(m, ignored=ignored, mean_over=protocol.mean_over, drop_missing=protocol.drop_missing)
        for m in (matrices if protocol.per_scene else [np.sum(matrices, axis=0)])
    ]
    fields = ("miou", "fmiou", "macc", "accuracy")
    means = {name: float(np.mean([getattr(score, name) for score in scores])) for name in fields}
    return SegmentationScores(**means, classes=max(score.classes for score in scores))


def matched_classes(scene: LabelledScene, protocol: Protocol) -> Int[np.ndarray, " n"]:
    """Return the class that each true point gets from the prediction, -1 where none."""
    if protocol.points == "same":
        if len(scene.found) != len(scene.truth):
            raise ConfigError(
                "points differ", expected=f"{len(scene.truth)} classes, one a point", got=len(scene.found)
            )
        return scene.found
    if not len(scene.found):
        return np.full(len(scene.truth), -1)
    from scipy.spatial import KDTree

    count = 5 if protocol.points == "majority of 5" else 1
    distance, at = KDTree(scene.found_points).query(scene.points, k=min(count, len(scene.found)))
    distance, at = (np.asarray(column).reshape(len(scene.points), -1) for column in (distance, at))
    classes = scene.found[at]
    if count > 1:
        best, votes = np.full(len(classes), -1), np.zeros(len(classes), dtype=np.int64)
        for column in range(classes.shape[1]):  # the nearest of the commonest wins
            own = (classes == classes[:, [column]]).sum(axis=1)
            best = np.where(own > votes, classes[:, column], best)
            votes = np.maximum(votes, own)
        return best
    near = distance[:, 0] <= (protocol.radius if protocol.points == "nearest within" else np.inf)
    return np.where(near, classes[:, 0], -1)
