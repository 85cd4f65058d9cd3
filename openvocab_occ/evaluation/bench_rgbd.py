"""What an RGB-D frame with masks costs as the map grows, beside objects kept as point clouds."""

import statistics
import time
from dataclasses import replace
from typing import Any

import numpy as np

from openvocab_occ.depth.render import DepthImage, render_depth
from openvocab_occ.evaluation.mapping_peers import ObjectClouds
from openvocab_occ.geometry import Camera, GridSpec, look_at, pose
from openvocab_occ.mapping import Segments, Sight, VoxelMap, lift, rows_from_depth
from openvocab_occ.objects import group_objects
from openvocab_occ.occupancy import OccupancyGrid

DIM, MASKS, VOXEL_SIZE = 512, 25, 0.05
VIEWS = 8
"""Frames in each room: one turn."""
_STAGES = ("rows", "lift", "fuse", "object clouds")
_K = np.array([[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]])


def bench_rgbd(frames: int = 40) -> dict[str, Any]:
    """Turn a camera of 640 x 480 round in one room after another; processor time.

    All rooms are alike, so every room shows as much, and as much that is new, as the one before: what grows from room
    to room is the map's doing.
    """
    rng = np.random.default_rng(0)
    own = rng.normal(size=(4096, DIM)).astype(np.float32)
    voxels, peer = VoxelMap(VOXEL_SIZE, DIM), ObjectClouds()
    _integrate(0, own, np.random.default_rng(0), VoxelMap(VOXEL_SIZE, DIM), ObjectClouds())  # compiles
    found = [_integrate(number, own, rng, voxels, peer) for number in range(max(frames // VIEWS, 2) * VIEWS)]
    times = np.array([row[:4] for row in found])
    ours, theirs = times[:, :3].sum(axis=1), times[:, 3]
    began = time.perf_counter()
    objects = group_objects(voxels)
    return {
        "scene": "synthetic rooms in a row, all alike", "rooms": len(found) // VIEWS, "frames": len(found),
        "masks": statistics.mean(row[4] for row in found), "features": DIM,
        "voxels_seen": statistics.mean(row[5] for row in found), "voxels": len(voxels),
        "cpu_seconds": float(np.median(ours)), "peer_cpu_seconds": float(np.median(theirs)),
        "cpu_ratio": float(np.median(theirs) / np.median(ours)),
        "cpu_stages": dict(zip(_STAGES, np.median(times, axis=0).tolist(), strict=True)),
        "growth": growth(ours), "peer_growth": growth(theirs),
        "growth_by_stage": {stage: growth(times[:, n]) for n, stage in enumerate(_STAGES[:3])},
        "peer_objects": len(peer.objects), "objects": len(objects),
        "objects_seconds_once": time.perf_counter() - began,
    }  # fmt: skip


def growth(times: np.ndarray) -> float:
    """Return by what share the time of a frame grows from the first room to the last.

    Each view is held against the same view of other rooms, and of all pairs of rooms the median counts (Theil and Sen),
    so that a hiccup of the machine is not taken for growth.
    """
    rooms = times.reshape(-1, VIEWS)
    x = np.linspace(0, 1, len(rooms))
    slopes = [(b - a) / (v - u) for u, a in zip(x, rooms, strict=True) for v, b in zip(x, rooms, strict=True) if u < v]
    return float(np.median(slopes, axis=0).sum() / np.median(rooms, axis=0).sum())


def _integrate(
    number: int, own: np.ndarray, rng: np.random.Generator, voxels: VoxelMap, peer: ObjectClouds
) -> tuple[float, ...]:
    """Give both one frame; return the seconds of each stage, how many masks it has and voxels it shows."""
    room = replace(_room(), T_world_grid=pose(np.array([8.0 * (number // VIEWS), 0.0, 0.0])))
    turn = 2 * np.pi * (number % VIEWS) / VIEWS
    eye = np.array([8.0 * (number // VIEWS), 0.0, 1.5])
    camera = Camera(_K, 640, 480, look_at(eye, eye + np.array([np.cos(turn), np.sin(turn), -0.25])))
    seen = render_depth(room, camera, max_depth=10.0)
    depth = np.where(seen.voxel >= 0, seen.depth + np.float32(0.005), 0).astype(np.float32)
    ids, vectors = _masks(room, seen, own, rng)
    marks = [time.process_time()]
    rows, keys = rows_from_depth(depth, camera, VOXEL_SIZE)
    marks.append(time.process_time())
    lifted = lift(rows, len(keys), Segments(ids, vectors), sight=Sight(camera, depth))
    marks.append(time.process_time())
    voxels.integrate(keys, lifted, time=float(number))
    marks.append(time.process_time())
    peer.integrate(depth, ids, vectors, camera)
    marks.append(time.process_time())
    return (*np.diff(marks).tolist(), len(vectors), len(keys))


def _room() -> OccupancyGrid:
    """Return a made-up room of 8 x 6 x 2.8 m in voxels of 5 cm, furnished with boxes, each its own label."""
    labels = np.zeros((160, 120, 56), dtype=np.uint8)
    for edge in (np.s_[:2], np.s_[-2:]):
        labels[edge], labels[:, edge], labels[:, :, edge] = 1, 2, 3
    rng = np.random.default_rng(3)
    for label in range(4, 44):
        x, y = int(rng.integers(4, 140)), int(rng.integers(4, 100))
        if 50 < x < 110 and 40 < y < 80:
            continue  # where the camera stands
        w, d, h = rng.integers(8, 24, 3)
        labels[x : x + w, y : y + d, 2 : 2 + h] = label
    names = ("free", *(f"thing {i}" for i in range(1, 64)))
    return OccupancyGrid(labels, GridSpec((-4.0, -3.0, 0.0), VOXEL_SIZE, labels.shape), free_label=0, class_names=names)


def _masks(
    room: OccupancyGrid, seen: DepthImage, own: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Cut the image into things, walls into pieces of 1 m; a thing's feature is its own and some noise."""
    hit = seen.voxel >= 0
    index = room.spec.unflat(seen.voxel[hit])
    name = room.labels.reshape(-1)[seen.voxel[hit]].astype(np.int64)
    piece = np.where(name < 4, (index // 20) @ np.array([49, 7, 1]) * 4 + name + 64, name)
    found, inverse, count = np.unique(piece, return_inverse=True, return_counts=True)
    largest = np.argsort(-count)[:MASKS]
    number = np.full(len(found), -1, dtype=np.int32)
    number[largest] = np.arange(len(largest))
    ids = np.full(seen.voxel.shape, -1, dtype=np.int32)
    ids[hit] = number[inverse]
    vectors = own[found[largest] % len(own)] + 0.3 * rng.normal(size=(len(largest), DIM)).astype(np.float32)
    return ids, (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
