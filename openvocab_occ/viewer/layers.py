"""The map as nodes of a viser scene: tiled points, boxes of hits, the path of the drive."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from jaxtyping import Float, Float32, Int64, UInt8

from openvocab_occ.errors import ConfigError
from openvocab_occ.export.palette import grey, paint_labels, paint_numbers
from openvocab_occ.export.semantics import name_voxels
from openvocab_occ.mapping.voxel_map import VoxelMap
from openvocab_occ.objects.box import Box
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.tree import SceneObject

if TYPE_CHECKING:
    import viser

ColorMode = Literal["image", "semantic", "height", "relevance"]
COLOR_MODES: tuple[str, ...] = get_args(ColorMode)
TILE_EDGE = 32.0  # metres; points go to the browser as float16, which is within 8 mm at 16 m from a tile's centre
HIT_COLOR = (255, 64, 0)
_WALL_SHADE = 0.82
_PATH_COLOR = (20, 110, 160)
_EDGES = np.array(
    [(i, (i + 1) % 4) for i in range(4)] + [(4 + i, 4 + (i + 1) % 4) for i in range(4)] + [(i, 4 + i) for i in range(4)]
)


@dataclass(frozen=True, eq=False)
class Tile:
    """Voxels of one cube of space."""

    name: str
    """Name of its node in the scene."""
    center: Float[np.ndarray, " 3"]
    """Middle of the cube, world, metres; the node is put here."""
    voxels: Int64[np.ndarray, " n"]
    """Positions in the map."""
    points: Float32[np.ndarray, "n 3"]
    """Their centres relative to `center`."""


def tile_voxels(centers: Float[np.ndarray, "n 3"], edge: float = TILE_EDGE) -> list[Tile]:
    """Sort voxels into cubes of this edge; each voxel is in exactly one."""
    if not len(centers):
        return []
    cells, members = np.unique(np.floor(centers / edge).astype(np.int64), axis=0, return_inverse=True)
    members = members.reshape(-1)
    order = np.argsort(members, kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(members))[:-1])
    tiles = []
    for cell, voxels in zip(cells, groups, strict=True):
        center = (cell + 0.5) * edge
        name = "/map/tile_{}_{}_{}".format(*cell).replace("-", "m")
        tiles.append(Tile(name, center, voxels, (centers[voxels] - center).astype(np.float32)))
    return tiles


def voxel_colors(
    scene: SceneMap, mode: str, scores: Float32[np.ndarray, " n"] | None = None
) -> UInt8[np.ndarray, "n 3"]:
    """Return the colour of each voxel.

    `image` is the colour the cameras saw, `semantic` that of its label, a little darker on walls; `height` runs from
    the 1st to the 99th percentile; `relevance` from the least of `scores`, grey, to the greatest.
    """
    voxels = scene.voxels
    if mode == "image":
        return voxels.colors
    if mode == "semantic":
        semantics = name_voxels(scene)
        return shade_walls(voxels, paint_labels(semantics.labels, semantics.names))
    if mode == "height":
        return paint_numbers(voxels.centers[:, 2], *height_range(scene), "viridis")
    if mode == "relevance":
        if scores is None:
            raise ConfigError("relevance needs a query", expected="a score for each voxel")
        low, high = score_range(scores)
        weight = np.clip(3 * (scores - low) / max(high - low, 1e-12), 0, 1)[:, None]  # grey below, pure from a third on
        heat = paint_numbers(scores.astype(np.float64), low, high, "plasma")
        ground = shade_walls(voxels, grey(voxels.colors))
        return (weight * heat + (1 - weight) * ground).astype(np.uint8)
    raise ConfigError("colour mode is not known", expected=" or ".join(COLOR_MODES), got=mode)


def shade_walls(voxels: VoxelMap, colors: UInt8[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Darken voxels that have another above them, so that flat colours still show shapes."""
    covered = voxels.index(voxels.keys + np.array([0, 0, 1], np.int32)) >= 0
    return np.where(covered[:, None], (colors * _WALL_SHADE).astype(np.uint8), colors)


def height_range(scene: SceneMap) -> tuple[float, float]:
    """Return the heights, metres, that `height` colours run between."""
    z = scene.voxels.centers[:, 2]
    low, high = np.percentile(z, (1, 99)) if len(z) else (0.0, 1.0)
    return float(low), float(high)


def score_range(scores: Float32[np.ndarray, " n"]) -> tuple[float, float]:
    """Return the least and the greatest finite score."""
    finite = scores[np.isfinite(scores)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)


def grey_but(colors: UInt8[np.ndarray, "n 3"], objects: Sequence[SceneObject]) -> UInt8[np.ndarray, "n 3"]:
    """Return the colours with every voxel greyed that is in none of the objects."""
    pale = grey(colors)
    for item in objects:
        pale[item.voxels] = colors[item.voxels]
    return pale


def box_edges(box: Box, margin: float = 0.0) -> Float32[np.ndarray, "12 2 3"]:
    """Return the ends of the twelve edges of a box, world, this many metres outside it."""
    return Box(box.center, box.size + 2 * margin, box.yaw).corners[_EDGES].astype(np.float32)


def draw_map(
    nodes: "viser.SceneApi", tiles: Sequence[Tile], colors: UInt8[np.ndarray, "n 3"], voxel_size: float
) -> "list[viser.PointCloudHandle]":
    """Add the tiles as flat squares of the voxels' size.

    On a client's own scene they cover the shared ones of the same name, for that client alone.
    """
    return [
        nodes.add_point_cloud(
            tile.name,
            tile.points,
            colors[tile.voxels],
            point_size=voxel_size,
            point_shape="square",
            point_shading="flat",
            position=tile.center,
        )
        for tile in tiles
    ]


def draw_path(nodes: "viser.SceneApi", positions: Float[np.ndarray, "n 3"]) -> None:
    """Add the way of the ego through the map as a line, if it moved."""
    if len(positions) > 1:
        segments = np.stack([positions[:-1], positions[1:]], axis=1).astype(np.float32)  # [n - 1, 2, 3]
        nodes.add_line_segments("/path", segments, _PATH_COLOR, thickness=3.0, thickness_units="screen")


def draw_hits(
    nodes: "viser.SceneApi", objects: Sequence[SceneObject], captions: Sequence[str], margin: float
) -> "list[viser.SceneNodeHandle]":
    """Add a box `margin` metres around each object and a caption above the first ones; return the nodes."""
    if not objects:
        return []
    edges = np.concatenate([box_edges(item.box, margin) for item in objects])
    drawn: list[viser.SceneNodeHandle] = [
        nodes.add_line_segments("/hits/edges", edges, HIT_COLOR, thickness=3.0, thickness_units="screen")
    ]
    for rank, (item, caption) in enumerate(zip(objects, captions, strict=False), start=1):
        top = item.center + np.array([0.0, 0.0, item.box.size[2] / 2 + 0.4])
        drawn.append(nodes.add_label(f"/hits/label_{rank}", caption, position=top, anchor="bottom-center"))
    return drawn
