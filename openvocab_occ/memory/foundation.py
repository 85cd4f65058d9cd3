"""What lies beneath the base: tiles that stand for journal entries that were pruned.

The base is the greater of these tiles and of what the journal still holds, record by record. So a map can still be
rebuilt, to the same bytes, and without any agent that none of the pruned entries was of.
"""

from collections.abc import Collection
from dataclasses import dataclass

from openvocab_occ.errors import ConfigError
from openvocab_occ.memory.layer import Layer
from openvocab_occ.memory.tile_map import TileMap

PREFIX = "pruned/"
_RECORD = "pruned.json"


@dataclass(frozen=True)
class Pruned:
    """Entries that a journal does not hold any more."""

    entries: int = 0
    size: int = 0
    """Bytes of them."""
    agents: tuple[str, ...] = ()
    """Who wrote those that are part of the map: these cannot be left out of it any more."""
    last: int = 0
    """Stamp of the latest, as in the records."""

    def joined(self, other: "Pruned") -> "Pruned":
        """Return both."""
        agents = tuple(sorted({*self.agents, *other.agents}))
        return Pruned(self.entries + other.entries, self.size + other.size, agents, max(self.last, other.last))

    def allow(self, *, without: Collection[str] = (), policy: str = "newest", until: int | None = None) -> None:
        """Say no to what needs the entries that are gone.

        Raises:
            ConfigError: An agent of theirs is to be left out, or they are to be folded otherwise, or in part.
        """
        why = f"{self.entries} entries up to {(self.last - 1) / 1000:.0f} are pruned from the journal"
        bound = sorted({*without} & {*self.agents})
        if bound:
            raise ConfigError(
                f"agent {bound[0]!r} cannot be left out: {why}, some of them its own", got=bound,
                fix="quarantine keeps its new writes out, TileMap.release lets a rebuild keep the old ones",
            )  # fmt: skip
        if self.entries and (policy != "newest" or (until is not None and until < self.last)):
            raise ConfigError(
                f"the map cannot be folded by {policy}" + ("" if until is None else " up to that time") + f": {why}",
                fix="fold it before pruning",
            )


def pruned(city: TileMap) -> Pruned:
    """Return what has been pruned from a map's journal so far."""
    found = city.store.read_json(_RECORD)
    if found is None:
        return Pruned()
    return Pruned(int(found["entries"]), int(found["size"]), tuple(found["agents"]), int(found["last"]))


def foundation(city: TileMap) -> Layer | None:
    """Return the tiles that pruned entries made, None where nothing was pruned."""
    return Layer(city.store, PREFIX, city.schema) if city.store.read_json(_RECORD) is not None else None


def record(city: TileMap, all_of_it: Pruned) -> None:
    """Say what has been pruned."""
    agents = [*all_of_it.agents]
    value = {"entries": all_of_it.entries, "size": all_of_it.size, "agents": agents, "last": all_of_it.last}
    city.store.write_json(_RECORD, value)


def merge_pruned(target: TileMap, source: TileMap) -> None:
    """Put what lies beneath one map beneath another."""
    theirs = foundation(source)
    if theirs is None:
        return
    mine, keys = Layer(target.store, PREFIX, target.schema), theirs.stored()
    for start in range(0, len(keys), 32):
        mine.merge(theirs.read(keys[start : start + 32]))
    record(target, pruned(target).joined(pruned(source)))
