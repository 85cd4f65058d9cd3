"""What the data set says of a keyframe: LiDAR sweep, boxes, labels, and all of it as a `Frame`."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int32

from openvocab_occ.datasets.city.labels import Labels, lidar_directions_world, observed
from openvocab_occ.datasets.city.movers import Mover
from openvocab_occ.datasets.city.sensors import LIDAR_NOISE, LIDAR_RANGE, PERIOD, T_EGO_LIDAR, lidar_directions
from openvocab_occ.datasets.city.surfaces import Material
from openvocab_occ.datasets.city.things import LABELS, MOVABLE, VEHICLES, Thing
from openvocab_occ.datasets.city.traversal import Instant, Traversal
from openvocab_occ.datasets.city.voxels import voxelise
from openvocab_occ.datasets.frame import Frame, View
from openvocab_occ.geometry import invert, transform
from openvocab_occ.occupancy import OCC3D_FREE, OCC3D_SPEC, OccupancyGrid
from openvocab_occ.occupancy.visibility import visibility_mask

_LIDAR_SPAN = (-6, -3, 0, 3, 6)  # keyframes whose LiDAR poses count for mask_lidar
_BEAM_STRIDE = 2  # of the columns of those sweeps
_PIXEL_STRIDE = 3  # of rays for mask_camera: 0.2 m apart at 40 m
BOX_RANGE = 60.0
"""Metres from the ego within which things get boxes."""
_MOVED = 0.5  # m that tell moving from standing still
_MOVING_SPEED = 0.2  # m/s
_SOAKED = {"rain": 0.012, "fog": 0.03}  # extinction of LiDAR, 1/m
_INTENSITY = {Material.ASPHALT: 12.0, Material.MARKING: 60.0, Material.SIGN: 90.0, Material.METAL: 45.0,
              Material.PAINT: 35.0, Material.GLASS: 5.0, Material.LEAF: 22.0, Material.GRASS: 18.0}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Sweep:
    """LiDAR returns of a keyframe, moving things and the ego held still at its time."""

    points: Float32[np.ndarray, "n 3"]
    """In the LiDAR frame, metres."""
    intensity: Float32[np.ndarray, " n"]
    ring: Float32[np.ndarray, " n"]
    instances: Int32[np.ndarray, " n"]
    """Number of the thing that was hit."""


@dataclass(frozen=True, kw_only=True)
class Box:
    """The box of a thing at a keyframe, in the world."""

    id: int
    label: int
    kind: str
    color: str
    center: tuple[float, float, float]
    size: tuple[float, float, float]
    """Length along the heading, width, height."""
    yaw: float
    velocity: tuple[float, float]
    """Metres a second along the world's x and y."""
    moves: bool
    """It moves by more than 0.5 m while it is within 60 m of the ego; a vehicle that does not is parked."""
    attribute: str
    """As nuScenes: vehicle.moving, vehicle.stopped (now, though it moves at another time), vehicle.parked, ..."""


def instant_of(drive: Traversal, index: int) -> Instant:
    """Return everything around the ego at the LiDAR's time of a keyframe."""
    time = index * PERIOD
    return drive.instant(time, drive.T_world_ego(time)[:3, 3])


def sweep(drive: Traversal, index: int, instant: Instant | None = None) -> Sweep:
    """Turn the LiDAR once."""
    instant = instant or instant_of(drive, index)
    directions, rings = lidar_directions()
    T_world_lidar = drive.T_world_ego(index * PERIOD) @ T_EGO_LIDAR
    rays = np.empty((len(directions), 6), np.float32)
    rays[:, :3] = T_world_lidar[:3, 3] - instant.surroundings.origin
    rays[:, 3:] = lidar_directions_world(directions, T_world_lidar)
    hits = instant.moment.cast(rays)
    rng = np.random.default_rng([drive.town.seed, 71, drive.route, drive.number, index])
    range_ = hits.t + np.float32(LIDAR_NOISE) * rng.standard_normal(len(hits.t), dtype=np.float32)
    soaked = _SOAKED.get(drive.condition_name, 0.0)
    through = np.exp(-soaked * np.minimum(hits.t, LIDAR_RANGE))
    kept = (hits.t < LIDAR_RANGE) & (rng.random(len(hits.t), dtype=np.float32) < 0.995 * through)
    table = np.full(len(Material), 25.0, np.float32)
    table[list(_INTENSITY)] = list(_INTENSITY.values())
    facing = np.abs(np.einsum("ij,ij->i", hits.normal, rays[:, 3:]))
    strength = table[instant.triangles.material[hits.face]] * (0.4 + 0.6 * facing)
    return Sweep(
        directions[kept] * range_[kept, None], np.round(strength[kept]), rings[kept],
        instant.triangles.instance[hits.face][kept],
    )  # fmt: skip


def boxes(drive: Traversal, index: int) -> list[Box]:
    """Return the boxes of everything that could move within 60 m of the ego."""
    time = index * PERIOD
    ego = drive.T_world_ego(time)
    found = [
        _box(thing, thing.pose(), (0.0, 0.0), False)
        for thing in drive.still
        if thing.label in MOVABLE and np.hypot(*(np.array(thing.position[:2]) - ego[:2, 3])) < BOX_RANGE
    ]
    for mover in drive.movers:
        T = drive.mover_pose(mover, time)
        if np.hypot(*(T[:2, 3] - ego[:2, 3])) < BOX_RANGE:
            found.append(_box(mover.thing, T, drive.mover_velocity(mover, time), moves(drive, mover)))
    return found


def moves(drive: Traversal, mover: Mover) -> bool:
    """Tell whether something moves by more than half a metre at the keyframes at which it is within 60 m of the ego."""
    if mover.thing.id not in drive.moved_by:
        times = np.arange(drive.num_frames) * PERIOD
        at = np.array([drive.mover_pose(mover, t)[:2, 3] for t in times])
        ego = np.array([drive.T_world_ego(t)[:2, 3] for t in times])
        seen = at[np.linalg.norm(at - ego, axis=1) < BOX_RANGE]
        drive.moved_by[mover.thing.id] = float(np.linalg.norm(seen - seen[:1], axis=1).max()) if len(seen) else 0.0
    return drive.moved_by[mover.thing.id] > _MOVED


def _box(thing: Thing, T: np.ndarray, velocity: tuple[float, float], moving: bool) -> Box:
    low, high = thing.mesh.bounds
    low = np.array([low[0], low[1], max(low[2], 0.0)])
    center = T[:3, :3] @ ((low + high) / 2) + T[:3, 3]
    now = bool(np.hypot(*velocity) > _MOVING_SPEED)
    if thing.label in (LABELS["bicycle"], LABELS["motorcycle"]):
        attribute = "cycle.with_rider" if thing.id >= 1_000_000 else "cycle.without_rider"
    elif thing.label == LABELS["pedestrian"]:
        attribute = "pedestrian.moving" if now else "pedestrian.standing"
    elif thing.label in VEHICLES:
        attribute = "vehicle.moving" if now else "vehicle.stopped" if moving else "vehicle.parked"
    else:
        attribute = ""
    return Box(
        id=thing.id, label=thing.label, kind=thing.kind, color=thing.color,
        center=(float(center[0]), float(center[1]), float(center[2])),
        size=(float(high[0] - low[0]), float(high[1] - low[1]), float(high[2] - low[2])),
        yaw=float(np.arctan2(T[1, 0], T[0, 0])), velocity=velocity, moves=moving, attribute=attribute,
    )  # fmt: skip


def labels(drive: Traversal, index: int, instant: Instant | None = None, *, masks: bool = True) -> Labels:
    """Return the Occ3D labels of a keyframe, in the ego frame at the LiDAR's time.

    Without masks everything counts as known, which saves half of the time.
    """
    instant = instant or instant_of(drive, index)
    T_world_ego = drive.T_world_ego(index * PERIOD)
    T_grid_local = invert(T_world_ego)
    T_grid_local[:3, 3] += T_grid_local[:3, :3] @ instant.surroundings.origin
    voxels = voxelise(instant.triangles, T_grid_local)
    if not masks:
        everything = np.ones(OCC3D_SPEC.shape, np.bool_)
        grid = OccupancyGrid(voxels.semantics, OCC3D_SPEC, T_world_ego, OCC3D_FREE)
        return Labels(grid, voxels.instances, everything, everything)
    whole = OccupancyGrid(voxels.semantics, OCC3D_SPEC, T_world_ego, OCC3D_FREE)
    directions, _ = lidar_directions()
    thin = directions.reshape(-1, 32, 3)[::_BEAM_STRIDE].reshape(-1, 3)
    last = drive.num_frames - 1
    stands = sorted({min(max(index + step, 0), last) for step in _LIDAR_SPAN})
    poses = [drive.T_world_ego(n * PERIOD) @ T_EGO_LIDAR for n in stands]
    origins = np.array([T[:3, 3] for T in poses])
    mask_lidar = observed(whole, origins, [lidar_directions_world(thin, T) for T in poses])
    returns = transform(T_EGO_LIDAR, sweep(drive, index, instant).points)
    flat = OCC3D_SPEC.flat(OCC3D_SPEC.index(returns))
    mask_lidar.reshape(-1)[flat[flat >= 0]] = True
    cameras = [camera for _, camera, _ in drive.cameras(index)]
    grid = OccupancyGrid(voxels.semantics, OCC3D_SPEC, T_world_ego, OCC3D_FREE, known=mask_lidar)
    mask_camera = visibility_mask(grid, cameras, mode="pixel", stride=_PIXEL_STRIDE)
    return Labels(grid, voxels.instances, mask_lidar, mask_camera)


def frame(drive: Traversal, index: int, *, size: tuple[int, int] = (704, 256), depth: bool = False, quick: bool = False
          ) -> Frame:  # fmt: skip
    """Return a keyframe with images, occupancy and LiDAR; with `depth` also the true depth of every pixel.

    A quick one is for training small models: the world stands still while the cameras fire, edges are not smoothed, all
    of the grid counts as known, and the LiDAR does not turn.
    """
    instant = instant_of(drive, index)
    views, poses = [], {}
    for name, camera, time in drive.cameras(index, size):
        picture = drive.render(camera, time, instant=instant, smooth=not quick, frozen=quick)
        views.append(View(picture.image, camera, picture.depth if depth else None, name))
        poses[f"{name.lower()}_ego"] = drive.T_world_ego(time)
    T_world_ego = drive.T_world_ego(index * PERIOD)
    return Frame(
        index=index,
        timestamp=drive.start_time() + index * PERIOD,
        T_world_ego=T_world_ego,
        views=tuple(views),
        occupancy=labels(drive, index, instant, masks=not quick).grid,
        points=None if quick else transform(T_EGO_LIDAR, sweep(drive, index, instant).points).astype(np.float32),
        token=f"{drive.name}-{index:03d}",
        poses={**poses, "lidar": T_world_ego @ T_EGO_LIDAR},
    )


def ego_track(drive: Traversal) -> Float[np.ndarray, "n 4 4"]:
    """Return the ego's pose at every keyframe."""
    return np.array([drive.T_world_ego(i * PERIOD) for i in range(drive.num_frames)])
