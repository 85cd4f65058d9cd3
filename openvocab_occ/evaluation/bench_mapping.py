"""How much the lift, the fusion and the whole of mapping cost, beside other ways, in one run."""

import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from openvocab_occ._jit import limit_threads
from openvocab_occ.datasets.frame import Frame, View
from openvocab_occ.datasets.registry import load_sequence
from openvocab_occ.depth.render import DepthImage, render_depth
from openvocab_occ.evaluation import mapping_peers
from openvocab_occ.evaluation.bench_rgbd import bench_rgbd
from openvocab_occ.geometry import Camera, look_at
from openvocab_occ.mapping import Lifted, PixelWeights, Sight, VoxelMap, cover_grid, lift, rows_from_grid
from openvocab_occ.occupancy import OccupancyGrid, read_occ3d
from openvocab_occ.pipeline.build import MapBuilder, build_map
from openvocab_occ.segmentation.encoder import FeatureMap

DIM, STRIDE = 512, 16
_YAWS_DEG = (0.0, 55.0, 110.0, 180.0, 250.0, 305.0)  # about those of the cameras of nuScenes


@dataclass(frozen=True)
class Cost:
    """What one way costs."""

    name: str
    seconds: float
    """Median of the runs, wall clock."""
    cpu_seconds: float
    peak_mb: float
    """Most resident memory above what was there before."""


def measured(name: str, work: Callable[[], Any], rounds: int) -> Cost:
    """Run `work` once to warm up and `rounds` times for the clock; watch the memory in the last run."""
    work()
    walls, cpus = [], []
    peak = 0.0
    for i in range(rounds):
        with _PeakMemory() if i == rounds - 1 else _Nothing() as memory:
            cpu, wall = time.process_time(), time.perf_counter()
            work()
            walls.append(time.perf_counter() - wall)
            cpus.append(time.process_time() - cpu)
        peak = getattr(memory, "megabytes", 0.0)
    return Cost(name, statistics.median(walls), statistics.median(cpus), peak)


def resident_mb() -> float:
    """Return the resident memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


class _Nothing:
    def __enter__(self) -> "_Nothing":
        return self

    def __exit__(self, *_: object) -> None:
        pass


class _PeakMemory:
    """Asks for the resident memory every millisecond."""

    megabytes = 0.0

    def __enter__(self) -> "_PeakMemory":
        self._before, self._done = resident_mb(), threading.Event()
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()
        return self

    def _watch(self) -> None:
        while not self._done.wait(0.001):
            self.megabytes = max(self.megabytes, resident_mb() - self._before)

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()


def street_grid(labels: Path | None) -> tuple[str, OccupancyGrid]:
    """Return a grid of Occ3D, or of the synthetic street."""
    if labels is not None:
        return "Occ3D labels", read_occ3d(labels)
    grid = load_sequence("street")[0].occupancy
    assert grid is not None
    return "synthetic street", grid


def cameras(width: int = 1600, height: int = 900, *, at: float = 0.0) -> list[Camera]:
    """Return six cameras on a car `at` metres along the road."""
    K = np.array([[0.79 * width, 0, width / 2 - 0.5], [0, 0.79 * width, height / 2 - 0.5], [0, 0, 1]])
    eye = np.array([at + 0.01, 0.02, 1.53])
    turns = [np.deg2rad(yaw + 1.0) for yaw in _YAWS_DEG]
    return [Camera(K, width, height, look_at(eye, eye + np.array([np.cos(t), np.sin(t), 0.0]))) for t in turns]


def random_cells(rng: np.random.Generator, width: int, height: int) -> FeatureMap:
    """Return random unit features at 1/16 of an image."""
    h, w = -(-height // STRIDE), -(-width // STRIDE)
    cells = rng.normal(size=(h, w, DIM)).astype(np.float32)
    cells /= np.linalg.norm(cells, axis=2, keepdims=True)
    scale = (w / width, h / height)
    return FeatureMap(cells, scale, (0.5 * scale[0] - 0.5, 0.5 * scale[1] - 0.5))


def bench_lift(labels: Path | None = None, *, rounds: int = 5) -> dict[str, Any]:
    """Time the lift of one 1600 x 900 view on one thread beside two dense ones; the sums must agree."""
    import torch

    name, grid = street_grid(labels)
    camera = cameras()[0].at(grid.T_world_grid @ cameras()[0].T_world_cam)
    image = render_depth(grid, camera)
    rows, flat = rows_from_grid(image, grid)
    features = random_cells(np.random.default_rng(0), camera.width, camera.height)
    sight = Sight(camera, image.depth, PixelWeights())
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with limit_threads(1):
            ours = measured("ours", lambda: lift(rows, len(flat), features), rounds)
            weighed = measured(
                "ours, weights and normals", lambda: lift(rows, len(flat), features, sight=sight), rounds
            )
            dense = measured(
                "upsample + index_add", lambda: mapping_peers.upsample_and_scatter(features.cells, rows, len(flat)),
                max(rounds // 2, 1),
            )  # fmt: skip
            gather = measured(
                "valid pixels, channels last", lambda: mapping_peers.gather_valid(features.cells, rows, len(flat)),
                max(rounds // 2, 1),
            )  # fmt: skip
            sums = lift(rows, len(flat), features).sums
        error = np.abs(sums - mapping_peers.gather_valid(features.cells, rows, len(flat))).max()
    finally:
        torch.set_num_threads(before)
    ways = (ours, weighed, dense, gather)
    return {
        "grid": name, "view": [camera.width, camera.height], "features": DIM, "stride": STRIDE, "voxels": len(flat),
        "pixels": int((rows >= 0).sum()), "ways": [asdict(way) for way in ways],
        "cpu_ratio_upsample": dense.cpu_seconds / ours.cpu_seconds,
        "cpu_ratio_best_dense": gather.cpu_seconds / ours.cpu_seconds,
        "weighed_cpu_ratio_upsample": dense.cpu_seconds / weighed.cpu_seconds,
        "weighed_cpu_ratio_best_dense": gather.cpu_seconds / weighed.cpu_seconds,
        "memory_share_of_upsample": max(ours.peak_mb, 0.1) / dense.peak_mb,
        "worst_difference": float(error), "largest_sum": float(np.abs(sums).max()),
    }  # fmt: skip


def bench_fuse(*, frames: int = 500, rows: int = 7500) -> dict[str, Any]:
    """Time `VoxelMap.integrate` over a loop driven twice: the second lap sees nothing new.

    Each frame is of `rows` voxels with 512 features, a window of a flat road that moves by 2.5 m.
    """
    rng = np.random.default_rng(0)
    window, across = rows // 100, 100
    sums = rng.normal(size=(rows, DIM)).astype(np.float32)
    ones = np.ones(rows, dtype=np.float32)
    lifted = Lifted(sums, ones, ones.astype(np.int32), sums[:, :3])
    local = np.stack(np.meshgrid(np.arange(window), np.arange(across), [0], indexing="ij"), axis=-1).reshape(-1, 3)
    lap = frames // 2 * 6
    voxels, times, sizes, memory = VoxelMap(0.4, DIM), [], [], []
    start = resident_mb()
    for frame in range(frames):
        keys = local.copy()
        keys[:, 0] = (keys[:, 0] + frame * 6) % lap
        began = time.perf_counter()
        voxels.integrate(keys.astype(np.int32), lifted, time=float(frame))
        times.append(time.perf_counter() - began)
        sizes.append(len(voxels))
        memory.append(resident_mb() - start)
    early, late = statistics.median(times[3:13]), statistics.median(times[-10:])
    half = frames // 2
    return {
        "frames": frames, "rows": rows, "features": DIM, "seconds_early": early, "seconds_late": late,
        "late_over_early": late / early, "slowest_over_early": max(times[3:]) / early,
        "voxels": sizes[-1], "voxels_after_first_lap": sizes[half], "memory_mb": memory[-1],
        "memory_mb_after_first_lap": memory[half],
        "memory_second_lap_share": (memory[-1] - memory[half]) / max(memory[-1], 1e-9),
    }  # fmt: skip


class _Precomputed:
    """An encoder that costs nothing."""

    name, contract, dim, labels, fingerprint, text = "precomputed", "dense", DIM, (), "0" * 64, None

    def __init__(self, cells: FeatureMap) -> None:
        self._cells = cells

    def encode(self, images: Any) -> list[FeatureMap]:
        return [self._cells for _ in images]


def bench_map(labels: Path | None = None, *, rounds: int = 5, frames: int = 40) -> dict[str, Any]:
    """Time whole keyframes without the network, RGB-D frames with masks beside object clouds, and the file."""
    return {"keyframe": _keyframe(labels, rounds), "rgbd": bench_rgbd(frames), "file": _file()}


def _keyframe(labels: Path | None, rounds: int) -> dict[str, Any]:
    """Six views of a keyframe through `MapBuilder.integrate`, and its stages apart."""
    name, grid = street_grid(labels)
    rng = np.random.default_rng(0)
    cells = random_cells(rng, 1600, 900)
    image = rng.integers(0, 256, size=(900, 1600, 3), dtype=np.uint8)
    builder = MapBuilder(_Precomputed(cells))  # pyright: ignore[reportArgumentType]
    times: list[float] = []
    cpus: list[float] = []
    stages: dict[str, list[float]] = {"depth": [], "rows and cover": [], "lift": [], "fuse": [], "look through": []}
    apart = VoxelMap(0.4, DIM)
    for number in range(rounds + 1):
        moved = replace(grid, T_world_grid=_shifted(2.5 * number) @ grid.T_world_grid)
        views = [c.at(moved.T_world_grid @ c.T_world_cam) for c in cameras()]
        frame = Frame(number, 0.5 * number, moved.T_world_grid, tuple(View(image, c) for c in views), moved)
        began, cpu = time.perf_counter(), time.process_time()
        builder.integrate(frame)
        times.append(time.perf_counter() - began)
        cpus.append(time.process_time() - cpu)
        for stage, seconds in _stages(moved, views, image, cells, apart, number).items():
            stages[stage].append(seconds)
    return {
        "grid": name, "views": 6, "view": [1600, 900], "features": DIM,
        "seconds": statistics.median(times[1:]), "cpu_seconds": statistics.median(cpus[1:]),
        "cpu_stages": {stage: statistics.median(values[1:]) for stage, values in stages.items()},
    }  # fmt: skip


def _shifted(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def _stages(
    grid: OccupancyGrid, views: list[Camera], image: np.ndarray, cells: FeatureMap, voxels: VoxelMap, number: int
) -> dict[str, float]:
    marks = [time.process_time()]
    images: list[DepthImage] = render_depth(grid, views, max_depth=60.0)
    marks.append(time.process_time())
    rows = [rows_from_grid(one, grid) for one in images]
    covers = [cover_grid(flat, grid, 0.4) for _, flat in rows]
    marks.append(time.process_time())
    lifted = [
        lift(row, len(flat), cells, image=image, sight=Sight(camera, one.depth))
        for (row, flat), one, camera in zip(rows, images, views, strict=True)
    ]
    marks.append(time.process_time())
    for cover, part in zip(covers, lifted, strict=True):
        voxels.integrate(cover, part, time=float(number))
    marks.append(time.process_time())
    looks = [(camera, one.depth) for camera, one in zip(views, images, strict=True)]
    voxels.free.integrate(looks, grid=grid, max_depth=60.0)
    marks.append(time.process_time())
    names = ("depth", "rows and cover", "lift", "fuse", "look through")
    return dict(zip(names, np.diff(marks).tolist(), strict=True))


def _file() -> dict[str, Any]:
    """Save a map of the synthetic street by the demo encoder; bytes a voxel, all files counted."""
    from openvocab_occ.objects.ovmap import read_manifest
    from openvocab_occ.segmentation.demo_models import demo_model
    from openvocab_occ.segmentation.onnx import load_encoder

    scene = build_map(load_sequence("street"), load_encoder(demo_model()))
    with tempfile.TemporaryDirectory() as folder:
        path = scene.save(Path(folder) / "street.ovmap")
        manifest = read_manifest(path)
        size = {file.name: file.stat().st_size for file in path.iterdir()}
    return {
        "map": "synthetic street, demo encoder", "voxels": len(scene.voxels), "vectors": manifest["counts"]["features"],
        "bytes_per_voxel": sum(size.values()) / len(scene.voxels),
        "bytes": size, "worst_cosine_error": manifest["features"]["worst_cosine_error"],
    }  # fmt: skip
