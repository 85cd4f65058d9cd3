"""Words of a query against the labels that a map knows: the same word, or an inflection of it."""

import difflib
import itertools
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Bool

from openvocab_occ.errors import QueryError

MAX_CHARACTERS = 1000
STOP_WORDS = frozenset({
    "a", "all", "an", "and", "any", "are", "at", "each", "every", "find", "for", "in", "is", "it", "me", "my", "of",
    "on", "or", "please", "show", "some", "that", "the", "there", "these", "this", "those", "to", "where", "which",
})  # fmt: skip
"""Words that say nothing about the kind of thing. Negations are not among them: they are reported as not understood."""
_WORD = re.compile(r"[^\W_]+")
_LONGEST_LABEL = 5  # words


@dataclass(frozen=True, eq=False)
class Match:
    """How a query was read."""

    channels: Bool[np.ndarray, " c"]
    """Which labels were meant."""
    unknown: tuple[str, ...] = ()
    """Words that name no label, without stop words."""
    nearest: dict[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    """Labels spelt like an unknown word, nearest first; no entry where there is none."""


def checked_text(text: str) -> str:
    """Return the text without space around it, or raise QueryError that says why it cannot be a query."""
    if not isinstance(text, str):
        raise QueryError("query is not text", expected="str", got=type(text).__name__)
    text = text.strip()
    if not text:
        raise QueryError("query is empty", expected="words", fix='ask for something, such as "truck"')
    if len(text) > MAX_CHARACTERS:
        raise QueryError("query is too long", expected=f"at most {MAX_CHARACTERS} characters", got=len(text))
    controls = sorted({f"U+{ord(c):04X}" for c in text if unicodedata.category(c) in ("Cc", "Cs")})
    if controls:
        raise QueryError("query holds control characters", expected="one line of text", got=", ".join(controls))
    return text


def match_labels(text: str, labels: Sequence[str]) -> Match:
    """Read a text as labels, longest first; case, hyphens and spaces within a label do not matter."""
    words = _words(text)
    channels, unknown = _read(words, tuple(labels), inflect=False)
    if unknown or not channels:  # the slow way only where the quick one leaves something
        channels, unknown = _read(words, tuple(labels), inflect=True)
    if not channels and not unknown:
        unknown = words or [text]
    meant = np.zeros(len(labels), dtype=bool)
    meant[channels] = True
    unknown = list(dict.fromkeys(unknown))
    near = {word: difflib.get_close_matches(word, [label.lower() for label in labels], n=3) for word in unknown}
    return Match(meant, tuple(unknown), {word: tuple(found) for word, found in near.items() if found})


def _words(text: str) -> list[str]:
    return _WORD.findall(unicodedata.normalize("NFKC", text).casefold())


def _read(words: Sequence[str], labels: tuple[str, ...], *, inflect: bool) -> tuple[list[int], list[str]]:
    """Return the channels that were meant and the words left over, without stop words."""
    known = _by_form(labels, inflect)
    channels: list[int] = []
    unknown: list[str] = []
    at = 0
    while at < len(words):
        for length in range(min(_LONGEST_LABEL, len(words) - at), 0, -1):
            found = [c for form in _forms(words[at : at + length], inflect) for c in known.get(form, ())]
            if found:
                channels += found
                at += length
                break
        else:
            if words[at] not in STOP_WORDS:
                unknown.append(words[at])
            at += 1
    return channels, unknown


@lru_cache(maxsize=16)
def _by_form(labels: tuple[str, ...], inflect: bool) -> dict[str, tuple[int, ...]]:
    """Map every form of every label to the channels that have it."""
    known: dict[str, tuple[int, ...]] = {}
    for channel, label in enumerate(labels):
        for form in _forms(_words(label), inflect):
            known[form] = (*known.get(form, ()), channel)
    return known


def _forms(words: Sequence[str], inflect: bool) -> set[str]:
    """Return the words run together, as they are and in the singular; so "dining tables" meets "diningtable"."""
    if not words:
        return set()
    if not inflect:
        return {"".join(words)}
    return {"".join(choice) for choice in itertools.product(*[{word, singular(word)} for word in words])}


@lru_cache(maxsize=4096)
def singular(word: str) -> str:
    """Return the singular of a plural noun, any other word as it is.

    inflect makes "bu" of "bus"; so a singular counts only if its plural is the word again.
    """
    engine = _inflect()
    shorter = engine.singular_noun(word) if word.isalpha() else False
    return shorter if shorter and engine.plural_noun(shorter) == word else word


@lru_cache(maxsize=1)
def _inflect() -> Any:
    import inflect  # takes a second or two

    return inflect.engine()
