"""What is really there: things with kinds, colours, states and boxes, and a map that knows exactly that."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from openvocab_occ.datasets.city import PAINTS, City
from openvocab_occ.datasets.city.things import MOVABLE, Thing
from openvocab_occ.mapping import Lifted, VoxelMap
from openvocab_occ.objects import Box, EncoderInfo, KeyFrame, ObjectTree, Provenance, SceneMap, SceneObject
from openvocab_occ.query.relations import Viewpoint

GROUND = "ground"
RANGE = 45.0
"""Metres from the ego within which the truth is asked for."""
_PERIOD = 0.5  # seconds between keyframes
_VOXEL = 0.4
_HIDDEN = 0.05
"""Things lower than this, metres, are paint."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TrueThing:
    """One thing."""

    id: int
    """From 1, as in the map of the truth."""
    kind: str
    """What a person would call it."""
    color: str
    """Empty where none was given."""
    state: str
    """moving, stopped, parked or fixed."""
    box: Box


@dataclass(frozen=True, eq=False, kw_only=True)
class Truth:
    """All things around a viewer."""

    name: str
    things: tuple[TrueThing, ...]
    viewer: Viewpoint
    ground: float
    """Half the side of the square around the viewer whose ground was seen, metres."""


def truth_of_city(seed: int, *, route: int = 0, index: int = 8) -> Truth:
    """Return the truth around the ego at a keyframe of the demo city, which is synthetic."""
    drive = City(seed).traversal(route)
    time = index * _PERIOD
    T = drive.T_world_ego(time)
    found: list[tuple[Thing, np.ndarray, str]] = [
        (thing, thing.pose(), "parked" if thing.label in MOVABLE and thing.color else "fixed") for thing in drive.still
    ]
    for mover in drive.movers:
        speed = float(np.hypot(*drive.mover_velocity(mover, time)))
        found.append((mover.thing, drive.mover_pose(mover, time), "moving" if speed > 0.5 else "stopped"))
    things = []
    for thing, pose, state in found:
        box = box_of(thing, pose)
        if np.hypot(*(box.center[:2] - T[:2, 3])) < RANGE and box.size[2] > _HIDDEN:
            color = thing.color if thing.color in PAINTS else ""
            things.append(TrueThing(id=len(things) + 1, kind=thing.kind, color=color, state=state, box=box))
    viewer = Viewpoint(T[:3, 3].copy(), float(np.arctan2(T[1, 0], T[0, 0])), f"ego at frame {index}")
    return Truth(name=f"city {seed}, route {route}, frame {index}", things=tuple(things), viewer=viewer, ground=60.0)


def scene_of_truth(truth: Truth, *, also: Sequence[str] = ()) -> SceneMap:
    """Return the map that a flawless mapper would make: labels, colours, states and boxes as they are.

    `also` are kinds that its model knows and that are not there.
    """
    kinds = sorted({thing.kind for thing in truth.things} | set(also))
    labels = (*kinds, GROUND)
    voxels = VoxelMap(_VOXEL, len(labels), contract="logits")
    middle = truth.viewer.position[:2]
    low, high = np.floor((middle - truth.ground) / _VOXEL), np.ceil((middle + truth.ground) / _VOXEL)
    x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]), indexing="ij")
    _add(voxels, np.stack([x, y, np.full_like(x, -50)], axis=-1).reshape(-1, 3), len(labels) - 1, (0, 0, 0))
    members = []
    for thing in truth.things:
        keys = _keys(thing.box)
        _add(voxels, keys, labels.index(thing.kind), _rgb(thing.color))
        members.append(keys)
    nodes = [
        SceneObject(
            id=thing.id,
            label=thing.kind,
            score=1.0,
            box=thing.box,
            voxels=np.sort(voxels.index(keys.astype(np.int32))),
            points=((keys + 0.5) * _VOXEL).astype(np.float32),
            embedding=np.eye(len(labels), dtype=np.float32)[labels.index(thing.kind)],
            state=thing.state,
            parent=0,
        )
        for thing, keys in zip(truth.things, members, strict=True)
    ]
    nothing = np.zeros(3)
    root = SceneObject(
        id=0, label="scene", score=1.0, box=Box(nothing, nothing, 0.0), voxels=np.empty(0, np.int64),
        points=np.empty((0, 3), np.float32), embedding=np.zeros(len(labels), np.float32), level="scene",
        children=tuple(node.id for node in nodes),
    )  # fmt: skip
    info = EncoderInfo(name="truth", contract="logits", dim=len(labels), labels=labels, fingerprint="0" * 64)
    T = np.eye(4)
    c, s = np.cos(truth.viewer.heading), np.sin(truth.viewer.heading)
    T[:2, :2], T[:3, 3] = [[c, -s], [s, c]], truth.viewer.position
    return SceneMap(
        voxels, ObjectTree([root, *nodes]), info, (KeyFrame(0, 0.0, T),), Provenance(name=truth.name, synthetic=True)
    )


def _add(voxels: VoxelMap, keys: np.ndarray, label: int, rgb: tuple[int, int, int]) -> None:
    n = len(keys)
    features = np.zeros((n, voxels.dim), dtype=np.float32)
    features[:, label] = 1
    ones = np.ones(n, dtype=np.float32)
    colors = np.tile(np.array(rgb, dtype=np.float32), (n, 1))
    voxels.integrate(keys.astype(np.int32), Lifted(features, ones, np.ones(n, np.int32), color_sum=colors), time=0.0)


def _keys(box: Box) -> Float64[np.ndarray, "n 3"]:
    """Return the voxels whose middle lies in a box, at least the one of its own middle; hollow where it is large."""
    reach = np.abs(box.axes) @ (box.size / 2)
    low, high = np.floor((box.center - reach) / _VOXEL), np.ceil((box.center + reach) / _VOXEL)
    grid = np.stack(np.meshgrid(*[np.arange(a, b) for a, b in zip(low, high, strict=True)], indexing="ij"), axis=-1)
    keys = grid.reshape(-1, 3)
    local = np.abs(((keys + 0.5) * _VOXEL - box.center) @ box.axes)
    half = np.maximum(box.size / 2, _VOXEL / 2)  # thin things have voxels too
    inside = (local <= half).all(axis=1) & (local > half - 2 * _VOXEL).any(axis=1)
    return keys[inside] if inside.any() else np.floor(box.center / _VOXEL)[None]


def _rgb(color: str) -> tuple[int, int, int]:
    """Return a paint's colour; grey where none was given, as a picture always gives some."""
    digits = PAINTS.get(color, "#7a7a7a").lstrip("#")
    return int(digits[:2], 16), int(digits[2:4], 16), int(digits[4:], 16)


def box_of(thing: Thing, T: np.ndarray) -> Box:
    """Return the box of a thing at a pose; its yaw is in -90..90 degrees, along its longer side."""
    low, high = (np.array(corner, dtype=np.float64) for corner in thing.mesh.bounds)
    center = T[:3, :3] @ ((low + high) / 2) + T[:3, 3]
    length, width, height = high - low
    yaw = float(np.arctan2(T[1, 0], T[0, 0]))
    if width > length:
        length, width, yaw = width, length, yaw + np.pi / 2
    yaw = (yaw + np.pi / 2) % np.pi - np.pi / 2
    return Box(center, np.array([length, width, height]), yaw)
