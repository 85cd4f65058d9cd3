"""How long answers take, against the least that reading the features takes."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from openvocab_occ.mapping import VoxelMap
from openvocab_occ.objects import Box, EncoderInfo, ObjectTree, SceneMap, SceneObject
from openvocab_occ.query.find import find
from openvocab_occ.query.scoring import Reading


@dataclass(frozen=True, kw_only=True)
class QueryTimes:
    """Seconds, the least of several runs that took turns."""

    voxels: int
    dim: int
    score: float
    """Scoring all voxels for a vector."""
    torch: float
    """torch's product of the same table, in the same dtype, with the same vector."""
    objects: int
    find_noun: float
    find_parked: float
    find_relation: float
    threads: int

    @property
    def ratio(self) -> float:
        """Ours over torch's."""
        return self.score / self.torch


def time_queries(*, voxels: int = 1_000_000, dim: int = 512, objects: int = 100_000, repeats: int = 7) -> QueryTimes:
    """Time scoring and finding on made-up features and boxes."""
    import torch

    rng = np.random.default_rng(0)
    table = rng.standard_normal((voxels, dim), dtype=np.float32)
    vector = rng.standard_normal(dim, dtype=np.float32)
    vector /= np.linalg.norm(vector)
    reading = Reading(vector=vector, kind="cosine", threshold=0.25)
    tensor, direction = torch.from_numpy(table), torch.from_numpy(vector)
    ours, theirs = _least([lambda: reading.score(table), lambda: torch.mv(tensor, direction)], repeats)
    del table, tensor
    scene = _crowd(objects, rng)
    asks = [_ask(scene, text) for text in ("trucks", "parked trucks", "trucks within 20 m")]
    for ask in asks:
        ask()  # the index is made once a map
    noun, parked, relation = _least(asks, repeats)
    return QueryTimes(
        voxels=voxels, dim=dim, score=ours, torch=theirs, objects=objects, find_noun=noun, find_parked=parked,
        find_relation=relation, threads=torch.get_num_threads(),
    )  # fmt: skip


def _ask(scene: SceneMap, text: str) -> Callable[[], object]:
    return lambda: find(scene, text, limit=20)


def _least(runs: list[Callable[[], object]], repeats: int) -> list[float]:
    """Return the least time of each, taken in turns so that a busy machine is busy for all."""
    times = [[] for _ in runs]
    for _ in range(repeats):
        for run, own in zip(runs, times, strict=True):
            start = time.perf_counter()
            run()
            own.append(time.perf_counter() - start)
    return [min(own) for own in times]


def _crowd(count: int, rng: np.random.Generator) -> SceneMap:
    """Return a map of boxes without voxels, 16 kinds, one in 20 a truck."""
    labels = ("truck", *(f"kind {letter}" for letter in "abcdefghijklmno"))
    centers = rng.uniform(-2000, 2000, (count, 3)) * [1, 1, 0]
    kinds = np.where(rng.random(count) < 0.05, 0, rng.integers(1, len(labels), count))
    eye, none, points = np.eye(len(labels), dtype=np.float32), np.empty(0, np.int64), np.empty((0, 3), np.float32)
    states = np.array(["parked", "moving", "unknown"])[rng.integers(0, 3, count)]
    nodes = [
        SceneObject(
            id=i + 1, label=labels[kinds[i]], score=1.0, box=Box(centers[i], np.array([4.0, 2.0, 2.0]), 0.3),
            voxels=none, points=points, embedding=eye[kinds[i]], state=str(states[i]), parent=0,
        )
        for i in range(count)
    ]  # fmt: skip
    nothing = np.zeros(3)
    root = SceneObject(
        id=0, label="scene", score=1.0, box=Box(nothing, nothing, 0.0), voxels=none, points=points,
        embedding=np.zeros(len(labels), np.float32), level="scene", children=tuple(range(1, count + 1)),
    )  # fmt: skip
    info = EncoderInfo(name="made up", contract="logits", dim=len(labels), labels=labels, fingerprint="0" * 64)
    return SceneMap(VoxelMap(0.4, len(labels), contract="logits"), ObjectTree([root, *nodes]), info)
