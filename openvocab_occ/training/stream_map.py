"""A map of one place in memory: what a `TileMap` is on disk, without disk, for the many short lives of training.

It reads and writes as a TileMap of the same lattice does (a test compares them), forgets when it is dropped, and knows
policies that a map of many vehicles cannot have. Of a pose it uses x, y and heading; heights are the ego's own.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64

from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import GridSpec
from openvocab_occ.networks.lmop import LOGIT_REACH, limited

WritePolicy = Literal["newest", "overwrite", "ema", "bayes", "gate"]
"""`newest`: what is seen replaces. `overwrite`: and what is hidden is forgotten (Neural Map Prior's way). `ema`: half
of each. `bayes`: the sum, limited. `gate`: shares of both that a network chooses for each voxel."""
Gate = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""From new logits [n, classes], old ones (0 where nothing was known) and facts [n, 3] to the shares [n, 2] of old and
new in what is stored. Facts: how often the voxel was written, days since the last time, metres from the ego."""
EMA_SHARE = 0.5
BAYES_REACH = 20.0  # evidence that has been added up; see networks.lmop.LOGIT_REACH
DAY = 86400.0  # seconds


@dataclass(frozen=True, eq=False)
class StreamPrior:
    """What memory knows of a window; the same record as a tile map's."""

    logits: Float32[np.ndarray, "x y z classes"]
    known: Bool[np.ndarray, "x y z"]


class StreamMap:
    """Centred logits of a rectangle of ground."""

    def __init__(
        self, low: Float64[np.ndarray, " 2"], high: Float64[np.ndarray, " 2"], spec: GridSpec, classes: int
    ) -> None:
        """Cover the rectangle of ego positions from `low` to `high`, metres, with the grid's reach around it."""
        self.spec = spec
        self.cell = float(spec.size[0])
        corners = np.array([[x, y] for x in (0, spec.shape[0]) for y in (0, spec.shape[1])]) * self.cell
        reach = float(np.linalg.norm(corners + np.asarray(spec.origin)[:2], axis=1).max()) + 2 * self.cell
        self._first = np.floor((low - reach) / self.cell).astype(np.int64)
        self.shape = tuple(int(n) for n in np.ceil((high + reach) / self.cell).astype(np.int64) - self._first)
        cells = self.shape[0] * self.shape[1]
        self.values = np.zeros((cells, spec.shape[2], classes), np.float16)
        self.writes = np.zeros((cells, spec.shape[2]), np.uint8)  # stays at 255
        self.stamps = np.zeros((cells, spec.shape[2]))
        self.known = np.zeros((cells, spec.shape[2]), np.bool_)

    def copy(self) -> "StreamMap":
        """Return a map that changes on its own."""
        other = object.__new__(StreamMap)
        other.__dict__.update(self.__dict__)
        for name in ("values", "writes", "stamps", "known"):
            setattr(other, name, getattr(self, name).copy())
        return other

    def read(self, T_world_ego: Float[np.ndarray, "4 4"]) -> StreamPrior:
        """Return the window at a pose: of each grid column the map column that holds its centre."""
        X, Y, Z = self.spec.shape
        x, y = self._centers(np.asarray(self.spec.origin)[:2], (X, Y))
        R, t = T_world_ego[:2, :2], T_world_ego[:2, 3]
        place = np.floor((np.stack([x, y], -1) @ R.T + t) / self.cell).astype(np.int64) - self._first
        inside = ((place >= 0) & (place < self.shape)).all(axis=-1)
        flat = np.where(inside, place[..., 0] * self.shape[1] + place[..., 1], 0).ravel()
        known = self.known[flat] & inside.ravel()[:, None]
        logits = self.values[flat].astype(np.float32)
        logits[~known] = 0.0
        return StreamPrior(logits.reshape(X, Y, Z, -1), known.reshape(X, Y, Z))

    def write(
        self,
        T_world_ego: Float[np.ndarray, "4 4"],
        logits: Float[np.ndarray, "x y z classes"],
        mask: Bool[np.ndarray, "x y z"],
        *,
        policy: WritePolicy = "newest",
        gate: Gate | None = None,
        stamp: float = 0.0,
    ) -> None:
        """Put logits, of any offset, into every map voxel whose centre lies in a voxel of the mask.

        Args:
            T_world_ego: Of the grid.
            logits: Of every voxel.
            mask: Which of them are written.
            policy: What becomes of what was there.
            gate: With the policy `gate`: chooses the shares of old and new.
            stamp: Time, Unix seconds; only a gate asks for it.
        """
        if policy not in get_args(WritePolicy) or (policy == "gate") != (gate is not None):
            raise ConfigError("policy is not known", expected=", ".join(get_args(WritePolicy)), got=policy,
                              fix="a gate goes with policy='gate'")  # fmt: skip
        cells, source = self._footprint(T_world_ego)
        new = logits.reshape(-1, *logits.shape[2:])[source].astype(np.float32)
        new = _limited(new, LOGIT_REACH)
        seen = mask.reshape(-1, mask.shape[2])[source]
        old, before = self.values[cells].astype(np.float32), self.known[cells]
        if policy == "ema":
            new = np.where(before[..., None], old + EMA_SHARE * (new - old), new)
        elif policy == "bayes":
            new = _limited(old + new, BAYES_REACH)
        elif gate is not None:
            age = np.where(before, np.maximum(stamp - self.stamps[cells], 0) / DAY, 0)
            reach = np.broadcast_to(self._reach(source)[:, None], age.shape)
            facts = np.stack([self.writes[cells], age, reach], axis=-1).astype(np.float32)
            shares = gate(new[seen], old[seen], facts[seen])
            new[seen] = _limited(shares[:, :1] * old[seen] + shares[:, 1:] * new[seen], BAYES_REACH)
        if policy == "overwrite":
            self.values[cells] = np.where(seen[..., None], new, 0)
            self.known[cells] = seen
            self.writes[cells] = seen
        else:
            self.values[cells] = np.where(seen[..., None], new, old)
            self.known[cells] = before | seen
            count = self.writes[cells]
            self.writes[cells] = np.where(seen & (count < 255), count + 1, count)
        self.stamps[cells] = np.where(seen, stamp, self.stamps[cells])

    def _reach(self, columns: np.ndarray) -> np.ndarray:
        """Return the distance of grid columns from the ego, metres."""
        i, j = np.divmod(columns, self.spec.shape[1])
        corner = np.asarray(self.spec.origin)
        return np.hypot(corner[0] + (i + 0.5) * self.cell, corner[1] + (j + 0.5) * self.cell)

    def _footprint(self, T: Float[np.ndarray, "4 4"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the flat map cells under a grid at a pose, and the flat grid column of each."""
        X, Y, _ = self.spec.shape
        corner, size = np.asarray(self.spec.origin)[:2], self.cell
        ends = np.array([[x, y] for x in (0, X) for y in (0, Y)]) * size + corner
        R, t = T[:2, :2], T[:2, 3]
        world = (ends @ R.T + t) / size
        low = np.maximum(np.floor(world.min(axis=0)).astype(np.int64) - self._first, 0)
        high = np.minimum(np.ceil(world.max(axis=0)).astype(np.int64) - self._first, self.shape)
        x, y = self._centers((low + self._first) * size, np.maximum(high - low, 0))
        local = (np.stack([x, y], -1) - t) @ R  # R^-1 = R^T
        place = np.floor((local - corner) / size).astype(np.int64)
        inside = ((place >= 0) & (place < (X, Y))).all(axis=-1)
        i, j = np.nonzero(inside)
        cells = (i + low[0]) * self.shape[1] + j + low[1]
        return cells, place[inside] @ np.array([Y, 1])

    def _centers(self, corner: np.ndarray, counts: tuple[int, int] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y = (corner[k] + (np.arange(counts[k]) + 0.5) * self.cell for k in range(2))
        X, Y = np.meshgrid(x, y, indexing="ij")
        return X, Y


def _limited(logits: np.ndarray, reach: float) -> np.ndarray:
    return limited(torch.from_numpy(logits), reach).numpy()
