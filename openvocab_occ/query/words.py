"""Words of a query against the names that a map knows: the same word, or an inflection of it."""

import difflib
import itertools
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from openvocab_occ.errors import QueryError

MAX_CHARACTERS = 1000
STOP_WORDS = frozenset({
    "a", "all", "an", "and", "any", "are", "at", "each", "every", "find", "for", "in", "is", "it", "me", "my", "of", "on",
    "or", "please", "show", "some", "that", "the", "there", "these", "this", "those", "to", "where", "which",
})  # fmt: skip
"""Words that say nothing about the kind of thing. Negations are not among them: they are reported as not understood."""
_WORD = re.compile(r"[^\W_]+")
_LONGEST_NAME = 5  # words


@dataclass(frozen=True)
class Match:
    """How a query was read."""

    labels: tuple[int, ...]
    """Positions of the names that were meant, each once, in the order of the query."""
    words: tuple[str, ...]
    """Words of the query that named them."""
    unknown: tuple[str, ...]
    """Words that name nothing here, without stop words."""
    nearest: dict[str, tuple[str, ...]]
    """Names spelt like an unknown word, nearest first; no entry where there is none."""


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


def match_names(text: str, names: Sequence[str]) -> Match:
    """Read a text as names, longest first; case, hyphens and spaces within a name do not matter."""
    words = _words(text)
    known = _by_form(tuple(names))
    labels: dict[int, None] = {}
    used: list[str] = []
    unknown: list[str] = []
    at = 0
    while at < len(words):
        for length in range(min(_LONGEST_NAME, len(words) - at), 0, -1):
            window = words[at : at + length]
            found = sorted({label for form in _forms(window) for label in known.get(form, ())})
            if found:
                labels |= dict.fromkeys(found)
                used.append(" ".join(window))
                at += length
                break
        else:
            if words[at] not in STOP_WORDS:
                unknown.append(words[at])
            at += 1
    if not labels and not unknown:
        unknown = list(words) or [text]
    unknown = list(dict.fromkeys(unknown))
    near = {word: difflib.get_close_matches(word, [name.lower() for name in names], n=3) for word in unknown}
    return Match(tuple(labels), tuple(used), tuple(unknown), {word: tuple(n) for word, n in near.items() if n})


def _words(text: str) -> list[str]:
    return _WORD.findall(unicodedata.normalize("NFKC", text).casefold().replace("'s ", " "))


@lru_cache(maxsize=8)
def _by_form(names: tuple[str, ...]) -> dict[str, tuple[int, ...]]:
    """Map every form of every name to the positions of the names that have it."""
    known: dict[str, tuple[int, ...]] = {}
    for position, name in enumerate(names):
        for form in _forms(_words(name)):
            known[form] = (*known.get(form, ()), position)
    return known


def _forms(words: Sequence[str]) -> set[str]:
    """Return the words run together, as they are and in the singular; so "dining tables" meets "diningtable"."""
    if not words:
        return set()
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
    import inflect  # 1.7 s, so on the first query only

    return inflect.engine()
