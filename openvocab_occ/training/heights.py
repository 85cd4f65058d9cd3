"""What height each pixel of a feature map looks at: the truth of DHD's height prediction."""

import numpy as np
from jaxtyping import UInt8

from openvocab_occ.depth import render_depth
from openvocab_occ.geometry import Camera
from openvocab_occ.networks.dhd import HEIGHT_STEP, SLABS
from openvocab_occ.networks.flashocc import FlashOccConfig
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.training.drives import Drive
from openvocab_occ.training.samples import network_spec
from openvocab_occ.training.streams import cameras_of

NO_HEIGHT = 255
"""Bin of a pixel that looks at nothing."""
_INSIDE = 0.06  # metres, more than half a bin: a ray that meets a face belongs to the voxel behind it


def height_bins(drive: Drive, frame: int, config: FlashOccConfig, cells: tuple[int, int]) -> UInt8[np.ndarray, "n h w"]:
    """Return for each camera and feature pixel the bin of the height above the ego's ground, `NO_HEIGHT` for the sky.

    DHD takes LiDAR points; these are the first voxels of the sample's own labels on the ray of each pixel, which
    every source has, also where a LiDAR is sparse, and which are as exact as the slabs that are chosen by them.
    """
    height, width = config.image_size
    h, w = cells
    spec = network_spec(config)
    grid = OccupancyGrid(drive.labels[frame], spec)
    shrink = np.diag([(w - 1) / (width - 1), (h - 1) / (height - 1), 1.0])  # as LiftSplat spreads its pixels
    cameras = [Camera(shrink @ c.K, w, h, c.T_world_cam) for c in cameras_of(drive, frame, config)]
    v, u = np.indices((h, w)).astype(np.float64)
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    found = np.full((len(cameras), h, w), NO_HEIGHT, np.uint8)
    for n, (camera, image) in enumerate(zip(cameras, render_depth(grid, cameras), strict=True)):
        hit = image.voxel >= 0
        rays = pixels[hit] @ np.linalg.inv(camera.K).T @ camera.T_world_cam[:3, :3].T
        z = camera.T_world_cam[2, 3] + image.depth[hit] * rays[:, 2]
        floor = spec.origin[2] + (image.voxel[hit] % spec.shape[2]) * config.cell
        z = np.clip(z, floor + _INSIDE, floor + config.cell - _INSIDE)
        bins = round((SLABS[-1][1] - SLABS[0][0]) / HEIGHT_STEP)
        found[n][hit] = np.clip(np.round((z - SLABS[0][0]) / HEIGHT_STEP), 0, bins)
    return found
