"""Nouns to scores, in the way of the map's encoder and its card."""

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float, Float32, Float64

from openvocab_occ.errors import ConfigError, EncoderMismatchError, ModelError, QueryError
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.query.answer import ScoreKind
from openvocab_occ.query.words import STOP_WORDS, Match, match_labels, singular, text_words
from openvocab_occ.segmentation.encoder import PixelEncoder
from openvocab_occ.segmentation.scoring import DEFAULT_THRESHOLD

LOGITS_THRESHOLD = 0.5
"""More likely than not, if the model's probabilities could be trusted."""
DENSE_THRESHOLD = DEFAULT_THRESHOLD["cosine"]
"""For a `dense` encoder whose card says nothing of scores."""
LIKE_THRESHOLD = 0.8
"""Cosine of two things that look alike: image features lie closer to each other than to words."""
_MAX_PIXELS = 1 << 25
_KNOWN: "WeakKeyDictionary[SceneMap, dict[str, np.ndarray | None]]" = WeakKeyDictionary()


@dataclass(frozen=True, eq=False, kw_only=True)
class Reading:
    """What a noun or a picture means to the encoder: nearness to vectors, and what that is worth."""

    vector: Float32[np.ndarray, " c"]
    kind: ScoreKind
    threshold: float
    scale: float = 1.0
    bias: float = 0.0
    negatives: Float32[np.ndarray, "k c"] | None = None
    """Unit vectors that the text must win against."""
    classes: Mapping[str, float] = field(default_factory=dict[str, float])
    """What a name of an occupancy class adds before the sigmoid, below 0 where it speaks against; others: nothing."""

    def score(
        self, features: Float32[np.ndarray, "n c"], said: Float[np.ndarray, " n"] | None = None
    ) -> Float32[np.ndarray, " n"]:
        """Return the score of features that are unit vectors, zero, or distributions.

        `said` is what is added for the classes that occupancy names; see `worth`.

        One product of matrix and vector; with negatives one product of matrices, so that features are read once.
        """
        if self.negatives is not None and self.kind not in ("cosine", "class probability"):
            both = features @ np.concatenate([self.vector[None], self.negatives]).T
            cosine, rival = both[:, 0], both[:, 1:].max(axis=1)
            return _sigmoid(self.scale * (cosine - rival))  # a softmax of two
        cosine = features @ self.vector
        if self.kind in ("cosine", "class probability"):
            return cosine
        logits = self.scale * cosine + self.bias
        return _sigmoid(logits if said is None else logits + said)

    def worth(self, names: Sequence[str]) -> Float64[np.ndarray, " k"]:
        """Return what each name of a class adds."""
        return np.array([self.classes.get(name, 0.0) for name in names], dtype=np.float64)

    def degree(self, score: Float[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Return scores as degrees: 0 at 0, 1/2 at the threshold, 1 at 1, straight lines between."""
        low = min(max(self.threshold, 1e-6), 1 - 1e-6)
        score = np.asarray(score, dtype=np.float64)
        return np.clip(np.where(score >= low, 0.5 + (score - low) / (2 * (1 - low)), score / (2 * low)), 0.0, 1.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class NounReading:
    """A noun, read; `reading` is None where no word of it is known."""

    reading: Reading | None
    match: Match
    matched: tuple[str, ...] = ()
    """Labels meant, on a map of labels."""


class Scorer:
    """Reads nouns and pictures for one map."""

    def __init__(self, scene: SceneMap, encoder: PixelEncoder | None, threshold: float | None = None) -> None:
        if encoder is not None and encoder.fingerprint != scene.encoder.fingerprint:
            raise EncoderMismatchError(
                "the encoder is not the one that made this map",
                expected=f"{scene.encoder.name} ({scene.encoder.fingerprint[:12]})",
                got=f"{encoder.name} ({encoder.fingerprint[:12]})",
                fix="load the map's encoder, or build the map again with this one",
            )
        if threshold is not None and not math.isfinite(threshold):
            raise ConfigError("threshold is not usable", expected="a finite score", got=threshold)
        self.info, self.encoder, self.asked = scene.encoder, encoder, threshold
        self.card: Any = getattr(encoder, "scoring", None)  # optional in the protocol
        self.has_labels = scene.encoder.contract == "logits"
        self._scene = scene
        self._class_names = () if self.has_labels else scene.class_names

    @property
    def kind(self) -> ScoreKind:
        """What the scores of nouns are."""
        return "class probability" if self.has_labels else "cosine" if self.card is None else self.card.kind

    @property
    def threshold(self) -> float:
        """Least score of a noun's hit."""
        if self.asked is not None:
            return float(self.asked)
        if self.has_labels:
            return LOGITS_THRESHOLD
        own = getattr(self.encoder, "threshold", None) if self.card is None else self.card.threshold
        return DENSE_THRESHOLD if own is None else float(own)

    def noun(self, text: str) -> NounReading:
        """Read a noun phrase."""
        if self.has_labels:
            match = match_labels(text, self.info.labels)
            named = tuple(label for label, meant in zip(self.info.labels, match.channels, strict=True) if meant)
            vector = match.channels.astype(np.float32)
            reading = Reading(vector=vector, kind=self.kind, threshold=self.threshold) if named else None
            return NounReading(reading=reading, match=match, matched=named)
        if self.encoder is None or self.encoder.text is None:
            raise ConfigError(
                "this map needs its text encoder to understand words",
                expected=f"encoder {self.info.name} with a text side",
                got="no encoder" if self.encoder is None else "an encoder without a text side",
                fix="pass the model that made it: find(scene, text, encoder), or --encoder FILE",
            )
        phrase = singular(text)
        unknown = self._unknown(phrase)
        if unknown and phrase != text and len(self._unknown(text)) < len(unknown):
            phrase, unknown = text, self._unknown(text)
        match = Match(np.zeros(0, dtype=bool), unknown)
        said = {word for word in text_words(phrase) if word not in STOP_WORDS}
        if unknown and not said - {word.casefold() for word in unknown}:
            return NounReading(reading=None, match=match)
        return NounReading(reading=self.vector(self._encode(phrase)), match=match)

    def vector(self, vector: Float32[np.ndarray, " c"]) -> Reading:
        """Read a vector of the text side's space, as a noun."""
        unit = self._unit(vector)
        if self.card is None:
            return Reading(vector=unit, kind="cosine", threshold=self.threshold)
        names = ("kind", "scale", "bias", "negatives")
        return Reading(
            vector=unit, threshold=self.threshold, classes=self._classes(unit),
            **{name: getattr(self.card, name) for name in names},
        )  # fmt: skip

    def like(self, vector: Float32[np.ndarray, " c"]) -> Reading:
        """Read the vector of something seen: its cosine with what else was seen."""
        threshold = LIKE_THRESHOLD if self.asked is None else self.asked
        return Reading(vector=self._unit(vector), kind="cosine", threshold=threshold)

    def crop(self, image: bytes) -> Reading:
        """Read a picture: the mean of its cells."""
        if self.encoder is None:
            raise ConfigError("a picture needs the map's encoder", got="no encoder", fix="find(scene, query, encoder)")
        cells = self.encoder.encode([_decoded(image)])[0].cells
        return self.like(cells.reshape(-1, cells.shape[-1]).mean(axis=0).astype(np.float32))

    def told(self, words: Sequence[str], features: Float32[np.ndarray, "n c"]) -> Float64[np.ndarray, "n k"] | None:
        """Return how likely each of some words is for features, one of them being right; None where no card says it.

        Words that the model does not know are as likely as the others are on average.
        """
        if self.has_labels or self.encoder is None or self.encoder.text is None or self.card is None:
            return None
        vectors = {} if self.card.kind == "cosine" else self._known(words)
        if not vectors:
            return None
        odds = self.card.scale * (features @ np.stack(list(vectors.values())).T).astype(np.float64)
        odds = np.exp(odds - odds.max(axis=1, keepdims=True))
        found = np.full((len(features), len(words)), 1 / len(words))
        found[:, [words.index(word) for word in vectors]] = (
            odds / odds.sum(axis=1, keepdims=True) * (len(vectors) / len(words))
        )
        return found

    def _classes(self, vector: Float32[np.ndarray, " c"]) -> dict[str, float]:
        """Return what each class name of the map's occupancy is worth for a text; none that the model does not know."""
        if not (self.card.classes or self.card.others):
            return {}
        spoken = self.spoken(vector, self.card.neutral)
        return {name: self.card.classes * pro - self.card.others * con for name, (pro, con) in spoken.items()}

    def spoken(self, vector: Float32[np.ndarray, " c"], neutral: float) -> dict[str, tuple[float, float]]:
        """Return how much each class name of the map's occupancy speaks for a text, and how much against it.

        For it: the cosine above `neutral`. Against it: by how much another name is nearer, times how surely that one is
        meant, which is its cosine above `neutral` as a share of the most there can be. A car is no truck; but where a
        text names none of the classes, or one of them only roughly, the others say nothing.
        """
        known = self._known(self._class_names)
        near = {name: max(float(own @ vector) - neutral, 0.0) for name, own in known.items()}
        most = max(near.values(), default=0.0)
        return {name: (own, most / (1 - neutral) * (most - own)) for name, own in near.items()} if most else {}

    def _known(self, words: Sequence[str]) -> dict[str, Float32[np.ndarray, " c"]]:
        """Return the vector of each word that the text model knows, encoded once a map."""
        kept = _KNOWN.setdefault(self._scene, {})
        for word in words:
            if word not in kept:
                kept[word] = None if self._unknown(word) else self._unit(self._encode(word))
        return {word: vector for word in words if (vector := kept[word]) is not None}

    def _unit(self, vector: Float32[np.ndarray, " c"]) -> Float32[np.ndarray, " c"]:
        vector = np.asarray(vector, dtype=np.float32)
        length = float(np.linalg.norm(vector))
        if vector.shape != (self.info.dim,) or not np.isfinite(length) or length == 0:
            raise QueryError(
                "vector does not fit the map", expected=f"{self.info.dim} finite numbers, not all 0", got=vector.shape
            )
        return (vector / length).astype(np.float32)

    def _unknown(self, text: str) -> tuple[str, ...]:
        tell = getattr(self.encoder.text, "unknown_words", None) if self.encoder is not None else None
        return tuple(tell(text)) if tell is not None else ()

    def _encode(self, text: str) -> Float32[np.ndarray, " c"]:
        assert self.encoder is not None
        assert self.encoder.text is not None
        vectors = np.asarray(self.encoder.text.encode([text]), dtype=np.float32)
        if vectors.shape != (1, self.info.dim) or not np.isfinite(vectors).all() or not vectors.any():
            raise ModelError(
                f"text side of {self.encoder.name} gave no usable vector",
                expected=f"finite, shape (1, {self.info.dim})",
                got=vectors.shape,
            )
        return vectors[0]


def _sigmoid(x: np.ndarray) -> Float32[np.ndarray, " n"]:
    return (0.5 * np.tanh(0.5 * x) + 0.5).astype(np.float32)


def _decoded(image: bytes) -> np.ndarray:
    """Return the pixels of a picture; other files and huge ones are refused before they are unpacked."""
    import cv2

    size = _png_size(image) if image.startswith(b"\x89PNG\r\n\x1a\n") else _jpeg_size(image)
    if size is None:
        raise QueryError("picture cannot be read", expected="PNG or JPEG", got=f"{len(image)} bytes")
    if not 0 < size[0] * size[1] <= _MAX_PIXELS:
        raise QueryError("picture is too large", expected=f"up to {_MAX_PIXELS} pixels", got=size)
    bgr = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)
    if bgr is None:
        raise QueryError("picture cannot be read", expected="PNG or JPEG", got="a damaged file")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def _png_size(image: bytes) -> tuple[int, int] | None:
    return struct.unpack(">II", image[16:24]) if len(image) >= 24 else None


def _jpeg_size(image: bytes) -> tuple[int, int] | None:
    """Return width and height from the first frame header."""
    at = 2
    while image.startswith(b"\xff\xd8") and at + 9 <= len(image) and image[at] == 0xFF:
        marker, length = image[at + 1], struct.unpack(">H", image[at + 2 : at + 4])[0]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", image[at + 5 : at + 9])
            return width, height
        at += 2 + length
    return None
