"""Phrases of the lexicon against what pixels can show: the truth that the pair is trained on."""

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np


class State(NamedTuple):
    """All that is true of a pixel: thing, colour of the thing, part, material; colour is empty where it has none."""

    kind: str
    color: str
    part: str
    material: str


SKY = State("sky", "", "", "")
UNSURE = -1
REPAINTED = "?"
"""Colour of a thing whose picture was painted over in training: what it is stays, what colour it has is unsure."""


@dataclass(frozen=True, eq=False)
class Phrases:
    """Texts, and for each whether it is true (1), false (0) or unsure (-1) of each state."""

    texts: list[str]
    truth: np.ndarray
    """int8 [texts, states]."""
    names: dict[str, list[int]]
    """Rows of the texts of each plain thing: `car` -> rows of car, cars, automobile."""
    colored: dict[str, np.ndarray]
    """Rows [words, colours] of the texts of coloured things: `car` -> red car, blue car; -1 is kept out."""


def kinds_of(lexicon: dict, thing: str) -> set[str]:
    """Return the kinds that a thing of the lexicon stands for."""
    entry = lexicon["things"][thing]
    return set(entry.get("kinds", ())).union(*(kinds_of(lexicon, other) for other in entry.get("of", ())))


def thing_truth(lexicon: dict, thing: str, states: list[State]) -> np.ndarray:
    """Return the truth of a thing's name for each state."""
    entry, kinds = lexicon["things"][thing], kinds_of(lexicon, thing)
    maybe = {k for name in entry.get("maybe", ()) for k in ({name} | _kinds_if_thing(lexicon, name))} - kinds
    right = [s.kind in kinds and ("parts" not in entry or s.part in entry["parts"]) for s in states]
    unsure = [s.kind in maybe for s in states]
    return np.where(right, 1, np.where(unsure, UNSURE, 0)).astype(np.int8)


def color_truth(color: str, states: list[State]) -> np.ndarray:
    """Return 1 where the thing has the colour; grey and silver are unsure of each other, repainted things of all."""
    close = {"grey": {"silver"}, "silver": {"grey", "white"}, "white": {"silver", "beige"}, "beige": {"white"}}
    unsure = {REPAINTED, *close.get(color, ())}
    found = [1 if s.color == color else UNSURE if s.color in unsure else 0 for s in states]
    return np.array(found, dtype=np.int8)


def both(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the truth of "a and b" in three-valued logic."""
    return np.where((a == 0) | (b == 0), 0, np.where((a == 1) & (b == 1), 1, UNSURE)).astype(np.int8)


def build(lexicon: dict, states: list[State]) -> Phrases:
    """Return all phrases of the lexicon; never one of a pair of colour and thing that is kept out."""
    texts: list[str] = []
    truth: list[np.ndarray] = []
    names: dict[str, list[int]] = {}
    colored: dict[str, np.ndarray] = {}

    def add(text: str, row: np.ndarray) -> int:
        texts.append(text)
        truth.append(row)
        return len(texts) - 1

    kept_out = {tuple(pair) for pair in lexicon["never_rendered"]}
    things = {thing: thing_truth(lexicon, thing, states) for thing in lexicon["things"]}
    for thing, row in things.items():
        entry = lexicon["things"][thing]
        names[thing] = [add(word, row) for word in entry["words"]]
        if entry.get("colored"):
            colored[thing] = np.full((3, len(lexicon["colors"])), -1)
            for at, color in enumerate(lexicon["colors"]):
                if (color, thing) not in kept_out:
                    for k, word in enumerate(entry["words"][:3]):
                        colored[thing][k, at] = add(f"{color} {word}", both(row, color_truth(color, states)))
    for color in lexicon["colors"]:  # of what has no colour of its own nothing is known
        add(color, np.where([s.color == "" for s in states], UNSURE, color_truth(color, states)).astype(np.int8))
    for entry in lexicon["parts"].values():
        row = np.array([int(s.part in entry["parts"]) for s in states], dtype=np.int8)
        for word in entry["words"]:
            add(word, row)
        for whole, word in product(entry.get("whole", ()), entry["words"][:2]):
            thing = whole if whole in things else "building"
            add(f"{whole} {word}", both(row, things[thing]))
    for entry in lexicon["materials"].values():
        maybe = entry.get("maybe_materials", ())
        found = [1 if s.material in entry["materials"] else UNSURE if s.material in maybe else 0 for s in states]
        for word in entry["words"]:
            add(word, np.array(found, dtype=np.int8))
    for word in lexicon["absent"]:
        add(word, np.zeros(len(states), dtype=np.int8))
    return Phrases(texts, np.stack(truth), names, colored)


def _kinds_if_thing(lexicon: dict, name: str) -> set[str]:
    return kinds_of(lexicon, name) if name in lexicon["things"] else set()
