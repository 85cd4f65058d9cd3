"""What things of the city are made of: materials that the shader knows, parts, and colours by name."""

from collections.abc import Mapping
from enum import IntEnum
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32


class Material(IntEnum):
    """Kinds of surface; `_shade_kernels` draws a texture and a gloss for each."""

    PLAIN = 0
    PAINT = 1
    """Car paint."""
    GLASS = 2
    RUBBER = 3
    METAL = 4
    ASPHALT = 5
    MARKING = 6
    PAVING = 7
    GRASS = 8
    BRICK = 9
    PLASTER = 10
    TILES = 11
    LEAF = 12
    BARK = 13
    WOOD = 14
    CONCRETE = 15
    WINDOW = 16
    """Of a building; some are lit at night."""
    LAMP = 17
    HEADLIGHT = 18
    TAILLIGHT = 19
    SIGN = 20


class Part(IntEnum):
    """Parts of things, the same numbers for all; 255 in an image is the sky."""

    BODY = 0
    WHEEL = 1
    WINDOW = 2
    CAB = 3
    ROOF = 4
    LIGHT = 5
    CARGO = 6
    TRUNK = 7
    CROWN = 8
    WALL = 9
    DOOR = 10
    FRAME = 11
    SIGN = 12
    GROUND = 13
    HEAD = 14
    TORSO = 15
    LEG = 16
    ARM = 17
    POLE = 18
    MARKING = 19
    """Paint on the road."""


PART_NAMES: tuple[str, ...] = tuple(part.name.lower() for part in Part)
"""Name of each part number."""
SKY = 255
"""Class and part of a pixel that shows no thing; its instance is 0."""


class Surface(NamedTuple):
    """A material and its colour."""

    material: Material
    color: str
    """sRGB, #rrggbb."""


PAINTS: Mapping[str, str] = MappingProxyType({
    "red": "#b8281f", "blue": "#26529a", "white": "#e6e6e1", "black": "#202226", "grey": "#747a80",
    "silver": "#b9bec3", "green": "#2f6f4c", "yellow": "#d9ae25", "orange": "#d3651d", "brown": "#6a4630",
    "beige": "#cdbb94",
})  # fmt: skip
"""Colours of vehicles and clothes by name."""

DARK = Surface(Material.PLAIN, "#1c1d20")
CHROME = Surface(Material.METAL, "#b9bcc0")
TYRE = Surface(Material.RUBBER, "#26262a")
GLASS = Surface(Material.GLASS, "#222a30")
STEEL = Surface(Material.METAL, "#6c7075")
HEADLIGHT = Surface(Material.HEADLIGHT, "#f2f2ea")
TAILLIGHT = Surface(Material.TAILLIGHT, "#b3161b")


def paint(name: str) -> Surface:
    """Return car paint of a named colour."""
    return Surface(Material.PAINT, PAINTS[name])


def plain(color: str) -> Surface:
    """Return a matt surface of a named or #rrggbb colour."""
    return Surface(Material.PLAIN, PAINTS.get(color, color))


def linear(color: str) -> Float32[np.ndarray, " 3"]:
    """Return the linear albedo of #rrggbb."""
    digits = color.lstrip("#")
    rgb = np.array([int(digits[i : i + 2], 16) for i in (0, 2, 4)], dtype=np.float64) / 255
    return (rgb**2.2).astype(np.float32)
