"""A journal that does not grow for ever: entries that are folded into the base need not be kept."""

from collections.abc import Callable

from openvocab_occ.errors import StorageError
from openvocab_occ.memory import journal
from openvocab_occ.memory.clock import ticks_of
from openvocab_occ.memory.fold import folded_entries
from openvocab_occ.memory.foundation import PREFIX, Pruned, pruned, record
from openvocab_occ.memory.journal import EntryName
from openvocab_occ.memory.layer import Layer
from openvocab_occ.memory.tile_map import TileMap


def prune(
    city: TileMap, *, before: float | None = None, progress: Callable[[int, int], object] | None = None
) -> Pruned:
    """Drop the journal entries of logs that are merged into the base; return what was dropped.

    May be stopped and repeated, and others may write meanwhile; one prune at a time. Entries of quarantined agents are
    dropped without a trace: `rebuild` leaves them out in any case.

    Args:
        city: The map.
        before: Only entries of before this time, Unix seconds.
        progress: Called with the entries done and their total.

    Raises:
        MapError: An entry is damaged; nothing is dropped.
    """
    if not city.writable:
        raise StorageError(f"{city.store.name} was opened for reading", fix="open it with writable=True")
    last = None if before is None else ticks_of(before) - 1
    merged = {log for log, is_merged in city.logs().items() if is_merged}
    barred = {agent for agent, reason in city.agents().items() if reason}
    names: list[EntryName] = []
    kept: list[EntryName] = []
    agents: set[str] = set()
    for name in journal.names(city.store, until=last):
        entry = journal.load(city.store, name, city.schema)
        if entry.log in merged:
            names.append(name)
            if entry.agent not in barred:
                kept.append(name)
                agents.add(entry.agent)
    if not names:
        return Pruned()
    sizes = {name: len(city.store.read(name.key) or b"") for name in names}
    dropped = Pruned(len(names), sum(sizes.values()), tuple(sorted(agents)), max(name.stamp for name in names))
    beneath = Layer(city.store, PREFIX, city.schema)
    for tiles in folded_entries(city, kept):
        beneath.merge(tiles)
    record(city, pruned(city).joined(dropped))  # from here on the tiles beneath count
    for done, name in enumerate(names, start=1):
        city.store.delete(name.key)
        if progress is not None:
            progress(done, len(names))
    return dropped
