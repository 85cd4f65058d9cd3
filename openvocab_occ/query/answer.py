"""Answers: what was found, how sure that is, and how the words were understood."""

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from openvocab_occ.objects.tree import SceneObject, Sighting
from openvocab_occ.query.algebra import Node

Verdict = Literal["found", "absent", "unobserved", "unknown words"]
"""`found`: objects fit. `absent`: it was looked for where it was asked for, and none fits. `unobserved`: the place that
was named was mostly not seen, or what was asked for (motion, colour) was not observed, so nothing can be said.
`unknown words`: the kind of thing was not understood."""
ScoreKind = Literal["class probability", "cosine", "sigmoid", "relevancy", "probability"]


class ClauseScore(NamedTuple):
    """What one clause of a query says of an object."""

    clause: str
    low: float
    high: float
    """Degree: fits from 1/2. Low and high differ where something was not observed."""

    def __str__(self) -> str:
        degree = f"{self.low:.2f}" if self.low == self.high else "not observed"
        return f"{self.clause}: {degree}"


class Counted(NamedTuple):
    """How many things fit."""

    value: int
    """Things that fit; where scores are calibrated those more likely than not, and one where anything is found."""
    low: int
    """How many fit with degree 3/4 or more."""
    high: int
    """How many may fit: with degree 1/4 or more, or undecided."""
    expected: float | None
    """Sum of the probabilities, and its standard deviation; only where scores are calibrated."""
    deviation: float | None


NONE_COUNTED = Counted(0, 0, 0, None, None)


@dataclass(frozen=True, eq=False)
class Hit:
    """An object and how well it fits the words."""

    object: SceneObject
    score: float
    """Of the noun, times the degrees of what else was asked."""
    undecided: bool = False
    """It fits as far as was observed, but not everything was; such hits do not count as found."""
    clauses: tuple[ClauseScore, ...] = ()
    probability: float | None = None
    """The score where all of it is calibrated."""
    times: tuple[float, float] | None = None
    """First and last time it was seen, seconds."""

    @property
    def views(self) -> tuple[Sighting, ...]:
        """Best sightings."""
        return self.object.views


@dataclass(frozen=True, eq=False, kw_only=True)
class Answer:
    """What a map says to a text."""

    text: str
    hits: tuple[Hit, ...]
    """Objects that fit, best first; after them those that may."""
    verdict: Verdict
    threshold: float
    """Least score of a noun's hit; of other clauses a degree of 1/2."""
    best: float | None
    """Score of the best object even where it is below the threshold; None where no object was scored."""
    score_kind: ScoreKind
    """What a noun's score is. Only `probability` is calibrated; a class probability is what the softmax says."""
    query: Node | None = None
    """The text, understood; None where nothing was."""
    reading: str = ""
    """The same in words."""
    counted: Counted = NONE_COUNTED
    """Before any limit."""
    matched: tuple[str, ...] = ()
    """Labels of the map that the words meant; empty for a `dense` map, which reads nouns as a whole."""
    unknown: tuple[str, ...] = ()
    """Words that were not understood, and had no effect."""
    nearest: dict[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    """Labels spelt like an unknown word."""
    known: tuple[str, ...] = ()
    """Labels that this map knows; empty for a `dense` map."""
    notes: tuple[str, ...] = ()
    """What a person should know of how the answer came about."""
    region_seen: float | None = None
    """Share of the named place that was observed; None where none was named."""
    observed_area: float = 0.0
    """Square metres of ground of which anything was seen: what `absent` speaks of where no place was named."""
    seconds: float = 0.0

    @property
    def count(self) -> int:
        """How many things fit."""
        return self.counted.value

    def explain(self) -> str:
        """Return how the text was read, and each hit with its score, clauses, place and size, as lines for a person."""
        lines = [f'"{self.text}": {self._verdict()}']
        if self.reading:
            lines.append(f"  read as: {self.reading}")
        if self.matched:
            lines.append(f"  labels: {', '.join(self.matched)}")
        lines += [f'  not understood: "{word}"{self._hint(word)}' for word in self.unknown]
        lines += [f"  note: {note}" for note in self.notes]
        if self.verdict == "unknown words":
            lines.append(f"  this map knows: {', '.join(self.known) or 'no words'}")
        if self.best is not None or self.verdict != "unknown words":
            best = "no object" if self.best is None else f"best {self.best:.2f}"
            trust = "calibrated" if self.score_kind == "probability" else "not calibrated"
            lines.append(f"  score: {self.score_kind}, {trust}; threshold {self.threshold:.2f}, {best}")
            lines.append(f"  looked at: {self._looked()}")
        for rank, hit in enumerate(self.hits, start=1):
            lines += _lines(rank, hit)
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        import msgspec

        names = ("text", "verdict", "threshold", "best", "score_kind", "reading", "region_seen", "observed_area",
                 "seconds")  # fmt: skip
        lists = {name: list(getattr(self, name)) for name in ("matched", "unknown", "known", "notes")}
        nearest = {word: list(near) for word, near in self.nearest.items()}
        query = None if self.query is None else msgspec.to_builtins(self.query)
        more = {"query": query, "count": self.counted._asdict(), "nearest": nearest}
        return {name: getattr(self, name) for name in names} | lists | more | {"hits": [_hit(h) for h in self.hits]}

    def _verdict(self) -> str:
        value, low, high, expected, deviation = self.counted
        if self.verdict not in ("found", "absent"):
            return self.verdict
        span = f" (between {low} and {high})" if low != value or high != value else ""
        mean = f", expected {expected:.1f} ± {deviation:.1f}" if expected is not None and deviation is not None else ""
        return f"{self.verdict}, {value}{span}{mean}"

    def _looked(self) -> str:
        if self.region_seen is None:
            return f"{self.observed_area:,.0f} m² of ground"
        return f"{self.region_seen:.0%} of the place that was named"

    def _hint(self, word: str) -> str:
        return f" (nearest: {', '.join(self.nearest[word])})" if word in self.nearest else ""


def _lines(rank: int, hit: Hit) -> list[str]:
    item = hit.object
    x, y, z = item.center
    length, width, height = item.box.size
    undecided = " undecided" if hit.undecided else ""
    first = (
        f"  {rank}. {item.label or 'object'} #{item.id}  {hit.score:.2f}{undecided}"
        f"  at ({x:.1f}, {y:.1f}, {z:.1f}) m, {length:.1f} x {width:.1f} x {height:.1f} m,"
        f" {len(item.voxels)} voxels, state {item.state}"
    )
    seen = [f"{view.view} of frame {view.frame}" for view in hit.views[:2]]
    lines = [first]
    if len(hit.clauses) > 1:
        lines.append("     " + "; ".join(map(str, hit.clauses)))
    if seen:
        lines.append("     seen in " + ", ".join(seen))
    return lines


def _hit(hit: Hit) -> dict[str, Any]:
    item = hit.object
    return {
        "score": hit.score,
        "probability": hit.probability,
        "undecided": hit.undecided,
        "id": item.id,
        "label": item.label,
        "state": item.state,
        "level": item.level,
        "center": item.center.tolist(),
        "size": item.box.size.tolist(),
        "yaw": item.box.yaw,
        "voxels": len(item.voxels),
        "times": None if hit.times is None else list(hit.times),
        "views": [{"frame": view.frame, "view": view.view, "box": list(view.box)} for view in hit.views],
        "clauses": [clause._asdict() for clause in hit.clauses],
    }
