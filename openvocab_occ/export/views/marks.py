"""Numbers on things ("set of marks"): which things get one, and where it is written."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32, UInt8

LEAST_PIXELS = 150
"""Pixels below which a thing is not marked: its number would hide it."""
MOST = 20
"""Marks in one picture."""
_FONT_SCALE, _PAD = 0.7, 4  # digits 15 pixels high
_APART = 3  # pixels between tags
_ROOMY = 10  # a tag within its object covers at most a tenth of it
_ANGLES = 24
_REACHES = (26, 36, 48, 64, 84, 110, 140, 180)
_COVER, _CROSS, _ANCHOR = 90.0, 220.0, 120.0  # pixels of leader that a fault weighs as much as
BLACK, WHITE, GOLD = (0, 0, 0), (255, 255, 255), (255, 208, 0)


class Tag(NamedTuple):
    """A number in a picture."""

    mark: int
    box: tuple[int, int, int, int]
    """Left, top, right, bottom pixel, all inclusive."""
    anchor: tuple[float, float]
    """Pixel on the object that it speaks of."""
    leader: bool
    """The tag is not on its object, a line leads there."""


def tag_size(mark: int) -> tuple[int, int]:
    """Return width and height of a tag, pixels."""
    import cv2

    (width, height), _ = cv2.getTextSize(str(mark), cv2.FONT_HERSHEY_DUPLEX, _FONT_SCALE, 1)
    return width + 2 * _PAD, height + 2 * _PAD


def innermost(mask: Bool[np.ndarray, "h w"]) -> tuple[int, int, float]:
    """Return u, v of the pixel farthest from a mask's rim, and that distance; the picture's border is a rim too."""
    import cv2

    inner = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    v, u = np.unravel_index(int(inner.argmax()), inner.shape)
    return int(u), int(v), float(inner[v, u])


def place_tags(
    shape: tuple[int, int],
    anchors: Mapping[int, tuple[float, float]],
    areas: Int32[np.ndarray, "h w"],
) -> list[Tag]:
    """Find a place for each number where it covers no other, and little of what is marked.

    Args:
        shape: Height and width of the picture.
        anchors: Pixel (u, v) on its object for each mark; those first in the mapping choose first.
        areas: Mark that each pixel belongs to, 0 for none.

    Returns:
        Tags in the order of the anchors; marks for which there is no room are left out.
    """
    counts = np.bincount(areas.reshape(-1), minlength=max([0, *anchors]) + 1)
    total = np.pad(np.cumsum(np.cumsum(areas > 0, axis=0), axis=1), ((1, 0), (1, 0)))
    points = np.array(list(anchors.values()), np.float64).reshape(-1, 2)
    tags: list[Tag] = []
    for rank, (mark, anchor) in enumerate(anchors.items()):
        width, height = tag_size(mark)
        here = np.array(anchor, np.float64)
        roomy = counts[mark] >= _ROOMY * width * height and _fits(areas, mark, here, width, height)
        centers = here[None] if roomy else np.empty((0, 2))
        for candidates in (centers, here + _ring(width, height), _lattice(shape, width, height)):
            boxes = _boxes(candidates, width, height)
            boxes = boxes[_allowed(boxes, shape, tags)]
            if not len(boxes):
                continue
            cost = _costs(boxes, here, np.delete(points, rank, axis=0), tags, total)
            best = boxes[int(cost.argmin())]
            left, top, right, bottom = (int(x) for x in best)
            tags.append(Tag(mark, (left, top, right, bottom), (float(here[0]), float(here[1])), not roomy))
            break
    return tags


def draw_tags(
    image: UInt8[np.ndarray, "h w 3"], tags: Sequence[Tag], gold: Sequence[int] = ()
) -> UInt8[np.ndarray, "h w 3"]:  # fmt: skip
    """Return a picture with tags: white on black, black on gold for the marks in `gold`; leaders end in a dot."""
    import cv2

    drawn = image.copy()
    for tag in tags:
        if not tag.leader:
            continue
        left, top, right, bottom = tag.box
        start = round((left + right) / 2), round((top + bottom) / 2)
        end = round(tag.anchor[0]), round(tag.anchor[1])
        cv2.line(drawn, start, end, WHITE, 3, cv2.LINE_AA)
        cv2.line(drawn, start, end, BLACK, 1, cv2.LINE_AA)
        cv2.circle(drawn, end, 4, WHITE, -1, cv2.LINE_AA)
        cv2.circle(drawn, end, 3, BLACK, -1, cv2.LINE_AA)
    for tag in tags:
        left, top, right, bottom = tag.box
        back, front = (GOLD, BLACK) if tag.mark in gold else (BLACK, WHITE)
        cv2.rectangle(drawn, (left, top), (right, bottom), back, -1)
        cv2.rectangle(drawn, (left, top), (right, bottom), front, 1)
        at = (left + _PAD, bottom - _PAD)
        cv2.putText(drawn, str(tag.mark), at, cv2.FONT_HERSHEY_DUPLEX, _FONT_SCALE, front, 1, cv2.LINE_AA)
    return drawn


def _fits(areas: Int32[np.ndarray, "h w"], mark: int, center: Float64[np.ndarray, " 2"], width: int, height: int
          ) -> bool:  # fmt: skip
    """Tell whether a tag at a pixel lies on its object, most of it."""
    left, top, right, bottom = (int(x) for x in _boxes(center[None], width, height)[0])
    inside = areas[max(top, 0) : bottom + 1, max(left, 0) : right + 1] == mark
    return inside.size > 0 and float(inside.mean()) > 0.9


def _ring(width: int, height: int) -> Float64[np.ndarray, "n 2"]:
    """Return offsets around an anchor: above first, then alternating to both sides."""
    steps = np.arange(_ANGLES)
    turns = np.where(steps % 2, (steps + 1) // 2, -(steps // 2)) * (2 * np.pi / _ANGLES)
    reach = np.array(_REACHES, np.float64)
    shape = np.array([width, height]) / 2
    way = np.stack([np.sin(turns), -np.cos(turns)], axis=1)
    return (way[None] * (reach[:, None, None] + shape * 0.5)).reshape(-1, 2)


def _lattice(shape: tuple[int, int], width: int, height: int) -> Float64[np.ndarray, "n 2"]:
    """Return places all over the picture, for crowded ones."""
    u = np.arange(width / 2 + 1, max(shape[1] - width / 2 - 1, width / 2 + 2), width / 2 + 2)
    v = np.arange(height / 2 + 1, max(shape[0] - height / 2 - 1, height / 2 + 2), height / 2 + 2)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)


def _boxes(centers: Float[np.ndarray, "n 2"], width: int, height: int) -> Float64[np.ndarray, "n 4"]:
    corner = np.round(np.asarray(centers, np.float64) - np.array([width, height]) / 2)
    return np.concatenate([corner, corner + np.array([width - 1, height - 1])], axis=1)


def _allowed(boxes: Float64[np.ndarray, "n 4"], shape: tuple[int, int], tags: Sequence[Tag]) -> np.ndarray:
    good = (boxes[:, :2] >= 1).all(axis=1) & (boxes[:, 2] <= shape[1] - 2) & (boxes[:, 3] <= shape[0] - 2)
    for tag in tags:
        left, top, right, bottom = tag.box
        apart = (boxes[:, 0] > right + _APART) | (boxes[:, 2] < left - _APART)
        apart |= (boxes[:, 1] > bottom + _APART) | (boxes[:, 3] < top - _APART)
        good &= apart
    return good


def _costs(
    boxes: Float64[np.ndarray, "n 4"], here: Float64[np.ndarray, " 2"], others: Float64[np.ndarray, "m 2"],
    tags: Sequence[Tag], total: np.ndarray,
) -> Float64[np.ndarray, " n"]:  # fmt: skip
    """Return how bad each place is: length of the leader, what the tag covers, what the leader crosses."""
    centers = (boxes[:, :2] + boxes[:, 2:]) / 2
    cost = np.linalg.norm(centers - here, axis=1)
    a, b, c, d = boxes.astype(np.int64).T
    area = total[d + 1, c + 1] - total[b, c + 1] - total[d + 1, a] + total[b, a]
    cost += _COVER * area / ((c - a + 1) * (d - b + 1))
    for point in others:
        cost += _ANCHOR * _within(point[None], boxes, 4.0)
    along = np.linspace(0, 1, 24)[:, None, None]
    path = here + along * (centers - here)  # samples x places x 2
    for tag in tags:
        box = np.array(tag.box, np.float64)
        cost += _CROSS * np.any(_within(path, box[None], 2.0), axis=0)
        if tag.leader:
            middle = (box[:2] + box[2:]) / 2
            theirs = np.array(tag.anchor) + np.linspace(0, 1, 24)[:, None] * (middle - np.array(tag.anchor))
            cost += _CROSS * np.any([_within(point[None], boxes, 2.0) for point in theirs], axis=0)
            cost += _CROSS / 2 * _crossing(here, centers, np.array(tag.anchor), middle)
    return cost


def _within(points: Float64[np.ndarray, "*n 2"], boxes: Float64[np.ndarray, "m 4"], margin: float) -> np.ndarray:
    inside = (points[..., 0] >= boxes[:, 0] - margin) & (points[..., 0] <= boxes[:, 2] + margin)
    return inside & (points[..., 1] >= boxes[:, 1] - margin) & (points[..., 1] <= boxes[:, 3] + margin)


def _crossing(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Tell which segments from a to each b cross the one from c to d."""

    def side(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
        return (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])

    return (side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a[None]) * side(c, d, b) < 0)
