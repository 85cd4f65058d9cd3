"""One map put into another, and what a map shows."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, UInt32

from openvocab_occ.errors import ConfigError
from openvocab_occ.memory import journal
from openvocab_occ.memory.changes import centers
from openvocab_occ.memory.footprint import tile_rows
from openvocab_occ.memory.foundation import merge_pruned
from openvocab_occ.memory.layer import TileKey
from openvocab_occ.memory.schema import CELLS
from openvocab_occ.memory.store import agent_number
from openvocab_occ.memory.tile_map import TileMap


@dataclass(frozen=True, eq=False)
class Surface:
    """The occupied voxels of a map. Rows of the arrays belong together."""

    points: Float64[np.ndarray, "n 3"]
    """Centres in the world, metres."""
    labels: Int64[np.ndarray, " n"]
    agents: Int64[np.ndarray, " n"]
    """Positions in `agent_names`."""
    stamps: Float64[np.ndarray, " n"]
    """Unix seconds."""
    agent_names: tuple[str, ...]


def surface(city: TileMap, *, exclude_logs: Collection[str] = ()) -> Surface:
    """Return the voxels whose largest class is not `free`, with who saw them and when."""
    names = tuple(sorted(city.agents()))
    numbers = np.array([agent_number(name) for name in names], dtype=np.uint32)
    parts: list[tuple[np.ndarray, ...]] = [(np.empty((0, 3)), np.empty(0), np.empty(0, np.uint32), np.empty(0))]
    for key, tile in city.tiles(exclude_logs=exclude_logs):
        cell, height = np.nonzero(tile.stamps > 0)
        label = city.schema.decode(tile.payload[cell, height]).argmax(axis=-1)
        keep = label != city.schema.free
        cell, height = cell[keep], height[keep]
        seconds = (tile.stamps[cell, height].astype(np.float64) - 1) / 1000
        parts.append((centers(city.schema, key, cell, height), label[keep], tile.writers[cell, height], seconds))
    points, labels, writers, stamps = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Surface(points, labels.astype(np.int64), _positions(writers, numbers), stamps, names)


def merge(target: TileMap, source: TileMap) -> int:
    """Put a map of the same lattice into another, log by log; return the tiles touched. May be repeated.

    The journal is copied first. The greatest record of each voxel stays, so the order of merges does not matter.
    """
    if target.schema != source.schema:
        raise ConfigError("the maps have another lattice, classes or dtype", expected=target.schema, got=source.schema)
    merge_journal(target, source)
    touched = 0
    ours, merged = target.logs(), source.logs()
    for log, into_base in merged.items():
        if into_base and ours.get(log) is False:
            target.consolidate(log)
    pairs = [(source.layers()[0], target.layers()[0])]
    pairs += [(source.overlay(log), target.overlay(log)) for log, into_base in merged.items() if not into_base]
    for theirs, mine in pairs:
        keys = theirs.stored()
        for start in range(0, len(keys), 32):
            mine.merge(theirs.read(keys[start : start + 32]))
        touched += len(keys)
    for log, into_base in merged.items():
        if into_base and log not in ours:
            target.mark_consolidated(log)
    return touched


def merge_journal(target: TileMap, source: TileMap) -> None:
    """Copy the register of agents and the journal, which come before the tiles."""
    for agent, reason in source.agents().items():
        if target.agents().get(agent) is None:
            target.admit(agent)
        if reason:
            target.quarantine(agent, reason)
    merge_pruned(target, source)
    for name in journal.names(source.store):
        content = source.store.read(name.key)
        if content is not None:
            target.store.write(name.key, content)


@dataclass(frozen=True, eq=False)
class Coverage:
    """How the map grew, write by write."""

    times: Float64[np.ndarray, " n"]
    """Unix seconds."""
    area: Float64[np.ndarray, "n agents"]
    """Square metres that each agent was the first to see, up to then."""
    agent_names: tuple[str, ...]


def coverage(city: TileMap) -> Coverage:
    """Return the ground that is known after each write, from the journal."""
    names = tuple(sorted(city.agents()))
    seen: dict[TileKey, np.ndarray] = {}
    times, areas, total = [], [], np.zeros(len(names))
    for entry in journal.entries(city.store, city.schema, journal.names(city.store)):
        new = 0
        for key, rows in tile_rows(entry, city.schema).items():
            ground = TileKey(0, key.x, key.y)  # all floors are one ground
            before = seen.setdefault(ground, np.zeros(CELLS, dtype=np.bool_))
            now = (rows >= 0).any(axis=1)
            new += int((now & ~before).sum())
            before |= now
        total[names.index(entry.agent)] += new * city.schema.cell**2
        times.append((entry.stamp - 1) / 1000)
        areas.append(total.copy())
    return Coverage(np.array(times), np.array(areas).reshape(-1, len(names)), names)


def _positions(writers: UInt32[np.ndarray, " n"], numbers: UInt32[np.ndarray, " m"]) -> Int64[np.ndarray, " n"]:
    """Return where each writer stands among the numbers, -1 if it does not."""
    if not len(numbers):
        return np.full(len(writers), -1, dtype=np.int64)
    order = np.argsort(numbers)
    at = order[np.minimum(np.searchsorted(numbers, writers, sorter=order), len(numbers) - 1)]
    return np.where(numbers[at] == writers, at, -1).astype(np.int64)
