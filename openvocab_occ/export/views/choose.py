"""Which places show most: along the drive, ahead on the road, of one object, of many. The same map, the same places."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from openvocab_occ.errors import ConfigError
from openvocab_occ.export.render import Renderer, pinhole, renderer_of
from openvocab_occ.export.route import Route, route_ahead
from openvocab_occ.export.views.lookout import (
    FRONT,
    Lookout,
    at_frame,
    fitted,
    front_of,
    ground_height,
    levelled,
    standing_at,
)
from openvocab_occ.export.views.marks import LEAST_PIXELS
from openvocab_occ.export.views.seen import visibility
from openvocab_occ.geometry import Camera, look_at
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.tree import OBJECT, SceneObject
from openvocab_occ.query.coverage import coverage_of

_PREVIEW = 4  # pictures are judged at a quarter of their size
_EYE = 1.6  # metres above the ground
_AZIMUTHS, _DISTANCES = 16, (0.0, 6.0, 14.0)  # directions; metres added to the nearest that shows all
_FOV = np.deg2rad(43.0)
_FAR = 60.0  # metres within which a recorded camera is tried
_CLEAR = 0.6  # metres around a camera that must be free
_BACK = 12  # metres that a stand may be moved back out of a thing
_RECORDED = 96  # cameras of the drive that are tried


@dataclass(frozen=True, eq=False)
class Covering:
    """A few views that together show many objects."""

    lookouts: tuple[Lookout, ...]
    shown: dict[int, int]
    """Which of the lookouts shows an object best, by its id."""
    missed: tuple[int, ...]
    """Ids of objects that none shows with enough pixels."""


def along_trajectory(
    scene: SceneMap, *, spacing: float = 20.0, camera: str = FRONT, width: int = 1024, height: int = 576
) -> list[Lookout]:
    """Return a camera's stands along the drive, at least `spacing` metres apart.

    Raises ConfigError where the map keeps no such camera, or the spacing is no length.
    """
    if not (np.isfinite(spacing) and spacing >= 0):
        raise ConfigError("spacing is not usable", expected="metres, 0 or more", got=spacing)
    found: list[Lookout] = []
    last: np.ndarray | None = None
    way = 0.0
    for frame in scene.frames:
        chosen = next((one for one in frame.cameras if one.name == camera), None)
        if chosen is None:
            continue
        place = frame.T_world_ego[:3, 3]
        if last is not None and np.linalg.norm(place - last) < spacing:
            continue
        way += 0.0 if last is None else float(np.linalg.norm(place - last))
        last = place
        stand = at_frame(frame, chosen, width, height)
        reason = f"{camera} of frame {frame.index}, {way:.0f} m along the drive"
        found.append(replace(stand, name=f"frame_{frame.index:03d}_{camera.lower()}", method="trajectory",
                             reason=reason))  # fmt: skip
    if not found:
        known = sorted({one.name for frame in scene.frames for one in frame.cameras})
        raise ConfigError("the map keeps no such camera", expected=" or ".join(known) or "any camera", got=camera)
    return found


def ahead(
    scene: SceneMap, distance: float, *, frame: int | None = None, width: int = 1024, height: int = 576,
    route: Route | None = None,
) -> Lookout:  # fmt: skip
    """Stand so many metres ahead of the ego on the road, looking along it: the upcoming road conditions.

    Where something stands there, the place is moved back along the way until the camera is free.

    Raises ConfigError where the known way is shorter than that.
    """
    way = route or route_ahead(scene, frame=frame, length=distance + 20.0)
    if not 0 <= distance <= way.length:
        raise ConfigError("the way ahead does not reach so far", expected=f"0 to {way.length:.0f} m", got=distance)
    tried = [distance - step for step in range(_BACK + 1) if distance - step >= 0] or [distance]
    for station in tried:
        stand = standing_at(scene, way.pose(station), width, height)
        if _is_clear(scene, stand.camera.position):
            break
    else:
        station, stand = distance, standing_at(scene, way.pose(distance), width, height)
    moved = f", moved back {distance - station:.0f} m out of what stands there" if station != distance else ""
    source = "driven" if station <= way.driven else "read from the road"
    return replace(stand, name=f"ahead_{distance:.0f}m", method="ahead",
                   reason=f"{distance:.0f} m ahead on the way ({source} there){moved}")  # fmt: skip


def looking_at(scene: SceneMap, id: int, *, width: int = 1024, height: int = 576, recorded: bool = True) -> Lookout:
    """Return the view of an object that shows most of it, among recorded cameras and places around it.

    Places around it lie on observed ground at eye height, with room about them. What counts is the share that is not
    hidden or cut off by the border; of equal ones the picture with most of its pixels, up to a quarter of it.

    Raises ConfigError for an object that is not there or has no voxels to show.
    """
    item = _thing(scene, id)
    best: tuple[tuple[float, float], Lookout] | None = None
    tried = 0
    for stand in _stands_for(scene, item, width, height, recorded=recorded):
        tried += 1
        worth = _worth(renderer_of(scene), stand.camera, id)
        if best is None or worth > best[0]:
            best = worth, stand
    if best is None or best[0][0] <= 0:
        raise ConfigError(f"no view shows object {id}", expected="a free place to see it from", got=f"{tried} tried")
    share = best[0][0]
    return replace(best[1], name=f"object_{id}", method="object",
                   reason=f"shows {share:.0%} of object {id} ({item.label or 'unnamed'}), best of {tried}: "
                   f"{best[1].reason}")  # fmt: skip


def covering(scene: SceneMap, ids: Iterable[int], *, limit: int = 6, width: int = 1024, height: int = 576) -> Covering:
    """Return few views that show many objects, each with enough pixels to be marked and half of it not hidden.

    Greedy: the camera of the drive that shows most of those not shown yet comes first (ln n + 1 times as many views as
    the best choice at worst). What no camera of the drive shows gets a view of its own.
    """
    wanted = [id for id in dict.fromkeys(ids) if _can_show(scene, id)]
    missing = [id for id in dict.fromkeys(ids) if id not in wanted]
    stands = _recorded(scene, width, height)
    renderer = renderer_of(scene)
    shows = [_shown(renderer, stand.camera, wanted) for stand in stands]
    chosen: list[Lookout] = []
    pixels: list[dict[int, int]] = []
    left = list(wanted)
    while left and len(chosen) < limit:
        gains = [(sum(id in seen for id in left), sum(seen.get(id, 0) for id in left)) for seen in shows]
        best = max(range(len(gains)), key=lambda k: (*gains[k], -k), default=None)
        if best is None or not gains[best][0]:
            break
        got = [id for id in left if id in shows[best]]
        reason = f"{stands[best].reason}; shows objects {', '.join(map(str, got))}"
        chosen.append(replace(stands[best], name=f"cover_{len(chosen) + 1}", method="cover", reason=reason))
        pixels.append(shows[best])
        left = [id for id in left if id not in got]
    for id in list(left):
        if len(chosen) >= limit:
            break
        try:
            stand = looking_at(scene, id, width=width, height=height, recorded=False)
        except ConfigError:
            continue
        seen = _shown(renderer, stand.camera, wanted)
        if id not in seen:
            continue
        chosen.append(replace(stand, name=f"cover_{len(chosen) + 1}", method="cover"))
        pixels.append(seen)
        left = [other for other in left if other not in seen]
    missing += left
    shown = {
        id: max((k for k, seen in enumerate(pixels) if id in seen), key=lambda k: (pixels[k][id], -k))
        for id in wanted
        if any(id in seen for seen in pixels)
    }
    return Covering(tuple(chosen), shown, tuple(id for id in missing if id not in shown))


def _thing(scene: SceneMap, id: int) -> SceneObject:
    item = scene.objects[id]
    if not _can_show(scene, id):
        raise ConfigError(f"object {id} cannot be shown", expected="an object with voxels of its own", got=item.level)
    return item


def _can_show(scene: SceneMap, id: int) -> bool:
    if scene.objects[id].level != OBJECT:
        return False
    return id in renderer_of(scene).surface.rows_by_item


def _recorded(scene: SceneMap, width: int, height: int) -> list[Lookout]:
    """Return cameras of the drive: all of some frames, spread evenly, front cameras first."""
    frames = [frame for frame in scene.frames if frame.cameras]
    if not frames:
        return []
    count = max(1, _RECORDED // max(len(frame.cameras) for frame in frames))
    picked = sorted({round(k * (len(frames) - 1) / max(count - 1, 1)) for k in range(min(count, len(frames)))})
    stands = [
        at_frame(frames[k], camera, width, height)
        for k in picked
        for camera in sorted(frames[k].cameras, key=lambda c: c is not front_of(frames[k]))
    ]
    return sorted(stands, key=lambda stand: not stand.name.startswith(FRONT))


def _stands_for(scene: SceneMap, item: SceneObject, width: int, height: int, *, recorded: bool) -> Iterable[Lookout]:
    """Yield cameras of the drive that may see an object, and places around it."""
    rows = renderer_of(scene).surface.rows_by_item[item.id]
    target = renderer_of(scene).surface.centers[rows].mean(axis=0)
    if recorded:
        for frame in scene.frames:
            for camera in frame.cameras:
                pixels, depth = camera.project(target[None])
                if 0 < depth[0] < _FAR and camera.inside(pixels)[0]:
                    yield replace(at_frame(frame, camera, width, height), name=camera.name)
    radius = float(np.linalg.norm(np.ptp(renderer_of(scene).surface.centers[rows], axis=0))) / 2
    nearest = radius / np.tan(_FOV / 2) + radius + 1.0
    floor = ground_height(scene, target[:2])
    for more in _DISTANCES:
        for k in range(_AZIMUTHS):
            turn = 2 * np.pi * k / _AZIMUTHS
            place = np.array([*(target[:2] + (nearest + more) * np.array([np.cos(turn), np.sin(turn)])), floor + _EYE])
            if not coverage_of(scene).seen(place[None, :2])[0] or not _is_clear(scene, place):
                continue
            camera = pinhole(width, height, _FOV, look_at(place, target))
            T = levelled(camera)
            T[2, 3] = floor
            reason = f"{nearest + more:.0f} m from it, {np.degrees(turn):.0f} degrees from the world's x axis"
            yield Lookout(camera=camera, T_world_ego=T, reason=reason)


def _is_clear(scene: SceneMap, position: Float[np.ndarray, " 3"]) -> bool:
    """Tell whether nothing is drawn within some way of a place."""
    surface = renderer_of(scene).surface
    if not len(surface):
        return True
    return bool((np.abs(surface.centers - position).max(axis=1) > _CLEAR).all())


def _preview(camera: Camera) -> Camera:
    return fitted(camera, max(camera.width // _PREVIEW, 16), max(camera.height // _PREVIEW, 16))


def _worth(renderer: Renderer, camera: Camera, id: int) -> tuple[float, float]:
    """Return how much of an object a camera shows, in twentieths, and the share of the picture that it fills."""
    small = _preview(camera)
    view = renderer.view(small)
    pixels = int(np.count_nonzero(view.item == id))
    if not pixels:
        return 0.0, 0.0
    seen = visibility(view, id, 100.0)
    share = seen.fraction * (0.5 if seen.truncated else 1.0)
    return round(share * 20) / 20, min(pixels / view.item.size, 0.25)


def _shown(renderer: Renderer, camera: Camera, ids: Sequence[int]) -> dict[int, int]:
    """Return the pixels of the objects that a camera shows well, as in the whole picture."""
    small = _preview(camera)
    scale = camera.width * camera.height / (small.width * small.height)
    view = renderer.view(small)
    counts = np.bincount(np.maximum(view.item, 0).reshape(-1), minlength=max([0, *ids]) + 1)
    large = [id for id in ids if counts[id] * scale >= LEAST_PIXELS]
    return {id: int(counts[id] * scale) for id in large if visibility(view, id, 100.0).fraction >= 0.5}
