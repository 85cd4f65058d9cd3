"""Questions whose answers are known, drawn from what is really there.

Each asks one thing that an answer can get wrong: the kind, a word for the same kind, colour, motion, place, number,
that there is none, that nobody looked. Truth about places is told by definitions of their own, from points on the
boxes; things too near a border to tell are marked `either`, and count for neither side.
"""

from collections import Counter
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from openvocab_occ.evaluation.grounding_truth import TrueThing, Truth
from openvocab_occ.query.relations import Viewpoint
from openvocab_occ.query.words import SYNONYMS

CATEGORIES = ("class", "synonym", "colour", "state", "relation", "count", "absent", "unobserved")
ABSENT = ("elephant", "sofa", "airplane", "boat", "piano", "horse", "umbrella", "refrigerator", "giraffe", "windmill")
_NEAR, _FAR = (9.0, 11.0), 45.0
_SIDE = (20.0, 40.0)
"""Degrees off an axis up to which a side is sure, and from which it surely is not: 45 is the diagonal."""
_RELATIONS = ("near", "left of", "right of", "behind", "in front of")
_PER_CATEGORY = 24


@dataclass(frozen=True, kw_only=True)
class Question:
    """A text, and the things that it asks for."""

    text: str
    category: str
    wanted: frozenset[int]
    either: frozenset[int] = frozenset()
    """Things that may be named or not."""
    verdict: str = "found"


def questions_about(truth: Truth, seed: int, *, per_category: int = _PER_CATEGORY) -> list[Question]:
    """Draw questions about a truth, the same for the same seed."""
    rng = np.random.default_rng(seed)
    drawn = []
    for category in CATEGORIES:
        all_of_it = _MAKERS[category](truth)
        order = rng.permutation(len(all_of_it))[:per_category]
        drawn += [all_of_it[i] for i in np.sort(order)]
    return drawn


@lru_cache(maxsize=256)
def plural(name: str) -> str:
    """Return a name of a kind in the plural."""
    from lemminflect import getInflection

    *first, last = name.split()
    return " ".join([*first, next(iter(getInflection(last, "NNS", inflect_oov=True)), f"{last}s")])


def _ids(truth: Truth, kind: str, **more: str) -> frozenset[int]:
    chosen = (t for t in truth.things if t.kind == kind and all(getattr(t, k) == v for k, v in more.items()))
    return frozenset(t.id for t in chosen)


def _kinds(truth: Truth) -> list[str]:
    return sorted({thing.kind for thing in truth.things})


def _classes(truth: Truth) -> list[Question]:
    return [Question(text=plural(kind), category="class", wanted=_ids(truth, kind)) for kind in _kinds(truth)]


def _synonyms(truth: Truth) -> list[Question]:
    kinds = set(_kinds(truth))
    found = []
    for line in SYNONYMS:
        names = line.split(", ")
        for word in names:
            meant = kinds & set(names)
            if word not in kinds and len(meant) == 1:
                found.append(Question(text=word, category="synonym", wanted=_ids(truth, meant.pop())))
    return found


def _colours(truth: Truth) -> list[Question]:
    pairs = sorted({(t.color, t.kind) for t in truth.things if t.color})
    pairs = [(color, kind) for color, kind in pairs if color not in ("beige", "silver")]  # no names of their own
    either = {
        kind: frozenset(t.id for t in truth.things if t.kind == kind and t.color in ("beige", "silver", ""))
        for _, kind in pairs
    }
    return [
        Question(
            text=f"{color} {plural(kind)}",
            category="colour",
            wanted=_ids(truth, kind, color=color),
            either=either[kind],
        )
        for color, kind in pairs
    ]


def _states(truth: Truth) -> list[Question]:
    pairs = sorted({(t.state, t.kind) for t in truth.things if t.state in ("moving", "parked")})
    return [
        Question(text=f"{state} {plural(kind)}", category="state", wanted=_ids(truth, kind, state=state))
        for state, kind in pairs
    ]


def _relations(truth: Truth) -> list[Question]:
    counts = Counter(t.kind for t in truth.things)
    single = [t for t in truth.things if counts[t.kind] == 1]
    found = []
    for anchor in single:
        for kind in _kinds(truth):
            others = [t for t in truth.things if t.kind == kind and t.id != anchor.id]
            for name in _RELATIONS:
                told = {t.id: _holds(name, t, anchor, truth.viewer) for t in others}
                wanted = frozenset(i for i, holds in told.items() if holds)
                either = frozenset(i for i, holds in told.items() if holds is None)
                if wanted:
                    text = f"{kind} {name} the {anchor.kind}"
                    found.append(Question(text=text, category="relation", wanted=wanted, either=either))
    return found


def _counts(truth: Truth) -> list[Question]:
    return [
        Question(text=f"how many {plural(kind)}", category="count", wanted=_ids(truth, kind)) for kind in _kinds(truth)
    ]


def _absent(truth: Truth) -> list[Question]:
    kinds = set(_kinds(truth))
    return [
        Question(text=word, category="absent", wanted=frozenset(), verdict="absent")
        for word in ABSENT
        if word not in kinds
    ]


def _unobserved(truth: Truth) -> list[Question]:
    x, y = truth.viewer.position[:2]
    away = 10 * truth.ground
    spots = [(x + away, y), (x - away, y), (x, y + away), (x, y - away)]
    return [
        Question(
            text=f"{kind} within 15 m of ({a:.0f}, {b:.0f})",
            category="unobserved",
            wanted=frozenset(),
            verdict="unobserved",
        )
        for kind in _kinds(truth)
        for a, b in spots
    ]


_MAKERS = {"class": _classes, "synonym": _synonyms, "colour": _colours, "state": _states, "relation": _relations,
           "count": _counts, "absent": _absent, "unobserved": _unobserved}  # fmt: skip


def _holds(name: str, thing: TrueThing, anchor: TrueThing, viewer: Viewpoint) -> bool | None:
    """Tell whether a relation holds, or None near its border."""
    a, b = _points(thing), _points(anchor)
    gap = float(np.linalg.norm(a[:, None] - b[None], axis=2).min())
    if name == "near":
        return True if gap < _NEAR[0] else False if gap > _NEAR[1] else None
    way = thing.box.center[:2] - anchor.box.center[:2]
    sight = (thing.box.center[:2] + anchor.box.center[:2]) / 2 - viewer.position[:2]
    if gap > 20 or max(anchor.box.size[0], thing.box.size[0]) > 6 or np.linalg.norm(way) < 4:
        return None if gap < _FAR else False  # long things have sides of their own
    angle = np.degrees(np.arctan2(sight[0] * way[1] - sight[1] * way[0], sight @ way))
    axis = {"behind": 0.0, "left of": 90.0, "in front of": 180.0, "right of": -90.0}[name]
    off = abs((angle - axis + 180.0) % 360.0 - 180.0)
    return True if off < _SIDE[0] else False if off > 90 - _SIDE[0] else None


def _points(thing: TrueThing) -> np.ndarray:
    """Return points all over a box's faces and inside, half a metre apart or closer."""
    steps = [np.linspace(-0.5, 0.5, min(int(np.ceil(s / 0.5)) + 1, 40)) for s in thing.box.size]
    steps[2] = np.array([-0.5, 0.0, 0.5])
    local = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    edge = (np.abs(local) == 0.5).any(axis=1)
    return thing.box.center + (local[edge] * thing.box.size) @ thing.box.axes.T
