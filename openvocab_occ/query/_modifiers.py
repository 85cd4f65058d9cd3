"""What follows a noun: relations, distances, attributes, clauses."""

from abc import abstractmethod
from dataclasses import replace

from openvocab_occ.query import algebra as q
from openvocab_occ.query import lexicon as lex
from openvocab_occ.query._phrase import Phrase
from openvocab_occ.query._quantity import quantity_at
from openvocab_occ.query._tokens import STOPS, Tokens
from openvocab_occ.query.algebra import Node


class Modifiers(Tokens):
    """The rules for modifiers; `phrase` reads the noun phrase of an anchor."""

    @abstractmethod
    def phrase(self, *, anchor: bool = False) -> Phrase | None:
        """Read a noun phrase."""

    def _modifiers(self, phrase: Phrase) -> Phrase:
        """Read what follows a noun."""
        while not self.done():
            start = self.pos
            negated = False
            if self._joined_modifier():
                self._joint_words()
            self.skip(lex.CLAUSE, {k: v for k, v in lex.FILLERS.items() if k != ("of", "the")})
            while self.take(lex.NEGATIONS):
                negated = not negated
                self.skip(lex.FILLERS)
            phrase, node = self._modifier(phrase)
            if node is None and phrase.order and phrase.order[2] is not None and self.pos > start:
                continue
            if node is None:
                if self.pos > start and self.done():
                    if negated:
                        self.unread.append("not")
                    break
                self.pos = start
                break
            if not isinstance(node, q.Anything):
                phrase = replace(phrase, after=(*phrase.after, q.Not(node) if negated else node))  # pyright: ignore[reportArgumentType]
        return phrase

    def _joint_words(self) -> None:
        while self.here() in (",", ";") or self.take(lex.AND) or self.take(lex.BUT):
            if self.here() in (",", ";"):
                self.pos += 1

    def _joined_modifier(self) -> bool:
        """Tell whether a joining word leads to another modifier of the same thing, not to another thing."""
        at, probe = self.pos, replace(self, unread=[], notes=[])
        probe._joint_words()
        if probe.pos == at:
            return False
        probe.skip(lex.CLAUSE, lex.FILLERS, lex.NEGATIONS)
        if probe._can_modify(False) and not probe._is_label(2):
            return True
        run = probe.pos
        while (attribute := lex.attribute_at(probe.words, probe.pos)) is not None:
            probe.pos += attribute[1]
        return probe.pos > run and (probe.done() or probe._ends_noun(True))

    def _can_modify(self, anchor: bool) -> bool:
        if anchor or self.done():
            return False
        tables = (lex.RELATIONS, lex.VIEWER_RELATIONS, lex.COMPARATIVES, lex.LACKING, lex.LIKE)
        return any(self.peek(t) for t in tables) or quantity_at(self.words, self.pos) is not None

    def _modifier(self, phrase: Phrase) -> tuple[Phrase, Node | None]:
        if self._is_label(2):
            return phrase, None
        if phrase.order and self._order_anchor():
            return self._ordered(phrase)
        if measured := self._quantity():
            return phrase, measured
        if self.peek(lex.LIKE) and (like := self._like()):
            return phrase, like
        if lacking := self.take(lex.LACKING):
            other = self.anchors()
            if other is None:
                self.unread.append(lacking)
                return phrase, q.Anything()
            return phrase, q.Not(q.Relation("touching", (other,)))  # pyright: ignore[reportArgumentType]
        if (by := self.peek(lex.SUPERLATIVES)) and phrase.order is None:
            self.pos += by.length
            return self._ordered(replace(phrase, order=(by.meaning, 1, None)))
        relation = self._relation()
        if relation is not None:
            return phrase, relation
        attribute = lex.attribute_at(self.words, self.pos)
        if attribute:
            self.pos += attribute[1]
            choices = [attribute[0]]
            while self.peek(lex.OR) and (other := lex.attribute_at(self.words, self.pos + 1)):
                choices.append(other[0])
                self.pos += 1 + other[1]
            return phrase, q.disjunction(*choices)
        if self._posture():
            self.pos += 1
            return phrase, q.Anything()
        return phrase, None

    def _relation(self) -> Node | None:
        here, viewer = self.peek(lex.RELATIONS), self.peek(lex.VIEWER_RELATIONS)
        if viewer and (here is None or viewer.length > here.length):
            self.pos += viewer.length
            return q.Relation(viewer.meaning, (q.Me(),))  # pyright: ignore[reportArgumentType]
        if here is None:
            return None
        said = self.words[self.pos : self.pos + here.length]
        self.pos += here.length
        if here.meaning == "between":
            return self._between(said)
        anchor = self.anchors()
        if anchor is None:
            if viewer:
                return q.Relation(viewer.meaning, (q.Me(),))  # pyright: ignore[reportArgumentType]
            following = self._shared_anchor(here.meaning)
            if following is not None:  # behind and left of the bus
                return following
            self.unread.extend(said)
            return q.Anything()
        if said == ("crossing",):
            return q.conjunction(q.State("moving"), q.Relation("on", (anchor,)))  # pyright: ignore[reportArgumentType]
        relation = here.meaning
        parts = anchor.of if isinstance(anchor, q.And) and _all_things(anchor) else (anchor,)
        return q.conjunction(*(q.Relation(relation, (part,)) for part in parts))  # pyright: ignore[reportArgumentType]

    def _shared_anchor(self, name: str) -> Node | None:
        joint = self.peek(lex.AND)
        if joint is None or not self.peek(lex.RELATIONS, joint.length):
            return None
        self.pos += joint.length
        other = self._relation()
        if isinstance(other, q.Relation):
            return q.conjunction(q.Relation(name, other.anchors), other)  # pyright: ignore[reportArgumentType]
        return other

    def _between(self, said: lex.Words) -> Node:
        first = self.phrase(anchor=True)
        if first is None:
            self.unread.extend(said)
            return q.Anything()
        second = None
        if self.peek(lex.AND):
            back = self.pos
            self.take(lex.AND)
            second = None if self._can_modify(False) else self.phrase(anchor=True)
            self.pos = self.pos if second else back
        anchors = (first.build(), second.build()) if second else (first.build(),)
        return q.Relation("between", anchors)  # pyright: ignore[reportArgumentType]

    def anchors(self) -> Node | None:
        """Read what a relation is to: one phrase, or several joined by `or` or `and`."""
        first = self.phrase(anchor=True)
        if first is None:
            return None
        result, joined = first.build(), [first.build()]
        while (joint := self.peek(lex.OR) or self.peek(lex.AND)) is not None:
            back, marks = self.pos, (len(self.unread), len(self.notes))
            self.pos += joint.length
            following = None if self._can_modify(False) or self._all_attributes() else self.phrase(anchor=True)
            if following is None:
                self.pos = back
                del self.unread[marks[0] :], self.notes[marks[1] :]
                break
            joined.append(following.build())
            result = q.disjunction(*joined) if joint.meaning == "or" else q.And(tuple(joined))  # pyright: ignore[reportArgumentType]
        return result

    def _all_attributes(self) -> bool:
        at = self.pos
        while (attribute := lex.attribute_at(self.words, at)) is not None:
            at += attribute[1]
        return at > self.pos and at >= len(self.words)

    def _order_anchor(self) -> bool:
        return self.here() in ("to", "from") or (self.here() == "of" and bool(self.peek(lex.ME, 1)))

    def _ordered(self, phrase: Phrase) -> tuple[Phrase, Node | None]:
        """Read `to the entrance`, `from the left`, after an order was asked for."""
        assert phrase.order is not None
        by, rank, _ = phrase.order
        if not self._order_anchor():
            return phrase, q.Anything()
        back = self.pos
        self.pos += 1
        side = next((w for w in (self.here(), self.here(1)) if w in ("left", "right")), None)
        if side and self.words[back] == "from":
            self.pos += 1 + (self.here() == "the")
            by = "left" if side == "left" else "-left"
            return replace(phrase, order=(by, rank, None)), q.Anything()
        anchor = self.anchors() if by.endswith("distance") or not by else None
        if anchor is None:
            self.pos = back
            return phrase, None
        anchor = q.disjunction(*anchor.of) if isinstance(anchor, q.And) and _all_things(anchor) else anchor
        return replace(phrase, order=(by, rank, anchor)), q.Anything()

    def _like(self) -> Node | None:
        back = self.pos
        self.take(lex.LIKE)
        self.skip(lex.FILLERS)
        while self.here() in ("object", "number", "id"):
            self.pos += 1
        if self.here().startswith("#"):
            self.pos += 1
            return q.Like(int(self.words[self.pos - 1][1:19]))
        self.pos = back
        return None

    def _quantity(self) -> Node | None:
        """Read `within 20 m of the bus`, `3 m tall`, `longer than 5 m`."""
        found = quantity_at(self.words, self.pos)
        if found is None:
            return None
        self.pos += found.length
        if found.dimension:
            return q.Measure(found.dimension, found.low, found.high)  # pyright: ignore[reportArgumentType]
        if self.here() in ("away", "distant"):
            self.pos += 1
        anchor: Node | None = None
        if self.here() in ("of", "from", "to", "around", "off"):
            back = self.pos
            self.pos += 1
            anchor = self.anchors()
            self.pos = self.pos if anchor else back
        anchor = q.disjunction(*anchor.of) if isinstance(anchor, q.And) and _all_things(anchor) else anchor
        return q.Within(anchor or q.Me(), found.high, found.low)  # pyright: ignore[reportArgumentType]

    def _ends_noun(self, begun: bool) -> bool:
        if self.here() in STOPS or self.here().startswith("#") or self.here() in ("to", "from"):
            return True
        tables = [lex.AND, lex.OR, lex.BUT, lex.EXCEPT, lex.LACKING, lex.LIKE, lex.COMPARATIVES, lex.VIEWER_RELATIONS,
                  lex.RELATIONS, lex.NEGATIONS]  # fmt: skip
        tables += [lex.CLAUSE, lex.SUPERLATIVES] if begun else []
        return any(self.peek(t) for t in tables) or quantity_at(self.words, self.pos) is not None


_DESCRIPTIONS = q.Color | q.Sized | q.Material | q.State | q.Measure | q.Relation | q.Within | q.Not


def _all_things(query: q.And) -> bool:
    """Tell whether an And came from joined anchors rather than from one described anchor."""
    return not any(isinstance(part, _DESCRIPTIONS) for part in query.of)
