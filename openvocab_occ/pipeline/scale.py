"""Many drives into one city: a task for each log, then a task for each tile. The same two functions here and on Ray.

    open = partial(load_sequence, "nuscenes", root, scene="scene-0061")
    jobs = [LogJob(name="2026-11-22a", agent="car-7", drive=open), ...]
    build_city(jobs, "city.tiles", scratch="logs/", engine=RayEngine())

Tasks pass names of files to each other, no data, so that `out` and `scratch` must be places that every machine reaches:
a folder on one machine, a bucket on a cluster. A task that is done again, because its machine died, ends in the same
bytes: a tile is the greatest record of each voxel, whoever writes it and how often.
"""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from openvocab_occ.datasets.frame import FrameSequence
from openvocab_occ.errors import ConfigError, DataError, MissingExtraError, NotFoundError
from openvocab_occ.memory import TileMap
from openvocab_occ.memory.cache import merged
from openvocab_occ.memory.layer import TileKey
from openvocab_occ.memory.merge import merge_journal
from openvocab_occ.memory.observe import observe
from openvocab_occ.memory.schema import MapSchema
from openvocab_occ.memory.writer import Writer
from openvocab_occ.occupancy import OccupancyGrid

_IN_FLIGHT = 256  # tasks given to Ray at a time


@dataclass(frozen=True, kw_only=True)
class LogJob:
    """One drive."""

    name: str
    """Of the log."""
    agent: str
    drive: Callable[[], FrameSequence]
    """Opens it; a function or `functools.partial` that can be sent to another process."""
    start: float = 0.0
    """Unix seconds at which its clock reads 0."""
    encoder: str | None = None
    """An ONNX file; then a scene map is built as well."""


@dataclass(frozen=True)
class LogResult:
    """What a log became."""

    name: str
    tiles: str
    """A map of this log alone."""
    keys: tuple[TileKey, ...]
    frames: int
    scene: str | None
    """Its `.ovmap`."""
    seconds: float


@dataclass(frozen=True)
class CityBuild:
    """What `build_city` did."""

    logs: tuple[LogResult, ...]
    tiles: int
    changed: int
    """Records that were not in the city before."""


@runtime_checkable
class Engine(Protocol):
    """Where tasks run."""

    def run(self, task: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
        """Yield task(*a) for each a, in order."""
        ...


class LocalEngine:
    """One task after the other, here."""

    def run(self, task: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
        """Yield task(*a) for each a, in order."""
        for each in arguments:
            yield task(*each)


class RayEngine:
    """Tasks on Ray: the cluster at `address`, or one that is started on this machine. Needs the extra `scale`.

    A task whose worker dies is done again, up to `retries` times; an error of a task is raised here as it is.
    """

    def __init__(self, *, address: str | None = None, cpus_per_task: float = 1.0, retries: int = 3) -> None:
        self._ray = _ray()
        self._options = {"num_cpus": cpus_per_task, "max_retries": retries}
        if not self._ray.is_initialized():
            self._ray.init(address=address, include_dashboard=False, log_to_driver=False, logging_level=logging.WARNING)

    def run(self, task: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> Iterator[Any]:
        """Yield task(*a) for each a, in order."""
        remote = self._ray.remote(**self._options)(_call)  # Ray takes Python's own functions only
        waiting: list[Any] = []
        todo = iter(arguments)
        try:
            while True:
                waiting += [remote.remote(task, *each) for each in islice(todo, _IN_FLIGHT - len(waiting))]
                if not waiting:
                    return
                yield self._ray.get(waiting.pop(0))
        except self._ray.exceptions.RayTaskError as error:
            raise (error.cause if isinstance(error.cause, Exception) else error) from error


def build_city(
    jobs: Sequence[LogJob],
    out: str,
    *,
    scratch: str,
    engine: Engine | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> CityBuild:
    """Turn drives into a map each, and these into the tiles of one city, which is made if there is none.

    Logs are merged into the city's base. What was done of a run that was stopped is done again, to the same end.

    Args:
        jobs: The drives; names differ.
        out: The city, a folder or a bucket.
        scratch: Folder or bucket for a map of each log, which are kept.
        engine: Where tasks run; here, one after the other, by default.
        progress: Called with the number of logs and tiles done, and their total as far as it is known.

    Raises:
        ConfigError: Names repeat, or the logs have not all the same lattice and classes.
        DataError: A log has no frame with occupancy.
    """
    names = [job.name for job in jobs]
    if not jobs or len(set(names)) != len(names):
        raise ConfigError("logs cannot be told apart", expected="one or more, each of its own name", got=names)
    runs, results = engine or LocalEngine(), list[LogResult]()
    for result in runs.run(run_log, [(job, scratch) for job in jobs]):
        results.append(result)
        if progress is not None:
            progress(len(results), len(jobs))
    maps = [TileMap.open(result.tiles, writable=False) for result in results]
    city = _open_or_create(out, maps[0].schema)
    for part in maps:
        if part.schema != city.schema:
            raise ConfigError("logs have another lattice or other classes", expected=city.schema, got=part.schema)
        merge_journal(city, part)
    sources: dict[TileKey, list[str]] = {}
    for result in results:
        for key in result.keys:
            sources.setdefault(key, []).append(result.tiles)
    changed = 0
    tasks = [(out, tuple(sources[key]), key) for key in sorted(sources)]
    for done, count in enumerate(runs.run(reduce_tile, tasks), start=1):
        changed += count
        if progress is not None:
            progress(len(jobs) + done, len(jobs) + len(tasks))
    for result in results:
        city.mark_consolidated(result.name)
    return CityBuild(tuple(results), len(tasks), changed)


def run_log(job: LogJob, scratch: str) -> LogResult:
    """Write the tiles of one drive, and its scene map, below `scratch`."""
    begun, sequence = time.perf_counter(), job.drive()
    path = f"{scratch.rstrip('/')}/{job.name}.tiles"
    city: TileMap | None = None
    writer: Writer | None = None
    with ExitStack() as opened:
        for frame in sequence:
            seen = observe(frame)
            if city is None or writer is None:
                city = _of_grid(path, frame.occupancy)
                writer = opened.enter_context(Writer(city, agent=job.agent, log=job.name))
            writer.write(seen.logits, seen.mask, seen.T_world_grid, seen.spec, stamp=seen.time + job.start)
    if city is None:
        raise DataError(f"log {job.name!r} has no frames", expected="at least one")
    scene = None
    if job.encoder is not None:
        from openvocab_occ.pipeline.build import build_map  # only then: seconds of import for each worker
        from openvocab_occ.segmentation.onnx import load_encoder

        scene = f"{scratch.rstrip('/')}/{job.name}.ovmap"
        build_map(sequence, load_encoder(job.encoder)).save(scene)
    keys = sorted({key for layer in city.layers() for key in layer.stored()})
    return LogResult(job.name, path, tuple(keys), len(sequence), scene, time.perf_counter() - begun)


def reduce_tile(out: str, sources: Sequence[str], key: TileKey) -> int:
    """Merge one tile of several maps into a city; return how many records changed."""
    parts = [tile for path in sources for _, tile in TileMap.open(path, writable=False).tiles(keys=[key])]
    return TileMap.open(out).layers()[0].merge({key: merged(parts)}) if parts else 0


def _of_grid(path: str, grid: OccupancyGrid | None) -> TileMap:
    if grid is None:
        raise DataError("the drive has no occupancy", expected="a grid in each frame")
    spec = grid.spec
    return _open_or_create(
        path, MapSchema(tuple(grid.class_names), spec.shape[2], float(spec.size[2]), float(spec.origin[2]))
    )


def _open_or_create(path: str, schema: MapSchema) -> TileMap:
    try:
        return TileMap.open(path)
    except NotFoundError:
        if "://" not in path:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
        return TileMap.create(
            path, schema.class_names, heights=schema.heights, cell=schema.cell, z0=schema.z0, dtype=schema.dtype,
            journal=schema.journal,
        )  # fmt: skip


def _call(task: Callable[..., Any], *arguments: Any) -> Any:
    return task(*arguments)


def _ray() -> Any:
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise MissingExtraError("scale-out needs Ray", fix="pip install 'openvocab_occ[scale]'") from error
    return ray
