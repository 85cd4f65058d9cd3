"""Plain English to the query algebra, by a grammar: no model, the same reading every time, nothing dropped unsaid.

    query   = [opening] (count | things) ; things = phrase {("and" | "or" | "," | "but not" | "except") phrase}
    phrase  = {number | ordinal | superlative | attribute | measure} noun {modifier}
    modifier = [negation] (relation anchor | distance anchor | attribute | measure | "like" #id | clause)

Where English leaves a choice it is made so: "and" between kinds of things gives both kinds; modifiers that follow the
last kind count for all kinds before it that have none of their own, and attributes before the first also for plain
nouns after it; each of several relations speaks of the thing looked for, but a clause ("that is ...") of the noun
before it. Words that no rule takes are returned in `unread`.
"""

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, replace

from openvocab_occ.query import algebra as q
from openvocab_occ.query import lexicon as lex
from openvocab_occ.query._modifiers import Modifiers
from openvocab_occ.query._phrase import Phrase, shared
from openvocab_occ.query._tokens import STOPS, integer, ordinal
from openvocab_occ.query.algebra import Node
from openvocab_occ.query.words import checked_text

_TOKEN = re.compile(r"#\d+|\d+(?:st|nd|rd|th)\b|\d+(?:[.,]\d+)?|[^\W\d_]+|[&+,;()]|(?:(?<=\s)|^)[-−–](?=\w)")
_MAX_TOKENS = 250


@dataclass(frozen=True, kw_only=True)
class Parse:
    """How a text was read."""

    query: Node | None
    """None where no word was read."""
    unread: tuple[str, ...] = ()
    """Words that had no effect, in their order."""
    notes: tuple[str, ...] = ()
    """Choices made where the text left one."""


def parse(text: str, labels: Sequence[str] = ()) -> Parse:
    """Read a text; `labels` are names with several words that must not be taken apart, such as "stop sign".

    Raises QueryError for a text that is empty, too long, or not one line.
    """
    text = checked_text(text)
    tokens = tokens_of(text)
    if len(tokens) > _MAX_TOKENS:
        raise q.QueryError("query is too long", expected=f"at most {_MAX_TOKENS} words", got=len(tokens))
    reader = _Reader(tokens, labels)
    query = reader.query()
    if query == q.Anything() and reader.unread:
        query = None
    if query is not None:
        try:
            q.check(query)
        except q.QueryError:  # too large, or a viewpoint alone
            query = None
    if query is None:
        said = tuple(t for t in tokens if t not in STOPS)
        return Parse(query=None, unread=tuple(dict.fromkeys(said)) or (text,))
    return Parse(query=query, unread=tuple(dict.fromkeys(reader.unread)), notes=tuple(dict.fromkeys(reader.notes)))


def tokens_of(text: str) -> tuple[str, ...]:
    """Split a text into words, numbers and the few signs that mean something."""
    plain = unicodedata.normalize("NFKC", text).casefold()
    signs = {"-": "not", "−": "not", "–": "not", "+": "plus"}
    return tuple(signs.get(token, token) for token in map(str, _TOKEN.findall(plain)))


class _Reader(Modifiers):
    """The rules for whole queries and noun phrases."""

    def query(self) -> Node | None:
        counted = self._opening()
        parts: list[Node] = []
        while not self.done():
            before = self.pos
            things = self.things()
            if things is not None:
                parts.append(things)
            if self.pos == before:
                self.drop()
        if not parts:
            return None
        query = q.disjunction(*[p for p in parts if not isinstance(p, q.Not)] or parts[:1])
        query = q.conjunction(query, *[p for p in parts if isinstance(p, q.Not) and p is not query])
        return q.Count(query) if counted else query  # pyright: ignore[reportArgumentType]

    def _opening(self) -> bool:
        while not self.done():
            if self.take(lex.COUNTS):
                return True
            opening = self.peek(lex.OPENINGS)
            if opening is None or self._is_label(opening.length):
                return False
            if self.words[self.pos] in ("what", "which") and opening.length == 1:
                return False
            self.pos += opening.length
        return False

    def things(self) -> Node | None:
        """Read phrases joined by words such as `and`."""
        phrases: list[Phrase] = []
        excluded: list[Node] = []
        while True:
            start = self.pos
            phrase = self.phrase()
            if phrase is not None:
                phrases.append(phrase)
            all_things = phrase is not None and phrase.build() == q.Anything()
            while self.take(lex.EXCEPT) or (all_things and self.take(lex.BUT)):
                out = self.phrase()
                if out is not None:
                    excluded.append(q.Not(out.build()))  # pyright: ignore[reportArgumentType]
            if self.done() or not self._joint() or self.pos == start:
                break
        if not phrases:
            return q.conjunction(*excluded) if excluded else None
        phrases = shared(phrases)
        built = [p.build() for p in phrases]
        wanted = [query for query in built if not isinstance(query, q.Not)]
        refused = [query for query in built if isinstance(query, q.Not)]
        return q.conjunction(*([q.disjunction(*wanted)] if wanted else []), *refused, *excluded)

    def _joint(self) -> bool:
        """Step over what joins two phrases."""
        start = self.pos
        while self.here() in (",", ";") or self.take(lex.OR) or self.take(lex.AND) or self.take(lex.BUT):
            if self.here() in (",", ";"):
                self.pos += 1
        return self.pos > start or bool(self.peek(lex.NEGATIONS))

    def phrase(self, *, anchor: bool = False) -> Phrase | None:
        """Read a noun phrase with its modifiers; as an anchor, only with those of its own clause."""
        phrase = self._head(anchor)
        if phrase is None:
            return None
        if not anchor or self.peek(lex.CLAUSE):
            phrase = self._modifiers(phrase)
        if phrase.order and not phrase.order[0]:
            self.notes.append("counted by distance from the viewer")
            phrase = replace(phrase, order=("-distance", phrase.order[1], phrase.order[2]))
        return phrase

    def _head(self, anchor: bool) -> Phrase | None:
        negated, number, order, level, start = False, None, None, None, self.pos
        if anchor and self.here() == "(":
            place = self._place()
            if place is not None:
                return Phrase(noun=place)
        if anchor and not self._is_label(1) and self.take(lex.ME):
            return Phrase(noun=q.Me())
        before: list[Node] = []
        while not self.done() and not self._is_label(2):
            word = self.here()
            if not anchor and self.peek(lex.NEGATIONS):
                refused = word in ("not", "non") and lex.attribute_at(self.words, self.pos + 1)
                self.take(lex.NEGATIONS)
                if refused:  # non-parked cars
                    before.append(q.Not(refused[0]))  # pyright: ignore[reportArgumentType]
                    self.pos += refused[1]
                else:
                    negated = not negated
            elif pair := self.take(lex.PAIRS):
                number = int(pair)
            elif by := self.take(lex.SUPERLATIVES):
                order = (by, order[1] if order else 1, None)
            elif rank := ordinal(word):
                order = (order[0] if order else "", rank, None)
                self.pos += 1
            elif found := self.take(lex.LEVELS):
                level = found
            elif measured := self._quantity():
                before.append(measured)
            elif (count := integer(word)) and not self.peek(lex.UNITS, 1):
                number = count
                self.pos += 1
            elif not (self.peek(lex.THINGS) and word not in ("any", "all")) and self.take(lex.FILLERS):
                continue
            else:
                break
        bare = self.pos == start
        noun, attributes = self._noun()
        before += attributes
        if noun is None and not before and order is None and not number and not self._can_modify(anchor):
            self.pos = start if not negated else self.pos
            return None
        return Phrase(
            noun=noun or q.Anything(),
            before=tuple(before),
            number=number,
            order=order,
            negated=negated,
            bare=bare and not before,
            level=level,
        )

    def _noun(self) -> tuple[Node | None, list[Node]]:
        """Read a run of nouns and attributes up to the next word that the grammar knows otherwise."""
        if self.here() in ("object", "item", "number") and self.here(1).startswith("#"):
            self.pos += 1
        if self.here().startswith("#"):
            self.pos += 1
            return q.Item(int(self.words[self.pos - 1][1:19])), []
        run: list[str] = []
        attributes: list[tuple[Node, str]] = []
        while not self.done():
            if attributes and not run and self._joined_attribute(attributes):
                continue
            label = next((n for n in (5, 4, 3, 2) if self._is_label(n)), 0)
            if label:
                run += self.words[self.pos : self.pos + label]
                self.pos += label
                continue
            if self._ends_noun(bool(run)):
                break
            attribute = lex.attribute_at(self.words, self.pos)
            if attribute:
                node, length = attribute
                attributes.append((node, " ".join(self.words[self.pos : self.pos + length])))
                self.pos += length
            elif not run and (thing := self.take(lex.THINGS)):
                return (q.Anything() if thing == "any" else q.Noun(thing)), [node for node, _ in attributes]
            elif run and self._posture():
                self.pos += 1
            elif self.peek(lex.FILLERS):
                if run and self.here() in ("is", "are", "was", "were"):
                    break
                self.skip(lex.FILLERS)
            else:
                run.append(self.here())
                self.pos += 1
        if not run and attributes and self._single(attributes[-1][1]):  # an orange, a glass
            run = [attributes.pop()[1]]
        return (q.Noun(" ".join(run)[:200]) if run else None), [node for node, _ in attributes]

    def _joined_attribute(self, attributes: list[tuple[Node, str]]) -> bool:
        """Read `or blue` after `red`: two of a kind are alternatives, as no thing is of two colours."""
        back = self.pos
        while self.here() == "," or self.take(lex.AND) or self.take(lex.OR):
            self.pos += self.here() == ","
        following = lex.attribute_at(self.words, self.pos) if self.pos > back else None
        if following is None:
            self.pos = back
            return False
        last = attributes[-1][0]
        kinds = {type(n) for n in q.walk(last)} - {q.Or}
        if kinds == {type(following[0])}:
            attributes[-1] = (q.disjunction(last, following[0]), attributes[-1][1])
        else:
            attributes.append((following[0], " ".join(self.words[self.pos : self.pos + following[1]])))
        self.pos += following[1]
        return True
