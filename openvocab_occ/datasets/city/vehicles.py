"""Cars, vans and buses. Front along +x, centred on the origin, wheels on z = 0, metres."""

from collections.abc import Sequence
from functools import lru_cache

from openvocab_occ.datasets.city.mesh import Builder, Mesh
from openvocab_occ.datasets.city.surfaces import (
    CHROME,
    DARK,
    GLASS,
    HEADLIGHT,
    TAILLIGHT,
    TYRE,
    Material,
    Part,
    Surface,
    paint,
    plain,
)

_ARCH = Surface(Material.RUBBER, "#0c0c0d")
_PLATE = plain("#e9e9e2")
SIDES = (-1, 1)
"""Right and left."""


def wheels(b: Builder, axles: Sequence[float], half_width: float, radius: float, *, width: float = 0.24) -> None:
    """Add a wheel at each end of each axle."""
    for x in axles:
        for s in SIDES:
            y = s * half_width
            b.tube((x, y - s * width, radius), (x, y + s * 0.01, radius), radius, TYRE, Part.WHEEL, sides=16)
            b.tube(
                (x, y - s * 0.3, 1.14 * radius),
                (x, y + s * 0.004, 1.14 * radius),
                1.13 * radius,
                _ARCH,
                Part.BODY,
                sides=16,
            )
            hub = (x, y - s * 0.1, radius)
            b.tube(hub, (x, y + s * 0.025, radius), (radius * 0.58, radius * 0.5), CHROME, Part.WHEEL)
            b.tube(hub, (x, y + s * 0.035, radius), (radius * 0.16, radius * 0.14), DARK, Part.WHEEL, sides=6)


def lights(b: Builder, front: tuple[float, float], back: tuple[float, float], half_width: float) -> None:
    """Add head and tail lights at (x, z) of both ends."""
    (xf, zf), (xb, zb) = front, back
    for s in SIDES:
        y = s * (half_width - 0.22)
        b.box((xf - 0.12, xf + 0.02), (y - 0.17, y + 0.17), (zf - 0.07, zf + 0.08), HEADLIGHT, Part.LIGHT)
        b.box((xb - 0.02, xb + 0.1), (y - 0.15, y + 0.15), (zb - 0.08, zb + 0.12), TAILLIGHT, Part.LIGHT)


def plates(b: Builder, front: float, back: float, z: float) -> None:
    """Add number plates."""
    b.box((front - 0.02, front + 0.025), (-0.26, 0.26), (z - 0.06, z + 0.06), _PLATE, Part.BODY)
    b.box((back - 0.025, back + 0.02), (-0.26, 0.26), (z + 0.02, z + 0.14), _PLATE, Part.BODY)


_CAR_SIDE = ((-2.1, 0.32), (2.05, 0.3), (2.18, 0.42), (2.16, 0.64), (2.02, 0.76), (0.95, 0.92), (-1.95, 0.98),
             (-2.16, 0.86), (-2.2, 0.5))  # fmt: skip
_GREENHOUSES = {  # x of the foot and of the top of the glass, z of the top, half width at foot and top
    "sedan": ((-1.6, 1.0), (-1.05, 0.2), 1.42, (0.8, 0.62)),
    "estate car": ((-1.98, 1.0), (-1.72, 0.2), 1.43, (0.8, 0.62)),
    "hatchback": ((-1.75, 0.95), (-1.3, 0.25), 1.47, (0.8, 0.63)),
    "suv": ((-2.02, 0.98), (-1.82, 0.35), 1.68, (0.84, 0.7)),
    "taxi": ((-1.6, 1.0), (-1.05, 0.2), 1.42, (0.8, 0.62)),
}
CAR_KINDS = tuple(_GREENHOUSES)
"""Body types of cars."""


@lru_cache(maxsize=256)
def car(kind: str, color: str) -> Mesh:
    """Return a car of a body type and a named colour."""
    b, coat = Builder(), paint(color)
    foot, top, height, (wide, narrow) = _GREENHOUSES[kind]
    lift = 0.12 if kind == "suv" else 0.0
    length = 0.9 if kind == "hatchback" else 1.0
    side = [(x * length, z + (lift if z > 0.45 else lift / 2)) for x, z in _CAR_SIDE]
    belt = 0.88 + lift
    b.slab(side, (-0.88, 0.88), coat, Part.BODY)
    b.frustum((foot, (-wide, wide)), (top, (-narrow, narrow)), (belt, height), GLASS, Part.WINDOW)
    eaves = ((top[0] - 0.06, top[1] + 0.08), (-narrow - 0.03, narrow + 0.03))
    ridge = ((top[0] + 0.1, top[1] - 0.1), (-narrow + 0.06, narrow - 0.06))
    b.frustum(eaves, ridge, (height - 0.02, height + 0.06), coat, Part.ROOF)
    for s in SIDES:
        for x0, x1 in ((foot[0], top[0]), (foot[1], top[1]), (-0.28, -0.28)):
            b.tube(
                (x0, s * wide, belt + 0.02), (x1, s * (narrow + 0.005), height + 0.01), 0.045, coat, Part.BODY, sides=4
            )
        b.box((-1.6, 1.6), (s * 0.85, s * 0.91), (0.28, 0.36), DARK, Part.BODY)
        b.box((0.62, 0.8), (s * 0.89, s * 1.07), (belt + 0.05, belt + 0.18), coat, Part.BODY)
        for x in (-0.05, -0.99):
            b.box((x, x + 0.18), (s * 0.88, s * 0.905), (belt - 0.13, belt - 0.1), CHROME, Part.DOOR)
            b.box((x + 0.25, x + 0.262), (s * 0.875, s * 0.884), (0.4, belt), DARK, Part.DOOR)
    front, back = side[2][0], side[-1][0]
    b.box((front - 0.08, front + 0.02), (-0.5, 0.5), (0.5 + lift, 0.62 + lift), DARK, Part.BODY)
    b.box((front - 0.08, front + 0.04), (-0.85, 0.85), (0.3, 0.42), DARK, Part.BODY)
    b.box((back - 0.04, back + 0.1), (-0.85, 0.85), (0.32, 0.46), DARK, Part.BODY)
    if kind == "taxi":
        b.box((-0.5, -0.3), (-0.25, 0.25), (1.47, 1.62), Surface(Material.LAMP, "#f2d27a"), Part.SIGN)
    lights(b, (side[3][0] - 0.01, 0.66 + lift), (back + 0.01, 0.8 + lift), 0.88)
    plates(b, front + 0.02, back - 0.04, 0.46)
    wheels(b, (1.32 * length, -1.33 * length), 0.89, 0.33 + lift / 3)
    return b.mesh()


_VAN_SIDE = ((-2.7, 0.35), (2.5, 0.35), (2.62, 0.5), (2.6, 0.85), (2.4, 1.1), (1.75, 1.3), (1.2, 2.2), (0.9, 2.32),
             (-2.6, 2.32), (-2.72, 2.1))  # fmt: skip


@lru_cache(maxsize=64)
def van(color: str) -> Mesh:
    """Return a delivery van."""
    b, coat = Builder(), paint(color)
    b.slab(_VAN_SIDE, (-0.98, 0.98), coat, Part.BODY)
    b.sheet([(1.78, -0.86, 1.36), (1.78, 0.86, 1.36), (1.28, 0.8, 2.12), (1.28, -0.8, 2.12)], GLASS, Part.WINDOW)
    for s in SIDES:
        y = s * 0.99
        pane = ((0.35, 1.3), (1.5, 1.3), (1.1, 2.0), (0.35, 2.0))
        b.slab(pane, (y - 0.006, y + 0.006), GLASS, Part.WINDOW)
        b.box((1.35, 1.5), (y - 0.02 * s, y + 0.18 * s), (1.25, 1.55), DARK, Part.BODY)
        b.box((-2.5, 0.2), (y - 0.01, y + 0.012), (0.72, 0.8), plain("#9aa0a6"), Part.BODY)
        b.box((0.2, 0.22), (y - 0.01, y + 0.006), (0.4, 2.2), plain("#8d9094"), Part.DOOR)
        b.box((-2.735, -2.7), (s * 0.45 - 0.32, s * 0.45 + 0.32), (1.4, 2.0), GLASS, Part.WINDOW)
    b.box((2.5, 2.66), (-0.95, 0.95), (0.33, 0.55), DARK, Part.BODY)
    b.box((2.55, 2.63), (-0.55, 0.55), (0.72, 0.86), DARK, Part.BODY)
    lights(b, (2.6, 0.86), (-2.74, 1.1), 0.98)
    plates(b, 2.64, -2.74, 0.5)
    wheels(b, (1.65, -1.6), 1.0, 0.36)
    return b.mesh()


@lru_cache(maxsize=16)
def bus(color: str) -> Mesh:
    """Return a city bus, 12 m long."""
    b, coat, trim = Builder(), paint(color), Surface(Material.PAINT, "#f0eee8")
    glass = Surface(Material.GLASS, "#1a2229")
    b.box((-5.9, 5.9), (-1.27, 1.27), (0.35, 3.1), coat, Part.BODY)
    b.frustum(((-5.85, 5.85), (-1.22, 1.22)), ((-5.6, 5.6), (-1.05, 1.05)), (3.1, 3.25), trim, Part.ROOF)
    b.box((-3.0, -0.6), (-0.7, 0.7), (3.25, 3.5), trim, Part.ROOF)
    b.box((-5.92, 5.92), (-1.285, 1.285), (0.35, 0.8), trim, Part.BODY)
    b.box((5.88, 5.93), (-1.12, 1.12), (1.2, 2.6), glass, Part.WINDOW)
    b.box((5.88, 5.94), (-0.8, 0.8), (2.72, 3.0), Surface(Material.LAMP, "#e08a1e"), Part.SIGN)
    b.box((-5.93, -5.88), (-1.0, 1.0), (1.6, 2.6), glass, Part.WINDOW)
    for s in SIDES:
        y = s * 1.275
        for i in range(6):
            b.box((-5.5 + 1.75 * i, -3.9 + 1.75 * i), (y - 0.006, y + 0.006), (1.35, 2.65), glass, Part.WINDOW)
        b.box((5.7, 6.1), (s * 1.3, s * 1.5), (2.0, 2.6), DARK, Part.BODY)
    for x in (4.45, -0.6):
        b.box((x, x + 1.2), (-1.29, -1.26), (0.45, 2.7), Surface(Material.GLASS, "#141a1f"), Part.DOOR)
    lights(b, (5.92, 0.75), (-5.9, 1.1), 1.27)
    wheels(b, (3.6, -3.2), 1.28, 0.5, width=0.36)
    return b.mesh()
