"""Colours of labels and of numbers."""

import colorsys
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int32, UInt8

NOTHING = (0, 0, 0)
"""Where a ray meets no voxel; no label has this colour."""
UNLABELLED = (150, 150, 150)
"""A voxel without a label; no label has this colour."""

_NAMED = {
    "road": (84, 88, 99), "driveable surface": (84, 88, 99), "curb": (196, 168, 120), "mark": (225, 195, 70),
    "sidewalk": (190, 178, 166), "other flat": (146, 130, 138), "terrain": (150, 180, 100),
    "vegetation": (52, 128, 68), "tree": (52, 128, 68), "manmade": (178, 140, 112), "building": (178, 140, 112),
    "car": (45, 100, 205), "truck": (235, 125, 40), "bus": (245, 185, 35), "trailer": (180, 95, 30),
    "construction vehicle": (200, 150, 20), "motorcycle": (150, 60, 190), "bicycle": (205, 100, 215),
    "pedestrian": (222, 45, 85), "person": (222, 45, 85), "traffic cone": (255, 85, 0), "barrier": (120, 60, 60),
    "background": (172, 180, 190),
    "others": (110, 120, 135), "pole": (200, 195, 70), "traffic sign": (250, 220, 60), "traffic light": (60, 190, 180),
}  # fmt: skip
_GOLDEN = 0.618033988749895  # steps of the golden section spread hues evenly, however many there are


def label_colors(names: Sequence[str]) -> UInt8[np.ndarray, "n 3"]:
    """Return a colour for each name, no two alike: the usual one for names of the street, else the next free hue."""
    taken = {NOTHING, UNLABELLED}
    colors: list[tuple[int, int, int]] = []
    step = 0
    for name in names:
        color = _NAMED.get(name.strip().lower().replace("_", " "))
        while color is None or color in taken:
            hue, band = (step * _GOLDEN) % 1.0, step // 24 % 3
            red, green, blue = colorsys.hls_to_rgb(hue, (0.52, 0.38, 0.68)[band], (0.65, 0.75, 0.55)[band])
            color = (round(red * 255), round(green * 255), round(blue * 255))
            step += 1
        taken.add(color)
        colors.append(color)
    return np.array(colors, dtype=np.uint8).reshape(-1, 3)


def paint_labels(labels: Int32[np.ndarray, "*n"], names: Sequence[str]) -> UInt8[np.ndarray, "*n 3"]:
    """Return the colour of each label, a position in the names; -1 is `UNLABELLED`."""
    table = np.vstack([label_colors(names), np.array([UNLABELLED], np.uint8)])  # position -1 reads the last row
    return table[labels]


def paint_numbers(values: Float[np.ndarray, " n"], low: float, high: float, scale: str) -> UInt8[np.ndarray, "n 3"]:
    """Return colours from low to high on the scale `viridis` or `plasma`; values beyond are clamped, NaN is low."""
    import cv2

    span = max(high - low, 1e-12)
    level = np.nan_to_num((np.asarray(values, np.float64) - low) / span, nan=0.0, posinf=1.0, neginf=0.0)
    grey = np.round(np.clip(level, 0.0, 1.0) * 255).astype(np.uint8)
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], getattr(cv2, f"COLORMAP_{scale.upper()}"))
    return np.ascontiguousarray(table[grey, 0, ::-1])  # [n, 3], BGR to RGB


def grey(colors: UInt8[np.ndarray, "*n 3"]) -> UInt8[np.ndarray, "*n 3"]:
    """Return colours without hue, pale: the ground on which answers stand out."""
    light = colors.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    return np.repeat((light * 0.35 + 125).astype(np.uint8)[..., None], 3, axis=-1)
