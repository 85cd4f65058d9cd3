"""A rendered view as pictures: exact for programs, shaded and outlined for eyes."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int32, UInt8

from openvocab_occ._jit import in_slices
from openvocab_occ.export._shade_kernels import shade
from openvocab_occ.export.palette import NOTHING, grey, paint_numbers
from openvocab_occ.export.render import MapView
from openvocab_occ.export.surface import Surface
from openvocab_occ.geometry import Camera

SKY = (226, 234, 242)
"""Where pictures for people show nothing."""
_SHADES = np.array([0.72, 0.86, 1.0])  # of faces across x, y and z: the ground is lightest
_HAZE = np.array([0.004, 0.35])  # of the sky's colour for each metre, and at most


def paint(
    view: MapView, colors: UInt8[np.ndarray, "n 3"], nothing: Sequence[int] = NOTHING
) -> UInt8[np.ndarray, "h w 3"]:
    """Give each pixel exactly the colour of its voxel."""
    table = np.vstack([colors, np.array([nothing], np.uint8)])  # position -1 reads the last row
    return table[view.voxel]


def shaded(view: MapView, colors: UInt8[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Draw voxels with shaded faces, paler in the distance."""
    camera, surface = view.camera, view.surface
    out = np.empty((*view.voxel.shape, 3), np.uint8)
    rays = _world_rays(camera)
    centers, sky = surface.centers32, np.array(SKY, np.float64)

    def rows(start: int, stop: int) -> None:
        shade(
            rays, camera.position, view.depth, view.voxel, centers, colors, sky, _SHADES, _HAZE, start, stop, out
        )  # fmt: skip

    in_slices(rows, len(out), grain=16)
    return out


def _world_rays(camera: Camera) -> Float[np.ndarray, "h w 3"]:
    """Return the rays of `camera.rays()` along world axes; those of a pinhole are affine in the pixel."""
    R = camera.T_world_cam[:3, :3]
    if camera.lens != "pinhole":
        return camera.rays() @ R.T
    M = R @ np.linalg.inv(camera.K)
    rays = np.empty((camera.height, camera.width, 3))
    v, u = np.arange(camera.height)[:, None], np.arange(camera.width)
    for axis in range(3):
        rays[..., axis] = M[axis, 0] * u + (M[axis, 1] * v + M[axis, 2])
    return rays


def relevance_colors(surface: Surface, scores: Mapping[int, float]) -> UInt8[np.ndarray, "n 3"]:
    """Return colours of voxels: objects with a score from dark (0) to bright (1), all else grey."""
    colors = grey(surface.palette)
    ids = np.array(sorted(scores), np.int64)
    painted = paint_numbers(np.array([scores[int(id)] for id in ids], np.float64), 0.0, 1.0, "plasma")
    for id, color in zip(ids, painted, strict=True):
        rows = surface.rows_by_item.get(int(id))
        if rows is not None:
            colors[rows] = color
    return colors


def outlines(item: Int32[np.ndarray, "h w"], ids: Collection[int], width: int = 1) -> Bool[np.ndarray, "h w"]:
    """Tell which pixels lie on the inner rim of some objects, `width` pixels wide."""
    kept = np.where(np.isin(item, np.array(sorted(ids), np.int64)), item, 0)
    edge = np.zeros(kept.shape, dtype=bool)
    for axis in (0, 1):
        for step in (*range(-width, 0), *range(1, width + 1)):
            edge |= kept != _shifted(kept, step, axis)
    return edge & (kept > 0)


def _shifted(image: np.ndarray, step: int, axis: int) -> np.ndarray:
    """Return the image moved by some pixels, its border repeated."""
    at = np.clip(np.arange(image.shape[axis]) + step, 0, image.shape[axis] - 1)
    return np.take(image, at, axis=axis)


def blend(
    image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], color: Sequence[int], share: float = 1.0
) -> None:
    """Mix a colour into some pixels, in place."""
    mixed = image[mask] * (1 - share) + np.array(color, np.float64) * share
    image[mask] = mixed.astype(np.uint8)


def to_pixels(values: Float[np.ndarray, "n 2"]) -> list[tuple[int, int]]:
    """Return points as OpenCV takes them."""
    return [(round(float(u)), round(float(v))) for u, v in values]
