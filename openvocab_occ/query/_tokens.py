"""The words of a query, read from left to right."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

from openvocab_occ.query import algebra as q
from openvocab_occ.query import lexicon as lex
from openvocab_occ.query.algebra import Node
from openvocab_occ.query.words import label_forms

STOPS = frozenset({",", ";", "(", ")"})


@dataclass
class Tokens:
    """A place in a text, and what could not be read so far."""

    words: lex.Words
    labels: Sequence[str]
    """Names of several words that are not taken apart."""
    pos: int = 0
    unread: list[str] = field(default_factory=list[str])
    notes: list[str] = field(default_factory=list[str])

    def here(self, offset: int = 0) -> str:
        at = self.pos + offset
        return self.words[at] if at < len(self.words) else ""

    def take(self, table: dict[lex.Words, str]) -> str | None:
        found = lex.at(table, self.words, self.pos)
        if found is None:
            return None
        self.pos += found.length
        return found.meaning

    def peek(self, table: dict[lex.Words, str], offset: int = 0) -> lex.Found | None:
        return lex.at(table, self.words, self.pos + offset)

    def skip(self, *tables: dict[lex.Words, str]) -> None:
        while any(self.take(table) for table in tables):
            pass

    def drop(self) -> None:
        """Give up on one word, and say so."""
        if self.here() not in STOPS and not self.peek(lex.FILLERS):
            self.unread.append(self.here())
        self.pos += 1

    def done(self) -> bool:
        return self.pos >= len(self.words)

    def _place(self) -> Node | None:
        inside = self.words[self.pos + 1 : self.pos + 12]
        if ")" not in inside:
            return None
        inside = inside[: inside.index(")")]
        flat = [-1.0 if w == "not" else w for w in inside if w != ","]
        values: list[float] = []
        sign = 1.0
        for word in flat:
            if word == -1.0:
                sign = -1.0
                continue
            try:
                values.append(sign * float(str(word).replace(",", ".")))
            except ValueError:
                return None
            sign = 1.0
        if len(values) not in (2, 3):
            return None
        self.pos += len(inside) + 2
        return q.Place((values[0], values[1], values[2] if len(values) == 3 else 0.0))

    def _is_label(self, length: int) -> bool:
        """Tell whether the next words together are a label of two words or more (or of one, for length 1)."""
        words = self.words[self.pos : self.pos + length]
        if len(words) < length:
            return False
        if length == 2:
            return any(self._named(self.words[self.pos : self.pos + n]) for n in (2, 3, 4, 5))
        return self._named(words)

    def _named(self, words: lex.Words) -> bool:
        return bool(words) and label_forms(self.labels, words)

    def _single(self, word: str) -> bool:
        return self._named((word,))

    def _posture(self) -> bool:
        """Tell whether a word such as `standing` only leads to a relation."""
        return bool(self.peek(lex.POSTURES) and (self.peek(lex.RELATIONS, 1) or self.peek(lex.VIEWER_RELATIONS, 1)))


def ordinal(word: str) -> int | None:
    digits = re.fullmatch(r"(\d{1,3})(?:st|nd|rd|th)", word)
    return int(digits[1]) if digits and int(digits[1]) else lex.ORDINALS.get(word)


def integer(word: str) -> int | None:
    return lex.NUMBERS.get(word) or (int(word) if re.fullmatch(r"\d{1,4}", word) and int(word) else None)
