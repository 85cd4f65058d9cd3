"""A small made-up street, drawn from a seed, whose truth is known exactly.

Everything here is synthetic: boxes of voxels with one colour a class, seen by six small cameras. It serves to try the
toolkit without data and to test it; it says nothing about how well a map of a real street will be.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8

from openvocab_occ.datasets.frame import Frame, FrameSequence, View
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import Camera, GridSpec, look_at, pose, transform
from openvocab_occ.io.files import PathLike
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_FREE, OccupancyGrid
from openvocab_occ.occupancy.rays import cast_rays

CAR, TRUCK, ROAD, SIDEWALK, TERRAIN, MANMADE, VEGETATION = (
    OCC3D_CLASSES.index(name)
    for name in ("car", "truck", "driveable surface", "sidewalk", "terrain", "manmade", "vegetation")
)
PALETTE: Mapping[int, tuple[int, int, int]] = MappingProxyType(
    {
        CAR: (200, 60, 50), TRUCK: (235, 170, 40), ROAD: (105, 100, 120), SIDEWALK: (205, 195, 200),
        TERRAIN: (150, 120, 70), MANMADE: (70, 90, 170), VEGETATION: (60, 140, 60), OCC3D_FREE: (170, 215, 245),
    }
)  # fmt: skip
"""RGB of each class in full light; that of `free` is the sky's."""

WORLD = GridSpec((0.0, -16.0, -1.0), 0.2, (320, 160, 50))
"""The street itself, in the world frame: x along the road, y to its left."""
WINDOW = GridSpec((-20.0, -16.0, -1.0), 0.4, (100, 80, 16))
"""The occupancy grid of a frame, in the ego frame: Occ3D's voxels and height, a smaller box."""
MAX_FRAMES = 20
_FRAME_PERIOD = 0.5  # s, as nuScenes' keyframes
_SPEED = 5.0  # m/s
_START = 6.0  # m along the road
_MAX_RANGE = 100.0
_HAZE = 150.0  # m after which a colour has faded to 1/e
_FACE_LIGHT = np.array([0.84, 0.92, 1.0], dtype=np.float32)  # of faces across x, y, z
_NOISE = np.float32(4.0)  # grey levels
_CAMERA_YAW_DEG = {
    "CAM_FRONT": 0, "CAM_FRONT_RIGHT": -55, "CAM_FRONT_LEFT": 55, "CAM_BACK": 180, "CAM_BACK_LEFT": 110,
    "CAM_BACK_RIGHT": -110,
}  # fmt: skip
_CAMERA = Camera(np.array([[228.0, 0, 159.5], [0, 228.0, 95.5], [0, 0, 1]]), 320, 192)


@dataclass(frozen=True, kw_only=True)
class StreetObject:
    """A thing of the street and the box that exactly holds its voxels, axes along the world's."""

    label: int
    name: str
    center: tuple[float, float, float]
    """Metres, at time 0."""
    size: tuple[float, float, float]
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    parts: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = ()
    """Lower and upper corners, relative to the lower corner of the box, of the boxes it is made of; one if none."""

    @property
    def moving(self) -> bool:
        """True for what is not parked or built."""
        return any(self.velocity)

    def bounds(self, time: float = 0.0) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Return lower and upper corner of the box at a time, metres in the world."""
        center = np.asarray(self.center) + np.asarray(self.velocity) * time
        return center - np.asarray(self.size) / 2, center + np.asarray(self.size) / 2


@dataclass(frozen=True, eq=False)
class Street:
    """The truth: ground, objects, and what is where at any time."""

    seed: int
    objects: tuple[StreetObject, ...]
    _still: UInt8[np.ndarray, "x y z"] = field(repr=False)

    def world(self, time: float) -> OccupancyGrid:
        """Return the whole street at a time, in voxels of 0.2 m."""
        labels = self._still.copy()
        for thing in self.objects:
            if thing.moving:
                _paint(labels, thing, time)
        return OccupancyGrid(labels, WORLD)

    def window(self, T_world_ego: Float[np.ndarray, "4 4"], world: OccupancyGrid) -> OccupancyGrid:
        """Return the grid around the ego: of the eight 0.2 m samples of a voxel, at least two hold its class.

        The ego stands on the ground and turns about z only. Voxels outside the street are not known.
        """
        quarters = np.array([-0.1, 0.1])
        ix, iy, ax, ay = np.meshgrid(*(np.arange(n) for n in WINDOW.shape[:2]), quarters, quarters, indexing="ij")
        columns = WINDOW.centers(np.stack([ix, iy, np.zeros_like(ix)], axis=-1))
        columns[..., 0] += ax
        columns[..., 1] += ay
        where = WORLD.index(transform(T_world_ego, columns))  # x y 2 2 3
        inside = np.asarray(WORLD.contains(where)).all(axis=(2, 3))
        at = np.clip(where, 0, np.asarray(WORLD.shape) - 1)
        samples = world.labels[at[..., 0], at[..., 1], : 2 * WINDOW.shape[2]]  # x y 2 2 2z: z lattices coincide
        samples = samples.reshape(*WINDOW.shape[:2], 4, WINDOW.shape[2], 2)
        samples = np.ascontiguousarray(samples.transpose(2, 4, 0, 1, 3)).reshape(8, *WINDOW.shape)
        labels = np.full(WINDOW.shape, OCC3D_FREE, dtype=np.uint8)
        most = np.ones(WINDOW.shape, dtype=np.uint8)
        for label in PALETTE:
            if label != OCC3D_FREE:
                votes = (samples == label).sum(axis=0, dtype=np.uint8)
                better = votes > most
                labels[better], most[better] = label, votes[better]
        known = np.broadcast_to(np.asarray(inside)[:, :, None], WINDOW.shape)
        return OccupancyGrid(labels, WINDOW, T_world_ego, known=known)


def street(seed: int = 0) -> Street:
    """Draw a street: a road with sidewalks, buildings, trees, poles, parked cars, three parked trucks, a moving car."""
    rng = np.random.default_rng(seed)
    things = tuple(_things(rng))
    labels = np.full(WORLD.shape, OCC3D_FREE, dtype=np.uint8)
    y = np.abs(WORLD.centers(np.stack([np.zeros(160, int), np.arange(160), np.zeros(160, int)], axis=1))[:, 1])
    labels[:, y < 6, :5] = ROAD  # up to z = 0
    labels[:, (y > 6) & (y < 9), :6] = SIDEWALK  # a kerb of 0.2 m
    labels[:, y > 9, :6] = TERRAIN
    for thing in things:
        if not thing.moving:
            _paint(labels, thing, 0.0)
    return Street(seed, things, labels)


def load_street(
    root: PathLike | None = None, *, scene: str | None = None, seed: int = 0, frames: int = 8
) -> FrameSequence:
    """Drive along a made-up street at 5 m/s, two frames a second; times count from the start."""
    if root is not None or scene is not None:
        raise ConfigError("street is made up from a seed", expected="no root and no scene", got=root or scene)
    if not 1 <= frames <= MAX_FRAMES:
        raise ConfigError("the street is too short", expected=f"1 to {MAX_FRAMES} frames", got=frames)
    place = street(seed)
    name = f"synthetic-street-{seed}"
    return FrameSequence(name, range(frames), lambda index: _frame(place, index), source="street", synthetic=True)


def ego_pose(time: float) -> Float[np.ndarray, "4 4"]:
    """Return T_world_ego: along +x in the right lane, swaying by 0.6 m so that the heading changes."""
    x = _START + _SPEED * time
    phase = 2 * np.pi * x / 40.0
    yaw = np.arctan(0.6 * 2 * np.pi / 40.0 * np.cos(phase))
    return pose((x, -1.7 + 0.6 * np.sin(phase), 0.0), (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)))


def _frame(place: Street, index: int) -> Frame:
    time = index * _FRAME_PERIOD
    T_world_ego = ego_pose(time)
    world = place.world(time)
    views = []
    for number, (name, degrees) in enumerate(_CAMERA_YAW_DEG.items()):
        yaw = np.deg2rad(degrees)
        eye = np.array([0.7 + np.cos(yaw), 0.5 * np.sin(yaw), 1.5])
        T_ego_cam = look_at(eye, eye + np.array([np.cos(yaw), np.sin(yaw), 0.0]))
        camera = _CAMERA.at(T_world_ego @ T_ego_cam)
        noise = np.random.default_rng((place.seed, index, number))
        views.append(View(_photograph(world, camera, noise), camera, name=name))
    token = f"street-{place.seed}-{index:03d}"
    occupancy = place.window(T_world_ego, world)
    return Frame(index, time, T_world_ego, tuple(views), occupancy, None, token, {"lidar_ego": T_world_ego})


def _photograph(world: OccupancyGrid, camera: Camera, noise: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """Draw what a camera sees: class colours, lit by face, mottled by voxel, faded by distance, with sensor noise."""
    rays = camera.rays().reshape(-1, 3) @ camera.T_world_cam[:3, :3].T
    hits = cast_rays(world, camera.position, rays, _MAX_RANGE)
    hit = np.flatnonzero(hits.voxel >= 0)
    voxel, distance, ray = hits.voxel[hit], hits.distance[hit], rays[hit]
    reach = distance / np.sqrt(np.einsum("ij,ij->i", ray, ray))
    offset = np.abs(camera.position + ray * reach[:, None] - world.centers(voxel)).T
    face = np.where(offset[2] >= np.maximum(offset[0], offset[1]), 2, np.where(offset[0] >= offset[1], 0, 1))
    clear = np.exp(distance / -_HAZE)
    colors = np.zeros((len(OCC3D_CLASSES), 3), dtype=np.float32)
    colors[list(PALETTE)] = list(PALETTE.values())
    sky = colors[OCC3D_FREE]
    image = np.tile(sky, (len(rays), 1))
    strength = _FACE_LIGHT[face] * (0.95 + 0.1 * _mottle(voxel)) * clear
    own = colors[world.labels.reshape(-1)[voxel]]
    image[hit] = own * strength[:, None] + sky * (1 - clear)[:, None]
    image += _NOISE * noise.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8).reshape(camera.height, camera.width, 3)


def _mottle(voxel: Int32[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
    """Return a number in [0, 1) for each voxel that looks random and is always the same (Knuth's hash)."""
    return ((voxel.astype(np.uint32) * np.uint32(2654435761)) >> np.uint32(16)).astype(np.float32) / 65536


def _paint(labels: UInt8[np.ndarray, "x y z"], thing: StreetObject, time: float) -> None:
    """Write an object into `labels`, cut off at the ends of the street."""
    corner = thing.bounds(time)[0]
    for low, high in thing.parts or (((0.0, 0.0, 0.0), thing.size),):
        cells = np.rint((np.array([low, high]) + corner - WORLD.origin) / WORLD.size).astype(int)
        (x0, y0, z0), (x1, y1, z1) = np.clip(cells, 0, WORLD.shape)
        labels[x0:x1, y0:y1, z0:z1] = thing.label


def _things(rng: np.random.Generator) -> Iterator[StreetObject]:
    """Yield the objects; every corner lies on the 0.2 m lattice."""
    slots = [(x, side) for x in (2.0, 11.0, 20.0, 29.0, 38.0, 47.0, 56.0) for side in (-1, 1)]
    order = rng.permutation(len(slots))
    for number, slot in enumerate(order[:9]):
        x, side = slots[slot]
        low = (x + 0.2 * int(rng.integers(0, 3)), 3.6 * side - (2.4 if side < 0 else 0.0), 0.0)
        yield _truck(low, number) if number < 3 else _car(low, number - 3)
    yield _car((58.0, 1.0, 0.0), 99, velocity=(-4.0, 0.0, 0.0))
    for side in (-1, 1):
        for number, x in enumerate((7.0, 19.0, 31.0, 43.0, 55.0)):
            x += 0.2 * int(rng.integers(0, 10))
            yield _tree((x, 7.6 * side - (0.0 if side > 0 else 1.2), 0.2), f"{number}{'r l'[side + 1]}", rng)
            yield _box(MANMADE, f"pole {number}{'r l'[side + 1]}", (x + 5.0, 6.4 * side - 0.2, 0.2), (0.4, 0.4, 5.0))
        x = 0.0
        while x < 60:
            length, height = 0.2 * int(rng.integers(40, 70)), 0.2 * int(rng.integers(22, 43))
            length = min(length, 64.0 - x)
            y = 10.0 if side > 0 else -16.0
            yield _box(MANMADE, f"building {x:.0f}{'r l'[side + 1]}", (x, y, 0.2), (length, 6.0, height))
            x = round(x + length + 0.2 * int(rng.integers(10, 20)), 1)


def _box(
    label: int, name: str, low: tuple[float, ...], size: tuple[float, float, float], **more: object
) -> StreetObject:
    x, y, z = (a + s / 2 for a, s in zip(low, size, strict=True))
    return StreetObject(label=label, name=name, center=(x, y, z), size=size, **more)  # pyright: ignore[reportArgumentType]


def _car(low: tuple[float, ...], number: int, **more: object) -> StreetObject:
    parts = (((0.0, 0.0, 0.0), (4.4, 2.0, 1.0)), ((1.0, 0.2, 1.0), (3.6, 1.8, 1.6)))
    name = "moving car" if more else f"parked car {number}"
    return _box(CAR, name, low, (4.4, 2.0, 1.6), parts=parts, **more)


def _truck(low: tuple[float, ...], number: int) -> StreetObject:
    parts = (((0.0, 0.0, 0.0), (7.0, 2.4, 0.8)), ((0.0, 0.0, 0.8), (1.6, 2.4, 2.4)), ((1.8, 0.0, 0.8), (7.0, 2.4, 3.2)))
    return _box(TRUCK, f"parked truck {number}", low, (7.0, 2.4, 3.2), parts=parts)


def _tree(low: tuple[float, ...], name: str, rng: np.random.Generator) -> StreetObject:
    trunk, top = 2.0 + 0.2 * int(rng.integers(0, 4)), 4.2 + 0.2 * int(rng.integers(0, 5))
    parts = (((0.4, 0.4, 0.0), (0.8, 0.8, trunk)), ((0.0, 0.0, trunk), (1.2, 1.2, top)))
    return _box(VEGETATION, f"tree {name}", low, (1.2, 1.2, top), parts=parts)
