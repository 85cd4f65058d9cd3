"""How long pictures of a large map take. The map is made up of streets and houses with missing voxels, and says so."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int32

from openvocab_occ._jit import limit_threads, num_threads
from openvocab_occ.export.draw import paint, shaded
from openvocab_occ.export.overhead import Extent, render_overhead
from openvocab_occ.export.render import Renderer, pinhole
from openvocab_occ.geometry import look_at
from openvocab_occ.mapping import Lifted, VoxelMap
from openvocab_occ.objects import Box, EncoderInfo, ObjectTree, SceneMap, SceneObject

_SIZE = 0.4  # metres, edge of a voxel
_LABELS = ("road", "sidewalk", "building", "car", "vegetation")
_MISSING = 0.1  # share of voxels that nobody saw


@dataclass(frozen=True, kw_only=True)
class ViewTimes:
    """Seconds, median over views from different places; synthetic."""

    voxels: int
    faces: int
    width: int
    height: int
    threads: int
    first: float
    """The first view, which makes the grid and its faces."""
    ids: float
    """Voxel, object and z-depth of each pixel."""
    cpu_ids: float
    """The same in seconds of CPU, all threads: what does not depend on what else the machine does."""
    cpu_shaded: float
    """As `shaded`, in seconds of CPU."""
    palette: float
    """`ids`, and the exact picture of labels."""
    shaded: float
    """`ids`, and the shaded picture."""
    panorama: float
    """1024 columns all around."""
    overhead: float
    """1000 pixels from above."""


def time_views(
    *, voxels: int = 1_000_000, width: int = 1024, height: int = 576, rounds: int = 9, threads: int = 2
) -> ViewTimes:
    """Time pictures along the streets of a made-up town of so many voxels."""
    scene = _town(voxels)
    with limit_threads(min(threads, num_threads())):
        renderer = Renderer(scene)
        cameras = [
            pinhole(width, height, 0.75, look_at((14.0 + 6 * k, 14.0, 1.7), (60.0 + 6 * k, 15.0, 1.0)))
            for k in range(rounds)
        ]
        first = _seconds(lambda: renderer.view(cameras[0]))
        shaded(renderer.view(cameras[0]), renderer.surface.palette)
        renderer.panorama(cameras[0].position, width=1024)
        assert renderer._window is not None, "the town is not empty"
        faces = len(renderer._window.grid.faces)
        T = np.eye(4)
        T[:3, 3] = cameras[0].position * [1, 1, 0]

        def median(work: Callable[[int], object]) -> float:
            return statistics.median(_seconds(lambda k=k: work(k)) for k in range(rounds))

        def median_cpu(work: Callable[[int], object]) -> float:
            return statistics.median(_cpu_seconds(lambda k=k: work(k)) for k in range(rounds))

        palette = renderer.surface.palette
        return ViewTimes(
            voxels=len(renderer.surface), faces=faces, width=width, height=height, threads=num_threads(), first=first,
            ids=median(lambda k: renderer.view(cameras[k])),
            cpu_ids=median_cpu(lambda k: renderer.view(cameras[k])),
            cpu_shaded=median_cpu(lambda k: shaded(renderer.view(cameras[k]), palette)),
            palette=median(lambda k: paint(renderer.view(cameras[k]), palette)),
            shaded=median(lambda k: shaded(renderer.view(cameras[k]), palette)),
            panorama=median(lambda k: renderer.panorama(cameras[k].position, width=1024)),
            overhead=median(lambda _: render_overhead(scene, renderer.surface, T, Extent(90, 10, 50, 0.1), ground=0.0)),
        )  # fmt: skip


def _cpu_seconds(work: Callable[[], object]) -> float:
    started = time.process_time()
    work()
    return time.process_time() - started


def _seconds(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def _town(count: int) -> SceneMap:
    """Return blocks of 60 m with a street of 28 m between them; houses, parked cars and trees along the streets."""
    rng = np.random.default_rng(0)
    parts: list[np.ndarray] = []
    labels: list[np.ndarray] = []
    total = 0
    blocks = int(np.ceil(np.sqrt(count / 45_000)))
    for bx in range(blocks):
        for by in range(blocks):
            if total > 1.12 * count:
                break
            for keys, label in _block(rng):
                parts.append(keys + np.array([bx * 220, by * 220, 0]))
                labels.append(np.full(len(keys), label))
                total += len(keys)
    keys, first = np.unique(np.concatenate(parts), axis=0, return_index=True)
    label = np.concatenate(labels)[first]
    kept = np.flatnonzero(rng.random(len(keys)) > _MISSING)[:count]
    keys, label = keys[kept].astype(np.int32), label[kept]
    ones = np.ones(len(keys), np.float32)
    voxels = VoxelMap(_SIZE, len(_LABELS), contract="logits")
    lifted = Lifted(np.eye(len(_LABELS), dtype=np.float32)[label], ones, ones.astype(np.int32),
                    np.zeros((len(keys), 3), np.float32))  # fmt: skip
    voxels.integrate(keys, lifted, time=0.0)
    nothing = np.zeros(3)
    root = SceneObject(id=0, label="scene", score=1.0, box=Box(nothing, nothing, 0.0), voxels=np.empty(0, np.int64),
                       points=np.empty((0, 3), np.float32), embedding=np.zeros(len(_LABELS), np.float32),
                       level="scene")  # fmt: skip
    info = EncoderInfo(name="made up", contract="logits", dim=len(_LABELS), labels=_LABELS, fingerprint="0" * 64)
    return SceneMap(voxels, ObjectTree([root]), info)


def _block(rng: np.random.Generator) -> list[tuple[Int32[np.ndarray, "n 3"], int]]:
    """Return a block of 220 x 220 voxels: ground with kerbs, then shells of what stands on it."""
    x, y = np.meshgrid(np.arange(220), np.arange(220), indexing="ij")
    paved = (x > 70) & (y > 70)
    ground = np.stack([x, y, paved.astype(int)], axis=-1).reshape(-1, 3)
    found = [(ground[~paved.reshape(-1)], 0), (ground[paved.reshape(-1)], 1)]
    for _ in range(14):
        corner = np.array([*rng.integers(80, 180, 2), 2])
        found.append((_shell(corner, (*rng.integers(15, 36, 2), int(rng.integers(8, 30)))), 2))
    for k in range(16):
        found.append((_shell(np.array([8 + 13 * k, 58 + rng.integers(0, 3), 1]), (11, 5, 4)), 3))
        crown = np.array(list(np.ndindex(11, 11, 9)))
        near = np.linalg.norm((crown - [5, 5, 4]) / [5.5, 5.5, 4.5], axis=1)
        found.append((crown[(near < 1) & (rng.random(len(near)) < 0.5)] + np.array([8 + 13 * k, 70, 6]), 4))
    return found


def _shell(corner: np.ndarray, size: tuple[int, int, int]) -> Int32[np.ndarray, "n 3"]:
    cells = np.array(list(np.ndindex(*size)))
    rim = (cells[:, :2] == 0) | (cells[:, :2] == np.array(size[:2]) - 1)
    return (cells[rim.any(axis=1) | (cells[:, 2] == size[2] - 1)] + corner).astype(np.int32)
