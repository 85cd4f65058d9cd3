"""How often a map's answers are right, by category of question."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from openvocab_occ.evaluation.grounding_metrics import average_precision, box_iou, calibration_error
from openvocab_occ.evaluation.grounding_queries import ABSENT, CATEGORIES, Question, questions_about
from openvocab_occ.evaluation.grounding_truth import Truth, scene_of_truth, truth_of_city
from openvocab_occ.objects import SceneMap, SceneObject
from openvocab_occ.query.answer import Answer
from openvocab_occ.query.find import LIKELY, find
from openvocab_occ.segmentation.encoder import PixelEncoder

IOUS = (0.1, 0.25, 0.5)
SAME = 0.25
"""IoU from which a hit is a true thing, for precision."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How one question went."""

    question: Question
    verdict: str
    iou: float
    """Of the best hit's box and the wanted thing that it fits best."""
    precision: float
    """Average precision of the ranked hits; 1 where nothing is wanted and nothing is named."""
    count: int
    confidence: tuple[float, ...] = ()
    correct: tuple[bool, ...] = ()
    """Of the hits that carry a probability."""

    @property
    def right(self) -> bool:
        """Tell whether the verdict is right, and where something is wanted the best hit too."""
        return self.verdict == self.question.verdict and (not self.question.wanted or self.iou >= SAME)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        q = self.question
        return {"category": q.category, "text": q.text, "wanted": len(q.wanted), "wanted_verdict": q.verdict,
                "verdict": self.verdict, "named": self.count, "iou": self.iou, "precision": self.precision}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class CategoryScores:
    """Shares in 0..1 over the questions of one category."""

    questions: int
    accuracy: dict[str, float]
    """Share of questions whose best hit overlaps a wanted thing by at least so much."""
    mean_precision: float
    verdicts: float
    """Share of questions with the right verdict."""
    count_exact: float
    count_within_one: float
    false_found: float
    """Share of questions that were wrongly called found."""


Overlap = Callable[[SceneObject, int], float]
"""IoU of an object of the map and a true thing, by its id."""


def judge(
    scene: SceneMap,
    truth: Truth,
    questions: Sequence[Question],
    encoder: PixelEncoder | None = None,
    *,
    overlap: Overlap | None = None,
) -> list[Outcome]:
    """Ask a map questions and compare its answers with the truth, by default by the IoU of boxes."""
    boxes = {thing.id: thing.box for thing in truth.things}
    of = overlap or (lambda item, id: box_iou(item.box, boxes[id]))
    return [_outcome(find(scene, q.text, encoder, viewpoint=truth.viewer), q, of) for q in questions]


def summarize(outcomes: Sequence[Outcome]) -> dict[str, CategoryScores]:
    """Return scores by category, in the order of CATEGORIES."""
    groups = {name: [o for o in outcomes if o.question.category == name] for name in CATEGORIES}
    return {name: _scores(group) for name, group in groups.items() if group}


def calibration_of(outcomes: Sequence[Outcome]) -> float | None:
    """Return the expected calibration error of all hits with a probability; None where none has one."""
    probability = np.array([p for o in outcomes for p in o.confidence])
    correct = np.array([c for o in outcomes for c in o.correct], dtype=bool)
    return calibration_error(probability, correct) if len(probability) else None


def judge_truth(seeds: Sequence[int]) -> list[Outcome]:
    """Judge maps of the demo city's own truth: what the queries alone get wrong. Anything below 1 is their fault."""
    outcomes = []
    for seed in seeds:
        truth = truth_of_city(seed)
        outcomes += judge(scene_of_truth(truth, also=ABSENT), truth, questions_about(truth, seed))
    return outcomes


def _outcome(answer: Answer, question: Question, of: Overlap) -> Outcome:
    hits = [hit for hit in answer.hits if not hit.undecided]
    taken: set[int] = set()
    correct: list[bool] = []
    counted: list[int] = []
    confidence: list[float] = []
    for rank, hit in enumerate(hits):
        overlaps = {id: of(hit.object, id) for id in question.wanted - taken}
        best = max(overlaps, key=lambda id: overlaps[id], default=None)
        right = best is not None and overlaps[best] >= SAME
        if right and best is not None:
            taken.add(best)
        elif any(of(hit.object, id) >= SAME for id in question.either):
            continue
        counted.append(rank)
        correct.append(right)
        if hit.probability is not None:
            confidence.append(hit.probability)
    top = [hits[rank] for rank in counted[:1]]
    iou = max((of(hit.object, id) for hit in top for id in question.wanted), default=0.0)
    if question.wanted:
        precision = average_precision(np.array(correct, dtype=bool), len(question.wanted))
    else:
        precision = float(not correct)
    return Outcome(
        question=question,
        verdict=answer.verdict,
        iou=iou,
        precision=precision,
        count=max(sum(p is None or p >= LIKELY for p in (hits[rank].probability for rank in counted)), len(top)),
        confidence=tuple(confidence),
        correct=tuple(correct) if confidence else (),
    )


def _scores(group: Sequence[Outcome]) -> CategoryScores:
    positive = [o for o in group if o.question.wanted]
    off = np.array([abs(o.count - len(o.question.wanted)) for o in group])
    return CategoryScores(
        questions=len(group),
        accuracy={f"{t:g}": float(np.mean([o.iou >= t for o in positive])) if positive else 1.0 for t in IOUS},
        mean_precision=float(np.mean([o.precision for o in group])),
        verdicts=float(np.mean([o.verdict == o.question.verdict for o in group])),
        count_exact=float((off == 0).mean()),
        count_within_one=float((off <= 1).mean()),
        false_found=float(np.mean([o.verdict == "found" and not o.question.wanted for o in group])),
    )
