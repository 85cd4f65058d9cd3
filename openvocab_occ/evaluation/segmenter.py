"""How well a dense model understands the synthetic city: pixels and words, against what is true of every pixel.

Only cities that no model of ours was trained or chosen on are used (`EVALUATION_SEEDS`). All numbers are of synthetic
streets and say nothing about real images.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float32, Int32, UInt8

from openvocab_occ.datasets.city import City
from openvocab_occ.errors import ConfigError, ModelError
from openvocab_occ.evaluation.words import CLASSES, NEVER_RENDERED, UNSEEN_ABSENT, UNSEEN_SYNONYMS
from openvocab_occ.segmentation.encoder import FeatureMap, PixelEncoder
from openvocab_occ.segmentation.scoring import DEFAULT_THRESHOLD, Scoring

EVALUATION_SEEDS = (2000, 2001, 2002, 2003)
"""Of cities; 1000 to 1101 are for training and validation."""
MIN_PIXELS = 100
"""Smaller things are not judged; sky and ground are, whatever is seen of them."""
SIZE = (704, 256)
KEYFRAMES = (3, 11, 19, 27, 35)
_NOT_JUDGED = -1


@dataclass(frozen=True, eq=False)
class Picture:
    """An image and what is true of its pixels."""

    image: UInt8[np.ndarray, "h w 3"]
    classes: Int32[np.ndarray, "h w"]
    """Position in CLASSES; -1 is not judged."""
    pairs: Int32[np.ndarray, "h w"]
    """Position in NEVER_RENDERED; -1 for others, -2 is not judged."""


def pictures(seeds: Sequence[int], condition: str = "clear") -> Iterator[Picture]:
    """Yield the six views of a few keyframes of a drive through the city of each seed."""
    number = {kind: place for place, kinds in enumerate(CLASSES.values()) for kind in kinds}
    for seed in seeds:
        drive = City(seed).traversal(route=0, condition=condition)
        facts = drive.attributes()
        class_of = {id_: number.get(fact.kind, _NOT_JUDGED) for id_, fact in facts.items()}
        rows = {(color, kind): p for p, (color, name) in enumerate(NEVER_RENDERED) for kind in CLASSES[name]}
        pair_of = {id_: rows.get((fact.color, fact.kind), -1) for id_, fact in facts.items()}
        for index in KEYFRAMES:
            for _, camera, moment in drive.cameras(index, size=SIZE):
                seen = drive.render(camera, moment)
                used, where, count = np.unique(seen.instance, return_inverse=True, return_counts=True)
                small = (count < MIN_PIXELS) & (used != 0)
                classes = [number["sky"] if i == 0 else class_of.get(int(i), _NOT_JUDGED) for i in used]
                pairs = [pair_of.get(int(i), -1) for i in used]
                shape = seen.instance.shape
                kept = np.where(small, _NOT_JUDGED, np.array(classes, dtype=np.int32)).astype(np.int32)
                apart = np.where(small, -2, np.array(pairs, dtype=np.int32)).astype(np.int32)
                yield Picture(seen.image, kept[where].reshape(shape), apart[where].reshape(shape))


def lexicon_of(model: Path) -> dict[str, str] | None:
    """Return the words that lexicon.yaml beside a model names the classes by; None where there is no such file."""
    file = model.parent / "lexicon.yaml"
    if not file.is_file():
        return None
    things = yaml.safe_load(file.read_text()).get("things", {})
    return {word: name for name in CLASSES if name in things for word in things[name]["words"]}


def evaluate(
    encoder: PixelEncoder,
    *,
    seeds: Sequence[int] = EVALUATION_SEEDS,
    condition: str = "clear",
    lexicon: dict[str, str] | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> dict[str, Any]:
    """Return the scores of a dense model, with the seeds they were measured on.

    Args:
        encoder: A dense model with its text side.
        seeds: Of cities.
        condition: Weather.
        lexicon: Words that it was trained on, and the class each names; their top-1 is reported.
        progress: Called with the pictures done and their total.

    Raises ModelError for a model without features, ConfigError for no seeds.
    """
    if encoder.contract != "dense" or encoder.text is None:
        raise ModelError(f"{encoder.name} cannot be asked in words", expected="a dense model", got=encoder.contract)
    if not seeds:
        raise ConfigError("there is nothing to evaluate on", expected="at least one seed", got=0)
    names = list(CLASSES)
    prompts = encoder.text.encode(names)
    pairs = encoder.text.encode([f"{color} {name}" for color, name in NEVER_RENDERED])
    absent_words = [word for word in UNSEEN_ABSENT if not _unknown(encoder, word)]
    absent = encoder.text.encode(absent_words)
    plain = Scoring(kind="cosine", threshold=DEFAULT_THRESHOLD["cosine"])
    scoring: Scoring = getattr(encoder, "scoring", None) or plain
    confusion = np.zeros((len(names), len(names)), dtype=np.int64)
    hit, union = np.zeros(len(pairs)), np.zeros(len(pairs))
    fired, asked, seconds = np.zeros(len(absent)), 0, []
    total = len(seeds) * len(KEYFRAMES) * 6
    for done, picture in enumerate(pictures(seeds, condition), start=1):
        started = time.perf_counter()
        found = encoder.encode([picture.image])[0]
        seconds.append(time.perf_counter() - started)
        guess = _per_pixel(found, found.cells @ prompts.T, picture.classes.shape).argmax(axis=2)
        judged = picture.classes >= 0
        confusion += np.bincount(
            picture.classes[judged] * len(names) + guess[judged], minlength=len(names) ** 2
        ).reshape(confusion.shape)
        cells = found.cells.reshape(-1, encoder.dim)
        for place, vector in enumerate(pairs):
            score = scoring(cells, vector).reshape(*found.cells.shape[:2], 1)
            said = _per_pixel(found, score, picture.classes.shape)[:, :, 0] >= scoring.threshold
            true, there = picture.pairs == place, picture.pairs != -2
            hit[place] += (said & true).sum()
            union[place] += ((said & there) | true).sum()
        fired += [(scoring(cells, vector) >= scoring.threshold).mean() for vector in absent]
        asked += 1
        if progress is not None:
            progress(done, total)
    area = confusion.sum(axis=0) + confusion.sum(axis=1) - confusion.diagonal()
    there = confusion.sum(axis=1) > 0
    iou = confusion.diagonal() / np.maximum(area, 1)
    unseen, wrong = _top1(encoder, prompts, UNSEEN_SYNONYMS)
    report = {
        "synthetic": True,
        "model": encoder.name,
        "seeds": list(seeds),
        "condition": condition,
        "pictures": asked,
        "class_miou": float(iou[there].mean()),
        "class_iou": {name: float(v) for name, v, t in zip(names, iou, there, strict=True) if t},
        "never_rendered_iou": {
            f"{color} {name}": float(h / u) if u else None
            for (color, name), h, u in zip(NEVER_RENDERED, hit, union, strict=True)
        },
        "unseen_synonyms_top1": unseen,
        "unseen_synonyms_wrong": wrong,
        "absent_fired_median": float(np.median(fired / asked)),
        "absent_fired_worst": float((fired / asked).max()),
        "absent_fired": dict(zip(absent_words, (fired / asked).tolist(), strict=True)),
        "absent_not_known": [word for word in UNSEEN_ABSENT if word not in absent_words],
        "ms_per_image": 1e3 * float(np.median(seconds)),
    }
    if lexicon:
        report["lexicon_top1"], report["lexicon_wrong"] = _top1(encoder, prompts, lexicon)
    return report


def _top1(
    encoder: PixelEncoder, prompts: Float32[np.ndarray, "k c"], words: dict[str, str]
) -> tuple[float, dict[str, str]]:
    """Return the share of words that are nearest to their class, and what the others are nearest to."""
    assert encoder.text is not None, "checked by the caller"
    names = list(CLASSES)
    unknown = {word for word in words if _unknown(encoder, word)}
    known = [word for word in words if word not in unknown]
    nearest = [names[i] for i in (encoder.text.encode(known) @ prompts.T).argmax(axis=1)] if known else []
    wrong = {word: near for word, near in zip(known, nearest, strict=True) if near != words[word]}
    wrong |= dict.fromkeys(unknown, "not known")
    return 1 - len(wrong) / len(words), wrong


def _unknown(encoder: PixelEncoder, text: str) -> bool:
    tell = getattr(encoder.text, "unknown_words", None)
    return tell is not None and len(tell(text)) == len(text.split())


def _per_pixel(
    found: FeatureMap, scores: Float32[np.ndarray, "r s k"], shape: tuple[int, ...]
) -> Float32[np.ndarray, "h w k"]:
    """Return scores at every pixel: bilinear between cells, the nearest beyond the outermost."""
    rows, columns = (
        np.clip(np.arange(n) * found.scale[1 - axis] + found.offset[1 - axis], 0, scores.shape[axis] - 1)
        for axis, n in enumerate(shape)
    )
    top, left = np.floor(rows).astype(int), np.floor(columns).astype(int)
    bottom, right = np.minimum(top + 1, scores.shape[0] - 1), np.minimum(left + 1, scores.shape[1] - 1)
    y, x = (rows - top).astype(np.float32)[:, None, None], (columns - left).astype(np.float32)[None, :, None]
    lines = scores[top] * (1 - y) + scores[bottom] * y
    return lines[:, left] * (1 - x) + lines[:, right] * x
