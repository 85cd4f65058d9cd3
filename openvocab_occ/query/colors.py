"""Colours by name, in Oklab, where equal distances look equally far (Ottosson 2020)."""

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8

NAMES = ("red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "white", "grey", "black")
GREY = np.array([name in ("white", "grey", "black") for name in NAMES])
_HUES = ((-30.0, "pink"), (15.0, "red"), (34.0, "orange"), (72.0, "yellow"), (112.0, "green"), (205.0, "blue"),
         (285.0, "purple"), (330.0, "pink"))  # fmt: skip
"""Angle in degrees from which a hue is called so. Dark pink is red, and pale orange brown."""
_GREY_BELOW = 0.125
"""Chroma over lightness, below which a colour has no hue: it and the hue stay as a surface falls into shade. Glass in
which the sky shows has about as much."""
_LEAST_CHROMA = 0.04
"""Below this the noise of a dark picture has a hue too."""
_BROWN_BELOW = 0.2
"""The same, below which orange is brown."""
_PINK_ABOVE = 0.6  # lightness
_NO_HUE = 0.2  # lightness below which a picture tells no hue
_BLACK_BELOW, _WHITE_ABOVE = 0.43, 0.77
"""Lightness in a picture of which the middle is `MIDDLE`."""
MIDDLE = 0.62
_SOFT = 0.08  # of lightness, over which grey becomes black or white
_PAINTED = 0.25
"""Share of a thing's pixels from which a hue is its colour: tyres, glass and shade make part of each thing dark."""
_LIGHTEST = 0.65
"""What is lighter than this share of a thing's pixels is its paint where nothing has a hue, for the same reason."""

_DOUBT = 0.05
"""What a colour keeps that a model or a measurement excludes."""


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
    light = lab[:, 0]
    hue = _hues(lab)
    shade = np.where(light < _BLACK_BELOW, NAMES.index("black"), NAMES.index("grey"))
    shade = np.where(light > _WHITE_ABOVE, NAMES.index("white"), shade)
    return np.where(hue < 0, shade, hue).astype(np.uint8)


def degrees(colors: Float[np.ndarray, "k 4"], middle: float = MIDDLE) -> Float64[np.ndarray, " names"]:
    """Return how far a thing is of each colour in NAMES.

    A hue is the thing's colour when enough of its pixels have it and no other hue has twice as many. Where none has
    enough, the thing is grey, black or white by the lightest of what it shows, held against the whole picture's light.

    Args:
        colors: Share of its pixels, and sRGB from 0 to 255.
        middle: Lightness of the middle of the picture, or map.
    """
    share = colors[:, 0].astype(np.float64) / max(float(colors[:, 0].sum()), 1e-12)
    lab = oklab(np.clip(np.rint(colors[:, 1:]), 0, 255).astype(np.uint8))
    hue = _hues(lab)
    held = np.bincount(hue[hue >= 0], share[hue >= 0], minlength=len(NAMES))
    most = float(held.max())
    found = held / max(most, _PAINTED)
    plain = np.flatnonzero(hue < 0)
    if not len(plain):
        return found
    order = plain[np.argsort(lab[plain, 0], kind="stable")]
    reached = np.cumsum(share[order]) >= _LIGHTEST * share[plain].sum() - 1e-12
    light = float(lab[order[int(reached.argmax())], 0]) * MIDDLE / max(middle, 0.1)
    black = float(np.clip(0.5 + (_BLACK_BELOW - light) / _SOFT, 0, 1))
    white = float(np.clip(0.5 + (light - _WHITE_ABOVE) / _SOFT, 0, 1))
    left = max(1 - most / _PAINTED, 0.0)
    for name, degree in (("black", black), ("white", white), ("grey", 1 - max(black, white))):
        found[NAMES.index(name)] = degree * left
    return found


def agreed(
    measured: Float64[np.ndarray, "m names"], told: Float64[np.ndarray, "m names"]
) -> Float64[np.ndarray, "m names"]:
    """Return degrees from what was measured and what a model tells, its probabilities of NAMES; of the best it is 1.

    The two err apart: light and shade deceive the one, what lies behind a thin thing the other. So they are multiplied,
    neither being trusted when it says never.
    """
    both = (measured + _DOUBT) * (told + _DOUBT / len(NAMES))
    return both / both.max(axis=1, keepdims=True)


def _hues(lab: Float32[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """Return the position in NAMES of each colour's hue; -1 for none."""
    light, chroma = lab[:, 0], np.hypot(lab[:, 1], lab[:, 2])
    angle = (np.degrees(np.arctan2(lab[:, 2], lab[:, 1])) - _HUES[0][0]) % 360 + _HUES[0][0]
    numbers = np.array([NAMES.index(name) for _, name in _HUES])
    hue = numbers[np.searchsorted([start for start, _ in _HUES], angle, side="right") - 1]
    ratio = chroma / np.maximum(light, 1e-6)
    hue = np.where((hue == NAMES.index("pink")) & (light < _PINK_ABOVE), NAMES.index("red"), hue)
    hue = np.where((hue == NAMES.index("orange")) & (ratio < _BROWN_BELOW), NAMES.index("brown"), hue)
    return np.where((ratio < _GREY_BELOW) | (chroma < _LEAST_CHROMA) | (light < _NO_HUE), -1, hue)
