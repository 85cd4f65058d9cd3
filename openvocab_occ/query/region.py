"""The place that a query names, and how much of it was seen."""

import numpy as np
from jaxtyping import Bool, Float64

from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.query import algebra as q
from openvocab_occ.query.algebra import Node
from openvocab_occ.query.boxes import Boxes, ground_gap, repeated
from openvocab_occ.query.coverage import CELL, coverage_of
from openvocab_occ.query.relations import REACH, Anchor, Viewpoint, between, related, within

_AROUND = frozenset({"next to", "near", "along", "between", "in front of", "behind", "left of", "right of"})
"""Relations that name ground beside their anchor; the others name the anchor itself, which was seen if it is known."""
_BETWEEN_REACH = 30.0
_MAX_ANCHORS = 64
_MAX_CELLS = 1 << 18


def share_seen(scene: SceneMap, places: list[tuple[Node, list[Anchor]]], viewer: Viewpoint) -> float | None:
    """Return the share of the named ground that was observed, or None where none was named.

    Several relations of one thing name the ground where all of them hold by at least 1/2.
    """
    named = [(query, anchors) for query, anchors in places if anchors and _reach(query) is not None]
    if not named:
        return None
    spots = _around(named)
    inside = np.ones(len(spots), dtype=bool)
    for query, anchors in named:
        inside &= _holds(query, anchors, spots, viewer)
    if not inside.any():
        return None
    return float(coverage_of(scene).seen(spots[inside]).mean())


def _reach(query: Node) -> float | None:
    """Return how far from an anchor the named ground goes, metres; None where a query names none or has no end."""
    if isinstance(query, q.Within):
        return query.at_most
    if isinstance(query, q.Relation) and query.name in _AROUND:
        return REACH.get(query.name, _BETWEEN_REACH)
    return None


def _around(named: list[tuple[Node, list[Anchor]]]) -> Float64[np.ndarray, "n 2"]:
    """Return the middles of squares around the anchors of the query that reaches least far."""
    query, anchors = min(named, key=lambda item: _reach(item[0]) or 0.0)
    reach = (_reach(query) or 0.0) + CELL
    centers = np.concatenate([anchor.box.center[:, :2] for anchor in anchors[:_MAX_ANCHORS]])
    radii = np.concatenate([anchor.box.radius for anchor in anchors[:_MAX_ANCHORS]]) + reach
    low, high = (centers - radii[:, None]).min(axis=0), (centers + radii[:, None]).max(axis=0)
    step = max(CELL, float(np.sqrt(np.prod(high - low) / _MAX_CELLS)))
    x, y = (np.arange(a, b, step) for a, b in zip(np.floor(low / CELL) * CELL + CELL / 2, high, strict=True))
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def _holds(
    query: Node, anchors: list[Anchor], spots: Float64[np.ndarray, "n 2"], viewer: Viewpoint
) -> Bool[np.ndarray, " n"]:
    """Tell where a thin post, as high as the anchor, would stand in the relation, beside the anchor itself."""
    degree, covered = np.zeros(len(spots)), np.zeros(len(spots), dtype=bool)
    for i, anchor in enumerate(anchors[:_MAX_ANCHORS]):
        posts = _posts(spots, anchor)
        if isinstance(query, q.Within):
            degree = np.maximum(degree, within(posts, anchor, query.at_least, query.at_most))
        elif isinstance(query, q.Relation) and query.name == "between":
            for other in anchors[i + 1 : _MAX_ANCHORS]:
                degree = np.maximum(degree, between(posts, anchor, other))
        elif isinstance(query, q.Relation):
            degree = np.maximum(degree, related(query.name, posts, anchor, viewer))
        if anchor.columns is None and not anchor.is_viewer:
            covered |= ground_gap(posts, repeated(anchor.box, len(posts))) <= 0
    return (degree >= 0.5) & ~covered


def _posts(spots: Float64[np.ndarray, "n 2"], anchor: Anchor) -> Boxes:
    n = len(spots)
    center = np.concatenate([spots, np.full((n, 1), anchor.box.center[0, 2])], axis=1)
    size = np.concatenate([np.full((n, 2), 1e-3), np.full((n, 1), anchor.box.size[0, 2])], axis=1)
    return Boxes(center, size, np.zeros(n))
