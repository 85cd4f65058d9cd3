"""Lengths in words: `within 20 m`, `at least 3 metres tall`, `between 5 and 10 m`, `longer than 5 m`."""

import re
from dataclasses import dataclass

from openvocab_occ.query import lexicon as lex

_NUMBER = re.compile(r"\d{1,7}(?:[.,]\d{1,6})?")
_NEARLY = 0.2
"""What "20 m away" and "about 20 m" leave to either side, as a share."""


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A range of metres, of a dimension or, without one, of a distance."""

    low: float
    high: float | None
    dimension: str
    length: int
    """Words read."""


def quantity_at(words: lex.Words, start: int) -> Quantity | None:
    """Return the length that begins at a word, or None."""
    at, wanted = start, ""
    if words[at : at + 1] == ("a",):
        at += 1
    comparative = lex.at(lex.COMPARATIVES, words, at)
    kind = None
    if comparative:
        wanted, at = comparative.meaning, at + comparative.length
    else:
        for table in (lex.MORE, lex.LESS, lex.ABOUT):
            found = lex.at(table, words, at)
            if found:
                kind, at = found.meaning, at + found.length
                break
    between = words[at : at + 1] == ("between",)
    first, at = _number(words, at + between)
    if first is None:
        return None
    second, after = (None, at)
    if words[at : at + 1] in (("and",), ("to",), ("not",)):  # `not` is how a dash reads
        second, after = _number(words, at + 1)
    at = after if second is not None else at
    if between and second is None:
        return None
    unit = lex.at(lex.UNITS, words, at)
    if unit is None and not (kind in ("less", "more") and _ends(words, at)):
        return None
    scale = float(unit.meaning) if unit else 1.0
    at += unit.length if unit else 0
    dimension = lex.at(lex.DIMENSIONS, words, at)
    if comparative:
        bounds = (first, None) if wanted[0] == "+" else (0.0, first)
        name = wanted[1:]
    else:
        name = dimension.meaning if dimension else ""
        at += dimension.length if dimension else 0
        if second is not None:
            bounds = (min(first, second), max(first, second))
        elif kind == "more":
            bounds = (first, None)
        elif kind == "less":
            bounds = (0.0, first)
        else:
            bounds = (first * (1 - _NEARLY), first * (1 + _NEARLY))
    low, high = bounds
    high = None if high is None else round(high * scale, 9)
    return Quantity(low=round(low * scale, 9), high=high, dimension=name, length=at - start)


def _ends(words: lex.Words, at: int) -> bool:
    """Tell whether a number without a unit may be metres here."""
    return at >= len(words) or words[at] in ("of", "from", "away", ",", "and")


def _number(words: lex.Words, at: int) -> tuple[float | None, int]:
    if at >= len(words):
        return None, at
    word = words[at]
    if _NUMBER.fullmatch(word):
        return float(word.replace(",", ".")), at + 1
    number = lex.NUMBERS.get(word)
    return (None if number is None else float(number)), at + 1
