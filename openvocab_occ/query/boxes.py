"""Upright boxes as arrays, and the distances between them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from openvocab_occ.objects.tree import SceneObject

_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
_GRID = np.stack(np.meshgrid(*[(np.arange(5) + 0.5) / 5 - 0.5] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
"""Samples of a footprint, as shares of its length and width."""


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes turned about the vertical; each row is one."""

    center: Float64[np.ndarray, "n 3"]
    size: Float64[np.ndarray, "n 3"]
    """Length (along yaw), width, height, metres."""
    yaw: Float64[np.ndarray, " n"]

    @classmethod
    def of(cls, objects: Sequence[SceneObject]) -> "Boxes":
        """Collect the boxes of objects."""
        boxes = [item.box for item in objects]
        return cls(
            np.array([box.center for box in boxes], dtype=np.float64).reshape(-1, 3),
            np.array([box.size for box in boxes], dtype=np.float64).reshape(-1, 3),
            np.array([box.yaw for box in boxes], dtype=np.float64),
        )

    def __len__(self) -> int:
        return len(self.yaw)

    def take(self, rows: Int64[np.ndarray, " m"] | Bool[np.ndarray, " n"] | slice) -> "Boxes":
        """Return some rows."""
        return Boxes(self.center[rows], self.size[rows], self.yaw[rows])

    @cached_property
    def axes(self) -> Float64[np.ndarray, "n 2 2"]:
        """Directions of length and width on the ground, one a column."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)

    @cached_property
    def bottom(self) -> Float64[np.ndarray, " n"]:
        """Lowest z."""
        return self.center[:, 2] - self.size[:, 2] / 2

    @cached_property
    def top(self) -> Float64[np.ndarray, " n"]:
        """Highest z."""
        return self.center[:, 2] + self.size[:, 2] / 2

    @cached_property
    def radius(self) -> Float64[np.ndarray, " n"]:
        """Of the circle around the footprint."""
        return np.hypot(self.size[:, 0], self.size[:, 1]) / 2

    def footprint(self, shares: Float[np.ndarray, "k 2"]) -> Float64[np.ndarray, "n k 2"]:
        """Return points of each footprint, given as shares of length and width from the centre."""
        local = shares * self.size[:, None, :2]
        return self.center[:, None, :2] + np.einsum("nij,nkj->nki", self.axes, local)

    @cached_property
    def corners(self) -> Float64[np.ndarray, "n 4 2"]:
        """Corners on the ground."""
        return self.footprint(_CORNERS)

    @cached_property
    def samples(self) -> Float64[np.ndarray, "n 25 2"]:
        """Points spread over each footprint."""
        return self.footprint(_GRID)

    def local(self, points: Float[np.ndarray, "n k 2"]) -> Float64[np.ndarray, "n k 2"]:
        """Return points of the ground along length and width of the box of their row, from its centre."""
        return np.einsum("nij,nki->nkj", self.axes, points - self.center[:, None, :2])

    def nearest(self, points: Float[np.ndarray, "n k 2"]) -> Float64[np.ndarray, "n k 2"]:
        """Return the points of each footprint nearest to points of the ground."""
        half = self.size[:, None, :2] / 2
        clamped = np.clip(self.local(points), -half, half)
        return self.center[:, None, :2] + np.einsum("nij,nkj->nki", self.axes, clamped)


def repeated(boxes: Boxes, count: int) -> Boxes:
    """Return one box many times, without copying."""
    return Boxes(
        np.broadcast_to(boxes.center, (count, 3)),
        np.broadcast_to(boxes.size, (count, 3)),
        np.broadcast_to(boxes.yaw, (count,)),
    )


def ground_gap(a: Boxes, b: Boxes) -> Float64[np.ndarray, " n"]:
    """Return the distance between the footprints of each row, 0 where they meet.

    Of two rectangles apart, a corner of one is nearest to the other; they meet if no axis of either separates them.
    """
    from_a = np.linalg.norm(a.corners - b.nearest(a.corners), axis=-1).min(axis=1)
    from_b = np.linalg.norm(b.corners - a.nearest(b.corners), axis=-1).min(axis=1)
    return np.where(_apart(a, b) | _apart(b, a), np.minimum(from_a, from_b), 0.0)


def _apart(a: Boxes, b: Boxes) -> Bool[np.ndarray, " n"]:
    """Tell whether an axis of a separates the footprints."""
    local, half = a.local(b.corners), a.size[:, :2] / 2
    return ((local.min(axis=1) > half) | (local.max(axis=1) < -half)).any(axis=1)


def height_gap(a: Boxes, b: Boxes) -> Float64[np.ndarray, " n"]:
    """Return the vertical distance of each row, negative by how far the heights overlap."""
    return np.maximum(a.bottom - b.top, b.bottom - a.top)


def gap(a: Boxes, b: Boxes) -> Float64[np.ndarray, " n"]:
    """Return the distance between the boxes of each row, metres, 0 where they meet."""
    return np.hypot(ground_gap(a, b), np.maximum(height_gap(a, b), 0.0))


def cover(a: Boxes, b: Boxes) -> Float64[np.ndarray, " n"]:
    """Return the share of each footprint of a that lies over that of b, in 25ths."""
    inside = np.abs(b.local(a.samples)) <= b.size[:, None, :2] / 2 + 1e-6
    return inside.all(axis=2).mean(axis=1)
