"""The lift by its definition: a feature for every pixel, then a sum over pixels."""

import numpy as np
from jaxtyping import Float, Int32

from openvocab_occ.segmentation.encoder import FeatureMap


def upsampled(features: FeatureMap, height: int, width: int) -> Float[np.ndarray, "h w c"]:
    """Return each pixel's feature by SciPy's linear spline, float64; beyond the outermost cells the nearest."""
    from scipy.ndimage import map_coordinates

    v, u = np.mgrid[:height, :width].astype(np.float64)
    at = np.stack([features.scale[1] * v + features.offset[1], features.scale[0] * u + features.offset[0]])
    channels = [
        map_coordinates(c, at, order=1, mode="nearest") for c in np.moveaxis(features.cells.astype(float), 2, 0)
    ]
    return np.stack(channels, axis=-1)


def lift_reference(rows: Int32[np.ndarray, "h w"], num_rows: int, features: FeatureMap) -> Float[np.ndarray, "m c"]:
    """Return the sums of `lift`, in float64."""
    pixels = upsampled(features, *rows.shape)
    sums = np.zeros((num_rows, pixels.shape[-1]))
    np.add.at(sums, rows[rows >= 0], pixels[rows >= 0])
    return sums
