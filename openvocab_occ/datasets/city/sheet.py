"""Pictures for people: a contact sheet of a written traversal, and the plan of the town."""

from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from openvocab_occ.datasets.city.surfaces import PAINTS
from openvocab_occ.datasets.city.tables import file_name, sample_token
from openvocab_occ.datasets.city.town import Town
from openvocab_occ.datasets.city.traversal import Traversal
from openvocab_occ.io.images import read_image
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_FREE
from openvocab_occ.occupancy.occ3d import read_occ3d

_ROWS = (("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT"), ("CAM_BACK_LEFT", "CAM_BACK", "CAM_BACK_RIGHT"))
_GAP = 6
_COLORS = dict(
    zip(
        OCC3D_CLASSES,
        ("#787878", "#ff7832", "#ff96a0", "#e0b000", "#0096f5", "#00c8c8", "#c8b400", "#ff0000", "#fff096", "#873c00",
         "#a020f0", "#8c5a8c", "#af004b", "#b888b8", "#96f050", "#d2c8b4", "#00a000", "#ffffff"),
        strict=True,
    )
)  # fmt: skip


def contact_sheet(root: Path, drive: Traversal, frames: int) -> UInt8[np.ndarray, "h w 3"]:
    """Return six cameras of up to three keyframes, each beside its occupancy seen from above, ahead to the right."""
    rows = []
    for index in sorted({0, frames // 2, frames - 1}):
        images = [[read_image(root / file_name(drive, index, name)) for name in row] for row in _ROWS]
        cameras = np.concatenate([_beside(row) for row in images])
        top = _from_above(read_occ3d(root / "gts" / drive.name / sample_token(drive, index) / "labels.npz").labels)
        rows.append(_beside([cameras, _fitted(top, len(cameras))]))
    return np.concatenate(rows)


def _beside(images: list[np.ndarray]) -> np.ndarray:
    height = max(len(image) for image in images)
    padded = [np.pad(im, ((0, height - len(im) + _GAP), (0, _GAP), (0, 0)), constant_values=24) for im in images]
    return np.concatenate(padded, axis=1)


def _fitted(image: np.ndarray, height: int) -> np.ndarray:
    import cv2

    return np.asarray(cv2.resize(image, (height, height), interpolation=cv2.INTER_NEAREST))


def _from_above(labels: np.ndarray) -> np.ndarray:
    """Colour the topmost occupied voxel of each column, brighter where it is higher."""
    palette = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in _COLORS.values()], dtype=np.float32)
    occupied = labels != OCC3D_FREE
    height = labels.shape[2] - 1 - occupied[:, :, ::-1].argmax(axis=2)
    top = np.take_along_axis(labels, height[:, :, None], axis=2)[:, :, 0]
    top[~occupied.any(axis=2)] = OCC3D_FREE
    shade = 0.65 + 0.35 * height / (labels.shape[2] - 1)
    return np.clip(palette[top] * shade[..., None], 0, 255).astype(np.uint8).transpose(1, 0, 2)[::-1]


def plan_picture(town: Town, metre: float = 3.0) -> UInt8[np.ndarray, "h w 3"]:
    """Return the ground, the buildings and the trees seen from above, north up, so many pixels a metre."""
    import cv2

    x0, x1, y0, y1 = town.plan.bounds
    low, size = np.array([x0, y0]) - 40.0, np.array([x1 - x0, y1 - y0]) + 80.0
    w, h = (int(a * metre) for a in size)
    image = np.zeros((h, w, 3), np.uint8)
    colors = {"terrain": (150, 175, 120), "road": (105, 105, 110), "sidewalk": (190, 186, 178),
              "square": (200, 165, 130), "tree": (70, 120, 60), "hedge": (70, 120, 60),
              "shed": (120, 90, 70)}  # fmt: skip
    for thing in town.things:
        if thing.kind in ("house", "shop", *colors):
            corners = thing.mesh.vertices[thing.mesh.faces[thing.mesh.part != 19]][:, :, :2]
            T = thing.pose()
            points = (corners @ T[:2, :2].T + T[:2, 3] - low) * metre
            points[..., 1] = h - points[..., 1]
            for triangle in np.round(points).astype(np.int32):
                cv2.fillConvexPoly(image, triangle, colors.get(thing.kind, (175, 120, 100)))
    for lane in town.lanes.lanes:
        line = (lane.points - low) * metre
        line[:, 1] = h - line[:, 1]
        color = tuple(int(PAINTS["yellow"][i : i + 2], 16) for i in (1, 3, 5))
        cv2.polylines(image, [np.round(line).astype(np.int32)[:, None]], False, color, 1, cv2.LINE_AA)
    return image
