"""Houses, shops and sheds. The front is on the -y side, the ground at z = 0, metres."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from openvocab_occ.datasets.city.mesh import Builder, Mesh
from openvocab_occ.datasets.city.surfaces import STEEL, Material, Part, Surface, plain

_TRIM = plain("#f1eee6")
_PLINTH = Surface(Material.CONCRETE, "#8d8980")
_PANE = Surface(Material.WINDOW, "#35424c")
_SILL = Surface(Material.CONCRETE, "#cfcac0")
_STOREY = 3.0
_WALLS = (
    *((Material.BRICK, c) for c in ("#a8573f", "#96503c", "#b0704c")),
    *((Material.PLASTER, c) for c in ("#e6d9bd", "#d9c2a0", "#c9d3d6", "#e3c9b8", "#d6d8c4", "#e8e2d6")),
)
_ROOFS = ("#8f4636", "#7b3f33", "#54504e", "#6b5a4a", "#9a5a3c")
_BANDS = ("#1f5a4c", "#7a2430", "#2b4a7c", "#b8741f")
_DOORS = ("#5b2c22", "#26483f", "#2b3a55", "#6b4a2c")


@dataclass(frozen=True, kw_only=True)
class House:
    """What a house looks like."""

    width: float
    """Along the street."""
    depth: float
    floors: int
    flat: bool = False
    """A flat roof, else one with a ridge along x."""
    shop: bool = False
    """Shop windows, a name and an awning on the ground floor."""
    look: int = 0
    """Any number; picks walls and colours."""


def _window(b: Builder, at: tuple[float, float], wall: tuple[int, int, float], size: tuple[float, float]) -> None:
    """Add a framed window.

    Args:
        b: Where to.
        at: Position along the wall and height of the sill.
        wall: Axis the wall runs along (0: x, 1: y), sign of its outward side, its coordinate on the other axis.
        size: Width and height.
    """
    (x, z), (axis, s, plane), (w, h) = at, wall, size

    def add(along: tuple[float, float], out: tuple[float, float], up: tuple[float, float], surface: Surface,
            part: Part = Part.FRAME) -> None:  # fmt: skip
        across = (plane + s * out[0], plane + s * out[1])
        b.box(*((along, across) if axis == 0 else (across, along)), up, surface, part)

    add((x - w / 2, x + w / 2), (-0.02, 0.02), (z, z + h), _PANE, Part.WINDOW)
    b.fine = True
    add((x - w / 2 - 0.12, x + w / 2 + 0.12), (0.0, 0.14), (z - 0.1, z), _SILL)
    for side in (x - w / 2, x + w / 2):
        add((side - 0.07, side + 0.07), (0.0, 0.06), (z, z + h), _TRIM)
    for bar in (z + h, z + 0.62 * h):
        add((x - w / 2 - 0.07, x + w / 2 + 0.07), (0.0, 0.06), (bar - 0.035, bar + 0.07), _TRIM)
    add((x - 0.025, x + 0.025), (0.0, 0.05), (z, z + h), _TRIM)
    b.fine = False


@lru_cache(maxsize=128)
def house(spec: House) -> Mesh:
    """Build a house."""
    rng = np.random.default_rng(spec.look)
    wall = Surface(*_WALLS[rng.integers(len(_WALLS))])
    x, y, top = spec.width / 2, spec.depth / 2, spec.floors * _STOREY + 0.4
    b = Builder()
    b.box((-x, x), (-y, y), (0, top), wall, Part.WALL)
    b.box((-x - 0.06, x + 0.06), (-y - 0.06, y + 0.06), (0, 0.5), _PLINTH, Part.WALL)
    count = max(2, int(spec.width // 2.6))
    door = int(rng.integers(count))
    for floor in range(spec.floors):
        z = 0.4 + floor * _STOREY + 0.95
        for i, at in enumerate((np.arange(count) + 0.5) * spec.width / count - x):
            _window(b, (at, z), (0, 1, y), (1.15, 1.45))
            if floor == 0 and i == door and not spec.shop:
                _door(b, at, -y, _DOORS[rng.integers(4)])
            elif floor or not spec.shop:
                _window(b, (at, z), (0, -1, -y), (1.15, 1.45))
        for at in (-spec.depth / 4, spec.depth / 4):
            for s in (-1, 1):
                _window(b, (at, z), (1, s, s * x), (1.1, 1.4))
    if spec.shop:
        _shop(b, x, -y, rng)
    if spec.flat:
        _parapet(b, x, y, top)
    else:
        _gable(b, (x, y, top), wall, Surface(Material.TILES, _ROOFS[rng.integers(5)]))
    return b.mesh()


def _door(b: Builder, x: float, y: float, color: str) -> None:
    b.box((x - 0.55, x + 0.55), (y - 0.05, y + 0.02), (0.15, 2.35), Surface(Material.WOOD, color), Part.DOOR)
    b.box((x - 0.68, x + 0.68), (y - 0.1, y), (2.35, 2.5), _TRIM, Part.FRAME)
    b.box((x - 0.9, x + 0.9), (y - 0.8, y), (0, 0.16), Surface(Material.CONCRETE, "#b0aca2"), Part.DOOR)
    b.box((x - 0.9, x + 0.9), (y - 0.75, y), (2.6, 2.7), Surface(Material.TILES, "#6e3b30"), Part.ROOF)


def _shop(b: Builder, x: float, y: float, rng: np.random.Generator) -> None:
    band = _BANDS[rng.integers(4)]
    board, letter = Surface(Material.SIGN, band), Surface(Material.SIGN, "#f4efdf")
    b.box((-x + 0.3, x - 0.3), (y - 0.03, y), (0.5, 2.6), Surface(Material.WINDOW, "#303a42"), Part.WINDOW)
    b.box((-x + 0.1, x - 0.1), (y - 0.12, y), (2.75, 3.35), board, Part.SIGN)
    awning = [(-x + 0.3, y, 2.66), (-x + 0.3, y - 1.3, 2.28), (x - 0.3, y - 1.3, 2.28), (x - 0.3, y, 2.66)]
    b.sheet(awning, plain(band), Part.ROOF)
    b.box((-x + 0.3, x - 0.3), (y - 1.3, y - 1.28), (2.1, 2.3), plain(band), Part.ROOF)
    b.fine = True
    at = -0.55 * x
    while at < 0.5 * x:  # a name in strokes that spell nothing
        width = rng.uniform(0.16, 0.34)
        b.box((at, at + 0.07), (y - 0.15, y - 0.12), (2.87, 3.22), letter, Part.SIGN)
        for z in rng.choice([2.87, 3.01, 3.15], int(rng.integers(1, 4)), replace=False):
            b.box((at, at + width), (y - 0.15, y - 0.12), (z, z + 0.07), letter, Part.SIGN)
        at += width + 0.12
    b.fine = False
    for post in np.linspace(-x + 0.3, x - 0.3, 5):
        b.box((post - 0.06, post + 0.06), (y - 0.08, y), (0.3, 2.65), plain(band), Part.FRAME)


def _parapet(b: Builder, x: float, y: float, top: float) -> None:
    stone = Surface(Material.CONCRETE, "#b9b2a4")
    for along, across in (
        ((-x - 0.1, x + 0.1), (-y - 0.1, -y + 0.2)),
        ((-x - 0.1, x + 0.1), (y - 0.2, y + 0.1)),
        ((-x - 0.1, -x + 0.2), (-y, y)),
        ((x - 0.2, x + 0.1), (-y, y)),
    ):
        b.box(along, across, (top, top + 0.55), stone, Part.ROOF)
    b.box((-1, 0.6), (-0.8, 0.8), (top, top + 1.2), STEEL, Part.ROOF)


def _gable(b: Builder, corner: tuple[float, float, float], wall: Surface, tiles: Surface) -> None:
    """Add a pitched roof over a box whose upper corner is given."""
    x, y, top = corner
    eave, rise = 0.45, 0.62 * y
    for s in (-1, 1):
        low, high = (s * (y + eave), top - eave * 0.62), (0.0, top + rise)
        quad = [(-x - eave, *low), (x + eave, *low), (x + eave, *high), (-x - eave, *high)]
        quad = quad if s < 0 else [quad[1], quad[0], quad[3], quad[2]]
        over = [(px, py, pz + 0.16) for px, py, pz in quad]
        sides = [(0, 2, 1), (0, 3, 2), (4, 5, 6), (4, 6, 7), (0, 1, 5), (0, 5, 4), (1, 2, 6), (1, 6, 5),
                 (2, 3, 7), (2, 7, 6), (3, 0, 4), (3, 4, 7)]  # fmt: skip
        b.add(quad + over, sides, tiles, Part.ROOF)
    low = top - 0.01
    prism = [(s * x, py, pz) for s in (-1, 1) for py, pz in ((-y, low), (y, low), (0.0, top + rise))]
    faces = [(0, 2, 1), (3, 4, 5), (0, 3, 5), (0, 5, 2), (1, 2, 5), (1, 5, 4), (0, 1, 4), (0, 4, 3)]
    b.add(prism, faces, wall, Part.WALL)
    chimney, left = Surface(Material.BRICK, "#8d5442"), x * 0.4
    b.box((left, left + 0.7), (0.8, 1.5), (top + rise * 0.3, top + rise + 0.7), chimney, Part.ROOF)
    b.box((left - 0.08, left + 0.78), (0.72, 1.58), (top + rise + 0.7, top + rise + 0.82), _PLINTH, Part.ROOF)


@lru_cache(maxsize=16)
def shed(look: int) -> Mesh:
    """Return a garden shed, 3 m by 2.4 m."""
    b, wood = Builder(), Surface(Material.WOOD, ("#7a5a3c", "#5f6a5c", "#8b4a36")[look % 3])
    b.box((-1.5, 1.5), (-1.2, 1.2), (0, 2.1), wood, Part.WALL)
    b.box((-0.45, 0.45), (-1.23, -1.19), (0.05, 1.95), Surface(Material.WOOD, "#4a3828"), Part.DOOR)
    b.frustum(((-1.7, 1.7), (-1.4, 1.4)), ((-1.6, 1.6), (-0.1, 0.1)), (2.05, 2.75), Surface(Material.TILES, "#54504e"),
              Part.ROOF)  # fmt: skip
    return b.mesh()
