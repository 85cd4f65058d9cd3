"""Noun phrases as they are read, before it is known what they share with their neighbours."""

from dataclasses import dataclass, replace

from openvocab_occ.query import algebra as q
from openvocab_occ.query.algebra import Node


@dataclass(frozen=True, kw_only=True)
class Phrase:
    """A noun with all that stands before and after it."""

    noun: Node
    before: tuple[Node, ...] = ()
    after: tuple[Node, ...] = ()
    number: int | None = None
    order: tuple[str, int, Node | None] | None = None
    """By what it is a superlative (with a minus for the least), its rank, its anchor."""
    negated: bool = False
    bare: bool = False
    """Nothing stands before the noun."""
    level: str | None = None

    def build(self) -> Node:
        """Return the phrase as a query."""
        whole = self.level == "part" and self.noun != q.Anything()
        noun = q.Relation("of", (self.noun,)) if whole else self.noun  # pyright: ignore[reportArgumentType]
        core = q.conjunction(noun, *self.before, *self.after)
        if isinstance(core, q.And) and isinstance(core.of[0], q.Anything):
            core = q.conjunction(*core.of[1:])
        if self.level:
            core = q.Level(core, self.level)  # pyright: ignore[reportArgumentType]
        if self.order:
            by, rank, anchor = self.order
            ranks = range(rank, rank + min(self.number or 1, 20))
            most = [q.Superlative(core, by.lstrip("-"), by[0] == "-", r, anchor) for r in ranks]  # pyright: ignore[reportArgumentType]
            core = q.disjunction(*most)
        elif self.number:
            core = q.Some(core, self.number)  # pyright: ignore[reportArgumentType]
        return q.Not(core) if self.negated else core  # pyright: ignore[reportArgumentType]


def shared(phrases: list[Phrase]) -> list[Phrase]:
    """Give modifiers to the neighbours that they also speak of."""
    last = phrases[-1]
    if last.after and not any(p.after or p.negated for p in phrases[:-1]) and not last.negated:
        phrases = [replace(p, after=last.after) for p in phrases]
    first = phrases[0]
    plain = [p.bare and not p.negated for p in phrases[1:]]
    if first.before and plain and all(plain) and isinstance(first.noun, q.Noun):
        phrases = [first, *(replace(p, before=first.before) for p in phrases[1:])]
    return phrases
