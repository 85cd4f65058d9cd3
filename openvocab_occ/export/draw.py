"""A rendered view as pictures that a person reads."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int32, UInt8

from openvocab_occ.export.palette import NOTHING, grey
from openvocab_occ.export.render import MapView
from openvocab_occ.geometry import transform
from openvocab_occ.mapping.voxel_map import VoxelMap

SKY = (226, 234, 242)
"""Where pictures for people show nothing."""
_SHADE = (0.80, 0.90, 1.0)  # of faces across x, y and z: the ground is lightest
_LEAST_PIXELS = 150  # a smaller object has no room for its name
_MOST_NAMES = 20
_ROOMY = 10  # names on an object cover at most a tenth of it


def paint(
    view: MapView, colors: UInt8[np.ndarray, "n 3"], nothing: Sequence[int] = NOTHING
) -> UInt8[np.ndarray, "h w 3"]:
    """Give each pixel exactly the colour of its voxel."""
    table = np.vstack([colors, np.array([nothing], np.uint8)])  # position -1 reads the last row
    return table[view.voxel]


def draw_view(
    view: MapView,
    voxels: VoxelMap,
    colors: UInt8[np.ndarray, "n 3"],
    names: dict[int, str],
    hits: Sequence[int] | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw voxels with shaded faces, outlines around objects and names on them.

    Args:
        view: What each pixel shows.
        voxels: The map.
        colors: Colour of each voxel.
        names: Text for each object, by id; only these are named, larger ones first.
        hits: Ids of the objects that answer a query; all else is greyed. None where there was no query.
    """
    image = paint(view, colors, SKY)
    met = view.voxel >= 0
    if hits is not None:
        faded = met & ~np.isin(view.item, np.asarray(hits, np.int32))
        image[faded] = grey(image[faded])
    shade = np.ones(view.voxel.shape, np.float32)
    shade[met] = np.asarray(_SHADE, np.float32)[_face_axis(view, voxels)[met]]
    image = (image * shade[..., None]).astype(np.uint8)
    image[_edges(view.item, hits)] = 255
    return _with_names(image, view.item, names)


def _face_axis(view: MapView, voxels: VoxelMap) -> Int32[np.ndarray, "h w"]:
    """Return the axis that each pixel's face is across: that in which the point met lies farthest from the centre."""
    points = transform(view.camera.T_world_cam, view.camera.rays() * view.depth[..., None])
    offset = np.abs(points - voxels.centers[view.voxel])
    return np.nan_to_num(offset).argmax(axis=-1).astype(np.int32)


def _edges(item: Int32[np.ndarray, "h w"], hits: Sequence[int] | None) -> Bool[np.ndarray, "h w"]:
    """Tell which pixels are the rim of an object, of hits only where there are some."""
    kept = item if hits is None else np.where(np.isin(item, np.asarray(hits, np.int32)), item, 0)
    edge = np.zeros(kept.shape, dtype=bool)
    edge[:, 1:] |= kept[:, 1:] != kept[:, :-1]
    edge[1:] |= kept[1:] != kept[:-1]
    return edge


def _with_names(
    image: UInt8[np.ndarray, "h w 3"], item: Int32[np.ndarray, "h w"], names: dict[int, str]
) -> UInt8[np.ndarray, "h w 3"]:
    """Write names at the innermost pixel of their objects, where they cover no other name."""
    import cv2

    drawn = image.copy()
    counts = np.bincount(item.reshape(-1))
    ids = [id_ for id_ in names if 0 < id_ < len(counts) and counts[id_] >= _LEAST_PIXELS]
    taken: list[Float[np.ndarray, " 4"]] = []
    for id_ in sorted(ids, key=lambda id_: -counts[id_])[:_MOST_NAMES]:
        text = names[id_].encode("ascii", "replace").decode()  # OpenCV's font knows no other letters
        (width, height), base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
        mask = item == id_
        inner = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
        v, u = (int(i) for i in np.unravel_index(int(np.argmax(inner)), inner.shape))
        if inner.max() < width / 2 and np.count_nonzero(mask) < _ROOMY * width * height:
            v = int(np.flatnonzero(mask.any(axis=1))[0]) - height  # above an object that its name would hide
        left = float(np.clip(u - width / 2, 4, max(image.shape[1] - width - 4, 4)))
        bottom = float(np.clip(v + height / 2, height + 4, max(image.shape[0] - base - 4, height + 4)))
        box = np.array([left - 4, bottom - height - 4, left + width + 4, bottom + base + 2])
        if any((box[:2] < other[2:]).all() and (other[:2] < box[2:]).all() for other in taken):
            continue
        taken.append(box)
        x0, y0, x1, y1 = box.astype(int).tolist()
        cv2.rectangle(drawn, (x0, y0), (x1, y1), (0, 0, 0), -1)
        at = (int(left), int(bottom))
        cv2.putText(drawn, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return drawn
