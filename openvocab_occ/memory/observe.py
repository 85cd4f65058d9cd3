"""From a frame of a drive to what is written into the map."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from openvocab_occ.datasets.frame import Frame
from openvocab_occ.errors import GridError
from openvocab_occ.geometry import Camera, GridSpec
from openvocab_occ.occupancy import OccupancyGrid, cast_rays

CONFIDENCE = 6.0
"""Logit of the label of a grid without scores, the other classes having 0."""


@dataclass(frozen=True, eq=False)
class Observation:
    """Logits of a grid at a pose, and which of them were seen."""

    logits: Float32[np.ndarray, "x y z classes"]
    mask: Bool[np.ndarray, "x y z"]
    T_world_grid: Float[np.ndarray, "4 4"]
    spec: GridSpec
    time: float


def observe(frame: Frame) -> Observation:
    """Return the frame's occupancy, masked to what its cameras see; without cameras, to what the grid knows.

    Raises:
        GridError: The frame has no occupancy.
    """
    grid = frame.occupancy
    if grid is None:
        raise GridError(
            f"frame {frame.index} has no occupancy", expected="a grid", fix="give --occupancy PATTERN of your own grids"
        )
    mask = np.ones(grid.spec.shape, dtype=np.bool_) if grid.known is None else grid.known.copy()
    if frame.views:
        mask &= np.any([seen_by(view.camera, grid) for view in frame.views], axis=0)
    logits = grid.logits
    if logits is None:
        logits = np.eye(len(grid.class_names), dtype=np.float32)[grid.labels] * np.float32(CONFIDENCE)
    return Observation(logits, mask, grid.T_world_grid, grid.spec, frame.timestamp)


def seen_by(camera: Camera, grid: OccupancyGrid) -> Bool[np.ndarray, "x y z"]:
    """Tell which voxels a camera sees (LMPOcc III-D).

    Of the ray to each voxel's centre the first occupied voxel is seen, and the centre's own where nothing is before it.
    """
    index = np.stack(np.meshgrid(*(np.arange(n) for n in grid.spec.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    points = grid.spec.centers(index) @ grid.T_world_grid[:3, :3].T + grid.T_world_grid[:3, 3]
    pixels, depth = camera.project(points)
    with np.errstate(invalid="ignore"):
        inside = np.flatnonzero(camera.inside(pixels) & (depth > 0.1))
    way = points[inside] - camera.position
    hits = cast_rays(grid, camera.position, way)
    seen = np.zeros(len(points), dtype=np.bool_)
    seen[hits.voxel[hits.voxel >= 0]] = True
    seen[inside] |= (hits.voxel == inside) | (hits.voxel < 0) | (hits.distance > np.linalg.norm(way, axis=1))
    return seen.reshape(grid.spec.shape)
