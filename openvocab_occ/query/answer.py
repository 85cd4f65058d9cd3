"""Answers: what was found, how sure that is, and how the words were understood."""

from dataclasses import dataclass, field
from typing import Any, Literal

from openvocab_occ.objects.tree import SceneObject

Verdict = Literal["found", "absent", "unknown words"]
"""`found`: objects reach the threshold. `absent`: the words were understood and no object of the map reaches it.
`unknown words`: no word was understood, so nothing can be said."""
ScoreKind = Literal["class probability", "cosine", "sigmoid", "relevancy", "probability"]


@dataclass(frozen=True, eq=False)
class Hit:
    """An object and how well it fits the words."""

    object: SceneObject
    score: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Answer:
    """What a map says to a text."""

    text: str
    hits: tuple[Hit, ...]
    """Objects that reach the threshold, best first."""
    verdict: Verdict
    threshold: float
    best: float | None
    """Score of the best object even where it is below the threshold; None where no object was scored."""
    score_kind: ScoreKind
    """Only `probability` is calibrated; a class probability is what the model's softmax says."""
    matched: tuple[str, ...] = ()
    """Labels of the map that the words meant; empty for a `dense` map, which reads the text as a whole."""
    unknown: tuple[str, ...] = ()
    """Words that were not understood, and had no effect."""
    nearest: dict[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    """Labels spelt like an unknown word."""
    known: tuple[str, ...] = ()
    """Labels that this map knows; empty for a `dense` map."""
    seconds: float = 0.0

    def explain(self) -> str:
        """Return how the text was read, and each hit with its score, place and size, as lines for a person."""
        lines = [f'"{self.text}": {self.verdict}']
        if self.matched:
            lines.append(f"  read as: {' or '.join(self.matched)}")
        lines += [f'  not understood: "{word}"{self._hint(word)}' for word in self.unknown]
        if self.verdict == "unknown words":
            lines.append(f"  this map knows: {', '.join(self.known) or 'no words'}")
        else:
            best = "no object" if self.best is None else f"best {self.best:.2f}"
            trust = "calibrated" if self.score_kind == "probability" else "not calibrated"
            lines.append(f"  score: {self.score_kind}, {trust}; threshold {self.threshold:.2f}, {best}")
        for rank, hit in enumerate(self.hits, start=1):
            x, y, z = hit.object.center
            length, width, height = hit.object.box.size
            lines.append(
                f"  {rank}. {hit.object.label or 'object'} #{hit.object.id}  {hit.score:.2f}"
                f"  at ({x:.1f}, {y:.1f}, {z:.1f}) m, {length:.1f} x {width:.1f} x {height:.1f} m,"
                f" {len(hit.object.voxels)} voxels, state {hit.object.state}"
            )
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        names = ("text", "verdict", "threshold", "best", "score_kind", "seconds")
        lists = {name: list(getattr(self, name)) for name in ("matched", "unknown", "known")}
        nearest = {word: list(near) for word, near in self.nearest.items()}
        hits = [_hit(hit) for hit in self.hits]
        return {name: getattr(self, name) for name in names} | lists | {"nearest": nearest, "hits": hits}

    def _hint(self, word: str) -> str:
        return f" (nearest: {', '.join(self.nearest[word])})" if word in self.nearest else ""


def _hit(hit: Hit) -> dict[str, Any]:
    item = hit.object
    return {
        "score": hit.score,
        "id": item.id,
        "label": item.label,
        "state": item.state,
        "center": item.center.tolist(),
        "size": item.box.size.tolist(),
        "yaw": item.box.yaw,
        "voxels": len(item.voxels),
    }
