"""A map from straight above, ego-centred: x (ahead) is up, y (left) is left."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32, Int64

from openvocab_occ.export.surface import Surface
from openvocab_occ.geometry import invert, transform
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.query.coverage import CELL, coverage_of

CEILING = 4.0
"""Metres above the ground from which on nothing is drawn, so that crowns of trees hide no cars."""


@dataclass(frozen=True)
class Extent:
    """How far a picture from above reaches, metres from the ego."""

    ahead: float
    behind: float
    side: float
    """To the left, and as far to the right."""
    pixel: float
    """Edge of a pixel, metres."""

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, pixels."""
        return round((self.ahead + self.behind) / self.pixel), round(2 * self.side / self.pixel)

    @classmethod
    def around(cls, points: Float[np.ndarray, "n 2"], *, longest: int = 1000, reach: float = 100.0) -> "Extent":
        """Return an extent of whole tens of metres that holds points of the ego frame, but none beyond `reach`."""
        near = np.clip(np.concatenate([points, np.zeros((1, 2))]), -reach, reach)
        ahead = float(np.ceil(max(near[:, 0].max() + 6.0, 30.0) / 10) * 10)
        behind = float(np.ceil(max(-near[:, 0].min() + 6.0, 10.0) / 10) * 10)
        side = float(np.ceil(max(np.abs(near[:, 1]).max() + 6.0, 20.0) / 10) * 10)
        return cls(ahead, behind, side, max(ahead + behind, 2 * side) / longest)


@dataclass(frozen=True, eq=False)
class Overhead:
    """What each pixel shows."""

    extent: Extent
    T_world_ego: Float[np.ndarray, "4 4"]
    """Level."""
    voxel: Int32[np.ndarray, "h w"]
    """Row of the highest voxel of the surface below the ceiling, -1 where none."""
    item: Int32[np.ndarray, "h w"]
    seen: Bool[np.ndarray, "h w"]
    """Somebody looked there; the rest is unknown."""

    def pixels(self, points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
        """Return pixels (u, v) of points of the world."""
        return self.ego_pixels(transform(invert(self.T_world_ego), points)[:, :2])

    def ego_pixels(self, xy: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        """Return pixels of points of the ego frame: pixel centres are integers, the ego is between two of them."""
        u = (self.extent.side - np.asarray(xy)[:, 1]) / self.extent.pixel - 0.5
        v = (self.extent.ahead - np.asarray(xy)[:, 0]) / self.extent.pixel - 0.5
        return np.stack([u, v], axis=1)


def render_overhead(
    scene: SceneMap, surface: Surface, T_world_ego: Float[np.ndarray, "4 4"], extent: Extent, *, ground: float
) -> Overhead:
    """Look from straight above at what is lower than `CEILING` above the ground, whose height in the world is given."""
    height, width = extent.shape
    flat = level(T_world_ego)
    v, u = np.mgrid[:height, :width]
    local = np.stack(
        [extent.ahead - (v + 0.5) * extent.pixel, extent.side - (u + 0.5) * extent.pixel], axis=-1
    )  # fmt: skip
    places = local @ flat[:2, :2].T + flat[:2, 3]
    seen = _seen(scene, places)
    cells = np.floor(places / surface.voxel_size).astype(np.int64)
    low, high = cells.reshape(-1, 2).min(axis=0), cells.reshape(-1, 2).max(axis=0) + 1
    rows = _column_rows(surface, low, high, int(np.floor((ground + CEILING) / surface.voxel_size)))
    table = np.full(tuple(high - low), -1, np.int32)
    table[tuple((surface.keys[rows, :2] - low).T)] = rows  # the highest is written last
    voxel = table[tuple(np.moveaxis(cells - low, -1, 0))]
    item = np.append(surface.item, np.int32(0))[voxel]
    return Overhead(extent, flat, voxel, item, seen | (voxel >= 0))


def _column_rows(
    surface: Surface, low: Int64[np.ndarray, " 2"], high: Int64[np.ndarray, " 2"], top: int
) -> Int64[np.ndarray, " n"]:
    """Return the rows of the voxels over a rectangle and below a height, the lowest first."""
    x, y, z = surface.keys.T
    rows = np.flatnonzero((x >= low[0]) & (x < high[0]) & (y >= low[1]) & (y < high[1]) & (z < top))
    return rows[np.argsort(z[rows], kind="stable")]


def _seen(scene: SceneMap, places: Float[np.ndarray, "h w 2"]) -> Bool[np.ndarray, "h w"]:
    """Tell which places lie in an observed square; each square is asked once."""
    cells = np.floor(places / CELL).astype(np.int64)
    low, high = cells.reshape(-1, 2).min(axis=0), cells.reshape(-1, 2).max(axis=0) + 1
    squares = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True)), indexing="ij"), axis=-1)
    known = coverage_of(scene).seen((squares.reshape(-1, 2) + 0.5) * CELL).reshape(squares.shape[:2])
    return known[tuple(np.moveaxis(cells - low, -1, 0))]


def level(T_world_ego: Float[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
    """Return a pose turned so that its z axis is the world's."""
    heading = np.arctan2(T_world_ego[1, 0], T_world_ego[0, 0])
    T = np.eye(4)
    T[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    T[:3, 3] = T_world_ego[:3, 3]
    return T


def wedge(K: Float[np.ndarray, "3 3"], width: int, R_ego_cam: Float[np.ndarray, "3 3"]) -> Sequence[float]:
    """Return the directions of the left and the right border of a pinhole's picture, radians against ahead."""
    ends = []
    for u in (-0.5, width - 0.5):
        ray = R_ego_cam @ np.array([(u - K[0, 2]) / K[0, 0], 0.0, 1.0])
        ends.append(float(np.arctan2(ray[1], ray[0])))
    return ends
