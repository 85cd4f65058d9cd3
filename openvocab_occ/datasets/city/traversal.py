"""One drive along a route on one day: where everything is at any time, and what the sensors see."""

from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Float, Float32

from openvocab_occ.datasets.city.mesh import Mesh
from openvocab_occ.datasets.city.movers import DURATION, WARM_UP, Mover, set_going
from openvocab_occ.datasets.city.parking import parked
from openvocab_occ.datasets.city.render import Lighting, Rendering, render
from openvocab_occ.datasets.city.scene import Caster, Moment, Triangles, gather, joined, placed
from openvocab_occ.datasets.city.sensors import PERIOD, RIG
from openvocab_occ.datasets.city.surfaces import PART_NAMES
from openvocab_occ.datasets.city.things import VEHICLES, Thing, flat_pose
from openvocab_occ.datasets.city.town import Town
from openvocab_occ.datasets.city.traffic import Motion
from openvocab_occ.datasets.city.weather import CONDITIONS, Condition, headlights, light_vector, street_light
from openvocab_occ.geometry import Camera
from openvocab_occ.occupancy import OCC3D_CLASSES

_LATTICE = 16.0  # m; things are gathered around a point of it, so that a picture does not depend on earlier ones
_KEPT = 3  # gathered places
_MOVER_SIGHT = 110.0
_LAMP_SIGHT = 60.0
_CELL, _CELLS = 0.4, 320  # of the map of what stands on the ground
MAX_FRAMES = round(DURATION / PERIOD)
"""Keyframes of a traversal."""
FIRST_DAY = 1_760_000_000.0
"""Unix seconds of traversal 0; the next ones are a day apart."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What stands still around a place."""

    origin: Float[np.ndarray, " 3"]
    triangles: Triangles
    caster: Caster
    ground: Float32[np.ndarray, "x y"]


@dataclass(frozen=True, eq=False)
class Instant:
    """Everything around a place at one time."""

    triangles: Triangles
    """Still ones first."""
    moment: Moment
    surroundings: Surroundings
    movers: tuple[Mover, ...]
    """Those in the table, in its order."""
    ground: Float32[np.ndarray, "x y"]
    """How much stands on each cell of the ground around the origin, softened."""


@dataclass(frozen=True, kw_only=True)
class Attributes:
    """What is true of an instance."""

    id: int
    """Number in instance images."""
    label: int
    """Occ3D class."""
    name: str
    """Of the class."""
    kind: str
    """What a person would call it: `box truck`, `house`, `stop sign`."""
    color: str
    """Name of its main colour, one of `PAINTS`; of people that of the coat; empty where it says nothing."""
    parts: tuple[str, ...]
    """Parts that it has, seen or not."""
    moves: bool
    """True for what takes part in traffic, also while it waits; whether it moves is in `boxes`."""


class Traversal:
    """A drive. Times are seconds from its first keyframe."""

    def __init__(self, town: Town, route: int, number: int, condition: str) -> None:
        self.town, self.route, self.number, self.condition_name = town, route, number, condition
        self.condition: Condition = CONDITIONS[condition]
        self.name = f"city-{town.seed}-r{route}-t{number}"
        self.agent = f"car-{number % 3 + 1}"
        """Which vehicle drove."""
        day = np.random.default_rng([town.seed, 51, number])
        self._azimuth, self._drift = float(day.uniform(-np.pi, np.pi)), float(day.uniform(0, 50))
        self.num_frames = MAX_FRAMES
        """Keyframes that count as the time of observation."""
        self.moved_by: dict[int, float] = {}
        """How far movers move while observed, as far as it was asked."""
        self._places: OrderedDict[tuple[int, int], Surroundings] = OrderedDict()

    @cached_property
    def _motions(self) -> tuple[Motion, list[Mover]]:
        return set_going(self.town, self.route, self.number, self.condition.traffic)

    @property
    def movers(self) -> list[Mover]:
        """Things that may move, in the order of their numbers."""
        return self._motions[1]

    @cached_property
    def still(self) -> list[Thing]:
        """Things that do not move, this day."""
        there = [t for t in self.town.things if t.exists[0] <= self.number < t.exists[1]]
        return there + parked(self.town.seed, list(self.town.spots), self.town.closed, self.number)

    def attributes(self) -> dict[int, Attributes]:
        """Return what is true of each instance, by its number."""
        movers = {m.thing.id for m in self.movers}
        return {
            t.id: Attributes(
                id=t.id, label=t.label, name=OCC3D_CLASSES[t.label], kind=t.kind, color=t.color,
                parts=tuple(PART_NAMES[p] for p in t.part_numbers()), moves=t.id in movers,
            )
            for t in [*self.still, *(m.thing for m in self.movers)]
        }  # fmt: skip

    def start_time(self) -> float:
        """Return the Unix time of the first keyframe."""
        return FIRST_DAY + 86400.0 * self.number + 3600.0 * self.route

    def T_world_ego(self, time: float) -> Float[np.ndarray, "4 4"]:
        """Return the ego's pose."""
        x, y, heading = self._motions[0].at(WARM_UP + time)
        return flat_pose((x, y, 0.0), heading)

    def mover_pose(self, mover: Mover, time: float) -> Float[np.ndarray, "4 4"]:
        """Return T_world_thing of something that moves."""
        x, y, heading = mover.motion.at(WARM_UP + time)
        return flat_pose((x, y, mover.thing.position[2]), heading)

    def mover_velocity(self, mover: Mover, time: float) -> tuple[float, float]:
        """Return metres a second along the world's x and y."""
        return mover.motion.velocity(WARM_UP + time)

    def cameras(self, index: int, size: tuple[int, int] = (704, 256)) -> list[tuple[str, Camera, float]]:
        """Return name, camera in the world and time of the six cameras of a keyframe."""
        found = []
        for mount in RIG:
            time = index * PERIOD + mount.delay
            camera = mount.camera(*size).at(self.T_world_ego(time) @ mount.T_ego_cam())
            found.append((mount.name, camera, time))
        return found

    def surroundings(self, position: Float[np.ndarray, " 3"]) -> Surroundings:
        """Return what stands still around a position; the last few are kept."""
        key = (round(position[0] / _LATTICE), round(position[1] / _LATTICE))
        if key in self._places:
            self._places.move_to_end(key)
            return self._places[key]
        origin = np.array([key[0] * _LATTICE, key[1] * _LATTICE, 0.0])
        triangles = gather(self.still, [t.pose() for t in self.still], origin)
        caster = Caster(triangles.vertices, triangles.faces)
        ground = _stamp(np.zeros((_CELLS, _CELLS), np.float32), self.still, [t.pose() for t in self.still], origin)
        self._places[key] = Surroundings(origin, triangles, caster, ground)
        if len(self._places) > _KEPT:
            self._places.popitem(last=False)
        return self._places[key]

    def instant(self, time: float, position: Float[np.ndarray, " 3"]) -> Instant:
        """Return everything around a position at a time."""
        around = self.surroundings(position)
        poses = [self.mover_pose(m, time) for m in self.movers]
        near = [i for i, p in enumerate(poses) if np.hypot(*(p[:2, 3] - around.origin[:2])) < _MOVER_SIGHT]
        table = gather([self.movers[i].thing for i in near], [poses[i] for i in near], around.origin, cull=False)
        moment = Moment(around.caster, Caster(table.vertices, table.faces), len(around.triangles))
        movers = tuple(self.movers[i] for i in near)
        ground = _stamp(around.ground.copy(), [m.thing for m in movers], [poses[i] for i in near], around.origin)
        return Instant(joined(around.triangles, table), moment, around, movers, _blurred(ground))

    def forget(self) -> None:
        """Drop what was gathered around places, to save memory."""
        self._places.clear()

    def moved(self, instant: Instant, time: float) -> Moment:
        """Return how rays fall a little earlier or later; the table of triangles keeps its rows."""
        around, still = instant.surroundings, len(instant.surroundings.triangles)
        if not instant.movers:
            return instant.moment
        vertices = np.concatenate(
            [placed(m.thing.mesh, self.mover_pose(m, time), around.origin) for m in instant.movers]
        )
        faces = instant.triangles.faces[still:] - np.uint32(len(around.triangles.vertices))
        return Moment(around.caster, Caster(vertices, faces), still)

    def render(
        self, camera: Camera, time: float, *, instant: Instant | None = None, smooth: bool = True, frozen: bool = False
    ) -> Rendering:
        """Take a picture.

        Args:
            camera: Anywhere in the world.
            time: Seconds from the first keyframe.
            instant: Of a time near by, to save work when several cameras share it.
            smooth: Take more samples where surfaces meet.
            frozen: Moving things stay where they are at the instant, not where they are at the time.
        """
        if instant is None:
            instant = self.instant(time, camera.position)
            moment = instant.moment
        else:
            moment = instant.moment if frozen else self.moved(instant, time)
        origin = instant.surroundings.origin
        T = camera.T_world_cam.copy()
        T[:3, 3] -= origin
        lighting = self._lighting(instant, time, camera.position)
        millis = round((time + 100.0) * 1000)
        seed = [self.town.seed, 61, self.route, self.number, millis, *(int(abs(v) * 1000) for v in camera.position)]
        return render(instant.triangles, moment, camera.at(T), lighting, rng=np.random.default_rng(seed), smooth=smooth)

    def _lighting(self, instant: Instant, time: float, eye: np.ndarray) -> Lighting:
        around = instant.surroundings
        return Lighting(
            condition=self.condition,
            light=light_vector(self.condition, self._azimuth, self._drift),
            lamps=self._lamps(instant, time, eye),
            ground=instant.ground,
            origin=np.full(2, -_CELL * _CELLS / 2),
            cell=_CELL,
            anchor=around.origin[:2].copy(),
        )

    def _lamps(self, instant: Instant, time: float, eye: np.ndarray) -> Float[np.ndarray, "lamps 11"]:
        """Return the lamps and headlights that shine at night, relative to the origin of the triangles."""
        rows: list[list[float]] = []
        if self.condition.night:
            for thing in self.still:
                if thing.light is not None and np.hypot(*(np.array(thing.position[:2]) - eye[:2])) < _LAMP_SIGHT:
                    T = thing.pose()
                    rows.append(street_light((T[:3, :3] @ np.array(thing.light) + T[:3, 3]).tolist()))
            for mover in instant.movers:
                x, y, heading = mover.motion.at(WARM_UP + time)
                if mover.thing.label in VEHICLES and np.hypot(x - eye[0], y - eye[1]) < _LAMP_SIGHT:
                    rows += headlights(x, y, heading, ahead=float(mover.thing.mesh.bounds[1][0]) + 0.3)
            ego = self.T_world_ego(time)
            heading = float(np.arctan2(ego[1, 0], ego[0, 0]))
            rows += headlights(float(ego[0, 3]), float(ego[1, 3]), heading, ahead=2.0, ego=True)
        lamps = np.array(rows, dtype=np.float64).reshape(-1, 11)
        lamps[:, :3] -= instant.surroundings.origin
        return lamps


@lru_cache(maxsize=512)
def _outline(mesh: Mesh) -> Float32[np.ndarray, "n 2"]:
    """Return the hull of what of a mesh is lower than 1.6 m."""
    import cv2

    low = mesh.vertices[mesh.vertices[:, 2] < 1.6, :2].astype(np.float32)
    return np.asarray(cv2.convexHull(low))[:, 0]


def _stamp(ground: np.ndarray, things: list[Thing], poses: list[np.ndarray], origin: np.ndarray) -> np.ndarray:
    """Mark the cells of the ground that things stand on; `ground` is changed and returned."""
    import cv2

    reach = _CELL * _CELLS / 2
    for thing, T in zip(things, poses, strict=True):
        if thing.id <= 4 or np.abs(T[:2, 3] - origin[:2]).max() > reach + 10:  # the ground itself, or far
            continue
        outline = _outline(thing.mesh) @ T[:2, :2].T + (T[:2, 3] - origin[:2])
        cells = np.round((outline + reach) / _CELL * 16 - 8).astype(np.int32)
        cv2.fillConvexPoly(ground, cells[:, None, ::-1].copy(), 1.0, shift=4)  # OpenCV's x is the second axis
    return ground


def _blurred(ground: np.ndarray) -> Float32[np.ndarray, "x y"]:
    import cv2

    soft = 0.7 * cv2.GaussianBlur(ground, (0, 0), 1.1) + 0.5 * cv2.GaussianBlur(ground, (0, 0), 3)
    return np.minimum(soft, 1).astype(np.float32)
