"""What stands along a street: lamps, signs, signals, cones, barriers, bins, benches, walls and fences. Metres."""

from functools import lru_cache

import numpy as np

from openvocab_occ.datasets.city.mesh import Builder, Mesh
from openvocab_occ.datasets.city.surfaces import STEEL, Material, Part, Surface, plain
from openvocab_occ.datasets.city.vehicles import SIDES

_POLE = Surface(Material.METAL, "#4a5054")
_WHITE = Surface(Material.SIGN, "#f4f4f0")
_RED = Surface(Material.SIGN, "#c01d20")
_INK = Surface(Material.SIGN, "#222222")
LAMP_HEIGHT = 6.2
"""Of the light of a street lamp, metres."""
LAMP_REACH = 1.9
"""From the pole to the light, metres."""


@lru_cache(maxsize=1)
def lamp() -> Mesh:
    """Return a street lamp whose arm reaches along +x."""
    b = Builder()
    b.tube((0, 0, 0), (0, 0, 6.0), (0.09, 0.055), _POLE, Part.POLE, sides=8)
    b.tube((0, 0, 0), (0, 0, 0.9), (0.13, 0.12), _POLE, Part.POLE, sides=8)
    b.path([(0, 0, 6.0), (0.5, 0, 6.25), (1.6, 0, 6.3)], 0.045, _POLE, Part.POLE)
    b.box((1.5, 2.1), (-0.14, 0.14), (6.24, 6.36), _POLE, Part.LIGHT)
    b.box((1.55, 2.05), (-0.11, 0.11), (6.2, 6.24), Surface(Material.LAMP, "#fff0cc"), Part.LIGHT)
    return b.mesh()


SIGN_KINDS = ("stop", "yield", "speed limit", "parking")


def _disc(b: Builder, corners: int, radius: float, x: float, surface: Surface, turn: float = 0.0) -> None:
    """Add a plate that faces -x, its centre 2.35 m up."""
    angle = turn + np.arange(corners) * 2 * np.pi / corners
    rim = np.stack([np.full(corners, x), radius * np.sin(angle), 2.35 + radius * np.cos(angle)], axis=1)
    front = np.concatenate([rim, [(x, 0.0, 2.35)]])
    i, n = np.arange(corners), corners
    j = (i + 1) % corners
    center = np.full(corners, n)
    faces = [np.stack(f, axis=1) for f in ((center, i, j), (center + n + 1, j + n + 1, i + n + 1))]
    b.add(
        np.concatenate([front, front + np.array([0.02, 0.0, 0.0])]),
        np.concatenate(faces),
        surface,
        Part.SIGN,
        solid=False,
    )


@lru_cache(maxsize=8)
def sign(kind: str) -> Mesh:
    """Return a traffic sign on a pole, facing -x."""
    b = Builder()
    b.tube((0, 0, 0), (0, 0, 2.6), 0.035, Surface(Material.METAL, "#9aa0a4"), Part.POLE, sides=7)
    if kind == "stop":
        _disc(b, 8, 0.42, -0.06, _WHITE, np.pi / 8)
        _disc(b, 8, 0.38, -0.067, _RED, np.pi / 8)
        b.box((-0.08, -0.07), (-0.24, 0.24), (2.28, 2.42), _WHITE, Part.SIGN)
    elif kind == "yield":
        _disc(b, 3, 0.5, -0.06, _RED, np.pi)
        _disc(b, 3, 0.31, -0.07, _WHITE, np.pi)
    elif kind == "speed limit":
        _disc(b, 20, 0.38, -0.06, _RED)
        _disc(b, 20, 0.29, -0.067, _WHITE)
        for y in (-0.16, 0.04):
            b.box((-0.08, -0.07), (y, y + 0.13), (2.22, 2.48), _INK, Part.SIGN)
    else:
        b.box((-0.065, -0.045), (-0.32, 0.32), (2.03, 2.67), Surface(Material.SIGN, "#1f5fae"), Part.SIGN)
        b.box((-0.075, -0.065), (0.06, 0.14), (2.13, 2.57), _WHITE, Part.SIGN)
        b.box((-0.075, -0.065), (-0.14, 0.1), (2.35, 2.55), _WHITE, Part.SIGN)
    return b.mesh()


@lru_cache(maxsize=4)
def signal(lit: int) -> Mesh:
    """Return a traffic signal facing -x; lit is 0 for red, 1 for amber, 2 for green."""
    b = Builder()
    b.tube((0, 0, 0), (0, 0, 3.4), (0.07, 0.06), _POLE, Part.POLE, sides=8)
    b.box((-0.22, -0.02), (-0.19, 0.19), (2.3, 3.35), plain("#1c2021"), Part.LIGHT)
    for k, color in enumerate(("#ff3020", "#ffb020", "#30e060")):
        glow = Surface(Material.LAMP, color) if k == lit else plain("#33302c")
        z = 3.16 - 0.33 * k
        b.tube((-0.2, 0, z), (-0.235, 0, z), 0.12, glow, Part.LIGHT, sides=12)
        b.box((-0.36, -0.22), (-0.14, 0.14), (z + 0.12, z + 0.14), plain("#1c2021"), Part.LIGHT)
    return b.mesh()


@lru_cache(maxsize=1)
def cone() -> Mesh:
    """Return a traffic cone."""
    b, orange, white = Builder(), plain("#e2581c"), plain("#f2f0ea")
    b.box((-0.19, 0.19), (-0.19, 0.19), (0, 0.04), orange, Part.BODY)
    b.tube((0, 0, 0.04), (0, 0, 0.28), (0.145, 0.1), orange, Part.BODY, sides=12)
    b.tube((0, 0, 0.28), (0, 0, 0.45), (0.1, 0.066), white, Part.BODY, sides=12)
    b.tube((0, 0, 0.45), (0, 0, 0.72), (0.066, 0.025), orange, Part.BODY, sides=12)
    return b.mesh()


@lru_cache(maxsize=4)
def barrier(kind: str = "plank") -> Mesh:
    """Return a barrier along y: `plank`, striped red and white, or `concrete`."""
    b = Builder()
    if kind == "concrete":
        profile = [
            (-0.3, 0),
            (0.3, 0),
            (0.3, 0.15),
            (0.12, 0.45),
            (0.08, 0.85),
            (-0.08, 0.85),
            (-0.12, 0.45),
            (-0.3, 0.15),
        ]
        b.slab(profile, (-1.0, 1.0), Surface(Material.CONCRETE, "#b9b4a8"), Part.BODY)
        return b.mesh()
    for s in SIDES:
        for x in (-0.25, 0.25):
            b.tube((x, s * 0.64, 0), (0, s * 0.64, 1.0), 0.03, STEEL, Part.POLE, sides=5)
    for k in range(6):
        y = -0.8 + k * 1.6 / 6
        color = Surface(Material.SIGN, "#d03a24" if k % 2 else "#f2f0ea")
        for z in (0.4, 0.75):
            b.box((-0.03, 0.03), (y, y + 1.6 / 6), (z, z + 0.22), color, Part.BODY)
    return b.mesh()


@lru_cache(maxsize=1)
def bin_() -> Mesh:
    """Return a litter bin."""
    b = Builder()
    b.tube((0, 0, 0), (0, 0, 0.95), (0.24, 0.27), Surface(Material.METAL, "#2f5a45"), Part.BODY, sides=12)
    b.tube((0, 0, 0.95), (0, 0, 1.05), (0.29, 0.2), Surface(Material.METAL, "#24332c"), Part.BODY, sides=12)
    return b.mesh()


@lru_cache(maxsize=1)
def bench() -> Mesh:
    """Return a bench; who sits on it looks along -x."""
    b, wood = Builder(), Surface(Material.WOOD, "#8a5c34")
    for x in (-0.22, -0.08, 0.06):
        b.box((x, x + 0.1), (-0.8, 0.8), (0.44, 0.48), wood, Part.BODY)
    for z in (0.6, 0.76):
        b.box((0.2, 0.24), (-0.8, 0.8), (z, z + 0.1), wood, Part.BODY)
    for s in SIDES:
        b.box((-0.2, 0.24), (s * 0.62, s * 0.68), (0, 0.44), STEEL, Part.BODY)
    return b.mesh()


@lru_cache(maxsize=64)
def wall(length: float, look: int = 0) -> Mesh:
    """Return a garden wall along x."""
    b, half = Builder(), length / 2
    brick = Surface(Material.BRICK, "#9c6a52") if look % 2 else Surface(Material.CONCRETE, "#a9a498")
    b.box((-half, half), (-0.14, 0.14), (0, 1.1), brick, Part.WALL)
    b.box((-half - 0.03, half + 0.03), (-0.2, 0.2), (1.1, 1.2), Surface(Material.CONCRETE, "#b5b0a6"), Part.WALL)
    return b.mesh()


@lru_cache(maxsize=64)
def fence(length: float, look: int = 0) -> Mesh:
    """Return a picket fence along x."""
    b, half = Builder(), length / 2
    wood = Surface(Material.WOOD, ("#e9e4d8", "#8a6a4a", "#5f6a5c")[look % 3])
    for z in (0.3, 0.85):
        b.box((-half, half), (-0.02, 0.02), (z, z + 0.08), wood, Part.FRAME)
    for x in np.arange(-half, half + 0.1, 2.0):
        b.box((x - 0.06, x + 0.06), (-0.05, 0.07), (0, 1.18), wood, Part.POLE)
    for x in np.arange(-half + 0.08, half, 0.2):
        b.box((x - 0.06, x + 0.06), (-0.045, -0.02), (0.06, 1.1), wood, Part.FRAME)
    return b.mesh()
