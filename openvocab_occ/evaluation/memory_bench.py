"""Speed and size of the tile map, each as a ratio to plain work on the same bytes in the same run."""

import os
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Float64

from openvocab_occ._jit import num_threads
from openvocab_occ.evaluation.memory_stress import CLASSES, fight, kill
from openvocab_occ.evaluation.simulated_streets import SimulatedStreets
from openvocab_occ.geometry import pose, transform
from openvocab_occ.io.files import fsync
from openvocab_occ.memory import TileMap
from openvocab_occ.memory.health import describe
from openvocab_occ.memory.merge import coverage
from openvocab_occ.memory.schema import MapSchema
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_SPEC

_EGO_HEIGHT = 0.4  # m of ground that lies above z0 + 0.6: Occ3D's ego frame stands about on the ground
_BATCH = 8  # writes that a Writer lets wait


def loop_route(frames: int, *, spacing: float = 5.0) -> Float64[np.ndarray, "n 4 4"]:
    """Return a smooth made-up loop that turns through all headings."""
    angle = np.linspace(0, 2 * np.pi, frames, endpoint=False)
    radius = frames * spacing / (2 * np.pi)
    half = (angle + np.pi / 2) / 2
    return np.stack([
        pose((radius * np.cos(a), radius * np.sin(a), 0.0), (np.cos(h), 0.0, 0.0, np.sin(h)))
        for a, h in zip(angle, half, strict=True)
    ])  # fmt: skip


def bench(folder: Path, *, frames: int = 24, repeats: int = 7, updates: int = 60, kills: int = 5) -> dict[str, Any]:
    """Measure windows, updates, size, writers and kills in an empty folder; medians of `repeats`."""
    route = loop_route(frames)
    streets = SimulatedStreets(route, _EGO_HEIGHT)
    city = TileMap.create(folder / "city.tiles", OCC3D_CLASSES)
    seen = [streets.observe(T, OCC3D_SPEC, n) for n, T in enumerate(route)]
    for n, (logits, mask, _) in enumerate(seen):
        city.write(logits, mask, route[n], OCC3D_SPEC, stamp=1000.0 + n, agent="car", log="loop")
    city.consolidate("loop")
    report: dict[str, Any] = {"synthetic": True, "frames": frames, "threads": num_threads()}
    report.update(_reading(city, route[frames // 3], repeats))
    logits, mask, _ = seen[frames // 3]
    report.update(_updating(city, folder, route[frames // 3], (logits, mask), repeats))
    report.update(_size(city, seen))
    stressed = TileMap.create(folder / "stress.tiles", CLASSES, heights=8)
    found = fight(stressed, updates=-(-updates // 3))
    report["writers"] = {"updates": found.updates, "lost": found.lost, "unreadable": found.unreadable}
    killed = kill(TileMap.create(folder / "kill.tiles", CLASSES, heights=8), kills=kills)
    report["kills"] = {"kills": killed.kills, "acknowledged": killed.updates, "lost": killed.lost,
                       "unreadable": killed.unreadable}  # fmt: skip
    return report


def _reading(city: TileMap, T: np.ndarray, repeats: int) -> dict[str, Any]:
    keys, dense, known, low = _dense(city)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in OCC3D_SPEC.shape), indexing="ij"), axis=-1)
    centers = np.asarray(OCC3D_SPEC.centers(index))

    def peer() -> np.ndarray:
        at = np.floor((transform(T, centers) - [0, 0, city.schema.z0]) / city.schema.cell).astype(np.int64) - low
        x, y, z = np.moveaxis(np.clip(at, 0, np.array(known.shape) - 1), -1, 0)
        return dense[x, y, z] * known[x, y, z][..., None]

    at = np.floor((transform(T, centers) - [0, 0, city.schema.z0]) / city.schema.cell).astype(np.int64) - low
    x, y, z = np.moveaxis(np.clip(at, 0, np.array(known.shape) - 1), -1, 0)
    city.read(T, OCC3D_SPEC)
    cached, gathered, bare = _alternate(repeats, lambda: city.read(T, OCC3D_SPEC), peer, lambda: dense[x, y, z])
    files = _window_files(city, T)
    plain = city.store.folder.parent / "plain" if city.store.folder else Path("plain")
    plain.mkdir()
    size = city.schema.cell_bytes * 64 * 64
    for file in files:
        (plain / file.name).write_bytes(file.read_bytes()[:-4])  # without the checksum: a plain zstd file

    def decode(name: str) -> int:
        return pa.Codec("zstd").decompress((plain / name).read_bytes(), decompressed_size=size).size

    def peer_cold() -> None:
        with ThreadPoolExecutor(num_threads()) as pool:
            list(pool.map(decode, [file.name for file in files]))

    fresh = TileMap.open(city.store.name)
    fresh.read(T, OCC3D_SPEC)

    def cold() -> None:
        fresh.forget()
        fresh.read(T, OCC3D_SPEC)

    def bare_output() -> None:
        np.empty((*OCC3D_SPEC.shape, city.schema.num_classes), dtype=np.float32).fill(0)

    first, decoded, output = _alternate(repeats, cold, peer_cold, bare_output)
    return {
        "window_cached_ms": cached.wall, "numpy_window_ms": gathered.wall, "numpy_gather_alone_ms": bare.wall,
        "window_cached_ratio": cached.over(gathered), "window_cached_ratio_to_gather_alone": cached.over(bare),
        "window_cold_ms": first.wall, "zstd_files_ms": decoded.wall, "window_cold_ratio": first.over(decoded),
        "window_cold_ratio_to_files_and_gather": first.over(decoded, bare),
        "window_output_ms": output.wall, "window_floor_ratio_to_files": round(1 + output.over(decoded), 2),
        "window_chunks": len(files),
        "map_tiles": len(keys),
        "cpu_ms": {"window_cached": cached.cpu, "numpy_window": gathered.cpu, "numpy_gather_alone": bare.cpu,
                   "window_cold": first.cpu, "zstd_files": decoded.cpu, "window_output": output.cpu},
    }  # fmt: skip


def _updating(
    city: TileMap, folder: Path, T: np.ndarray, seen: tuple[np.ndarray, np.ndarray], repeats: int
) -> dict[str, Any]:
    bare = TileMap.create(folder / "bare.tiles", city.schema.class_names, journal=False)
    clock = iter(range(10**6))

    def write(target: TileMap) -> Callable[[], object]:
        return lambda: target.write(*seen, T, OCC3D_SPEC, stamp=5000.0 + next(clock), agent="car", log="new")

    write(bare)()
    contents = [file.read_bytes() for file in sorted((folder / "bare.tiles/logs/new").glob("c.*"))]
    write(city)()
    entry = max((folder / "city.tiles/journal/car").iterdir(), key=lambda file: file.stat().st_mtime).read_bytes()

    def files(values: list[bytes]) -> Callable[[], None]:
        return lambda: _write_files(folder / "files", values)

    plain, update, with_entry, journaled = _alternate(
        repeats, files(contents), write(bare), files([*contents, entry]), write(city)
    )
    logits, mask = seen

    def batch() -> None:
        bare.put([
            bare.prepare(logits, mask, T, OCC3D_SPEC, stamp=5000.0 + next(clock), agent="car", log="new")
            for _ in range(_BATCH)
        ])  # fmt: skip

    (together,) = _alternate(max(1, repeats // 2), batch)
    return {
        "update_ms": update.wall, "files_fsynced_ms": plain.wall, "update_ratio": update.over(plain),
        "journaled_update_ms": journaled.wall, "files_and_entry_fsynced_ms": with_entry.wall,
        "journaled_update_ratio": journaled.over(with_entry), "update_chunks": len(contents),
        "journal_entry_bytes": len(entry), "update_cpu_ms": update.cpu, "journaled_update_cpu_ms": journaled.cpu,
        f"update_ms_in_batches_of_{_BATCH}": round(together.wall / _BATCH, 2),
        f"update_cpu_ms_in_batches_of_{_BATCH}": round(together.cpu / _BATCH, 2),
    }  # fmt: skip


def _size(city: TileMap, seen: list[Any]) -> dict[str, Any]:
    about = describe(city)
    ground = float(coverage(city).area[-1].sum()) / 1e6
    errors = {}
    for dtype in ("uint8", "float16", "float32"):
        schema = MapSchema(city.schema.class_names, dtype=dtype)
        changed = total = 0
        worst = worst_log = 0.0
        for logits, mask, _ in seen[:4]:
            rows = logits[mask].astype(np.float64)
            back = schema.decode(schema.encode(logits[mask])).astype(np.float64)
            changed += int((rows.argmax(-1) != back.argmax(-1)).sum())
            total += len(rows)
            p, q = _softmax(rows), _softmax(back)
            worst = max(worst, float(np.abs(p - q).max()))
            worst_log = max(worst_log, float(np.abs(np.log(p / q))[p > 0.01].max()))
        errors[dtype] = {"argmax_changed": changed / total, "worst_probability_error": float(f"{worst:.2g}"),
                         "worst_log_error_above_1_percent": float(f"{worst_log:.2g}")}  # fmt: skip
    stored = about["layers"]["base"] and sum(city.layers()[0].sizes().values())
    return {
        "gb_per_km2_of_tiles": round(stored / 1e9 / about["tile_area_km2"], 4),
        "gb_per_km2_of_known_ground": round(stored / 1e9 / ground, 4),
        "dense_float32_gb_per_km2": about["dense_float32_gb_per_km2"],
        "tile_km2": about["tile_area_km2"], "known_ground_km2": round(ground, 5),
        "argmax_changed": errors["uint8"]["argmax_changed"],
        "worst_probability_error": errors["uint8"]["worst_probability_error"], "errors": errors,
    }  # fmt: skip


@dataclass(frozen=True)
class _Time:
    """Medians, milliseconds."""

    wall: float
    cpu: float
    """Of all threads of this process."""

    def over(self, *others: "_Time") -> float:
        """Return the ratio of wall times to the sum of others."""
        return round(self.wall / sum(other.wall for other in others), 2)


def _alternate(repeats: int, *works: Callable[[], object]) -> list[_Time]:
    """Return the medians of each, taken in turns so that a busy machine slows all alike."""
    times: list[list[tuple[float, float]]] = [[] for _ in works]
    for _ in range(repeats):
        for work, taken in zip(works, times, strict=True):
            start = time.perf_counter(), time.process_time()
            work()
            taken.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    return [_Time(*(round(statistics.median(part) * 1000, 2) for part in zip(*taken, strict=True))) for taken in times]


def _dense(city: TileMap) -> tuple[list[Any], np.ndarray, np.ndarray, np.ndarray]:
    """Return the whole map as arrays in memory, and the voxel they begin with."""
    tiles = dict(city.tiles())
    span = np.array([64, 64, city.schema.heights])
    corners = np.array([[key.x, key.y, key.floor] for key in tiles]) * span
    low = corners.min(axis=0)
    size = tuple((corners.max(axis=0) + span - low).tolist())
    dense = np.zeros((*size, city.schema.num_classes), dtype=np.float32)
    known = np.zeros(size, dtype=np.bool_)
    for corner, tile in zip(corners, tiles.values(), strict=True):
        part = tuple(slice(a, a + n) for a, n in zip(corner - low, span, strict=True))
        dense[part] = tile.logits.reshape(*span, -1)
        known[part] = (tile.stamps > 0).reshape(span)
    return [*tiles], dense, known, low


def _window_files(city: TileMap, T: np.ndarray) -> list[Path]:
    from openvocab_occ.memory.layer import chunk_name
    from openvocab_occ.memory.window import Window

    folder = (city.store.folder or Path()) / "base"
    names = [chunk_name(key) for key in Window(T, OCC3D_SPEC, city.schema).tiles()]
    return [folder / name for name in names if (folder / name).exists()]


def _write_files(folder: Path, contents: list[bytes]) -> None:
    folder.mkdir(exist_ok=True)
    for n, content in enumerate(contents):
        scratch = folder / f"{n}.new"
        with scratch.open("wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        scratch.replace(folder / str(n))
        fsync(folder)


def _softmax(rows: np.ndarray) -> np.ndarray:
    e = np.exp(rows - rows.max(axis=-1, keepdims=True))
    return e / e.sum(axis=-1, keepdims=True)
