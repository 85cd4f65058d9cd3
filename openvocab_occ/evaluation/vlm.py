"""How well a vision-language model reads view bundles: its answers against the scene graph's, and against guessing."""

import json
import re
import urllib.error
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from openvocab_occ.errors import ConfigError, DataError, QueryError
from openvocab_occ.export.views import ViewBundle
from openvocab_occ.export.views.prompt import ANSWER_FORM, SYSTEM, messages, picture_names, prompt_text
from openvocab_occ.query.llm import LanguageModel, unfenced

KINDS = ("count", "exists", "side", "nearest", "state", "ahead", "on_road")
"""Kinds of questions, in the order of reports."""
Answer = int | str


@dataclass(frozen=True, kw_only=True)
class Shown:
    """What of a bundle a model is shown: an ablation where something is left out."""

    pictures: bool = True
    marks: bool = True
    bev: bool = True
    table: bool = True

    @property
    def name(self) -> str:
        """Say it in a word or two."""
        left_out = [word for word, there in vars(self).items() if not there]
        return "all" if not left_out else "without " + ", ".join(left_out)


@dataclass(frozen=True, kw_only=True)
class Reading:
    """One answer of a model."""

    bundle: str
    question: int
    kind: str
    expected: Answer
    got: Answer | None
    """None where the reply could not be read, or was `unknown`."""
    correct: bool
    note: str = ""
    """Why there is no answer."""


@dataclass(frozen=True, kw_only=True)
class Score:
    """Shares of the questions of one kind."""

    questions: int
    correct: float
    unread: float
    """Share without a usable answer."""
    chance: float
    """What guessing among the choices gets in the mean; for counts, naming the commonest count of this kind."""


def judge(
    bundle: ViewBundle,
    model: LanguageModel,
    *,
    shown: Shown | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> list[Reading]:
    """Ask a model all questions of a bundle, each by itself. `shown=None` shows it nothing but the question: blind.

    Raises ConfigError where the service cannot be reached or refuses; a reply that cannot be read is a wrong answer.
    """
    found = []
    questions = questions_of(bundle)
    for done, question in enumerate(questions, start=1):
        found.append(_ask(bundle, question, model, shown))
        if progress is not None:
            progress(done, len(questions))
    return found


def questions_of(bundle: ViewBundle) -> list[dict[str, Any]]:
    """Return the questions of a bundle.

    Raises DataError where its questions.json cannot be read.
    """
    path = bundle.paths["questions.json"]
    try:
        questions = json.loads(path.read_text(encoding="utf-8"))["questions"]
        for one in questions:
            if not isinstance(one["answer"], int | str) or one["kind"] not in KINDS or not one["question"]:
                raise ValueError(one)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} cannot be read", expected="questions with kind and answer", got=error) from error
    return questions


def messages_for(bundle: ViewBundle, question: str, shown: Shown | None) -> list[dict[str, Any]]:
    """Return the chat that asks a question about a bundle."""
    if shown is None:
        words = (
            f"A question about a view of a street that you cannot see; guess.\n\nQuestion: {question}\n\n{ANSWER_FORM}"
        )
        return [{"role": "system", "content": SYSTEM}, {"role": "user", "content": [{"type": "text", "text": words}]}]
    files = bundle.view["files"]
    marks, bev = shown.marks and "view_marked.png" in files, shown.bev and "bev_marked.png" in files
    text = prompt_text(bundle.view, marks=marks, bev=bev and shown.pictures, table=shown.table)
    names = picture_names(marks=marks, bev=bev) if shown.pictures else []
    return messages(text, [bundle.folder / name for name in names], question)


def summarize(readings: Sequence[Reading], questions: Sequence[dict[str, Any]]) -> dict[str, Score]:
    """Return scores by kind, and of all; `questions` are those that were asked, for what chance would get."""
    scores = {}
    for kind in (*KINDS, "all"):
        group = [r for r in readings if kind in (r.kind, "all")]
        if not group:
            continue
        scores[kind] = Score(
            questions=len(group),
            correct=sum(r.correct for r in group) / len(group),
            unread=sum(r.got is None for r in group) / len(group),
            chance=_chance([q for q in questions if kind in (q["kind"], "all")]),
        )
    return scores


def read_answer(reply: str, question: dict[str, Any]) -> Answer | None:
    """Return what a reply says: a whole number where one is asked for, else one of the choices; None where neither.

    The reply is JSON with `answer`, fenced or not; a number may stand in words such as "mark 3".
    """
    try:
        said = json.loads(unfenced(reply))["answer"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    if isinstance(question["answer"], int):
        if isinstance(said, bool):
            return None
        if isinstance(said, int | float):
            return int(said) if said == int(said) else None
        numbers = re.findall(r"\d+", said) if isinstance(said, str) else []
        return int(numbers[0]) if len(numbers) == 1 else None
    if isinstance(said, bool):
        said = "yes" if said else "no"
    words = re.findall(r"[a-z]+", said.lower()) if isinstance(said, str) else []
    named = [choice for choice in question["choices"] if choice in words]
    return named[0] if len(named) == 1 else None


def _ask(bundle: ViewBundle, question: dict[str, Any], model: LanguageModel, shown: Shown | None) -> Reading:
    note = ""
    try:
        got = read_answer(model.chat(messages_for(bundle, question["question"], shown)), question)
        note = "" if got is not None else "no usable answer"
    except urllib.error.HTTPError as error:
        raise ConfigError("the model refuses", got=f"HTTP {error.code}", fix="check --model and the key") from error
    except (urllib.error.URLError, TimeoutError, ConnectionError) as error:
        raise ConfigError("the model cannot be reached", got=error, fix="check --endpoint") from error
    except (QueryError, ValueError) as error:
        got, note = None, str(error)[:200]
    return Reading(
        bundle=bundle.folder.name, question=question["id"], kind=question["kind"], expected=question["answer"], got=got,
        correct=got == question["answer"], note=note,
    )  # fmt: skip


def _chance(questions: Sequence[dict[str, Any]]) -> float:
    if not questions:
        return 0.0
    counts = [q["answer"] for q in questions if q["kind"] == "count"]
    common = max(map(counts.count, counts)) / len(counts) if counts else 0.0
    return sum(common if q["kind"] == "count" else 1 / len(q["choices"]) for q in questions) / len(questions)
