"""Conditions: what lights the town, what hangs in the air, and what happens to a finished picture."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Float32, UInt8

from openvocab_occ.datasets.city import _shade_kernels as k

Triple = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Condition:
    """Light and air of a drive. Colours are linear."""

    sun_elevation_deg: float = 38.0
    sun: Triple = (0.0, 0.0, 0.0)
    zenith: Triple
    horizon: Triple
    bounce: Triple
    """Light from below."""
    haze: float
    """Extinction, 1/m."""
    haze_color: Triple
    wet: float = 0.0
    night: float = 0.0
    clouds: float = 0.6
    exposure: float
    ambient: float = 1.1
    noise: float = 1.2
    """Of the sensor, grey levels."""
    traffic: float = 1.0
    """Moving vehicles, relative to an ordinary day."""


_CLEAR = Condition(
    sun=(3.1, 2.75, 2.25), zenith=(0.17, 0.36, 0.78), horizon=(0.62, 0.74, 0.9), bounce=(0.26, 0.24, 0.19), haze=0.0013,
    haze_color=(0.6, 0.7, 0.84), exposure=0.66, ambient=1.25,
)  # fmt: skip
CONDITIONS: Mapping[str, Condition] = MappingProxyType({
    "clear": _CLEAR,
    "rain": Condition(zenith=(0.36, 0.39, 0.43), horizon=(0.58, 0.61, 0.64), bounce=(0.14, 0.14, 0.14), haze=0.0075,
                      haze_color=(0.5, 0.53, 0.56), wet=1.0, clouds=0.7, exposure=1.0, noise=2.6),
    "night": Condition(sun=(0.03, 0.04, 0.07), zenith=(0.006, 0.01, 0.028), horizon=(0.03, 0.034, 0.056),
                       bounce=(0.01, 0.009, 0.009), haze=0.0022, haze_color=(0.026, 0.028, 0.042), night=1.0,
                       clouds=0.45, exposure=2.0, noise=3.5, traffic=0.6),
    "fog": Condition(zenith=(0.74, 0.77, 0.8), horizon=(0.8, 0.82, 0.84), bounce=(0.24, 0.24, 0.24), haze=0.026,
                     haze_color=(0.76, 0.785, 0.81), wet=0.25, clouds=0.0, exposure=0.8, ambient=1.0, noise=1.6),
    "heavy traffic": replace(_CLEAR, traffic=2.6),
})  # fmt: skip
"""Conditions by name."""


def light_vector(condition: Condition, azimuth: float, drift: float) -> Float[np.ndarray, " n"]:
    """Return what the shader reads: the condition, with the sun at an azimuth (radians) and the clouds moved on."""
    p = np.zeros(k.SIZE)
    elevation = np.deg2rad(condition.sun_elevation_deg)
    p[k.SUN : k.SUN + 3] = (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
    for at, color in ((k.SUN_COLOR, condition.sun), (k.ZENITH, condition.zenith), (k.HORIZON, condition.horizon),
                      (k.BOUNCE, condition.bounce), (k.HAZE_COLOR, condition.haze_color)):  # fmt: skip
        p[at : at + 3] = color
    p[[k.HAZE, k.WET, k.NIGHT, k.CLOUDS]] = condition.haze, condition.wet, condition.night, condition.clouds
    p[[k.EXPOSURE, k.AMBIENT, k.DRIFT]] = condition.exposure, condition.ambient, drift
    return p


def street_light(position: Sequence[float]) -> list[float]:
    """Return the row of a street lamp for the shader."""
    return [*position, 0.0, 0.0, -1.0, 34.0, 24.0, 13.0, 0.1, 20.0**2]


def headlights(x: float, y: float, heading: float, *, ahead: float, ego: bool = False) -> list[list[float]]:
    """Return rows for the beams of a vehicle."""
    c, s = float(np.cos(heading)), float(np.sin(heading))
    if not ego:
        return [[x + ahead * c, y + ahead * s, 0.75, c, s, -0.09, 16.0, 15.0, 13.0, 0.86, 28.0**2]]
    return [
        [x + ahead * c - side * s, y + ahead * s + side * c, 0.8, c, s, -0.06, 17.0, 16.5, 15.0, 0.84, 42.0**2]
        for side in (-0.7, 0.7)
    ]


def tone_curve(exposure: float) -> UInt8[np.ndarray, " n"]:
    """Return a filmic curve (Narkowicz 2015) and the sRGB gamma as a table over linear light in [0, 6)."""
    x = np.arange(8192) / 8192 * 6.0 * exposure
    y = (x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14)
    return (255 * np.clip(y, 0, 1) ** (1 / 2.2) + 0.5).astype(np.uint8)


def develop(linear: Float32[np.ndarray, "n 3"], curve: UInt8[np.ndarray, " m"]) -> UInt8[np.ndarray, "n 3"]:
    """Return the grey levels of linear light."""
    return curve[np.minimum((linear * np.float32(8192 / 6.0)).astype(np.int32), 8191)]


def finish(
    image: UInt8[np.ndarray, "h w 3"], condition: Condition, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """Add what lens and sensor do: glow of bright things, streaks of rain, a vignette, noise."""
    import cv2

    h, w = image.shape[:2]
    x = image.astype(np.float32)
    if condition.night or condition.wet == 1.0:
        small = cv2.resize(image, (max(w // 4, 1), max(h // 4, 1)), interpolation=cv2.INTER_AREA).astype(np.float32)
        bright = np.maximum(small - (150 if condition.night else 190), 0)
        halo = cv2.resize(cv2.GaussianBlur(bright, (0, 0), max(w / 176, 0.5)), (w, h))
        x += halo * (0.95 if condition.night else 0.5)
    if condition.wet == 1.0:
        streaks = np.zeros((h, w), np.float32)
        size = h / 256
        for _ in range(400):
            a, b = rng.integers(w), rng.integers(h)
            n = float(rng.uniform(6, 20)) * size
            cv2.line(
                streaks,
                (int(a), int(b)),
                (int(a - n * 0.15), int(b + n)),
                float(rng.uniform(0.04, 0.15)),
                1,
                cv2.LINE_AA,
            )
        x += (205 - x) * streaks[..., None]
    v, u = np.meshgrid(np.linspace(-1, 1, h, dtype=np.float32), np.linspace(-1, 1, w, dtype=np.float32), indexing="ij")
    x *= (1 - 0.1 * (u * u + v * v))[..., None]
    x += np.float32(condition.noise) * rng.standard_normal(x.shape, dtype=np.float32)
    return np.clip(x, 0, 255).astype(np.uint8)
