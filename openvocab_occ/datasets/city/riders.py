"""Bicycles, motorcycles and people. Front along +x, feet and wheels on z = 0, metres."""

from functools import lru_cache

import numpy as np

from openvocab_occ.datasets.city.mesh import Builder, Mesh
from openvocab_occ.datasets.city.surfaces import (
    CHROME,
    DARK,
    HEADLIGHT,
    PAINTS,
    STEEL,
    TYRE,
    Material,
    Part,
    Surface,
    paint,
    plain,
)
from openvocab_occ.datasets.city.vehicles import SIDES


@lru_cache(maxsize=32)
def bicycle(color: str, rider: str | None = None) -> Mesh:
    """Return a bicycle; `rider` is the colour of the coat of who rides it."""
    b, coat = Builder(), paint(color)
    turn = np.arange(17) * 2 * np.pi / 16
    for x in (0.52, -0.52):
        rim = [(x + 0.31 * np.cos(a), 0.0, 0.335 + 0.31 * np.sin(a)) for a in turn]
        b.path(rim, 0.025, TYRE, Part.WHEEL, sides=5)
    for tube in (
        ((-0.52, 0, 0.34), (-0.12, 0, 0.3), (-0.22, 0, 0.82), (-0.52, 0, 0.34)),
        ((-0.12, 0, 0.3), (0.38, 0, 0.78), (-0.2, 0, 0.76)),
        ((0.52, 0, 0.34), (0.36, 0, 0.95)),
    ):
        b.path(tube, 0.022, coat, Part.FRAME, sides=5)
    b.path([(0.36, -0.26, 1.0), (0.36, 0.26, 1.0)], 0.02, DARK, Part.FRAME, sides=5)
    b.box((-0.36, -0.1), (-0.08, 0.08), (0.84, 0.9), DARK, Part.BODY)
    if rider is not None:
        _seated(b, rider, (-0.2, 0.92), (0.36, 1.0), 0.32)
    return b.mesh()


@lru_cache(maxsize=32)
def motorcycle(color: str, rider: str | None = None) -> Mesh:
    """Return a motorcycle; `rider` is the colour of the jacket of who rides it."""
    b, coat = Builder(), paint(color)
    for x in (0.7, -0.65):
        b.tube((x, -0.08, 0.31), (x, 0.08, 0.31), 0.31, TYRE, Part.WHEEL, sides=16)
        b.tube((x, -0.09, 0.31), (x, 0.09, 0.31), 0.17, CHROME, Part.WHEEL)
    b.box((-0.35, 0.3), (-0.16, 0.16), (0.28, 0.62), STEEL, Part.BODY)
    b.slab([(-0.1, 0.6), (0.35, 0.62), (0.42, 0.85), (0.1, 0.95), (-0.1, 0.82)], (-0.17, 0.17), coat, Part.BODY)
    b.slab([(-0.95, 0.78), (-0.1, 0.68), (-0.1, 0.82), (-0.9, 0.92)], (-0.14, 0.14), DARK, Part.BODY)
    for s in SIDES:
        b.path([(0.7, s * 0.1, 0.31), (0.42, s * 0.1, 0.95)], 0.03, CHROME, Part.FRAME)
    b.path([(0.36, -0.35, 1.02), (0.42, 0, 0.98), (0.36, 0.35, 1.02)], 0.022, DARK, Part.FRAME)
    b.ball((0.5, 0, 0.86), (0.1, 0.1, 0.1), HEADLIGHT, Part.LIGHT)
    b.tube((-0.8, -0.2, 0.35), (0.0, -0.18, 0.3), (0.05, 0.04), CHROME, Part.BODY, sides=8)
    if rider is not None:
        _seated(b, rider, (-0.4, 0.85), (0.36, 1.0), 0.35)
        b.ball((-0.14, 0, 1.58), (0.15, 0.13, 0.15), DARK, Part.HEAD, level=2)
    return b.mesh()


def _seated(b: Builder, color: str, seat: tuple[float, float], bar: tuple[float, float], foot: float) -> None:
    """Add a person on a saddle (x, z) with hands on a bar."""
    coat, skin = plain(color), plain("#c68d63")
    x, z = seat
    shoulder = (x + 0.2, z + 0.52)
    b.tube((x, 0, z), (shoulder[0], 0, shoulder[1]), (0.15, 0.19), coat, Part.TORSO, sides=8)
    b.ball((shoulder[0] + 0.06, 0, shoulder[1] + 0.2), (0.11, 0.1, 0.13), skin, Part.HEAD, level=2)
    for s in SIDES:
        knee = (x + 0.38, s * 0.13, z - 0.18)
        b.path([(x, s * 0.1, z), knee, (x + 0.16, s * 0.13, foot - 0.1)], 0.08, plain("#2c3546"), Part.LEG)
        hand = (bar[0], s * 0.26, bar[1] + 0.02)
        b.path([(shoulder[0], s * 0.2, shoulder[1] - 0.04), hand], 0.05, coat, Part.ARM)


_SKIN = ("#e0b08c", "#c68d63", "#8a5a3c", "#f0c8a8")
_HAIR = ("#2a1d14", "#5b3a1e", "#1a1a1c", "#b08d57")


@lru_cache(maxsize=256)
def pedestrian(color: str, look: int, stride: float = 0.5) -> Mesh:
    """Return a person in a coat of a named colour.

    Args:
        color: Of the coat.
        look: Any number; picks skin, hair, trousers, size and whether there is a backpack.
        stride: Length of the step, metres; the sign says which foot is ahead, 0 stands.
    """
    rng = np.random.default_rng(look)
    skin, hair = plain(_SKIN[rng.integers(4)]), plain(_HAIR[rng.integers(4)])
    leg = plain(("#2c3546", "#3b3a38", "#6b5b48", "#1f2328")[rng.integers(4)])
    coat, size, pack = plain(PAINTS[color]), rng.uniform(0.92, 1.06), rng.random() < 0.4
    b = Builder()
    for s in SIDES:
        a = s * stride * 0.45
        foot = a - (0.1 if a < 0 else 0.0)
        knee = (a * 0.55 + 0.04, s * 0.1, 0.47)
        b.tube((0, s * 0.1, 0.88), knee, (0.1, 0.075), leg, Part.LEG, sides=8)
        b.tube(knee, (foot, s * 0.1, 0.07), (0.075, 0.055), leg, Part.LEG, sides=8)
        b.box((foot - 0.08, foot + 0.18), (s * 0.1 - 0.05, s * 0.1 + 0.05), (0, 0.09), DARK, Part.LEG)
        elbow, hand = (-a * 0.35, s * 0.27, 1.13), (-a * 0.5 + 0.1, s * 0.25, 0.9)
        b.tube((0, s * 0.22, 1.4), elbow, (0.065, 0.05), coat, Part.ARM, sides=7)
        b.tube(elbow, hand, (0.05, 0.04), coat, Part.ARM, sides=7)
        b.ball(hand, (0.055, 0.055, 0.055), skin, Part.ARM)
    chest = ((-0.12, 0.12), (-0.22, 0.22))
    b.frustum(((-0.11, 0.11), (-0.16, 0.16)), chest, (0.82, 1.38), coat, Part.TORSO)
    b.frustum(chest, ((-0.06, 0.06), (-0.1, 0.1)), (1.38, 1.48), coat, Part.TORSO)
    b.tube((0, 0, 1.45), (0.01, 0, 1.56), 0.055, skin, Part.HEAD, sides=7)
    b.ball((0.02, 0, 1.64), (0.105, 0.09, 0.125), skin, Part.HEAD, level=2)
    b.ball((-0.015, 0, 1.68), (0.105, 0.1, 0.11), hair, Part.HEAD, level=2)
    if pack:
        b.box((-0.27, -0.12), (-0.15, 0.15), (1.0, 1.38), Surface(Material.PLAIN, "#7a3b2e"), Part.TORSO)
    return b.mesh().scaled(float(size))
