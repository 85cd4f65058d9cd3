"""How fast and how right depth images of a grid are, beside other ways to them, in one run."""

import statistics
import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from openvocab_occ._jit import limit_threads
from openvocab_occ.datasets.registry import load_sequence
from openvocab_occ.depth.render import render_depth
from openvocab_occ.errors import ConfigError
from openvocab_occ.evaluation import depth_peers
from openvocab_occ.geometry import Camera, GridSpec, look_at
from openvocab_occ.occupancy import OccupancyGrid, read_occ3d, visibility_mask

PEERS: dict[str, Callable[..., depth_peers.Peer]] = {
    "open3d": depth_peers.open3d_scene,
    "embreex": depth_peers.embreex_scene,
    "walk": depth_peers.numba_walk,
    "sampling": depth_peers.torch_sampling,
}
"""Ours to walk: see `depth_peers`."""
MAX_DEPTH, STEP = 100.0, 0.1  # metres, of LMPOcc
LATE = 0.2  # metres beyond the exact depth at which a sample counts as having missed a voxel
_WRONG = 0.01  # metres off the walk
_YAWS_DEG = (0.0, 55.0, 110.0, 180.0, 250.0, 305.0)  # about those of the cameras of nuScenes


@dataclass(frozen=True)
class Timing:
    """One way to the depth of all cameras."""

    name: str
    threads: int
    seconds: float
    """Median of the runs, wall clock, building included."""
    cpu_seconds: float
    """Median of the processor time of the process."""
    rays_per_second: float
    ratio: float
    """Its seconds over ours at as many threads."""
    differ: float
    """Share of the pixels that are off the walk by more than 1 cm."""


@dataclass(frozen=True)
class DepthReport:
    """What `bench_depth` found."""

    grid: str
    cameras: int
    width: int
    height: int
    rounds: int
    timings: tuple[Timing, ...]
    memory_over_output: float
    """Peak of what one call allocates, over the size of what it returns."""
    half_voxel_ratio: float
    """Time of the same scene in voxels of half the size along x and y, over that of the scene, one thread."""
    seconds_again: float
    """Median of a second call on the same grid, whose faces are known, one thread."""
    seconds_sampled: float
    """Median with step=0.1, one thread."""
    seconds_visible: float
    """Median of `visibility_mask(mode="pixel")` of all cameras, one thread."""
    samples_late: float
    """Share of the pixels on which sampling at 0.1 m reads more than 0.2 m too far: it has cut a corner."""


def bench_depth(
    labels: Path | None = None,
    *,
    rounds: int = 5,
    threads: Sequence[int] = (1, 2),
    peers: Sequence[str] = ("open3d", "embreex", "walk"),
    width: int = 1600,
    height: int = 900,
) -> DepthReport:
    """Render six cameras around a car in every way, in turns, and compare.

    Args:
        labels: `labels.npz` of Occ3D; without, the first frame of the synthetic street.
        rounds: Runs of each way; the sampling peer runs once at the first number of threads only.
        threads: Numbers of threads to try.
        peers: Names of `PEERS`.
        width: Pixels of an image.
        height: Pixels of an image.
    """
    unknown = [name for name in peers if name not in PEERS]
    if unknown or rounds < 1 or not threads:
        raise ConfigError("bench cannot run so", expected=f"peers of {list(PEERS)}, rounds and threads", got=unknown)
    grid, name = _scene(labels)
    cameras = rig(grid, width, height)
    timings: list[Timing] = []
    truth = depth_peers.numba_walk(grid, cameras, MAX_DEPTH, max(threads))()
    rays = sum(depth.size for depth in truth)
    for count in threads:
        ways = {"ours": _ours(grid, cameras, count)}
        ways |= {peer: PEERS[peer](grid, cameras, MAX_DEPTH, count) for peer in peers if peer != "sampling"}
        timings += _timings(_race(ways, truth, rounds), count, rays)
        del ways
        if "sampling" in peers and count == threads[0]:
            way = {"sampling": depth_peers.torch_sampling(grid, cameras, MAX_DEPTH, count, STEP)}
            timings += _timings(_race(way, truth, 1, warm=False), count, rays, timings[0].seconds)
    with limit_threads(1):
        finer = [_median(lambda g=g: render_depth(_fresh(g), cameras), rounds) for g in (grid, halved(grid))]
        return DepthReport(
            grid=name,
            cameras=len(cameras),
            width=width,
            height=height,
            rounds=rounds,
            timings=tuple(timings),
            memory_over_output=_memory(grid, cameras),
            half_voxel_ratio=finer[1] / finer[0],
            seconds_again=_median(lambda: render_depth(grid, cameras), rounds),
            seconds_sampled=_median(lambda: render_depth(_fresh(grid), cameras, step=STEP), rounds),
            seconds_visible=_median(lambda: visibility_mask(grid, cameras, mode="pixel"), rounds),
            samples_late=_late(grid, cameras),
        )


def rig(grid: OccupancyGrid, width: int, height: int) -> list[Camera]:
    """Return six cameras around the origin of the grid's frame, 1.513 m up (no plane of Occ3D's lattice)."""
    K = np.array([[1266.0, 0.0, 816.0], [0.0, 1266.0, 491.0], [0.0, 0.0, 1.0]])
    K[:2] *= np.array([[width / 1600], [height / 900]])
    cameras = []
    for yaw in np.deg2rad(_YAWS_DEG):
        ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        place = np.array([1.5, 0.5, 0.0]) * ahead + [0.0, 0.0, 1.513]
        cameras.append(Camera(K, width, height, grid.T_world_grid @ look_at(place, place + ahead)))
    return cameras


def halved(grid: OccupancyGrid) -> OccupancyGrid:
    """Return the same scene in voxels of half the size along x and y."""
    labels = grid.labels.repeat(2, axis=0).repeat(2, axis=1)
    known = None if grid.known is None else grid.known.repeat(2, axis=0).repeat(2, axis=1)
    x, y, z = grid.spec.size.tolist()
    spec = GridSpec(grid.spec.origin, (x / 2, y / 2, z), labels.shape)
    return replace(grid, labels=labels, spec=spec, known=known, logits=None)


def _scene(labels: Path | None) -> tuple[OccupancyGrid, str]:
    if labels is not None:
        return read_occ3d(labels), f"Occ3D {labels.name}"
    grid = load_sequence("street")[0].occupancy
    assert grid is not None  # the street always has one
    return grid, "synthetic street"


def _fresh(grid: OccupancyGrid) -> OccupancyGrid:
    """Return the grid without its faces, so that they are made anew; what is occupied is known to all ways."""
    fresh = replace(grid)
    fresh.__dict__["occupied"] = grid.occupied
    return fresh


def _ours(grid: OccupancyGrid, cameras: list[Camera], threads: int) -> depth_peers.Peer:
    def run() -> list[np.ndarray]:
        with limit_threads(threads):
            return [image.depth for image in render_depth(_fresh(grid), cameras, max_depth=MAX_DEPTH)]

    return run


def _race(
    ways: dict[str, depth_peers.Peer], truth: list[np.ndarray], rounds: int, *, warm: bool = True
) -> dict[str, tuple[float, float, float]]:
    """Run all ways in turns, so that what else the machine does meets all; wall and processor seconds, share off."""
    walls: dict[str, list[float]] = {name: [] for name in ways}
    cpus: dict[str, list[float]] = {name: [] for name in ways}
    off: dict[str, float] = {}
    for turn in range(rounds + warm):
        for name, way in ways.items():
            wall, cpu = time.perf_counter(), time.process_time()
            depths = way()
            if turn >= warm:
                walls[name].append(time.perf_counter() - wall)
                cpus[name].append(time.process_time() - cpu)
            off[name] = float(np.mean([_off(d, t) for d, t in zip(depths, truth, strict=True)]))
    return {name: (statistics.median(walls[name]), statistics.median(cpus[name]), off[name]) for name in ways}


def _off(depth: np.ndarray, truth: np.ndarray) -> float:
    ended = np.where(np.isfinite(depth.ravel()), depth.ravel(), MAX_DEPTH)
    return float((np.abs(np.minimum(ended, MAX_DEPTH) - truth.ravel()) > _WRONG).mean())


def _timings(
    found: dict[str, tuple[float, float, float]], threads: int, rays: int, ours: float | None = None
) -> list[Timing]:
    base = found["ours"][0] if ours is None else ours
    return [Timing(name, threads, wall, cpu, rays / wall, wall / base, off) for name, (wall, cpu, off) in found.items()]


def _median(work: Callable[[], object], rounds: int) -> float:
    work()
    times = []
    for _ in range(rounds):
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return statistics.median(times)


def _memory(grid: OccupancyGrid, cameras: list[Camera]) -> float:
    """Return the peak of what a call allocates in numpy, over the size of its output."""
    fresh = _fresh(grid)
    tracemalloc.start()
    try:
        images = render_depth(fresh, cameras, max_depth=MAX_DEPTH)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    return peak / sum(image.depth.nbytes + image.voxel.nbytes for image in images)


def _late(grid: OccupancyGrid, cameras: list[Camera]) -> float:
    exact = render_depth(grid, cameras, max_depth=MAX_DEPTH)
    sampled = render_depth(grid, cameras, max_depth=MAX_DEPTH, step=STEP)
    return float(np.mean([(s.depth - e.depth > LATE).mean() for s, e in zip(sampled, exact, strict=True)]))
