"""Maps made from the journal: anew, without an agent, up to a time, or by a policy that needs the writes in order."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from openvocab_occ._jit import in_slices
from openvocab_occ.errors import ConfigError, MapError
from openvocab_occ.memory import journal
from openvocab_occ.memory._tiles_kernels import merge_rows
from openvocab_occ.memory.cache import merged
from openvocab_occ.memory.clock import ticks_of
from openvocab_occ.memory.footprint import tile_rows
from openvocab_occ.memory.foundation import PREFIX, foundation, pruned
from openvocab_occ.memory.journal import Entry, EntryName
from openvocab_occ.memory.layer import Layer, TileKey
from openvocab_occ.memory.schema import CELLS, MapSchema, Tile
from openvocab_occ.memory.store import Location, agent_number
from openvocab_occ.memory.tile_map import TileMap
from openvocab_occ.memory.window import Window

FoldPolicy = Literal["newest", "bayes", "ema"]
_BLOCK = 24  # tiles folded at a time: 150 MB of float32 state


@dataclass(frozen=True, kw_only=True)
class FoldConfig:
    """How the writes of a voxel become one."""

    policy: FoldPolicy = "newest"
    """`newest`: the record with the greatest (stamp, agent, logits). `bayes`: the sum of log-probabilities, as if each
    write were independent evidence. `ema`: an exponential mean."""
    half_life: float | None = None
    """Of `bayes`: seconds after which evidence counts half; None for never."""
    limit: float = 8.0
    """Of `bayes`: no class falls further below the best one, so that a changed world is believed after some looks. A
    `uint8` map keeps no more than 9."""
    weight: float = 0.3
    """Of `ema`: share of a new write."""

    def __post_init__(self) -> None:
        if self.policy not in ("newest", "bayes", "ema"):
            raise ConfigError("policy is not known", expected="newest, bayes or ema", got=self.policy)
        if not (0 < self.weight <= 1 and self.limit > 0 and (self.half_life is None or self.half_life > 0)):
            raise ConfigError("fold is not usable", expected="0 < weight <= 1, limit and half_life above 0", got=self)


@dataclass(frozen=True)
class _Reach:
    """An entry and the box of tiles it may touch."""

    name: EntryName
    log: str
    low: TileKey
    counts: tuple[int, ...]

    def touches(self, key: TileKey) -> bool:
        return all(a <= k < a + n for k, a, n in zip(key, self.low, self.counts, strict=True))


def rebuild(
    city: TileMap,
    *,
    without: Collection[str] = (),
    out: Location | None = None,
    until: float | None = None,
    config: FoldConfig | None = None,
    policy: FoldPolicy | None = None,
) -> int:
    """Make tiles anew from the journal; return how many. Quarantined agents are always left out.

    In place, agents named in `without` are quarantined. It may run while others write: a tile is replaced only if
    nobody wrote it meanwhile, by all that the journal holds then. With `out` a new map is made there, without journal.

    Raises:
        ConfigError: The map has no journal, or a policy other than `newest`, or `until`, is asked for in place; or
            what is asked for needs entries that were pruned.
        MapError: A journal entry or a tile is damaged; `verify` and `repair` find and mend tiles.
    """
    fold = config or FoldConfig(policy=policy or "newest")
    if not city.schema.journal:
        raise ConfigError(f"{city.store.name} has no journal", fix="create maps with journal=True")
    if out is None and (fold.policy != "newest" or until is not None):
        raise ConfigError("a map is not folded otherwise in place", expected="out, a new path", got=fold.policy)
    barred = {*without, *(agent for agent, reason in city.agents().items() if reason)}
    last = None if until is None else ticks_of(until)
    pruned(city).allow(without=barred, policy=fold.policy, until=last)
    if out is None:
        for agent in without:
            city.quarantine(agent, "left out by rebuild")
    reaches = _reaches(city, journal.names(city.store, without=barred, until=last))
    if out is None:
        return sum(_in_place(city, layer, barred, reaches) for layer in city.layers())
    s = city.schema
    target = TileMap.create(
        out, s.class_names, heights=s.heights, cell=s.cell, z0=s.z0, dtype=s.dtype, journal=False
    )  # fmt: skip
    base, beneath, written = target.layers()[0], foundation(city), 0
    for tiles in _blocks(city, reaches, fold, beneath):
        base.replace(tiles)
        written += len(tiles)
    for agent in city.agents():
        if agent not in barred:
            target.admit(agent)
    return written


def folded_entries(city: TileMap, names: Collection[EntryName]) -> Iterator[dict[TileKey, Tile]]:
    """Yield, some at a time, the tiles that some entries alone make by the rule of writes."""
    yield from _blocks(city, _reaches(city, names), FoldConfig(), None)


def _blocks(
    city: TileMap, reaches: Sequence[_Reach], fold: FoldConfig, beneath: Layer | None
) -> Iterator[dict[TileKey, Tile]]:
    """Yield folded tiles that hold something."""
    keys = sorted({key for reach in reaches for key in _box(reach)} | {*(beneath.stored() if beneath else ())})
    for start in range(0, len(keys), _BLOCK):
        tiles = folded(city, reaches, keys[start : start + _BLOCK], fold, beneath=beneath)
        found = {key: tile for key, tile in tiles.items() if tile.stamps.any()}
        if found:
            yield found


def folded(
    city: TileMap, reaches: Sequence[_Reach], keys: Collection[TileKey], fold: FoldConfig, *,
    beneath: Layer | None = None,
) -> dict[TileKey, Tile]:  # fmt: skip
    """Return tiles made of the entries that touch them, in order, and of what lies beneath."""
    make = _Newest if fold.policy == "newest" else _Evidence
    states = {key: make(city.schema, fold) for key in keys}
    for reach in reaches:
        touched = [key for key in states if reach.touches(key)]
        if not touched:
            continue
        entry = journal.load(city.store, reach.name, city.schema)
        rows = tile_rows(entry, city.schema, touched)
        values = city.schema.decode(entry.codes) if fold.policy != "newest" else None
        work = [*rows.items()]

        def add(
            start: int, stop: int, work: Any = work, entry: Entry = entry, values: np.ndarray | None = values
        ) -> None:
            for key, found in work[start:stop]:
                states[key].add(found, entry, values)

        in_slices(add, len(work))
    made = {key: state.tile() for key, state in states.items()}
    old = beneath.read(made) if beneath else {}
    return {key: merged([tile, old[key]]) if key in old else tile for key, tile in made.items()}


def repair(city: TileMap, damaged: dict[str, list[TileKey]]) -> int:
    """Make damaged tiles, as `verify` lists them by layer, anew from the journal; return how many."""
    if not city.schema.journal:
        raise ConfigError(f"{city.store.name} has no journal", fix="restore the damaged chunks from a copy")
    if damaged.get(PREFIX):
        raise MapError(
            f"{city.store.name}/{PREFIX} is damaged, and the entries that made it are pruned",
            got=f"{len(damaged[PREFIX])} tiles", fix="restore them from a copy",
        )  # fmt: skip
    barred = {agent for agent, reason in city.agents().items() if reason}
    pruned(city).allow(without=barred)
    reaches = _reaches(city, journal.names(city.store, without=barred))
    for layer in city.layers():
        for key in damaged.get(layer.prefix, []):
            layer.drop(key)
        _in_place(city, layer, barred, reaches, damaged.get(layer.prefix, []))
    return sum(map(len, damaged.values()))


def counts(city: TileMap, *, without: Collection[str] = ()) -> dict[TileKey, np.ndarray]:
    """Return how often each voxel has been written, uint16[cells, heights] of each tile, from the journal."""
    found: dict[TileKey, np.ndarray] = {}
    for entry in journal.entries(city.store, city.schema, journal.names(city.store, without=without)):
        for key, rows in tile_rows(entry, city.schema).items():
            tile = found.setdefault(key, np.zeros((CELLS, city.schema.heights), dtype=np.uint16))
            np.minimum(tile + (rows >= 0).astype(np.uint32), 65535, out=tile, casting="unsafe")
    return found


def _reaches(city: TileMap, names: Collection[EntryName]) -> list[_Reach]:
    found = []
    for name in names:
        entry = journal.load(city.store, name, city.schema)
        window = Window(entry.T_world_ego, entry.spec, city.schema)
        found.append(_Reach(name, entry.log, window.low, window.counts))
    return found


def _box(reach: _Reach) -> list[TileKey]:
    return [TileKey(*(a + i for a, i in zip(reach.low, step, strict=True))) for step in np.ndindex(*reach.counts)]


def _in_place(
    city: TileMap, layer: Layer, barred: Collection[str], reaches: list[_Reach], only: Sequence[TileKey] | None = None
) -> int:
    """Fold the tiles of one layer, each in a transaction that fails if somebody else writes it."""
    in_base = {log for log, is_merged in city.logs().items() if is_merged}
    logs = in_base if layer.prefix == "base/" else {log for log in city.logs() if city.overlay(log) is layer}
    mine = [reach for reach in reaches if reach.log in logs]
    seen = {reach.name for reach in reaches}
    beneath = foundation(city) if layer.prefix == "base/" else None
    keys = sorted({*layer.stored(), *(key for r in mine for key in _box(r))}) if only is None else [*only]

    def change(key: TileKey, tile: Tile) -> int:
        # the tile has been read: whatever was put into it has been in the journal before
        late = [n for n in journal.names(city.store, without=barred) if n not in seen]
        fresh = mine + [reach for reach in _reaches(city, late) if reach.log in logs]
        new = folded(city, sorted(fresh, key=lambda r: r.name), [key], FoldConfig(), beneath=beneath)[key]
        different = int((tile.record != new.record).any())
        tile.record[:] = new.record
        return different

    for start in range(0, len(keys), _BLOCK):
        layer.update(keys[start : start + _BLOCK], change)
    return len(keys)


class _Newest:
    """The merge that writes do as well."""

    def __init__(self, schema: MapSchema, _: FoldConfig) -> None:
        self._tile = Tile(schema)

    def add(self, rows: np.ndarray, entry: Entry, _: np.ndarray | None) -> None:
        tile, stamp, writer = self._tile, np.uint64(entry.stamp), np.uint32(agent_number(entry.agent))
        force = entry.policy == "replace"
        merge_rows(rows, entry.codes, stamp, writer, force, tile.stamps, tile.writers, tile.payload)

    def tile(self) -> Tile:
        return self._tile


class _Evidence:
    """Log-odds or their mean, in float32 until the end."""

    def __init__(self, schema: MapSchema, fold: FoldConfig) -> None:
        self._fold = fold
        self._tile = Tile(schema)
        self._state = np.zeros((CELLS, schema.heights, schema.num_classes), dtype=np.float32)

    def add(self, rows: np.ndarray, entry: Entry, values: np.ndarray | None) -> None:
        if values is None:
            raise AssertionError("evidence is added as logits")
        hit = rows >= 0
        new, old, before = values[rows[hit]], self._state[hit], self._tile.stamps[hit]
        if self._fold.policy == "ema":
            share = np.where(before == 0, 1.0, self._fold.weight).astype(np.float32)[:, None]
            mixed = (1 - share) * old + share * new
        else:
            if self._fold.half_life is not None:
                age = (entry.stamp - before.astype(np.float64)) / 1000
                old = old * np.exp2(-age / self._fold.half_life).astype(np.float32)[:, None]
            mixed = old + new
            mixed -= mixed.max(axis=-1, keepdims=True)
            np.maximum(mixed, -self._fold.limit, out=mixed)
        self._state[hit] = mixed
        self._tile.stamps[hit] = entry.stamp
        self._tile.writers[hit] = agent_number(entry.agent)

    def tile(self) -> Tile:
        seen = self._tile.stamps > 0
        self._tile.payload[seen] = self._tile.schema.encode(self._state[seen])
        return self._tile


def check_journal(city: TileMap) -> list[str]:
    """Return the entries that are damaged."""
    bad: list[str] = []
    for name in journal.names(city.store):
        try:
            journal.load(city.store, name, city.schema)
        except MapError:
            bad.append(name.key)
    return bad
