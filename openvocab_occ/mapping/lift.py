"""The lift: features of image cells onto the voxels that the pixels see, without ever making per-pixel features.

A pixel's feature is a bilinear mix of four cells of the feature map, and a voxel's is the sum over its pixels. So
voxels = W @ cells with one sparse matrix W (voxels x cells), whose entries are sums of bilinear weights.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32, Int32, Int64, UInt8

from openvocab_occ.arrays import check_shape
from openvocab_occ.depth.render import DepthImage
from openvocab_occ.errors import DataError, ShapeError
from openvocab_occ.geometry import Camera, transform
from openvocab_occ.mapping.keys import keys_of, pack, unpack
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.segmentation.encoder import FeatureMap

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True, eq=False)
class Lifted:
    """What the pixels of one or more views say about the voxels they see, one row a voxel."""

    sums: Float32[np.ndarray, "m c"]
    """Features added over pixels. Of unit features, the length divided by `weight` tells how well the pixels agree."""
    weight: Float32[np.ndarray, " m"]
    """Weights of the pixels added up; each pixel weighs 1."""
    pixels: Int32[np.ndarray, " m"]
    """How many pixels."""
    color_sum: Float32[np.ndarray, "m 3"] | None = None
    """RGB, 0 to 255, added over pixels; None where no image was given."""


def lift(
    rows: Int32[np.ndarray, "h w"],
    num_rows: int,
    features: FeatureMap,
    *,
    image: UInt8[np.ndarray, "h w 3"] | None = None,
) -> Lifted:
    """Add up the features, and colours, of the pixels that belong to each row.

    `rows` holds the row of each pixel, -1 for none. Pixels beyond the centres of the outermost cells take the nearest
    cell. A row without pixels gets zeros. Memory: 48 bytes a lifted pixel, whatever the length of a feature.
    """
    if rows.size and not -1 <= int(rows.min()) <= int(rows.max()) < num_rows:
        raise ShapeError(
            "pixel rows are out of range", expected=f"-1..{num_rows - 1}", got=f"{rows.min()}..{rows.max()}"
        )
    if image is not None:
        check_shape(image, (*rows.shape, 3), "image of the lift")
    v, u = np.nonzero(rows >= 0)
    row = rows[v, u]
    pixels = np.bincount(row, minlength=num_rows).astype(np.int32)
    sums = _bilinear_weights(row, u, v, num_rows, features) @ features.cells.reshape(-1, features.cells.shape[2])
    color_sum = None
    if image is not None:
        channels = [np.bincount(row, image[v, u, c], minlength=num_rows) for c in range(3)]
        color_sum = np.stack(channels, axis=1).astype(np.float32)
    return Lifted(sums, pixels.astype(np.float32), pixels, color_sum)


def _bilinear_weights(
    row: Int32[np.ndarray, " p"],
    u: Int64[np.ndarray, " p"],
    v: Int64[np.ndarray, " p"],
    num_rows: int,
    features: FeatureMap,
) -> "csr_array":
    """Return W, float32 csr (num_rows x cells), of pixels (u, v) that belong to `row`."""
    from scipy.sparse import coo_array

    height, width = features.cells.shape[:2]
    x = np.clip(features.scale[0] * u + features.offset[0], 0, width - 1)
    y = np.clip(features.scale[1] * v + features.offset[1], 0, height - 1)
    left, top = np.floor(x).astype(np.int32), np.floor(y).astype(np.int32)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    x, y = x - left, y - top  # now fractions of a cell
    cells = np.concatenate([top * width + left, top * width + right, bottom * width + left, bottom * width + right])
    weights = np.concatenate([(1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x])
    W = coo_array((weights, (np.tile(row, 4), cells)), shape=(num_rows, height * width)).tocsr()
    W.data = W.data.astype(np.float32)  # added up in float64, for many pixels go to one entry
    return W


def join(parts: Sequence[Lifted]) -> Lifted:
    """Put the rows of several lifts below one another; colours are kept when every part has them."""
    colors = [part.color_sum for part in parts if part.color_sum is not None]
    return Lifted(
        np.concatenate([part.sums for part in parts]),
        np.concatenate([part.weight for part in parts]),
        np.concatenate([part.pixels for part in parts]),
        np.concatenate(colors) if len(colors) == len(parts) else None,
    )


def rows_from_grid(
    depth_image: DepthImage, grid: OccupancyGrid, voxel_size: float
) -> tuple[Int32[np.ndarray, "h w"], Int32[np.ndarray, "m 3"], UInt8[np.ndarray, " m"]]:
    """Return the row of each pixel, and the key and class of each row, one row a voxel of the grid that is seen.

    A voxel's key is the one its centre lies in; rows of a turned grid, or of a finer one, may share a key.
    """
    hit = depth_image.voxel >= 0
    flat, inverse = np.unique(depth_image.voxel[hit], return_inverse=True)
    rows = np.full(depth_image.voxel.shape, -1, dtype=np.int32)
    rows[hit] = inverse
    return rows, keys_of(grid.centers(flat), voxel_size), grid.labels.reshape(-1)[flat]


def rows_from_depth(
    depth: Float[np.ndarray, "h w"], camera: Camera, voxel_size: float, *, max_depth: float = np.inf
) -> tuple[Int32[np.ndarray, "h w"], Int32[np.ndarray, "m 3"]]:
    """Return the row of each pixel and the key of each row, from measured z-depth in metres.

    Pixels at 0, not finite, or beyond `max_depth` have none; a negative depth raises DataError.
    """
    check_shape(depth, (camera.height, camera.width), "depth")
    rays = camera.rays()
    with np.errstate(invalid="ignore"):
        if (depth < 0).any():
            raise DataError("measured depth is negative", expected="metres, 0 where there is none", got=depth.min())
        good = (depth > 0) & (depth <= max_depth) & np.isfinite(depth) & np.isfinite(rays).all(axis=-1)
    points = transform(camera.T_world_cam, rays[good] * depth[good].astype(np.float64)[:, None])
    packed, inverse = np.unique(pack(keys_of(points, voxel_size)), return_inverse=True)
    rows = np.full(depth.shape, -1, dtype=np.int32)
    rows[good] = inverse
    return rows, unpack(packed)
