"""The algebra over a map's objects: each clause gives every object an interval of degrees.

An interval is a point where all was observed, and [0, 1] where it was not: "parked" of a thing whose motion nobody saw.
And takes the least, Or the greatest, Not turns an interval round (Kleene's logic over fuzzy degrees), so what was not
observed stays undecided unless something else settles it. A thing fits if its lower end reaches 1/2, and may fit if its
upper end does. Beside degrees goes a score for the order of hits: the noun's own, times the degrees of the rest.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from openvocab_occ.errors import QueryError
from openvocab_occ.mapping.picking import Picker
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.tree import OBJECT
from openvocab_occ.query import algebra as q
from openvocab_occ.query import colors
from openvocab_occ.query.algebra import Node
from openvocab_occ.query.boxes import Boxes
from openvocab_occ.query.index import Index, index_of
from openvocab_occ.query.reading import reading_of
from openvocab_occ.query.relations import Anchor, Viewpoint, between, distance, falling, related, rising, within
from openvocab_occ.query.scoring import Reading, Scorer

HALF = 0.5
DEFAULT_LEVELS = frozenset({OBJECT, "region"})
_SIZES = {"large": ("volume", 1), "small": ("volume", -1), "tall": ("height", 1), "low": ("height", -1),
          "long": ("length", 1), "short": ("length", -1), "wide": ("width", 1), "narrow": ("width", -1)}  # fmt: skip
_CLEARLY_LARGER = 1.6
"""Ratio of lengths (of cube roots for volumes) to the median at which a thing is surely large; 1/2 at its root."""
_STILL = ("stopped", "parked", "fixed")
_LATE = (q.Relation, q.Within)  # dear, so asked of what is left
_LAST = (q.Sized,)  # needs to know what it is compared with


class Clause(NamedTuple):
    """What a query says of every node."""

    low: Float64[np.ndarray, " n"]
    high: Float64[np.ndarray, " n"]
    score: Float64[np.ndarray, " n"]


class Traced(NamedTuple):
    """A clause that was evaluated on the way, for the reasons of an answer."""

    reading: str
    clause: Clause


@dataclass
class Report:
    """What else evaluating a query brought to light."""

    unknown: list[str] = field(default_factory=list[str])
    nearest: dict[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    matched: list[str] = field(default_factory=list[str])
    notes: list[str] = field(default_factory=list[str])
    trace: list[Traced] = field(default_factory=list[Traced])
    places: list[tuple[Node, list[Anchor]]] = field(default_factory=list[tuple[Node, list[Anchor]]])
    """Relations and distances that a thing must satisfy, with what they are to."""
    calibrated: bool = True


class Evaluator:
    """Evaluates queries over one map, as one viewer sees it."""

    def __init__(self, scene: SceneMap, scorer: Scorer, viewer: Viewpoint) -> None:
        self.scene, self.scorer, self.viewer = scene, scorer, viewer
        self.index: Index = index_of(scene)
        self.report = Report()
        self._levels = DEFAULT_LEVELS
        self._depth = 0  # inside anchors above 0
        self._required = True
        self._main: list[Reading] = []

    @property
    def rule(self) -> Reading | None:
        """How the first noun of the query was read."""
        return self._main[0] if self._main else None

    def evaluate(self, query: Node, rows: Bool[np.ndarray, " n"] | None = None) -> Clause | None:
        """Return degrees and scores; None where no word of the query is understood.

        Only `rows` need to be right; the others may come out as 0.
        """
        rows = np.ones(len(self.index), dtype=bool) if rows is None else rows
        if isinstance(query, q.And):
            return self._and(query, rows)
        if isinstance(query, q.Or):
            return self._or(query, rows)
        if isinstance(query, q.Not):
            required, self._required = self._required, False
            inner = self.evaluate(query.of, rows)
            self._required = required
            return None if inner is None else self._masked(Clause(1 - inner.high, 1 - inner.low, 1 - inner.high))
        if isinstance(query, q.Superlative | q.Some):
            inner = self.evaluate(query.of, rows)
            return None if inner is None else self._selected(query, inner)
        if isinstance(query, q.Count):
            return self.evaluate(query.of, rows)
        if isinstance(query, q.Level):
            levels, self._levels = self._levels, frozenset({query.level})
            inner = self.evaluate(query.of, rows)
            self._levels = levels
            return inner
        clause = self._leaf(query, rows)
        if clause is not None and self._depth == 0:
            self.report.trace.append(Traced(reading_of(query), clause))
        return clause

    # --- combinations ---

    def _and(self, query: q.And, rows: Bool[np.ndarray, " n"]) -> Clause | None:
        n = len(self.index)
        whole = Clause(*(np.ones(n) for _ in range(3)))
        doubtful = False
        order = sorted(query.of, key=lambda part: 2 * _holds(part, _LAST) + _holds(part, _LATE))
        for part in order:
            clause = self.evaluate(part, rows)
            if clause is None:
                if isinstance(part, q.Noun):
                    return None
                doubtful = True
                continue
            # a noun's score multiplies as it is; what is not a noun does so by its degree
            whole = Clause(
                np.minimum(whole.low, clause.low), np.minimum(whole.high, clause.high), whole.score * clause.score
            )
            rows = rows & (whole.high >= HALF)
        if doubtful:
            whole = whole._replace(low=np.zeros(n))
        return self._masked(whole)

    def _or(self, query: q.Or, rows: Bool[np.ndarray, " n"]) -> Clause | None:
        required, self._required = self._required, False
        parts = [clause for part in query.of if (clause := self.evaluate(part, rows)) is not None]
        self._required = required
        return Clause(*(np.maximum.reduce(list(column)) for column in zip(*parts, strict=True))) if parts else None

    def _selected(self, query: q.Superlative | q.Some, inner: Clause) -> Clause:
        """Keep the best of what fits; undecided where what may fit would change the choice."""
        sure, maybe = inner.low >= HALF, inner.high >= HALF
        if isinstance(query, q.Some):
            keys = -inner.score
            chosen, possible = self._first(sure, keys, query.number), self._first(maybe, keys, query.number)
            if sure.sum() < query.number and self._depth == 0:
                self.report.notes.append(f"asked for {query.number}, {int(sure.sum())} fit")
        else:
            keys = self._keys(query)
            chosen = self._first(sure, keys, query.rank, only=True)
            possible = self._first(maybe, keys, query.rank, only=True)
        settled = chosen & possible
        candidates = possible | chosen
        return Clause(
            np.where(settled, inner.low, 0.0),
            np.where(candidates, inner.high, 0.0),
            np.where(candidates, inner.score, 0.0),
        )

    def _first(
        self, among: Bool[np.ndarray, " n"], keys: Float64[np.ndarray, " n"], number: int, *, only: bool = False
    ) -> Bool[np.ndarray, " n"]:
        rows = np.flatnonzero(among)
        rows = rows[np.lexsort((self.index.ids[rows], keys[rows]))][number - 1 if only else 0 : number]
        chosen = np.zeros(len(among), dtype=bool)
        chosen[rows] = True
        return chosen

    def _keys(self, query: q.Superlative) -> Float64[np.ndarray, " n"]:
        """Return what to sort by, the wanted end first."""
        boxes = self.index.boxes
        if query.by == "distance":
            gaps = [distance(boxes, anchor) for anchor in self._anchors(query.anchor or q.Me())[0]]
            keys = np.minimum.reduce(gaps) if gaps else np.zeros(len(boxes))
        elif query.by == "left":
            way = boxes.center[:, :2] - self.viewer.position[:2]
            keys = np.arctan2(way[:, 1], way[:, 0]) - self.viewer.heading
            keys = (keys + np.pi) % (2 * np.pi) - np.pi
        else:
            keys = self._dimension(query.by)
        return keys if query.least else -keys

    # --- single clauses ---

    def _leaf(self, query: Node, rows: Bool[np.ndarray, " n"]) -> Clause | None:
        match query:
            case q.Noun(text):
                return self._noun(text)
            case q.Anything():
                return self._masked(_sure(np.ones(len(self.index))))
            case q.Color(name):
                return self._masked(self._color(name, rows))
            case q.Material(name):
                return self._material(name)
            case q.State(name):
                return self._masked(self._state(name))
            case q.Sized(name):
                return self._masked(self._sized(name, rows))
            case q.Measure(dimension, low, high):
                value = self._dimension(dimension)
                degree = np.ones(len(value)) if high is None else falling(value, high * 0.9, high * 1.1 + 1e-9)
                return self._masked(
                    _sure(np.minimum(degree, rising(value, low * 0.9, low * 1.1 + 1e-9)) if low else degree)
                )
            case q.Relation() | q.Within():
                return self._placed(query, rows)
            case q.Item(id):
                return _sure((self.index.ids == self._row(id, ids=True)).astype(np.float64))
        return self._example(query)

    def _noun(self, text: str) -> Clause | None:
        read = self.scorer.noun(text)
        self.report.unknown += read.match.unknown
        self.report.nearest.update(read.match.nearest)
        if read.reading is None:
            return None
        if self._depth == 0:
            self.report.matched += read.matched
        return self._scored(read.reading)

    def _scored(self, reading: Reading) -> Clause:
        if self._depth == 0:
            self._main.append(reading)
            self.report.calibrated &= reading.kind == "probability"
        said = self.index.said(reading.worth(self.index.label_names)) if reading.classes else None
        score = reading.score(self.index.embeddings, said).astype(np.float64)
        degree = reading.degree(score)
        return self._masked(Clause(degree, degree, score))

    def _material(self, name: str) -> Clause | None:
        if self.scorer.has_labels:
            self.report.unknown.append(name)
            self.report.notes.append("a map of labels knows no materials")
            return None
        return self._noun(name)

    def _example(self, query: Node) -> Clause:
        match query:
            case q.Vector(values):
                vector = np.array(values, dtype=np.float32)
                return self._scored(self.scorer.like(vector) if self.scorer.has_labels else self.scorer.vector(vector))
            case q.Crop(image):
                return self._scored(self.scorer.crop(image))
            case q.Like(id):
                row = self._row(id)
                clause = self._scored(self.scorer.like(self.index.embeddings[row]))
                others = np.arange(len(self.index)) != row
                return Clause(*(np.where(others, column, 0.0) for column in clause))
            case q.Click(origin, direction):
                row = self._clicked(np.array(origin), np.array(direction))
                return self._scored(self.scorer.like(self.index.embeddings[row]))
        raise QueryError("query cannot be evaluated here", got=reading_of(query))

    def _state(self, name: str) -> Clause:
        wanted = _STILL if name == "still" else (name,)
        fits = self.index.in_states(wanted).astype(np.float64)
        blind = self.index.in_states(("unknown",))
        if blind.all() and len(blind) and self._depth == 0:
            self.report.notes.append(f"nothing was observed about motion, so nothing is known to be {name}")
        return Clause(fits, np.where(blind, 1.0, fits), np.where(blind, 0.5, fits))

    def _color(self, name: str, rows: Bool[np.ndarray, " n"]) -> Clause:
        degree, known = np.zeros(len(rows)), np.ones(len(rows), dtype=bool)
        at = np.flatnonzero(rows)
        if name in ("bright", "dark"):
            light, known[at] = self.index.lightness(at)
            degree[at] = np.clip((light - 0.5) / 0.4 if name == "bright" else (0.7 - light) / 0.4, 0.0, 1.0)
        else:
            found, known[at] = self.index.color_degrees(at)
            told = self.scorer.told(colors.NAMES, self.index.embeddings[at])
            degree[at] = (found if told is None else colors.agreed(found, told))[:, colors.NAMES.index(name)]
        if len(at) and not known[at].any() and self._depth == 0:
            self.report.notes.append("no image gave colours")
        return Clause(np.where(known, degree, 0.0), np.where(known, degree, 1.0), np.where(known, degree, 0.5))

    def _sized(self, name: str, rows: Bool[np.ndarray, " n"]) -> Clause:
        by, sign = _SIZES[name]
        value = self._dimension(by)
        rows = rows & self._on_level()
        if rows.sum() < 2:
            if self._depth == 0:
                self.report.notes.append(f"nothing of its kind to compare with, so none is known to be {name}")
            return Clause(np.zeros(len(rows)), np.ones(len(rows)), np.full(len(rows), 0.5))
        times = np.log(np.maximum(value, 1e-9) / max(float(np.median(value[rows])), 1e-9)) * sign
        times = times / 3 if by == "volume" else times
        return _sure(rising(times, 0.0, np.log(_CLEARLY_LARGER)))

    def _placed(self, query: q.Relation | q.Within, rows: Bool[np.ndarray, " n"]) -> Clause | None:
        at = np.flatnonzero(rows & self._on_level())
        things = self.index.boxes.take(at)
        low, high = np.zeros(len(self.index)), np.zeros(len(self.index))
        asked = query.anchors if isinstance(query, q.Relation) else (query.anchor,)
        sides = [self._anchors(anchor) for anchor in asked]
        if any(not anchors and unknown for anchors, _, unknown in sides):
            return None
        if self._depth == 0 and self._required:
            self.report.places.append((query, [anchor for anchors, _, _ in sides for anchor in anchors]))

        def better(degree: np.ndarray, sure: tuple[float, float], own: int = -1) -> None:
            degree = np.where(at == own, 0.0, degree)
            low[at] = np.maximum(low[at], np.minimum(degree, sure[0]))
            high[at] = np.maximum(high[at], np.minimum(degree, sure[1]))

        if isinstance(query, q.Relation) and query.name == "between":
            self._between(sides, things, better, at)
        else:
            rule: Callable[[Anchor], np.ndarray] = (
                (lambda a: within(things, a, query.at_least, query.at_most))
                if isinstance(query, q.Within)
                else (lambda a: related(query.name, things, a, self.viewer))
            )
            for anchor, (own, *sure) in zip(*sides[0][:2], strict=True):
                better(rule(anchor), (sure[0], sure[1]), int(own))
        return self._masked(Clause(low, high, (low + high) / 2))

    def _between(self, sides: list[Any], things: Boxes, better: Callable[..., None], at: np.ndarray) -> None:
        first, last = sides[0], sides[-1]
        for i, (a, (row_a, *sure_a)) in enumerate(zip(first[0], first[1], strict=True)):
            for j, (b, (row_b, *sure_b)) in enumerate(zip(last[0], last[1], strict=True)):
                if (len(sides) == 1 and j <= i) or row_a == row_b:
                    continue
                degree = np.where((at == row_a) | (at == row_b), 0.0, between(things, a, b))
                better(degree, (min(sure_a[0], sure_b[0]), min(sure_a[1], sure_b[1])))

    def _anchors(self, query: Node) -> tuple[list[Anchor], list[tuple[int, float, float]], bool]:
        """Return what a relation is to, with the row and the degrees of each; and whether its words are unknown."""
        if isinstance(query, q.Me):
            return [Anchor(self.viewer.boxes(), is_viewer=True)], [(-1, 1.0, 1.0)], False
        if isinstance(query, q.Place):
            spot = Viewpoint(np.array(query.at)).boxes()
            return [Anchor(spot, is_viewer=False)], [(-1, 1.0, 1.0)], False
        self._depth += 1
        levels, self._levels = self._levels, DEFAULT_LEVELS
        clause = self.evaluate(query)
        self._depth, self._levels = self._depth - 1, levels
        if clause is None:
            return [], [], True
        rows = np.flatnonzero(clause.high >= HALF)
        if not len(rows):
            self.report.notes.append(f"there is no {reading_of(query)} to compare with")
        found = [(int(row), float(clause.low[row]), float(clause.high[row])) for row in rows]
        return [self.index.anchor(int(row)) for row in rows], found, False

    # --- measures ---

    def _dimension(self, name: str) -> Float64[np.ndarray, " n"]:
        size = self.index.boxes.size
        return size.prod(axis=1) if name == "volume" else size[:, ("length", "width", "height").index(name)]

    def _on_level(self) -> Bool[np.ndarray, " n"]:
        on = self.index.on_levels(self._levels)
        # a region of things alone, such as a front of buildings, would name them again
        return on & ~self.index.regions_of_things if self._levels == DEFAULT_LEVELS else on

    def _masked(self, clause: Clause) -> Clause:
        on = self._on_level()
        return clause if on.all() else Clause(*(np.where(on, column, 0.0) for column in clause))

    def _row(self, id: int, *, ids: bool = False) -> int:
        if id not in self.index.row_of:
            raise QueryError(
                f"there is no object #{id}", expected=f"an id of the map's {len(self.index)} objects", got=id
            )
        return id if ids else self.index.row_of[id]

    def _clicked(self, origin: Float64[np.ndarray, " 3"], direction: Float64[np.ndarray, " 3"]) -> int:
        """Return the object of the first voxel that a ray enters."""
        hit = Picker(self.scene.voxels).pick(origin, direction)
        rows = [row for row, node in enumerate(self.index.nodes) if hit is not None and hit.voxel in node.voxels]
        rows = [row for row in rows if self.index.nodes[row].level in DEFAULT_LEVELS] or rows
        if not rows:
            raise QueryError("the click hits no object", got=f"from {origin.tolist()} towards {direction.tolist()}")
        return rows[0]


def _sure(degree: Float64[np.ndarray, " n"]) -> Clause:
    return Clause(degree, degree, degree)


def _holds(query: Node, kinds: tuple[type[Node], ...]) -> bool:
    return any(isinstance(node, kinds) for node in q.walk(query))
