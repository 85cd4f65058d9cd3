"""Tracks become objects: box, embedding, names, state and the evidence for it."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float32, Float64, Int64

from openvocab_occ.mapping import VoxelMap
from openvocab_occ.mapping.keys import unpack
from openvocab_occ.objects.box import Box, principal_yaw
from openvocab_occ.objects.kinds import plausible_length
from openvocab_occ.objects.looks import palette
from openvocab_occ.objects.refine import class_of
from openvocab_occ.objects.state import Motion, State, StateConfig, judge
from openvocab_occ.objects.tracks import Track
from openvocab_occ.objects.tree import SceneObject, Sighting
from openvocab_occ.segmentation.encoder import Contract

TOP_NAMES = 5
Namer = Callable[[Float32[np.ndarray, "n c"]], list[tuple[tuple[str, float], ...]]]
"""Embeddings to their best words and scores."""


def describe(
    track: Track,
    packed: Int64[np.ndarray, " n"],
    voxels: VoxelMap,
    *,
    names: Sequence[str],
    labels: Sequence[str] = (),
    config: StateConfig | None = None,
) -> SceneObject:
    """Return the object of a track.

    Args:
        track: Refined.
        packed: Keys of its voxels that belong to no other object.
        voxels: The map the object will stand in; the voxels of what moved are not in it.
        names: Classes that the track counts votes for.
        labels: Channels of a `logits` map.
        config: When a thing counts as moved, and as parked.
    """
    motion = track.motion(config)
    state, confidence, evidence = state_of(track, voxels, names, config)
    keys = unpack(packed)
    positions = voxels.index(keys)
    there = positions >= 0
    if there.any() and state not in ("moving",):
        keys = keys[there]
    contract: Contract = voxels.contract
    embedding = unit(track.feature_sum if track.look is None else track.look.feature_sum, contract)
    name = class_of(track, names)
    if contract == "logits" and labels:
        best = int(embedding.argmax())
        label, score = labels[best], float(embedding[best])
        top = [int(i) for i in np.argsort(-embedding, kind="stable")[:TOP_NAMES] if embedding[i] > 0]
        words = tuple((labels[i], float(embedding[i])) for i in top)
    else:
        total = float(track.class_votes.sum())
        label, score = name, (float(track.class_votes.max()) / total if total > 0 else 0.0)
        words = ()
    going = state in ("moving", "stopped")
    heading = track.heading() if going else None
    crops = track.crops
    return SceneObject(
        id=track.id,
        label=label,
        score=score,
        box=fit_box(track, packed if state != "moving" else unpack_last(track), heading if state == "moving" else None),
        voxels=np.sort(positions[there]).astype(np.int64),
        points=((keys + 0.5) * voxels.voxel_size).astype(np.float32),
        embedding=embedding,
        state=state,
        parent=0,
        views=tuple(Sighting(c.frame, c.view, c.box, c.score) for c in crops),
        evidence=evidence,
        confidence=confidence,
        heading=heading,
        speed=motion.speed if going else 0.0,
        times_seen=len(track.frames),
        first_seen=min(track.times),
        last_seen=max(track.times),
        best_embedding=unit(np.sum([c.feature * c.score for c in crops], axis=0), contract) if crops else None,
        agreement=float(np.linalg.norm(track.feature_sum)) / max(track.weight, 1e-9) if contract == "dense" else 1.0,
        names=words,
        colors=None if track.look is None else palette(track.look),
    )


def motion_of(track: Track, voxels: VoxelMap, config: StateConfig | None = None) -> Motion:
    """Return a track's motion, with what other frames saw through of its first and its latest place."""
    assert track.first is not None, "a track has sightings"
    assert track.last is not None, "a track has sightings"
    keys = unpack(np.union1d(track.first.seen, track.last.seen))
    at = voxels.index(keys)
    hits = np.where(at >= 0, voxels.count[at], 0) if len(voxels) else np.zeros(len(keys))
    through = voxels.free.count(keys).astype(np.int64)
    return replace(track.motion(config), left=float(((through > 0) & (2 * through >= hits)).mean()))


def state_of(
    track: Track, voxels: VoxelMap, names: Sequence[str], config: StateConfig | None = None
) -> tuple[State, float, str]:
    """Return a track's state, how sure it is, and what speaks for it."""
    lengths = plausible_length(class_of(track, names))
    longest = None if lengths is None else lengths[1]
    return judge(motion_of(track, voxels, config), movable=track.movable(names), longest=longest, config=config)


def unpack_last(track: Track) -> Int64[np.ndarray, " n"]:
    """Return the packed keys of the latest sighting."""
    assert track.last is not None, "a track has at least one sighting"
    return track.last.seen


def unit(vector: np.ndarray, contract: Contract) -> Float32[np.ndarray, " c"]:
    """Return a sum of features as a unit vector, or of distributions as one; zeros stay."""
    norm = float(vector.sum()) if contract == "logits" else float(np.linalg.norm(vector))
    return (vector / norm if norm > 0 else vector).astype(np.float32)


def fit_box(track: Track, packed: Int64[np.ndarray, " n"], heading: float | None = None) -> Box:
    """Return the upright box of a thing: around its seen voxels, and the hidden ones that most sightings agree on.

    Of a moving thing the latest sighting and its heading count. Length >= width.
    """
    size = track.voxel_size
    points = (unpack(np.union1d(packed, track.body)) + 0.5) * size
    yaw = heading if heading is not None else _yaw(np.unique(points[:, :2], axis=0), size)
    yaw = (yaw + np.pi / 2) % np.pi - np.pi / 2
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s], [s, c]])
    local = np.c_[points[:, :2] @ turn, points[:, 2]]
    lower, upper = local.min(axis=0) - size / 2, local.max(axis=0) + size / 2
    middle, extent = (lower + upper) / 2, upper - lower
    if extent[1] > extent[0]:
        extent, yaw = extent[[1, 0, 2]], yaw - np.pi / 2 if yaw > 0 else yaw + np.pi / 2
    return Box(np.r_[turn @ middle[:2], middle[2]], extent, float(yaw))


def _yaw(points: Float64[np.ndarray, "n 2"], size: float) -> float:
    """Return the angle of the rectangle of least area; where the spread's own axis is hardly worse, that one.

    Whole voxels do not tell a few degrees apart, the spread of all points does.
    """
    spread = principal_yaw(points)
    own = float(np.rad2deg(spread) % 90)
    tried = np.unique(np.round(np.r_[np.arange(0.0, 90.0, 3.0), own], 6))

    def area(degrees: float) -> float:
        a = np.deg2rad(degrees)
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        return float(np.prod(np.ptp(points @ turn, axis=0) + size / 2))

    areas = np.array([area(degrees) for degrees in tried])
    return spread if area(own) <= 1.05 * areas.min() else float(np.deg2rad(tried[int(areas.argmin())]))
