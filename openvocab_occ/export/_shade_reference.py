"""The same pictures from whole arrays, by the point of each pixel and the nearest face of a unit cube around it."""

import numpy as np


def shade_reference(rays, position, depth, voxel, centers, colors, sky, shades, haze):  # noqa: ANN001
    """Return the picture that `_shade_kernels.shade` paints."""
    points = np.asarray(position) + depth[..., None].astype(np.float64) * rays
    offset = np.abs(points - centers[voxel])
    axis = np.nan_to_num(offset).argmax(axis=-1)
    value = colors[voxel] * np.asarray(shades)[axis][..., None]
    pale = np.minimum(haze[0] * depth.astype(np.float64), haze[1])[..., None]
    painted = (value + pale * (np.asarray(sky, np.float64) - value)).astype(np.uint8)
    return np.where((voxel >= 0)[..., None], painted, np.asarray(sky, np.uint8))
