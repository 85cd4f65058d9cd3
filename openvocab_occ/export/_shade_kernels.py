"""Colours of voxels with shaded faces, pixel by pixel."""

from typing import no_type_check

import numpy as np

from openvocab_occ._jit import kernel


@kernel
@no_type_check
def shade(rays, position, depth, voxel, centers, colors, sky, shades, haze, start, stop, out):
    """Paint the rows start..stop: the voxel's colour, darker by the axis of the face that is seen, paler with distance.

    The face is across the axis in which the point that is seen lies farthest from the voxel's centre. `rays` have
    z-depth 1 and world axes. `haze` is the share of `sky` for each metre of depth, and its greatest.
    """
    width = depth.shape[1]
    for v in range(start, stop):
        for u in range(width):
            row = voxel[v, u]
            if row < 0:
                for c in range(3):
                    out[v, u, c] = np.uint8(sky[c])
                continue
            d = np.float64(depth[v, u])
            x = abs(position[0] + d * rays[v, u, 0] - centers[row, 0])
            y = abs(position[1] + d * rays[v, u, 1] - centers[row, 1])
            z = abs(position[2] + d * rays[v, u, 2] - centers[row, 2])
            axis = 0
            if y > x:
                axis = 1
            if z > max(x, y):
                axis = 2
            pale = min(haze[0] * d, haze[1])
            for c in range(3):
                value = colors[row, c] * shades[axis]
                out[v, u, c] = np.uint8(value + pale * (sky[c] - value))
