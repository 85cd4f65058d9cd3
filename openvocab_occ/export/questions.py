"""Questions about a bundle, with answers from the scene graph: what a reader of the pictures should be able to tell."""

import itertools
from collections.abc import Callable, Iterator
from typing import Any

from openvocab_occ.export.brief import RouteBrief
from openvocab_occ.objects.kinds import Kind, kind_of

_SIDE, _MARGIN = 5.0, 1.5  # degrees off ahead, and metres between ranges, from which an answer is beyond doubt
_EACH = 4  # questions of one kind, at most
_ABSENT = ("bus", "traffic cone", "pedestrian", "motorcycle", "barrier", "truck", "bicycle", "trailer", "car")
_SETTLED = ("parked", "moving", "stopped")

Question = dict[str, Any]


def questions_about(view: dict[str, Any], brief: RouteBrief | None = None) -> list[Question]:
    """Return questions about the content of a view.json, each with its answer; the same view gives the same ones.

    Only what is beyond doubt is asked: observed states, sides and distances that clearly differ. `answer` is a whole
    number, `yes` or `no`, a mark, or one of `choices`; `kind` is count, exists, side, nearest, state or ahead;
    with a brief of the way also on_road, which the pictures tell and the words do not.
    """
    marked = sorted((o for o in view["objects"] if o["mark"]), key=lambda o: o["mark"])
    makers: tuple[Callable[[list[dict[str, Any]]], Iterator[Question]], ...] = (
        _counts, _exists, _sides, _nearest, _states, _ahead,
    )  # fmt: skip
    found = [question for make in makers for question in _some(list(make(marked)))]
    if brief is not None:
        found += _some(list(_on_road(marked, brief)))
    return [{"id": number, **question} for number, question in enumerate(found, start=1)]


def _on_road(marked: list[dict[str, Any]], brief: RouteBrief) -> Iterator[Question]:
    where = {one.id: one for one in brief.objects}
    for item in marked:
        one = where.get(item["id"])
        if one is not None and one.state != "moving":
            yield {"kind": "on_road", "question": f"Does mark {item['mark']} stand on the road?",
                   "answer": "yes" if one.on_road else "no", "choices": ["yes", "no"],
                   "marks": [item["mark"]]}  # fmt: skip


def _some(questions: list[Question]) -> list[Question]:
    """Return a few, spread evenly over all."""
    if len(questions) <= _EACH:
        return questions
    return [questions[round(k * (len(questions) - 1) / (_EACH - 1))] for k in range(_EACH)]


def _labels(marked: list[dict[str, Any]]) -> list[str]:
    return sorted({o["label"] for o in marked if o["label"]})


def _counts(marked: list[dict[str, Any]]) -> Iterator[Question]:
    for label in _labels(marked):
        marks = [o["mark"] for o in marked if o["label"] == label]
        yield {"kind": "count", "question": f'How many of the marked objects are labelled "{label}"?',
               "answer": len(marks), "marks": marks}  # fmt: skip
    movable = [o for o in marked if kind_of(o["label"]) == Kind.MOVABLE]
    parked = [o["mark"] for o in movable if o["state"] == "parked"]
    if movable and all(o["state"] != "unknown" for o in movable):
        yield {"kind": "count", "question": "How many of the marked objects are parked?", "answer": len(parked),
               "marks": parked}  # fmt: skip


def _exists(marked: list[dict[str, Any]]) -> Iterator[Question]:
    present = _labels(marked)
    absent = [label for label in _ABSENT if label not in present]
    for yes, no in zip(present, absent, strict=False):  # as many of both
        marks = [o["mark"] for o in marked if o["label"] == yes]
        yield {"kind": "exists", "question": f'Is any marked object labelled "{yes}"?', "answer": "yes",
               "choices": ["yes", "no"], "marks": marks}  # fmt: skip
        yield {"kind": "exists", "question": f'Is any marked object labelled "{no}"?', "answer": "no",
               "choices": ["yes", "no"], "marks": []}  # fmt: skip


def _sides(marked: list[dict[str, Any]]) -> Iterator[Question]:
    for item in marked:
        if _SIDE <= abs(item["bearing_deg"]) <= 180 - _SIDE:
            side = "left" if item["bearing_deg"] > 0 else "right"
            yield {"kind": "side", "question": f"Is mark {item['mark']} to the left or to the right of straight ahead?",
                   "answer": side, "choices": ["left", "right"], "marks": [item["mark"]]}  # fmt: skip


def _nearest(marked: list[dict[str, Any]]) -> Iterator[Question]:
    for label in _labels(marked):
        same = sorted((o for o in marked if o["label"] == label), key=lambda o: o["range_m"])
        if len(same) > 1 and same[1]["range_m"] - same[0]["range_m"] >= _MARGIN:
            yield {"kind": "nearest", "question": f'Which marked object labelled "{label}" is nearest to the ego, by '
                   "its centre? Give its mark.", "answer": same[0]["mark"], "choices": [o["mark"] for o in same],
                   "marks": [same[0]["mark"]]}  # fmt: skip


def _states(marked: list[dict[str, Any]]) -> Iterator[Question]:
    for item in marked:
        if item["state"] in _SETTLED:
            yield {"kind": "state", "question": f"Is mark {item['mark']} parked, moving or stopped?",
                   "answer": item["state"], "choices": list(_SETTLED), "marks": [item["mark"]]}  # fmt: skip


def _ahead(marked: list[dict[str, Any]]) -> Iterator[Question]:
    for one, other in itertools.pairwise(marked):
        gap = one["center_ego"][0] - other["center_ego"][0]
        if abs(gap) >= 2 * _MARGIN:
            farther = one if gap > 0 else other
            yield {"kind": "ahead", "question": f"Which is farther ahead, mark {one['mark']} or mark {other['mark']}? "
                   "Give its mark.", "answer": farther["mark"], "choices": [one["mark"], other["mark"]],
                   "marks": [farther["mark"]]}  # fmt: skip
