"""The pictures of a bundle."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int32, UInt8, UInt16

from openvocab_occ.export.draw import SKY, blend, outlines, shaded, to_pixels
from openvocab_occ.export.overhead import Overhead, wedge
from openvocab_occ.export.render import MapView
from openvocab_occ.export.surface import Surface
from openvocab_occ.export.views.contents import DEPTH_SCALE, MARGIN
from openvocab_occ.export.views.marks import BLACK, GOLD, WHITE, Tag, draw_tags, place_tags
from openvocab_occ.export.views.seen import SeenObject
from openvocab_occ.geometry import Camera, invert, transform
from openvocab_occ.objects.kinds import Kind, kind_of
from openvocab_occ.objects.tree import SceneObject

_UNKNOWN, _HATCH = (206, 206, 210), (186, 186, 192)
_CROP_EDGE = 192
_LARGE = 16.0  # square metres


def instance_image(view: MapView, seen: Sequence[SeenObject]) -> UInt16[np.ndarray, "h w"]:
    """Return each pixel's instance number, 0 where none."""
    table = np.zeros(max([0, *(one.object.id for one in seen)]) + 1, np.uint16)
    table[[one.object.id for one in seen]] = [one.instance for one in seen]
    return table[np.where(view.item < len(table), view.item, 0)]


def depth_image(view: MapView) -> UInt16[np.ndarray, "h w"]:
    """Return z-depth in steps of 1/256 m, 0 where nothing is met."""
    steps = np.clip(np.rint(view.depth * np.float32(DEPTH_SCALE)), 1, 65535)
    return np.where(view.voxel >= 0, steps, 0).astype(np.uint16)


def clean_view(filled: MapView, surface: Surface) -> UInt8[np.ndarray, "h w 3"]:
    """Return the labels with shaded faces; `filled` has no holes of one voxel."""
    return shaded(filled, surface.palette)


def marked_view(
    clean: UInt8[np.ndarray, "h w 3"], item: Int32[np.ndarray, "h w"], marks: Mapping[int, int], tags: Sequence[Tag],
    hits: Sequence[int],
) -> UInt8[np.ndarray, "h w 3"]:  # fmt: skip
    """Draw outlines of marked objects and their numbers; those of hits in gold."""
    image = clean.copy()
    blend(image, outlines(item, [id for id in marks if id not in hits]), WHITE)
    found = [id for id in marks if id in hits]
    if found:
        blend(image, outlines(item, found, 2), GOLD)
    return draw_tags(image, tags, [marks[id] for id in found])


def areas_of(item: Int32[np.ndarray, "h w"], marks: Mapping[int, int]) -> Int32[np.ndarray, "h w"]:
    """Return the mark of each pixel, 0 where none."""
    table = np.zeros(max([int(item.max(initial=0)), *marks]) + 1, np.int32)
    for id, mark in marks.items():
        table[id] = mark
    return table[item]


def overhead_base(overhead: Overhead, surface: Surface) -> UInt8[np.ndarray, "h w 3"]:
    """Return the labels from above: shaded by height steps, pale where seen to be empty, hatched where unknown."""
    height, width = overhead.voxel.shape
    table = np.vstack([surface.palette, np.array([SKY], np.uint8)])
    image = table[overhead.voxel]
    level = np.append(surface.keys[:, 2], -(1 << 20))[overhead.voxel]
    step = np.zeros((height, width), bool)  # an edge down to the right or below lies in the shade
    step[:, :-1] |= level[:, :-1] > level[:, 1:]
    step[:-1] |= level[:-1] > level[1:]
    blend(image, step & (overhead.voxel >= 0), BLACK, 0.35)
    v, u = np.mgrid[:height, :width]
    image[~overhead.seen] = _UNKNOWN
    image[~overhead.seen & ((u + v) % 9 < 2)] = _HATCH
    return image


def marked_overhead(
    overhead: Overhead, base: UInt8[np.ndarray, "h w 3"], camera: Camera, items: Mapping[int, SceneObject],
    points: Mapping[int, Float[np.ndarray, " 3"]], hits: Sequence[int], route: Float[np.ndarray, "n 2"] | None = None,
    *, marks: bool = True,
) -> tuple[UInt8[np.ndarray, "h2 w2 3"], list[Tag]]:  # fmt: skip
    """Draw grid, ego, field of view, route, outlines and numbers.

    Args:
        overhead: What each pixel shows.
        base: Its picture.
        camera: Whose field of view is drawn.
        items: Marked objects, by mark.
        points: Where each of them is pointed at, in the world, by mark.
        hits: Marks drawn in gold.
        route: A way in the world to draw.
        marks: Write numbers.
    """
    import cv2

    image = np.ascontiguousarray(base)
    _grid(image, overhead)
    if route is not None and len(route) > 1:
        line = np.concatenate([route, np.zeros((len(route), 1))], axis=1)
        path = np.array(to_pixels(overhead.pixels(line)), np.int32)
        cv2.polylines(image, [path], False, (235, 235, 60), 3, cv2.LINE_AA)
    _ego(image, overhead, camera)
    for mark, item in items.items():
        if mark not in hits and item.box.size[0] * item.box.size[1] > _LARGE and kind_of(item.label) == Kind.FIXED:
            continue  # the box of a front or a hedge lies over everything else
        corners = np.array(to_pixels(overhead.pixels(item.box.corners[:4])), np.int32)
        cv2.polylines(image, [corners], True, BLACK, 3, cv2.LINE_AA)
        cv2.polylines(image, [corners], True, GOLD if mark in hits else WHITE, 1, cv2.LINE_AA)
    tags: list[Tag] = []
    if marks and items:
        at = overhead.pixels(np.array([points[mark] for mark in items]))
        limit = [image.shape[1] - 1, image.shape[0] - 1]
        at = np.clip(at, 0, limit)
        anchors = {mark: (float(u), float(v)) for mark, (u, v) in zip(items, at, strict=True)}
        areas = areas_of(overhead.item, {item.id: mark for mark, item in items.items()})
        tags = place_tags(areas.shape, anchors, areas)
        image = draw_tags(image, tags, hits)
    return _with_axes(image, overhead), [_moved(tag) for tag in tags]


def crop(clean: UInt8[np.ndarray, "h w 3"], one: SeenObject, item: Int32[np.ndarray, "h w"]) -> np.ndarray:
    """Return an object and a quarter around it, enlarged to be seen, its outline white."""
    import cv2

    left, top, right, bottom = one.box
    pad = max(8, round(0.25 * max(right - left, bottom - top)))
    rows = slice(max(top - pad, 0), bottom + pad + 1)
    columns = slice(max(left - pad, 0), right + pad + 1)
    image = clean[rows, columns].copy()
    blend(image, outlines(item[rows, columns], [one.object.id]), WHITE)
    scale = _CROP_EDGE / max(image.shape[:2])
    size = max(round(image.shape[1] * scale), 1), max(round(image.shape[0] * scale), 1)
    way = cv2.INTER_NEAREST if scale > 1 else cv2.INTER_AREA
    return np.ascontiguousarray(cv2.resize(image, size, interpolation=way))


def _grid(image: UInt8[np.ndarray, "h w 3"], overhead: Overhead) -> None:
    extent = overhead.extent
    for x in np.arange(-extent.behind + 10, extent.ahead, 10):
        row = round((extent.ahead - x) / extent.pixel)
        blend(image, _line(image.shape, row, 0, bool(x == 0)), BLACK, 0.30)
    for y in np.arange(-extent.side + 10, extent.side, 10):
        column = round((extent.side - y) / extent.pixel)
        blend(image, _line(image.shape, column, 1, bool(y == 0)), BLACK, 0.30)


def _line(shape: tuple[int, ...], at: int, axis: int, bold: bool) -> Bool[np.ndarray, "h w"]:
    mask = np.zeros(shape[:2], bool)
    where = slice(max(at - 1, 0), at + (2 if bold else 0))
    mask[(where, slice(None)) if axis == 0 else (slice(None), where)] = True
    return mask


def _ego(image: UInt8[np.ndarray, "h w 3"], overhead: Overhead, camera: Camera) -> None:
    """Draw the field of view and an arrow at the ego, 4.6 m long."""
    import cv2

    T_ego_cam = invert(overhead.T_world_ego) @ camera.T_world_cam
    at = T_ego_cam[:2, 3]
    if camera.lens == "pinhole" and abs(T_ego_cam[2, 2]) < 0.9:
        reach = max(overhead.extent.ahead, overhead.extent.side) * 2
        for direction in wedge(camera.K, camera.width, T_ego_cam[:3, :3]):
            end = at + reach * np.array([np.cos(direction), np.sin(direction)])
            a, b = to_pixels(overhead.ego_pixels(np.stack([at, end])))
            cv2.line(image, a, b, WHITE, 3, cv2.LINE_AA)
            cv2.line(image, a, b, (40, 40, 40), 1, cv2.LINE_AA)
    arrow = np.array([[3.2, 0.0], [-1.4, 1.3], [-0.5, 0.0], [-1.4, -1.3]])
    shape = np.array(to_pixels(overhead.ego_pixels(arrow)), np.int32)
    cv2.fillPoly(image, [shape], BLACK, cv2.LINE_AA)
    cv2.polylines(image, [shape], True, WHITE, 1, cv2.LINE_AA)


def _with_axes(image: UInt8[np.ndarray, "h w 3"], overhead: Overhead) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Add the margins, with x at the left and y below."""
    import cv2

    left, below = MARGIN
    extent = overhead.extent
    out = np.full((image.shape[0] + below, image.shape[1] + left, 3), 255, np.uint8)
    out[: image.shape[0], left:] = image
    for x in np.arange(-extent.behind + 10, extent.ahead, 10):
        row = round((extent.ahead - x) / extent.pixel)
        _text(out, f"{x:.0f}", left - 5, row + 5, right=True)
    for y in np.arange(-extent.side + 10, extent.side, 10):
        column = round((extent.side - y) / extent.pixel) + left
        text = f"{y:.0f}"
        (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
        _text(out, text, column - width // 2, image.shape[0] + 18)
    _text(out, "x m", 4, 16)
    _text(out, "y m", 4, image.shape[0] + 18)
    return out


def _text(image: UInt8[np.ndarray, "h w 3"], text: str, u: int, v: int, *, right: bool = False) -> None:
    import cv2

    if right:
        u -= cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0]
    cv2.putText(image, text, (u, v), cv2.FONT_HERSHEY_SIMPLEX, 0.5, BLACK, 1, cv2.LINE_AA)


def _moved(tag: Tag) -> Tag:
    """Return a tag where it is in the picture with margins."""
    left, top, right, bottom = tag.box
    return Tag(tag.mark, (left + MARGIN[0], top, right + MARGIN[0], bottom), (tag.anchor[0] + MARGIN[0], tag.anchor[1]),
               tag.leader)  # fmt: skip


def ego_points_of(T_world_ego: Float[np.ndarray, "4 4"], points: Iterable[np.ndarray]) -> Float[np.ndarray, "n 2"]:
    """Return points of the world along the ground of the ego frame."""
    return transform(invert(T_world_ego), np.array(list(points), np.float64).reshape(-1, 3))[:, :2]
