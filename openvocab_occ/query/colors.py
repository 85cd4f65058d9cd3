"""Colours by name, in Oklab, where equal distances look equally far (Ottosson 2020)."""

import numpy as np
from jaxtyping import Float32, Float64, UInt8

NAMES = ("red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "white", "grey", "black")
CHROMATIC = np.array([name not in ("white", "grey", "black") for name in NAMES])
_EXAMPLES = {
    "red": [(200, 30, 35), (120, 20, 25), (225, 75, 65)],
    "orange": [(235, 120, 30), (200, 95, 25)],
    "yellow": [(240, 210, 50), (200, 170, 40)],
    "green": [(40, 140, 50), (25, 75, 40), (120, 170, 70), (90, 110, 50)],
    "blue": [(30, 70, 185), (70, 145, 220), (20, 35, 95)],
    "purple": [(110, 50, 150), (70, 30, 95)],
    "pink": [(240, 140, 175), (220, 80, 140)],
    "brown": [(110, 70, 40), (155, 105, 65), (70, 42, 25)],
}
_GREY_BELOW = 0.055
"""Chroma over lightness, below which a colour has no hue: a hue stays as a surface falls into shade, chroma fades."""
_BLACK_BELOW, _WHITE_ABOVE = 0.33, 0.86  # lightness
_LIGHTNESS_WEIGHT = 0.4  # light says less about a surface than hue does


def oklab(rgb: UInt8[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    """Return lightness (0..1), green-red and blue-yellow of sRGB colours."""
    c = rgb.astype(np.float32) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    to_lms = np.array([[0.4122214708, 0.5363325363, 0.0514459929], [0.2119034982, 0.6806995451, 0.1073969566],
                       [0.0883024619, 0.2817188376, 0.6299787005]], dtype=np.float32)  # fmt: skip
    to_lab = np.array([[0.2104542553, 0.7936177850, -0.0040720468], [1.9779984951, -2.4285922050, 0.4505937099],
                       [0.0259040371, 0.7827717662, -0.8086757660]], dtype=np.float32)  # fmt: skip
    return (np.cbrt(linear @ to_lms.T) @ to_lab.T).astype(np.float32)


def names_of(rgb: UInt8[np.ndarray, "n 3"]) -> UInt8[np.ndarray, " n"]:
    """Return the position in NAMES of each colour."""
    lab = oklab(rgb)
    scale = np.array([_LIGHTNESS_WEIGHT, 1, 1], dtype=np.float32)
    examples, owner = _examples()
    distance = ((lab * scale)[:, None] - (examples * scale)[None]) ** 2  # n k 3
    name = owner[distance.sum(axis=2).argmin(axis=1)]
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    grey = chroma < _GREY_BELOW * (lab[:, 0] + 0.1)
    dark, light = lab[:, 0] < _BLACK_BELOW, lab[:, 0] > _WHITE_ABOVE
    shade = np.where(dark, NAMES.index("black"), np.where(light, NAMES.index("white"), NAMES.index("grey")))
    return np.where(grey | (lab[:, 0] < 0.16), shade, name).astype(np.uint8)


def degrees(names: UInt8[np.ndarray, " n"]) -> Float64[np.ndarray, " k"]:
    """Return how far a thing is of each colour in NAMES, by those of its voxels: the commonest has 1.

    Hues count double: windows, tyres and shade make part of every vehicle black or grey.
    """
    counts = np.bincount(names, minlength=len(NAMES))[: len(NAMES)] * np.where(CHROMATIC, 2.0, 1.0)
    return counts / max(float(counts.max()), 1e-12)


def _examples() -> tuple[Float32[np.ndarray, "k 3"], np.ndarray]:
    rgb = np.array([c for name in _EXAMPLES for c in _EXAMPLES[name]], dtype=np.uint8)
    owner = np.array([NAMES.index(name) for name in _EXAMPLES for _ in _EXAMPLES[name]])
    return oklab(rgb), owner
