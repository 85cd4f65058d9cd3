"""Words to objects, and to voxels."""

import difflib
import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import as_pose
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.query import algebra as q
from openvocab_occ.query.algebra import Node
from openvocab_occ.query.answer import NONE_COUNTED, ClauseScore, Counted, Hit, Verdict
from openvocab_occ.query.answer import Answer as Answer
from openvocab_occ.query.coverage import coverage_of
from openvocab_occ.query.evaluate import HALF, Clause, Evaluator
from openvocab_occ.query.grammar import Parse, parse
from openvocab_occ.query.lexicon import vocabulary
from openvocab_occ.query.llm import LanguageModel
from openvocab_occ.query.reading import reading_of
from openvocab_occ.query.region import share_seen
from openvocab_occ.query.relations import Viewpoint
from openvocab_occ.query.scoring import Reading, Scorer
from openvocab_occ.segmentation.encoder import PixelEncoder

Seen = Viewpoint | Float[np.ndarray, "4 4"] | float | None
"""A viewpoint, the pose T_world_ego of a viewer, a time (ego at the frame nearest to it); None: ego at the end."""
_SEEN_ENOUGH = 0.5
LIKELY = 0.5
"""Probability from which a thing is counted: a hit may be less likely than that where the card's threshold is lower."""


def find(
    scene: SceneMap,
    query: str | Node,
    encoder: PixelEncoder | None = None,
    *,
    limit: int | None = None,
    threshold: float | None = None,
    viewpoint: Seen = None,
    language_model: LanguageModel | None = None,
) -> Answer:
    """Find the objects of a map that fit a text, or a query of the algebra.

    In a map of a `logits` encoder nouns must be labels, inflections of them or words for the same; an object scores the
    mean probability of the labels meant, added up. In a map of a `dense` encoder, which must be passed, it scores by
    the cosine of its embedding and the noun's, in the way of the model's card. Attributes, states and relations are
    measured on the map. Words that are not understood are reported and have no effect. Equal scores rank by id.

    `threshold` is the least score of a noun, by default the card's. `viewpoint` is where left, right, in front, behind
    and "me" are said from. A `language_model` reads texts instead of the grammar, where its replies are valid.

    Raises QueryError for a query that cannot be read, EncoderMismatchError for another encoder than the map's.
    """
    start = time.perf_counter()
    if limit is not None and limit < 1:
        raise ConfigError("limit is not usable", expected="at least 1, or None for all hits", got=limit)
    scorer = Scorer(scene, encoder, threshold)
    parsed = parsed_query(scene, query, language_model)
    viewer = viewpoint_of(scene, viewpoint)
    evaluator = Evaluator(scene, scorer, viewer)
    clause = None if parsed.query is None else evaluator.evaluate(parsed.query)
    report = evaluator.report
    seen = share_seen(scene, report.places, viewer) if clause is not None else None
    unknown = tuple(dict.fromkeys([*parsed.unread, *report.unknown]))
    calibrated = clause is not None and report.calibrated and _all_calibrated(parsed.query)
    notes = [*parsed.notes, *report.notes, *_viewer_note(parsed.query, viewer)]
    return Answer(
        text=query if isinstance(query, str) else reading_of(query),
        query=parsed.query,
        reading="" if parsed.query is None else reading_of(parsed.query),
        hits=_hits(evaluator, clause, limit, calibrated=calibrated),
        verdict=_verdict(clause, seen, has_unknown=bool(unknown)),
        threshold=scorer.threshold if evaluator.rule is None else evaluator.rule.threshold,
        best=float(clause.score.max()) if clause is not None and len(clause.score) else None,
        score_kind=scorer.kind if evaluator.rule is None else evaluator.rule.kind,
        counted=_counted(clause, calibrated=calibrated),
        matched=tuple(dict.fromkeys(report.matched)),
        unknown=unknown,
        nearest={**_nearest(parsed.unread, scene), **report.nearest},
        known=scene.encoder.labels,
        notes=tuple(dict.fromkeys(notes)),
        region_seen=seen,
        observed_area=coverage_of(scene).area,
        seconds=time.perf_counter() - start,
    )


def score_voxels(
    scene: SceneMap, query: str | Node, encoder: PixelEncoder | None = None, *, viewpoint: Seen = None
) -> Float32[np.ndarray, " n"]:
    """Return each voxel's score for a query; all zero where no word is understood.

    Nouns are scored voxel by voxel as `find` scores objects. What only objects have, such as states and relations,
    counts by the object that a voxel belongs to, and is 0 elsewhere.
    """
    parsed = parsed_query(scene, query)
    scorer = Scorer(scene, encoder)
    if parsed.query is None:
        return np.zeros(len(scene.voxels), dtype=np.float32)
    return _Voxels(scene, Evaluator(scene, scorer, viewpoint_of(scene, viewpoint))).score(parsed.query)


def parsed_query(scene: SceneMap, query: str | Node, language_model: LanguageModel | None = None) -> Parse:
    """Read a text with the map's labels in mind, or check a query."""
    if isinstance(query, Node):
        return Parse(query=q.checked(query))
    if language_model is not None:
        return language_model.parse(query, scene.encoder.labels)
    return parse(query, scene.encoder.labels)


def viewpoint_of(scene: SceneMap, at: Seen) -> Viewpoint:
    """Return where a viewer stands."""
    if isinstance(at, Viewpoint):
        return at
    if isinstance(at, np.ndarray):
        return _posed(as_pose(at, "viewpoint"), "a given pose")
    if not scene.frames:
        if at is not None:
            raise ConfigError("the map keeps no frames, so a time tells no place", got=at, fix="pass a Viewpoint")
        return Viewpoint(np.zeros(3), name="the world's origin, as the map keeps no frames")
    if at is not None and not np.isfinite(at):
        raise ConfigError("viewpoint is not usable", expected="a finite time", got=at)
    frame = scene.frames[-1] if at is None else min(scene.frames, key=lambda f: abs(f.timestamp - at))
    return _posed(frame.T_world_ego, f"ego at frame {frame.index}")


def _posed(T_world_ego: Float64[np.ndarray, "4 4"], name: str) -> Viewpoint:
    return Viewpoint(T_world_ego[:3, 3].copy(), float(np.arctan2(T_world_ego[1, 0], T_world_ego[0, 0])), name)


def _viewer_note(query: Node | None, viewer: Viewpoint) -> list[str]:
    sides = ("in front of", "behind", "left of", "right of")
    if query is not None and any(
        isinstance(node, q.Me)
        or (isinstance(node, q.Relation) and node.name in sides)
        or (isinstance(node, q.Superlative) and node.by in ("distance", "left") and node.anchor is None)
        for node in q.walk(query)
    ):
        return [f"as seen from {viewer.name}"]
    return []


def _verdict(clause: Clause | None, seen: float | None, *, has_unknown: bool) -> Verdict:
    if clause is None:
        return "unknown words"
    if (clause.low >= HALF).any():
        return "found"
    if seen is not None and seen < _SEEN_ENOUGH:
        return "unobserved"
    if (clause.high >= HALF).any():
        return "unknown words" if has_unknown else "unobserved"
    return "absent"


def _hits(evaluator: Evaluator, clause: Clause | None, limit: int | None, *, calibrated: bool) -> tuple[Hit, ...]:
    if clause is None:
        return ()
    index = evaluator.index
    rows = np.flatnonzero(clause.high >= HALF)
    undecided = clause.low[rows] < HALF
    order = np.lexsort((index.ids[rows], -clause.score[rows], undecided))[:limit]
    hits = []
    voxels = evaluator.scene.voxels
    for row in rows[order]:
        node = index.nodes[row]
        score = float(clause.score[row])
        clauses = [
            ClauseScore(t.reading, float(t.clause.low[row]), float(t.clause.high[row])) for t in evaluator.report.trace
        ]
        seen = node.voxels
        times = (float(voxels.first_seen[seen].min()), float(voxels.last_seen[seen].max())) if len(seen) else None
        hits.append(
            Hit(node, score, bool(clause.low[row] < HALF), tuple(clauses), score if calibrated else None, times)
        )
    return tuple(hits)


def _counted(clause: Clause | None, *, calibrated: bool) -> Counted:
    if clause is None:
        return NONE_COUNTED
    fits, low, high = (
        int(n) for n in ((clause.low >= HALF).sum(), (clause.low >= 0.75).sum(), (clause.high >= 0.25).sum())
    )
    if not calibrated:
        return Counted(fits, low, high, None, None)
    p = np.clip(clause.score, 0.0, 1.0)
    value = max(int(((clause.low >= HALF) & (p >= LIKELY)).sum()), min(fits, 1))
    return Counted(value, min(low, value), max(high, value), float(p.sum()), float(np.sqrt((p * (1 - p)).sum())))


def _all_calibrated(query: Node | None) -> bool:
    """Tell whether a query asks for nothing but kinds of things, whose scores a card can calibrate."""
    return query is not None and all(isinstance(node, q.Noun | q.Count) for node in q.walk(query))


def _nearest(unread: tuple[str, ...], scene: SceneMap) -> dict[str, tuple[str, ...]]:
    names = sorted({label.casefold() for label in scene.encoder.labels} | vocabulary())
    near = {word: tuple(difflib.get_close_matches(word, names, n=3)) for word in unread[:32]}
    return {word: found for word, found in near.items() if found}


@dataclass(frozen=True, eq=False)
class _Voxels:
    """Scores of voxels, with those of objects where only objects can tell."""

    scene: SceneMap
    evaluator: Evaluator

    def score(self, query: Node) -> Float32[np.ndarray, " n"]:
        n = len(self.scene.voxels)
        match query:
            case q.Noun(text):
                reading = self.evaluator.scorer.noun(text).reading
                return np.zeros(n, np.float32) if reading is None else self._noun(reading)
            case q.And(of):
                return np.multiply.reduce([self.score(part) for part in of]).astype(np.float32)
            case q.Or(of):
                return np.maximum.reduce([self.score(part) for part in of])
            case q.Count(of) | q.Level(of):
                return self.score(of)
            case q.Not(q.Noun(text)):
                reading = self.evaluator.scorer.noun(text).reading
                if reading is None:
                    return np.ones(n, np.float32)
                return (1 - reading.degree(self._noun(reading))).astype(np.float32)
            case q.Color(name) if name not in ("bright", "dark"):
                from openvocab_occ.query.colors import NAMES

                return (self.evaluator.index.voxel_color_names == NAMES.index(name)).astype(np.float32)
        return self._of_objects(self.evaluator.evaluate(query))

    def _noun(self, reading: Reading) -> Float32[np.ndarray, " n"]:
        voxels, names = self.scene.voxels, self.scene.class_names
        worth = np.zeros(256)
        worth[: len(names)] = reading.worth(names)
        return reading.score(voxels.features, worth[voxels.labels] if reading.classes else None)

    def _of_objects(self, clause: Clause | None) -> Float32[np.ndarray, " n"]:
        scores = np.zeros(len(self.scene.voxels), dtype=np.float32)
        if clause is not None:
            rows: Bool[np.ndarray, " n"] = clause.score > 0
            for row in np.flatnonzero(rows):
                voxels = self.evaluator.index.nodes[row].voxels
                scores[voxels] = np.maximum(scores[voxels], np.float32(clause.score[row]))
        return scores
