"""A way along a road: where the ego is going to drive, or may."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float64

from openvocab_occ.arrays import as_floats
from openvocab_occ.errors import ConfigError
from openvocab_occ.objects.ground import Ground
from openvocab_occ.objects.regions import Regions, find_regions
from openvocab_occ.objects.scene_map import SceneMap

_STEP = 1.0  # metres
_TURNS = np.deg2rad(np.arange(-24.0, 25.0, 4.0))  # directions that are tried at each step
_FEEL = np.arange(1.0, 11.0)  # metres ahead that are felt for road
_EDGE = 1.2  # metres from the road's rim that a way keeps


@dataclass(frozen=True, eq=False)
class Route:
    """A line along the ground, in the direction of travel."""

    points: Float64[np.ndarray, "n 2"]
    """World, metres; no two in a row are the same."""
    height: float = 0.0
    """Of the ground, metres."""
    driven: float = 0.0
    """Metres of it, from the start, that the ego of the map drove; the rest was read from the road."""

    def __post_init__(self) -> None:
        points = as_floats(self.points, (None, 2), "points of a route")
        gaps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        points = points[np.append(True, gaps > 1e-6)]
        if len(points) < 2:
            raise ConfigError("a route leads nowhere", expected="at least 2 different points", got=len(points))
        object.__setattr__(self, "points", points)

    @cached_property
    def arc(self) -> Float64[np.ndarray, " n"]:
        """Metres from the start to each point."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1))])

    @property
    def length(self) -> float:
        """Metres."""
        return float(self.arc[-1])

    def at(self, station: float) -> Float64[np.ndarray, " 2"]:
        """Return the place so many metres from the start, at most at the end."""
        return np.array([np.interp(station, self.arc, self.points[:, k]) for k in (0, 1)])

    def heading(self, station: float) -> float:
        """Return the direction of travel, radians, over 4 m around a station."""
        way = self.at(min(station + 2.0, self.length)) - self.at(max(station - 2.0, 0.0))
        return float(np.arctan2(way[1], way[0]))

    def pose(self, station: float) -> Float64[np.ndarray, "4 4"]:
        """Return T_world_ego at a station, level, looking along the way."""
        heading, place = self.heading(station), self.at(station)
        T = np.eye(4)
        T[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
        T[:3, 3] = [place[0], place[1], self.height]
        return T

    def stands(self, spacing: float) -> list[tuple[float, Float64[np.ndarray, "4 4"]]]:
        """Return stations every so many metres from the start on, with their poses; none within 5 m of the end."""
        stations = np.arange(0.0, max(self.length - 5.0, 1e-9), spacing)
        return [(float(s), self.pose(float(s))) for s in stations]

    def locate(self, points: Float[np.ndarray, "m 2"]) -> tuple[Float64[np.ndarray, " m"], Float64[np.ndarray, " m"]]:
        """Return for each point the station of the nearest place on the way, and how far it is to the left of it.

        Stations before the start and beyond the end go on straight.
        """
        start, way = self.points[:-1], np.diff(self.points, axis=0)
        length = np.linalg.norm(way, axis=1)
        unit = way / length[:, None]
        offset = np.asarray(points, np.float64)[:, None] - start
        along = (offset * unit).sum(axis=2)
        low, high = np.zeros(len(length)), length.copy()
        low[0], high[-1] = -np.inf, np.inf
        along = np.clip(along, low, high)
        away = np.linalg.norm(offset - along[..., None] * unit, axis=2)
        best = away.argmin(axis=1)
        rows = np.arange(len(best))
        side = unit[best, 0] * offset[rows, best, 1] - unit[best, 1] * offset[rows, best, 0]
        left = np.where(side >= 0, away[rows, best], -away[rows, best])
        return self.arc[best] + along[rows, best], left


def regions_of(scene: SceneMap) -> Regions:
    """Return the ground of a map, cut into regions."""
    path = np.array([frame.T_world_ego[:2, 3] for frame in scene.frames], dtype=np.float64).reshape(-1, 2)
    names = scene.class_names if len(scene.class_names) > 2 else scene.encoder.labels
    return find_regions(scene.voxels, names, path)


def route_ahead(
    scene: SceneMap, *, frame: int | None = None, length: float = 100.0, regions: Regions | None = None
) -> Route:
    """Return the way that lies ahead of the ego at a keyframe: the one it drove, then on along the road.

    Beyond the end of the drive the way follows the middle of the road and goes straight on over junctions, until the
    road or what is known of it ends.

    Args:
        scene: The map.
        frame: Index of the keyframe; the first by default.
        length: Metres, at most.
        regions: Of the map, if they were found already.

    Raises:
        ConfigError: The map keeps no frames or has none of this index, or the length is none.
    """
    if not (np.isfinite(length) and length > 0):
        raise ConfigError("length of a route is not usable", expected="metres above 0", got=length)
    if not scene.frames:
        raise ConfigError("the map keeps no frames, so nothing tells where the ego is", fix="pass a Route")
    known = [f.index for f in scene.frames]
    if frame is not None and frame not in known:
        raise ConfigError("no keyframe has this index", expected=f"one of {known[:8]}", got=frame)
    at = 0 if frame is None else known.index(frame)
    T = scene.frames[at].T_world_ego
    driven = _driven(np.array([f.T_world_ego[:2, 3] for f in scene.frames[at:]]), T)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(driven, axis=0), axis=1))])
    if arc[-1] < length:
        ground = (regions or regions_of(scene)).ground
        heading = float(np.arctan2(*(driven[-1] - driven[-2])[::-1])) if len(driven) > 1 else _heading(T)
        more = _along_road(ground, driven[-1], heading, length - float(arc[-1]))
        points = np.concatenate([driven, more])
    else:
        points = driven
    if len(points) < 2:
        points = np.stack([driven[0], driven[0] + 2 * T[:2, 0]])
    route = Route(points, float(T[2, 3]), float(arc[-1]))
    if route.length > length:
        keep = route.arc < length
        cut = np.concatenate([route.points[keep], route.at(length)[None]])
        route = Route(cut, route.height, min(route.driven, length))
    return route


def _heading(T_world_ego: Float[np.ndarray, "4 4"]) -> float:
    return float(np.arctan2(T_world_ego[1, 0], T_world_ego[0, 0]))


def _driven(places: Float[np.ndarray, "n 2"], T_world_ego: Float[np.ndarray, "4 4"]) -> Float64[np.ndarray, "m 2"]:
    """Return places at least half a metre apart, so that standing still turns no corner."""
    kept = [places[0]]
    for place in places[1:]:
        if np.linalg.norm(place - kept[-1]) >= 0.5:
            kept.append(place)
    return np.array(kept, np.float64)


def _along_road(
    ground: Ground, start: Float[np.ndarray, " 2"], heading: float, length: float
) -> Float64[np.ndarray, "n 2"]:
    """Feel for the road step by step: of the directions that keep to it longest, the widest and straightest."""
    place, found = np.asarray(start, np.float64), []
    for _ in range(int(length / _STEP)):
        ways = np.stack([np.cos(heading + _TURNS), np.sin(heading + _TURNS)], axis=1)
        probes = place + ways[:, None] * _FEEL[:, None]
        room = ground.at(ground.width, probes)  # directions x metres ahead
        open_ = np.cumprod(room > _EDGE, axis=1).sum(axis=1)
        if not open_.max():
            break
        worth = open_ + 0.25 * np.minimum(room, 4.0).mean(axis=1) - 2.0 * np.abs(_TURNS) / _TURNS.max()
        best = int(worth.argmax())
        heading += float(_TURNS[best]) * 0.5
        place = place + _STEP * np.array([np.cos(heading), np.sin(heading)])
        if ground.at(ground.width, place[None])[0] <= 0:
            break
        found.append(place)
    return np.array(found, np.float64).reshape(-1, 2)
