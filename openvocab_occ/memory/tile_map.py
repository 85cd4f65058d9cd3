"""`TileMap`: the long-term memory of a city, written by many vehicles, read as a prior (LMPOcc III-B, III-D)."""

import threading
from collections.abc import Collection, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from openvocab_occ._jit import in_slices
from openvocab_occ.arrays import ArrayLike, check_shape
from openvocab_occ.errors import AlreadyExistsError, ConfigError, DataError, NotFoundError, StorageError
from openvocab_occ.geometry import GridSpec
from openvocab_occ.memory import journal
from openvocab_occ.memory._tiles_kernels import gather, merge_rows
from openvocab_occ.memory.cache import TileCache, merged
from openvocab_occ.memory.clock import fading_rate, ticks_of
from openvocab_occ.memory.footprint import tile_rows
from openvocab_occ.memory.layer import Layer, TileKey
from openvocab_occ.memory.recent import Recent
from openvocab_occ.memory.schema import LEVELS, DType, MapSchema, Tile
from openvocab_occ.memory.store import Location, Store, agent_number, safe_name
from openvocab_occ.memory.window import Prior, Window

Policy = Literal["newest", "replace"]
Interpolation = Literal["nearest", "bilinear"]
_CACHE_BYTES = 256 * 2**20
_BASE = "base/"
_LOGS = "logs/"
_AGENTS = "agents/"
_REGISTRY = "registry/"


@dataclass(frozen=True)
class Written:
    """What a write did."""

    voxels: int
    """Map voxels whose centres lie in visible voxels of the grid."""
    changed: int
    """Those of them whose record changed; fewer where something newer was stored."""
    tiles: int


class TileMap:
    """A map on disk or in a bucket. Handles are light; one may be used by several threads, a map by many processes."""

    def __init__(
        self, store: Store, schema: MapSchema, *, writable: bool = True, cache_bytes: int = _CACHE_BYTES
    ) -> None:
        """Use `create` or `open`."""
        self.store = store
        self.schema = schema
        self.writable = writable
        self._layers: dict[str, Layer] = {}
        self._recent = Recent()
        self._cache = TileCache(schema, cache_bytes)
        self._lock = threading.RLock()

    @staticmethod
    def create(
        path: Location,
        class_names: Sequence[str],
        *,
        heights: int = 16,
        cell: float = 0.4,
        z0: float = -1.0,
        dtype: DType = "uint8",
        journal: bool = True,
    ) -> "TileMap":
        """Make an empty map.

        Args:
            path: A folder that is not there or empty, or a bucket: `s3://bucket/prefix`.
            class_names: Of the logits; one called `free` is needed by change reports and dynamic removal.
            heights: Voxels of a floor along z. Floors lie on top of each other without end, so hills fit.
            cell: Edge of a voxel, metres.
            z0: Lower end of floor 0 in the world, metres.
            dtype: How logits are kept; see `docs/memory.md` for the error of each.
            journal: Keep every write as it came, so that the map can be rebuilt, folded otherwise, or audited.

        Raises:
            AlreadyExistsError: Something is there.
        """
        schema = MapSchema(tuple(class_names), heights, float(cell), float(z0), dtype, journal)
        store = Store(path, create=True)
        if [key for key in store.list("") if not key.startswith(".locks/")]:
            raise AlreadyExistsError(f"{store.name} is not empty", expected="a new path", fix="open it, or remove it")
        group = {"zarr_format": 3, "node_type": "group", "attributes": {}}
        Layer(store, _BASE, schema)
        store.write_json(f"{_LOGS}zarr.json", group)
        store.write_json("zarr.json", {**group, "attributes": schema.attributes()})  # last: now it is a map
        return TileMap(store, schema)

    @staticmethod
    def open(path: Location, *, writable: bool = True, cache_bytes: int = _CACHE_BYTES) -> "TileMap":
        """Open a map; `cache_bytes` of decoded tiles are kept in memory.

        Raises:
            NotFoundError: There is no map.
            MapError: It is damaged, or of a later format.
        """
        store = Store(path, create=False)
        meta = store.read_json("zarr.json")
        if meta is None:
            raise NotFoundError("no tile map there", expected=f"{store.name}/zarr.json", fix="TileMap.create makes one")
        schema = MapSchema.of_attributes(meta.get("attributes", {}), store.name)
        return TileMap(store, schema, writable=writable, cache_bytes=cache_bytes)

    def read(
        self,
        T_world_ego: ArrayLike,
        spec: GridSpec,
        *,
        exclude_logs: Collection[str] = (),
        interpolation: Interpolation = "nearest",
        half_life: float | None = None,
        now: float | None = None,
    ) -> Prior:
        """Return what is known of a grid around a vehicle.

        Args:
            T_world_ego: Pose of the grid's frame; turned in any way.
            spec: The grid.
            exclude_logs: Logs whose writes are left out, such as the one that is being driven.
            interpolation: `nearest` takes the map voxel that holds a grid voxel's centre; `bilinear` mixes, in x and y,
                the known ones of the four around it. What is known is the same for both.
            half_life: Seconds after which a memory counts half: logits fade to 0 with age.
            now: Unix seconds that ages are counted to; the clock's by default.

        Raises:
            ConfigError: An excluded log has been merged into the base, where it cannot be told apart.
            MapError: A tile is damaged.
        """
        if interpolation not in ("nearest", "bilinear"):
            raise ConfigError("interpolation is not known", expected="nearest or bilinear", got=interpolation)
        fading = fading_rate(half_life, now)
        window = Window(T_world_ego, spec, self.schema)
        logits = np.empty((*spec.shape, self.schema.num_classes), dtype=np.float32)
        known = np.empty(spec.shape, dtype=np.bool_)
        layers = self.layers(exclude_logs)
        levels = LEVELS if self.schema.dtype == "uint8" else LEVELS[:0]
        affine = window.to_lattice
        with self._lock:
            cache = self._cache
            table = window.table(cache.load(window.tiles(), layers))
            in_slices(
                lambda start, stop: gather(
                    affine, table, cache.values, cache.stamps, levels, fading, interpolation == "bilinear", start, stop,
                    logits, known,
                ),
                spec.shape[0], grain=8,
            )  # fmt: skip
        return Prior(logits, known)

    def read_route(
        self, poses: Iterable[ArrayLike], spec: GridSpec, *, exclude_logs: Collection[str] = (), ahead: int = 2
    ) -> Iterator[Prior]:
        """Yield the prior at each pose of a route, `ahead` of them being read while one is used."""
        with ThreadPoolExecutor(max_workers=1, thread_name_prefix="prior") as worker:
            waiting = []
            for T_world_ego in poses:
                waiting.append(worker.submit(self.read, T_world_ego, spec, exclude_logs=exclude_logs))
                if len(waiting) > ahead:
                    yield waiting.pop(0).result()
            for future in waiting:
                yield future.result()

    def write(
        self,
        logits: Float[np.ndarray, "x y z classes"],
        mask: Bool[np.ndarray, "x y z"],
        T_world_ego: ArrayLike,
        spec: GridSpec,
        *,
        stamp: float,
        agent: str,
        log: str,
        policy: Policy = "newest",
    ) -> Written:
        """Put what is visible into the map; on return it is there, for everyone, and survives a power cut.

        Every map voxel whose centre lies in a voxel of `mask` is written. Writing the same again changes nothing, and
        writes in any order give the same map: of each voxel the record with the greatest (stamp, agent, logits) stays.

        Args:
            logits: Of any offset: kept are log-probabilities about their mean.
            mask: Visible voxels; nothing else is touched.
            T_world_ego: Pose of the grid's frame.
            spec: The grid.
            stamp: When it was seen, Unix seconds; kept to the millisecond.
            agent: Who saw it.
            log: The drive; it can be left out of reads until `consolidate` merges it into the base.
            policy: `newest`, or `replace`: the last call wins whatever its stamp (the paper's way, for one writer).

        Raises:
            ShapeError, DataError: Shapes contradict each other, or a logit under the mask is not finite.
            ConfigError: The stamp lies in the future, or the agent is quarantined.
            StorageError: The store is full, read-only or fought over; the map is as before, or has part of the tiles,
                and writing again completes them.
        """
        ready = self.prepare(logits, mask, T_world_ego, spec, stamp=stamp, agent=agent, log=log, policy=policy)
        return self.put([ready])

    def prepare(
        self,
        logits: Float[np.ndarray, "x y z classes"],
        mask: Bool[np.ndarray, "x y z"],
        T_world_ego: ArrayLike,
        spec: GridSpec,
        *,
        stamp: float,
        agent: str,
        log: str,
        policy: Policy = "newest",
    ) -> journal.Entry:
        """Check and encode a write, so that `put` can do it later; its arguments, and what it raises, are `write`'s."""
        shape = spec.shape
        check_shape(logits, (*shape, self.schema.num_classes), "logits")
        check_shape(mask, shape, "mask")
        if mask.dtype != np.bool_:
            raise DataError("mask is not a mask", expected="bool", got=mask.dtype)
        if policy not in ("newest", "replace"):
            raise ConfigError(
                "policy is not known", expected="newest or replace", got=policy,
                fix="bayes and ema are folded from the journal by TileMap.rebuild",
            )  # fmt: skip
        window = Window(T_world_ego, spec, self.schema)
        ticks = ticks_of(stamp)
        safe_name(log, "log")
        safe_name(agent, "agent")
        flat, codes = self.schema.encode_seen(logits.reshape(-1, logits.shape[-1]), mask.reshape(-1))
        return journal.Entry(window.T_world_ego, spec, flat, codes, ticks, agent, log, policy)

    def put(self, entries: Sequence[journal.Entry]) -> Written:
        """Write what was prepared, all of one log and in this order, as `write` does; each tile is committed once."""
        for agent in {entry.agent for entry in entries}:
            self.admit(agent)
        with ThreadPoolExecutor(max_workers=1, thread_name_prefix="journal") as aside:
            kept = aside.submit(journal.append, self.store, entries if self.schema.journal else [])
            footprints = [(entry, tile_rows(entry, self.schema)) for entry in entries]
            keys = dict.fromkeys(key for _, rows in footprints for key in rows)

            def change(key: TileKey, tile: Tile) -> int:
                return sum(
                    merge_rows(
                        rows[key], entry.codes, np.uint64(entry.stamp), np.uint32(agent_number(entry.agent)),
                        entry.policy == "replace", tile.stamps, tile.writers, tile.payload,
                    )
                    for entry, rows in footprints if key in rows
                )  # fmt: skip

            # what is in a tile is in the journal
            changed = self.overlay(entries[0].log).update(keys, change, first=kept.result) if keys else 0
            kept.result()
        reached = sum(int(np.count_nonzero(part >= 0)) for _, rows in footprints for part in rows.values())
        return Written(reached, changed, len(keys))

    def admit(self, agent: str) -> None:
        """Enter an agent into the register, or refuse it."""
        if not self.writable:
            raise StorageError(f"{self.store.name} was opened for reading", fix="open it with writable=True")
        safe_name(agent, "agent")
        key = f"{_AGENTS}{agent_number(agent):08x}"
        known = self.store.read_json(key)
        if known is None:
            self.store.write_json(key, {"agent": agent})
        elif known.get("agent") != agent:
            raise ConfigError(f"agent {agent!r} cannot be told from {known.get('agent')!r}", fix="give it another name")
        elif known.get("quarantined"):
            raise ConfigError(
                f"agent {agent!r} is quarantined", got=known["quarantined"], fix="TileMap.release lets it in"
            )

    def agents(self) -> dict[str, str | None]:
        """Return who has written, each with the reason why it is quarantined or None."""
        entries = (self.store.read_json(key) for key in self.store.list(_AGENTS))
        return {str(e["agent"]): e.get("quarantined") for e in entries if e}

    def quarantine(self, agent: str, reason: str) -> None:
        """Take no more writes of an agent; `rebuild` also takes out what it wrote."""
        self.store.write_json(f"{_AGENTS}{agent_number(agent):08x}", {"agent": agent, "quarantined": reason or "yes"})

    def release(self, agent: str) -> None:
        """Take writes of an agent again."""
        self.store.write_json(f"{_AGENTS}{agent_number(agent):08x}", {"agent": agent})

    def logs(self) -> dict[str, bool]:
        """Return the logs that have been written, each with whether it is merged into the base."""
        entries = (self.store.read_json(key) for key in self.store.list(_REGISTRY))
        return {str(e["log"]): bool(e.get("consolidated")) for e in entries if e}

    def layers(self, exclude_logs: Collection[str] = ()) -> list[Layer]:
        """Return base and overlays that a read takes in."""
        if isinstance(exclude_logs, str):
            raise ConfigError("exclude_logs is one name", expected="a collection of names", got=repr(exclude_logs))
        logs = self.logs()
        gone = [log for log in exclude_logs if logs.get(log)]
        if gone:
            raise ConfigError(f"log {gone[0]!r} cannot be left out: it is merged into the base", got=sorted(gone))
        return [self._layer(_BASE), *(self._layer(_overlay(log)) for log in logs if log not in exclude_logs)]

    def overlay(self, log: str) -> Layer:
        """Return the layer that writes of a log go to: its own, or the base once it is merged."""
        key = _REGISTRY + safe_name(log, "log")
        known = self.store.read_json(key)
        if known is None:
            layer = self._layer(_overlay(log))
            self.store.write_json(key, {"log": log})
            return layer
        return self._layer(_BASE if known.get("consolidated") else _overlay(log))

    def consolidate(self, log: str) -> int:
        """Merge a log into the base, where reads are cheaper and it cannot be left out any more; return its tiles.

        May be repeated after it was stopped. Nobody should be writing this log.
        """
        if log not in self.logs():
            raise NotFoundError(f"there is no log {log!r}", expected=f"one of {sorted(self.logs())}")
        source, base = self._layer(_overlay(log)), self._layer(_BASE)
        keys = source.stored()
        for start in range(0, len(keys), 32):
            base.merge(source.read(keys[start : start + 32]))
        self.mark_consolidated(log)
        self.store.delete(f"{_overlay(log)}c.")
        return len(keys)

    def mark_consolidated(self, log: str) -> None:
        """Say that what was written of a log is in the base."""
        self.store.write_json(_REGISTRY + safe_name(log, "log"), {"log": log, "consolidated": True})

    def tiles(
        self, *, exclude_logs: Collection[str] = (), keys: Iterable[TileKey] | None = None
    ) -> Iterator[tuple[TileKey, Tile]]:
        """Yield every stored tile, merged over its layers."""
        layers = self.layers(exclude_logs)
        where = {layer.prefix: set(layer.stored()) for layer in layers}
        found = sorted(set().union(*where.values()) if keys is None else keys)
        for key in found:
            parts = [layer.read([key])[key] for layer in layers if key in where[layer.prefix]]
            if parts:
                yield key, merged(parts)

    def rebuild(self, *, without: str | Collection[str] = (), **options: Any) -> int:
        """Make the tiles anew from the journal, leaving agents out for good; see `fold.rebuild`."""
        from openvocab_occ.memory.fold import rebuild

        return rebuild(self, without=(without,) if isinstance(without, str) else without, **options)

    def forget(self) -> None:
        """Drop the tiles kept in memory."""
        with self._lock:
            self._cache.clear()

    def _layer(self, prefix: str) -> Layer:
        with self._lock:
            if prefix not in self._layers:
                self._layers[prefix] = Layer(self.store, prefix, self.schema, self._recent)
            return self._layers[prefix]


def _overlay(log: str) -> str:
    return f"{_LOGS}{safe_name(log, 'log')}/"
