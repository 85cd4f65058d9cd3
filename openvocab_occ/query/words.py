"""Words of a query against the labels that a map knows: the same word, or an inflection of it."""

import difflib
import itertools
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from jaxtyping import Bool

from openvocab_occ.errors import QueryError

MAX_CHARACTERS = 1000
STOP_WORDS = frozenset({
    "a", "all", "an", "and", "any", "are", "at", "each", "every", "find", "for", "in", "is", "it", "me", "my", "of",
    "on", "or", "please", "show", "some", "that", "the", "there", "these", "this", "those", "to", "where", "which",
})  # fmt: skip
"""Words that say nothing about the kind of thing. Negations are not among them: they are reported as not understood."""
SYNONYMS = (
    "person, pedestrian, human, man, woman, people, walker, somebody", "car, automobile, auto, sedan, hatchback",
    "truck, lorry", "bus, coach", "bicycle, bike, cycle, pushbike", "motorcycle, motorbike, moped, scooter",
    "road, street, roadway, carriageway, driveable surface, drivable surface, asphalt road",
    "sidewalk, pavement, footpath, footway, walkway", "building, house", "vegetation, tree, bush, plant, greenery",
    "traffic sign, road sign, street sign", "traffic light, traffic signal, stoplight", "traffic cone, cone, pylon",
    "couch, sofa", "tv, television, tvmonitor, screen", "airplane, aeroplane, plane", "boat, ship", "dog, puppy",
    "cat, kitten", "table, diningtable", "construction vehicle, excavator, digger, bulldozer", "terrain, grass, lawn",
    "pole, post, lamppost", "wall, barricade", "fence, railing", "barrier, roadblock", "trash can, bin, rubbish bin",
)  # fmt: skip
"""Words for the same kind of thing, for maps of labels; a `dense` model knows such things itself."""
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
    """Read a text as labels or words for the same thing, longest first; case, hyphens and spaces do not matter."""
    words = text_words(text)
    known = _by_form(tuple(labels))
    channels = np.zeros(len(labels), dtype=bool)
    unknown: list[str] = []
    at = 0
    while at < len(words):
        for length in range(min(_LONGEST_LABEL, len(words) - at), 0, -1):
            forms = _forms(words[at : at + length])
            found = {label for form in forms for label in known.get(form, ())}
            if not found:
                same = {other for form in forms for other in _synonyms().get(form, ())}
                found = {label for form in same for label in known.get(form, ())}
            if found:
                channels[list(found)] = True
                at += length
                break
        else:
            if words[at] not in STOP_WORDS:
                unknown.append(words[at])
            at += 1
    if not channels.any() and not unknown:
        unknown = words or [text]
    unknown = list(dict.fromkeys(unknown))
    near = {word: difflib.get_close_matches(word, [label.lower() for label in labels], n=3) for word in unknown}
    return Match(channels, tuple(unknown), {word: tuple(found) for word, found in near.items() if found})


def text_words(text: str) -> list[str]:
    """Return the words of a text without case, punctuation and compatibility forms."""
    return _WORD.findall(unicodedata.normalize("NFKC", text).casefold())


def label_forms(labels: Sequence[str], words: Sequence[str]) -> bool:
    """Tell whether words, in any inflection, are one of the labels."""
    if not labels:
        return False
    known = _by_form(tuple(labels))
    return any(form in known for form in _forms(words))


@lru_cache(maxsize=8)
def _by_form(labels: tuple[str, ...]) -> dict[str, tuple[int, ...]]:
    """Map every form of every label to the channels that have it."""
    known: dict[str, tuple[int, ...]] = {}
    for channel, label in enumerate(labels):
        for form in _forms(text_words(label)):
            known[form] = (*known.get(form, ()), channel)
    return known


def _forms(words: Sequence[str]) -> set[str]:
    """Return the words run together, as they are and as singular nouns; so "dining tables" meets "diningtable"."""
    if not words:
        return set()
    return {"".join(choice) for choice in itertools.product(*map(lemmas, words))}


@lru_cache(maxsize=1)
def _synonyms() -> dict[str, frozenset[str]]:
    """Map each form to the forms of the same meaning."""
    same: dict[str, frozenset[str]] = {}
    for line in SYNONYMS:
        forms = frozenset("".join(text_words(name)) for name in line.split(", "))
        for form in forms:
            same[form] = same.get(form, frozenset()) | forms
    return same


@lru_cache(maxsize=4096)
def singular(text: str) -> str:
    """Return a noun phrase with its last word in the singular: text encoders learnt most names so."""
    from lemminflect import getLemma

    words = text.split()
    if not words:
        return text
    last = words[-1]
    found = "person" if last == "people" else next(iter(getLemma(last, upos="NOUN", lemmatize_oov=False)), last)
    return " ".join([*words[:-1], found])


@lru_cache(maxsize=4096)
def lemmas(word: str) -> frozenset[str]:
    """Return the nouns that a word may be a form of: leaves are leaf or leave, a bus is a bus, people are persons."""
    from lemminflect import getLemma

    found = {"person"} if word == "people" else set(getLemma(word, upos="NOUN"))
    return frozenset({word, *found})
