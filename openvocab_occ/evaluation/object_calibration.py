"""Probabilities of answers: how likely an object is what a word names, from maps of drives whose truth is known.

A logistic regression on three pieces of evidence: the cosine of the object's look and the word, and how much the class
that occupancy names speaks for the word and against it (`Scorer.spoken`, of `NEUTRAL`). The pairs are those of objects
and questions of a generated set, so their base rate is that of questions asked.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from openvocab_occ.errors import DataError
from openvocab_occ.evaluation.grounding import SAME
from openvocab_occ.evaluation.grounding_drive import Drive, questions_of
from openvocab_occ.query.scoring import Scorer
from openvocab_occ.segmentation.card import Calibration
from openvocab_occ.segmentation.encoder import PixelEncoder

NEUTRAL = 0.6
"""Cosine of two words from which one of them speaks for the other. Of this text encoder, kinds of vehicle reach it."""
_CATEGORIES = ("class", "synonym", "absent")
_PRIOR = 0.03
"""Ridge on the weights: evidence that never occurs gets none; such as never erred on these drives, a finite one."""
_STEPS = 50


@dataclass(frozen=True, eq=False)
class Pairs:
    """Objects and words; one row a pair."""

    evidence: Float64[np.ndarray, "n 3"]
    """Cosine of look and word; what the class name says for and against the word, times what speaks for the class."""
    correct: Bool[np.ndarray, " n"]


def object_pairs(drive: Drive, encoder: PixelEncoder, seed: int, synonyms: dict[str, str] | None = None) -> Pairs:
    """Return each object of a drive with each noun it may be asked by; what may be called either way is left out."""
    overlap, scorer = drive.overlap(), Scorer(drive.scene, encoder)
    objects = list(drive.scene.objects)
    looks = np.stack([item.embedding for item in objects])
    purity = np.array([item.score for item in objects])
    evidence, correct = [np.empty((0, 3))], [np.empty(0, dtype=bool)]
    for question in questions_of(drive, seed, synonyms=synonyms):
        reading = scorer.noun(question.text).reading if question.category in _CATEGORIES else None
        if reading is None:
            continue
        names = scorer.spoken(reading.vector, NEUTRAL)
        said = np.array([names.get(item.label, (0.0, 0.0)) for item in objects]) * purity[:, None]
        kept = np.array([all(overlap(item, id) < SAME for id in question.either) for item in objects])
        evidence.append(np.column_stack([looks @ reading.vector, said])[kept])
        right = [any(overlap(item, id) >= SAME for id in question.wanted) for item in objects]
        correct.append(np.array(right, dtype=bool)[kept])
    return Pairs(np.concatenate(evidence), np.concatenate(correct))


def fit_objects(pairs: Sequence[Pairs], *, dataset: str, date: str) -> Calibration:
    """Fit by maximum likelihood, with Newton's method.

    Raises DataError unless there are pairs of both kinds, and right ones look more like their words.
    """
    evidence = np.concatenate([p.evidence for p in pairs])
    correct = np.concatenate([p.correct for p in pairs]).astype(np.float64)
    good = int(correct.sum())
    if min(good, len(correct) - good) < 10:
        raise DataError("too few pairs to calibrate", expected="at least 10 of each kind", got=(good, len(correct)))
    X = np.concatenate([evidence, np.ones((len(evidence), 1))], axis=1)
    w = np.zeros(X.shape[1])
    for _ in range(_STEPS):
        p = 0.5 * np.tanh(0.5 * (X @ w)) + 0.5
        hessian = (X * (p * (1 - p))[:, None]).T @ X + _PRIOR * np.eye(len(w))
        step = np.linalg.solve(hessian, X.T @ (p - correct) + _PRIOR * w)
        w -= step
        if np.abs(step).max() < 1e-8:
            break
    if not (np.isfinite(w).all() and w[0] > 0):
        raise DataError("pairs contradict the model", expected="higher cosines where the word is right", got=w[0])
    a, classes, others, b = (round(float(value), 3) for value in w)
    return Calibration(
        a=a, b=b, classes=max(classes, 0.0), others=max(-others, 0.0), neutral=NEUTRAL,
        dataset=dataset, date=date, count=len(correct),
    )  # fmt: skip
