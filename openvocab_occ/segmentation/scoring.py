"""Cosines to scores that a person can read, by what the model's makers or a calibration say."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32

from openvocab_occ.errors import DataError
from openvocab_occ.segmentation.card import Calibration, ScoreCard
from openvocab_occ.segmentation.encoder import TextEncoder

Kind = Literal["cosine", "sigmoid", "relevancy", "probability"]
"""What a score is: probability only after a calibration on labelled voxels."""
DEFAULT_THRESHOLD = {"cosine": 0.25, "sigmoid": 0.5, "relevancy": 0.5, "probability": 0.5}
"""cosine: what matching pairs of CLIP-like models reach. The others: more likely than not."""
_MAX_STEPS = 50


@dataclass(frozen=True, eq=False, kw_only=True)
class Scoring:
    """How features and a text become a score."""

    kind: Kind
    threshold: float
    """Least score of a hit."""
    scale: float = 1.0
    bias: float = 0.0
    negatives: Float32[np.ndarray, "k c"] | None = None
    """Unit vectors that a text must win against; relevancy only."""
    classes: float = 0.0
    """What the name of an occupancy class is worth; see `card.Calibration`."""
    others: float = 0.0
    neutral: float = 0.0

    def __call__(
        self, features: Float[np.ndarray, "n c"], vector: Float[np.ndarray, " c"]
    ) -> Float32[np.ndarray, " n"]:
        """Return the score of each feature for a unit text vector; features of length 0 score as cosine 0."""
        features = np.asarray(features, dtype=np.float32)
        lengths = np.linalg.norm(features, axis=1)
        lengths = np.where(lengths > 0, lengths, 1)
        cosine = features @ vector.astype(np.float32) / lengths
        if self.kind == "cosine":
            return cosine
        logits = self.scale * cosine + self.bias
        if self.negatives is not None:
            rival = (features @ self.negatives.T).max(axis=1) / lengths
            logits = self.scale * (cosine - rival)  # softmax of two is the sigmoid of their difference
        return (0.5 * np.tanh(0.5 * logits) + 0.5).astype(np.float32)


def scoring_of(card: ScoreCard, text: TextEncoder) -> Scoring:
    """Return the scoring of a card; its negatives go through the text encoder."""
    kind: Kind = "probability" if card.calibration is not None else card.kind
    threshold = card.threshold if card.threshold is not None else DEFAULT_THRESHOLD[kind]
    if card.calibration is not None:
        fit = card.calibration
        return Scoring(
            kind=kind, threshold=threshold, scale=fit.a, bias=fit.b,
            classes=fit.classes, others=fit.others, neutral=fit.neutral,
        )  # fmt: skip
    negatives = np.asarray(text.encode(card.negatives), dtype=np.float32) if card.negatives else None
    return Scoring(kind=kind, threshold=threshold, scale=card.scale or 1.0, bias=card.bias, negatives=negatives)


def classify(features: Float[np.ndarray, "... c"], vectors: Float[np.ndarray, "k c"]) -> np.ndarray:
    """Return the number of the text that each feature is nearest to."""
    return np.asarray(features @ np.asarray(vectors).T).argmax(axis=-1)


def fit_platt(
    cosines: Float[np.ndarray, " n"], positive: Bool[np.ndarray, " n"], *, dataset: str, date: str
) -> Calibration:
    """Fit probability = sigmoid(a cosine + b) by maximum likelihood, with Platt's smoothed targets.

    Newton's method after Lin, Lin and Weng, "A note on Platt's probabilistic outputs", 2007.
    Raises DataError unless both kinds are there and positives have the higher cosines.
    """
    good, bad = int(positive.sum()), int((~positive).sum())
    if min(good, bad) < 10:
        raise DataError("too few labels to calibrate", expected="at least 10 of each kind", got=f"{good} and {bad}")
    if not np.isfinite(cosines).all():
        raise DataError("cosines are not finite", expected="numbers", got="NaN or infinite values")
    target = np.where(positive, (good + 1) / (good + 2), 1 / (bad + 2))
    design = np.stack([cosines.astype(np.float64), np.ones(len(cosines))], axis=1)
    weights = np.array([0.0, math.log((good + 1) / (bad + 1))])

    def loss(at: np.ndarray) -> float:
        return float((np.logaddexp(0, design @ at) - target * (design @ at)).sum())

    for _ in range(_MAX_STEPS):
        p = 0.5 * np.tanh(0.5 * (design @ weights)) + 0.5
        gradient = design.T @ (p - target)
        hessian = (design * (p * (1 - p))[:, None]).T @ design + 1e-9 * np.eye(2)
        step = np.linalg.solve(hessian, gradient)
        size = 1.0
        while size > 1e-8 and loss(weights - size * step) > loss(weights):
            size /= 2
        weights = weights - size * step
        if np.abs(size * step).max() < 1e-8:
            break
    if weights[0] <= 0:
        raise DataError(
            "labels contradict the model",
            expected="higher cosines where the label is",
            got=f"slope {weights[0]:.3g}",
            fix="do the words name what the labels do?",
        )
    return Calibration(a=float(weights[0]), b=float(weights[1]), dataset=dataset, date=date, count=len(cosines))


def unknown_words(text: TextEncoder, texts: Sequence[str]) -> tuple[str, ...]:
    """Return the words of the texts that a text encoder says it does not know; none where it cannot say."""
    tell = getattr(text, "unknown_words", None)
    return tuple(dict.fromkeys(word for one in texts for word in tell(one))) if tell is not None else ()
