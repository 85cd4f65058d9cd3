"""Whose logits contradict the map."""

from dataclasses import dataclass

import numpy as np

from openvocab_occ.memory import journal
from openvocab_occ.memory.footprint import tile_rows
from openvocab_occ.memory.layer import TileKey
from openvocab_occ.memory.tile_map import TileMap

_LEAST = 500  # voxels seen by others too, below which nothing is said


@dataclass(frozen=True)
class Witness:
    """How far an agent's writes agree with what the others say of the same voxels."""

    agent: str
    compared: int
    """Voxel observations that at least two others had a say in."""
    contradicted: float
    """Share of them in which most of the others say free where it says occupied, or the reverse."""

    def suspicious(self, limit: float) -> bool:
        """Tell whether enough was compared, and too much of it contradicted."""
        return self.compared >= _LEAST and self.contradicted > limit


def audit(city: TileMap) -> list[Witness]:
    """Compare every agent with the others, voxel by voxel, from the journal; the least trusted first.

    Each agent has one vote a voxel, free or occupied: that of its last write. A voxel counts for an agent where two
    or more others voted and did not tie. One agent cannot convict another, and a wrong one among three is found.
    Memory: one byte a voxel and agent of the whole map.
    """
    votes: dict[str, dict[TileKey, np.ndarray]] = {}
    free = city.schema.free
    for entry in journal.entries(city.store, city.schema, journal.names(city.store)):
        occupied = np.where(city.schema.decode(entry.codes).argmax(axis=-1) == free, -1, 1).astype(np.int8)
        mine = votes.setdefault(entry.agent, {})
        for key, rows in tile_rows(entry, city.schema).items():
            tile = mine.setdefault(key, np.zeros(rows.shape, dtype=np.int8))
            tile[rows >= 0] = occupied[rows[rows >= 0]]
    found = []
    for agent, mine in votes.items():
        compared = against = 0
        for key, vote in mine.items():
            others = [theirs[key] for name, theirs in votes.items() if name != agent and key in theirs]
            if len(others) < 2:
                continue
            total = np.sum(others, axis=0, dtype=np.int32)
            judged = (vote != 0) & (total != 0) & (np.count_nonzero(others, axis=0) >= 2)
            compared += int(judged.sum())
            against += int((judged & (np.sign(total) != vote)).sum())
        found.append(Witness(agent, compared, against / compared if compared else 0.0))
    return sorted(found, key=lambda witness: -witness.contradicted)


def quarantine_contradicting(city: TileMap, *, limit: float = 0.2) -> list[Witness]:
    """Quarantine agents of whom more than `limit` is contradicted by most others; return them.

    Writes of theirs are refused from then on; `rebuild` takes out what they wrote.
    """
    guilty = [witness for witness in audit(city) if witness.suspicious(limit)]
    for witness in guilty:
        reason = f"{witness.contradicted:.0%} of {witness.compared} voxels contradicted by the others"
        city.quarantine(witness.agent, reason)
    return guilty
