"""A query in words: what was understood, in a form that leaves nothing open."""

from openvocab_occ.query import algebra as q
from openvocab_occ.query.algebra import Node

_MOST = {"volume": ("largest", "smallest"), "length": ("longest", "shortest"), "width": ("widest", "narrowest"),
         "height": ("tallest", "lowest"), "distance": ("farthest", "nearest"),
         "left": ("leftmost", "rightmost")}  # fmt: skip


def reading_of(query: Node) -> str:
    """Return a query as words."""
    match query:
        case q.Noun(text):
            return f"'{text}'"
        case q.Anything():
            return "anything"
        case q.Color(name):
            return f"of colour {name}"
        case q.Sized(name):
            return f"{name} for its kind"
        case q.Material(name):
            return f"of material {name}"
        case q.State(name):
            return f"seen to be {name}"
        case q.Measure(dimension, low, high):
            return f"{dimension} {_range(low, high)}"
        case q.Me():
            return "the viewer"
        case q.Place(at):
            return f"({at[0]:g}, {at[1]:g}, {at[2]:g})"
        case q.Relation(name, anchors):
            return f"{name} {' and '.join(_inner(a) for a in anchors)}"
        case q.Within(anchor, high, low):
            return f"{_range(low, high)} from {_inner(anchor)}"
        case q.Not(of):
            return f"not {_inner(of)}"
        case q.And(of):
            return ", ".join(_inner(part) for part in of)
        case q.Or(of):
            return " or ".join(_inner(part) for part in of)
        case q.Level(of, level):
            return f"{level}s: {_inner(of)}"
        case q.Superlative():
            return _superlative(query)
        case q.Some(of, number):
            return f"the best {number} of {_inner(of)}"
        case q.Count(of):
            return f"how many: {reading_of(of)}"
    return _example(query)


def _example(query: Node) -> str:
    match query:
        case q.Like(id):
            return f"like #{id}"
        case q.Item(id):
            return f"#{id}"
        case q.Vector(values):
            return f"near a vector of {len(values)} numbers"
        case q.Crop(image):
            return f"like a picture of {len(image)} bytes"
        case q.Click(origin, direction):
            return f"like what lies from {origin} towards {direction}"
    return type(query).__name__.lower()


def _superlative(query: q.Superlative) -> str:
    order = _MOST[query.by][query.least]
    rank = "" if query.rank == 1 else f"{query.rank}. "
    anchor = f" to {_inner(query.anchor)}" if query.anchor is not None else ""
    return f"{rank}{order}{anchor} of {_inner(query.of)}"


def _inner(query: Node) -> str:
    text = reading_of(query)
    return f"[{text}]" if isinstance(query, q.And | q.Or | q.Superlative | q.Some) else text


def _range(low: float, high: float | None) -> str:
    if high is None:
        return f"at least {low:g} m"
    return f"up to {high:g} m" if low <= 0 else f"{low:g} to {high:g} m"
