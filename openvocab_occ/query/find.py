"""Words to objects, and to voxels."""

import itertools
import math
import time
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from openvocab_occ.errors import ConfigError, EncoderMismatchError, ModelError
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.query.answer import Answer as Answer
from openvocab_occ.query.answer import Hit, ScoreKind, Verdict
from openvocab_occ.query.words import STOP_WORDS, Match, checked_text, match_labels, text_words
from openvocab_occ.segmentation.encoder import PixelEncoder
from openvocab_occ.segmentation.scoring import DEFAULT_THRESHOLD, Scoring, unknown_words

LOGITS_THRESHOLD = 0.5
"""More likely than not, if the model's probabilities could be trusted."""
DENSE_THRESHOLD = DEFAULT_THRESHOLD["cosine"]
"""For a `dense` encoder without a scoring of its own."""
_COSINE = Scoring(kind="cosine", threshold=DENSE_THRESHOLD)


class _Reading(NamedTuple):
    """A text as a direction in feature space, and how nearness to it becomes a score."""

    vector: Float32[np.ndarray, " c"]
    match: Match
    scoring: Scoring | None
    """None for `logits` maps, where score = feature . vector."""
    understood: bool

    def __call__(self, features: Float32[np.ndarray, "n c"]) -> Float32[np.ndarray, " n"]:
        return features @ self.vector if self.scoring is None else self.scoring(features, self.vector)


def find(
    scene: SceneMap,
    text: str,
    encoder: PixelEncoder | None = None,
    *,
    limit: int | None = None,
    threshold: float | None = None,
) -> Answer:
    """Rank the objects of a map by how well they fit a text.

    In a map of a `logits` encoder the words must be labels or inflections of them; an object scores the mean
    probability of the labels meant, added up. In a map of a `dense` encoder, which must be passed, its score comes from
    the cosine of its embedding and the text's, in the way of the model's card (see `Scoring`). Words that the text
    encoder does not know are reported. Equal scores rank by id, larger objects first.

    Raises QueryError for a text that cannot be read, EncoderMismatchError for another encoder than the map's.
    """
    start = time.perf_counter()
    if limit is not None and limit < 1:
        raise ConfigError("limit is not usable", expected="at least 1, or None for all hits", got=limit)
    text = checked_text(text)
    reading = _read(scene, text, encoder)
    threshold = _threshold(reading.scoring, threshold)
    things = list(scene.objects) if reading.understood else []
    scores = reading(np.stack([thing.embedding for thing in things])).tolist() if things else []
    scored = [Hit(thing, score) for thing, score in zip(things, scores, strict=True)]
    scored.sort(key=lambda hit: (-hit.score, hit.object.id))
    hits = tuple(hit for hit in scored if hit.score >= threshold)
    verdict: Verdict = "unknown words" if not reading.understood else "found" if hits else "absent"
    kind: ScoreKind = "class probability" if reading.scoring is None else reading.scoring.kind
    return Answer(
        text=text,
        hits=hits[:limit],
        verdict=verdict,
        threshold=threshold,
        best=scored[0].score if scored else None,
        score_kind=kind,
        matched=tuple(itertools.compress(scene.encoder.labels, reading.match.channels)),
        unknown=reading.match.unknown,
        nearest=reading.match.nearest,
        known=scene.encoder.labels,
        seconds=time.perf_counter() - start,
    )


def score_voxels(scene: SceneMap, text: str, encoder: PixelEncoder | None = None) -> Float32[np.ndarray, " n"]:
    """Return each voxel's score for a text, as `find` scores objects; all zero where no word is understood."""
    reading = _read(scene, checked_text(text), encoder)
    features = scene.voxels.features
    return reading(features) if reading.understood else np.zeros(len(features), dtype=np.float32)


def _read(scene: SceneMap, text: str, encoder: PixelEncoder | None) -> _Reading:
    if encoder is not None and encoder.fingerprint != scene.encoder.fingerprint:
        raise EncoderMismatchError(
            "the encoder is not the one that made this map",
            expected=f"{scene.encoder.name} ({scene.encoder.fingerprint[:12]})",
            got=f"{encoder.name} ({encoder.fingerprint[:12]})",
            fix="load the map's encoder, or build the map again with this one",
        )
    if scene.encoder.contract == "logits":
        match = match_labels(text, scene.encoder.labels)
        return _Reading(match.channels.astype(np.float32), match, None, bool(match.channels.any()))
    if encoder is None or encoder.text is None:
        raise ConfigError(
            "this map needs its text encoder to understand words",
            expected=f"encoder {scene.encoder.name} with a text side",
            got="no encoder" if encoder is None else "an encoder without a text side",
            fix="pass it: find(scene, text, encoder)",
        )
    unknown = unknown_words(encoder.text, [text])
    match = Match(np.zeros(0, dtype=bool), unknown)
    if unknown and not set(_spoken(text)) - {word.casefold() for word in unknown}:
        return _Reading(np.zeros(scene.encoder.dim, dtype=np.float32), match, _COSINE, False)
    vectors = np.asarray(encoder.text.encode([text]), dtype=np.float32)
    if vectors.shape != (1, scene.encoder.dim) or not np.isfinite(vectors).all():
        raise ModelError(
            f"text side of {encoder.name} gave no usable vector",
            expected=f"finite, shape (1, {scene.encoder.dim})",
            got=vectors.shape,
        )
    vector = vectors[0] / max(float(np.linalg.norm(vectors[0])), 1e-12)
    scoring = getattr(encoder, "scoring", None) or _COSINE
    return _Reading(vector.astype(np.float32), match, scoring, True)


def _spoken(text: str) -> list[str]:
    """Return the words that say something."""
    return [word for word in text_words(text) if word not in STOP_WORDS]


def _threshold(scoring: Scoring | None, asked: float | None) -> float:
    if asked is not None:
        if not math.isfinite(asked):
            raise ConfigError("threshold is not usable", expected="a finite score", got=asked)
        return float(asked)
    return LOGITS_THRESHOLD if scoring is None else scoring.threshold
