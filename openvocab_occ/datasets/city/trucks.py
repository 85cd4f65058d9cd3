"""Trucks of several body types, trailers and construction vehicles. Front along +x, wheels on z = 0, metres."""

from functools import lru_cache

from openvocab_occ.datasets.city.mesh import Builder, Mesh
from openvocab_occ.datasets.city.surfaces import (
    CHROME,
    DARK,
    GLASS,
    HEADLIGHT,
    STEEL,
    TAILLIGHT,
    TYRE,
    Material,
    Part,
    Surface,
    paint,
    plain,
)
from openvocab_occ.datasets.city.vehicles import SIDES, wheels

TRUCK_KINDS = ("box truck", "flatbed truck", "cement truck", "garbage truck", "tanker truck", "dump truck")
"""Body types."""
_LOAD = plain("#eceae2")


def _cab(b: Builder, coat: Surface, x0: float, x1: float, h: float = 2.75) -> None:
    """Add a cab-over cab between x0 and x1."""
    profile = [(x0, 0.55), (x1 - 0.05, 0.55), (x1, 0.9), (x1, 1.55), (x1 - 0.18, h - 0.25), (x1 - 0.4, h), (x0, h)]
    b.slab(profile, (-1.2, 1.2), coat, Part.CAB)
    y, z = 1.06, h - 0.32
    pane = [(x1 + 0.008, -y, 1.62), (x1 + 0.008, y, 1.62), (x1 - 0.155, 1.0, z), (x1 - 0.155, -1.0, z)]
    b.sheet(pane, GLASS, Part.WINDOW)
    b.box((x1 - 0.02, x1 + 0.03), (-0.95, 0.95), (0.95, 1.4), DARK, Part.CAB)
    b.box((x1 - 0.15, x1 + 0.1), (-1.22, 1.22), (0.42, 0.8), plain("#3a3c40"), Part.CAB)
    for k in range(3):
        b.box((x1, x1 + 0.04), (-0.9, 0.9), (1.0 + 0.13 * k, 1.05 + 0.13 * k), CHROME, Part.CAB)
    for s in SIDES:
        y = s * 1.205
        door = [(x0 + 0.45, 1.55), (x1 - 0.12, 1.55), (x1 - 0.28, h - 0.35), (x0 + 0.45, h - 0.35)]
        b.slab(door, (y - 0.006, y + 0.006), GLASS, Part.WINDOW)
        b.box((x1 - 0.1, x1 + 0.1), (y + s * 0.05, y + s * 0.19), (1.6, 2.2), DARK, Part.CAB)
        b.box((x1 - 0.1, x1 + 0.11), (s * 0.95 - 0.17, s * 0.95 + 0.17), (0.55, 0.73), HEADLIGHT, Part.LIGHT)


def _chassis(b: Builder, x0: float, x1: float) -> None:
    b.box((x0, x1), (-0.45, 0.45), (0.6, 0.95), DARK, Part.BODY)
    for s in SIDES:
        b.box((x0 - 0.06, x0 + 0.04), (s * 0.7, s * 1.1), (0.75, 0.95), TAILLIGHT, Part.LIGHT)
        for z in (0.5, 0.72):
            b.box((x0 + 2.7, x1 - 2.5), (s * 1.11, s * 1.19), (z, z + 0.12), STEEL, Part.BODY)
    b.box((x0 - 0.05, x0 + 0.05), (-1.15, 1.15), (0.45, 0.58), plain("#a83226"), Part.BODY)


@lru_cache(maxsize=64)
def truck(kind: str, color: str) -> Mesh:
    """Return a truck, 8 m long, whose cab has a named colour."""
    b, coat = Builder(), paint(color)
    _cab(b, coat, 2.0, 3.9)
    _chassis(b, -4.0, 2.2)
    wheels(b, (3.0, -1.6, -2.75), 1.2, 0.5, width=0.36)
    _BODIES[kind](b, coat)
    return b.mesh()


def _box_body(b: Builder, coat: Surface) -> None:
    b.box((-4.0, 1.85), (-1.25, 1.25), (1.05, 3.55), _LOAD, Part.CARGO)
    b.box((-4.0, 1.87), (-1.27, 1.27), (0.98, 1.1), STEEL, Part.CARGO)
    b.box((-4.03, 1.88), (-1.27, 1.27), (3.5, 3.58), Surface(Material.METAL, "#a0a4a8"), Part.CARGO)
    b.box((-3.5, 1.3), (-1.262, 1.262), (2.0, 2.55), plain(coat.color), Part.CARGO)
    b.box((-4.03, -3.98), (-0.02, 0.02), (1.1, 3.5), DARK, Part.DOOR)
    for x in (-3.98, 1.84):
        b.box((x - 0.03, x + 0.03), (-1.27, 1.27), (1.1, 3.5), Surface(Material.METAL, "#b5b8bb"), Part.CARGO)


def _flatbed(b: Builder, coat: Surface) -> None:
    b.box((-4.0, 1.85), (-1.25, 1.25), (0.98, 1.12), Surface(Material.WOOD, "#7a5a3a"), Part.CARGO)
    b.box((1.7, 1.85), (-1.25, 1.25), (1.1, 2.3), STEEL, Part.CARGO)
    for s in SIDES:
        b.box((-4.0, 1.7), (s * 1.2, s * 1.26), (1.1, 1.55), Surface(Material.METAL, coat.color), Part.CARGO)
    for row, (count, y0, z) in enumerate(((5, -0.85, 1.36), (4, -0.64, 1.72))):
        log = Surface(Material.WOOD, ("#a87f4f", "#97703f")[row])
        for i in range(count):
            b.tube((-3.7, y0 + 0.42 * i, z), (1.4, y0 + 0.42 * i, z), 0.2, log, Part.CARGO, sides=8)


def _mixer(b: Builder, coat: Surface) -> None:
    drum = Surface(Material.PLAIN, "#c9cbca")
    b.tube((1.6, 0, 2.0), (0.3, 0, 2.15), (0.75, 1.22), drum, Part.CARGO, sides=16)
    b.tube((0.3, 0, 2.15), (-1.5, 0, 2.4), (1.22, 1.15), coat, Part.CARGO, sides=16)
    b.tube((-1.5, 0, 2.4), (-3.6, 0, 2.85), (1.15, 0.5), drum, Part.CARGO, sides=16)
    b.tube((-3.4, 0, 3.0), (-3.9, 0, 3.5), (0.25, 0.5), STEEL, Part.CARGO)
    b.tube((-3.7, 0, 2.3), (-4.3, 0, 1.2), 0.22, STEEL, Part.CARGO, sides=8)
    b.box((-3.9, -3.2), (-0.6, 0.6), (0.9, 2.4), STEEL, Part.CARGO)


def _garbage(b: Builder, coat: Surface) -> None:
    body = [(-3.3, 1.0), (1.85, 1.0), (1.85, 3.2), (1.4, 3.35), (-2.6, 3.35), (-3.3, 2.9)]
    b.slab(body, (-1.24, 1.24), Surface(Material.PAINT, "#3f8a55"), Part.CARGO)
    b.slab([(-4.2, 0.95), (-3.3, 0.95), (-3.3, 3.1), (-3.8, 3.0), (-4.2, 2.2)], (-1.2, 1.2), coat, Part.CARGO)
    for x in (-2.4, -1.2, 0.0, 1.2):
        b.box((x - 0.05, x + 0.05), (-1.28, 1.28), (1.0, 3.2), Surface(Material.METAL, "#3b6b45"), Part.CARGO)


def _tank(b: Builder, coat: Surface) -> None:
    shell = Surface(Material.METAL, "#c3c7ca")
    b.tube((1.8, 0, 2.15), (-3.9, 0, 2.15), 1.18, shell, Part.CARGO, sides=18)
    for x in (1.5, -0.3, -2.0, -3.6):
        b.tube((x, 0, 2.15), (x - 0.12, 0, 2.15), 1.21, coat, Part.CARGO, sides=18)
    b.box((-3.6, 1.5), (-0.35, 0.35), (3.28, 3.4), STEEL, Part.CARGO)


def _dumper(b: Builder, coat: Surface) -> None:
    b.slab([(-3.9, 1.1), (1.8, 1.0), (1.8, 2.5), (-4.1, 2.3)], (-1.25, 1.25), coat, Part.CARGO)
    b.slab([(1.0, 2.5), (2.6, 2.85), (2.6, 2.95), (1.0, 2.62)], (-1.2, 1.2), coat, Part.CARGO)
    for x in (-3.6, -2.2, -0.8, 0.6):
        b.box((x - 0.07, x + 0.07), (-1.31, 1.31), (1.1, 2.35), coat, Part.CARGO)
    b.ball((-1.2, 0, 2.3), (2.4, 1.1, 0.6), Surface(Material.CONCRETE, "#86715a"), Part.CARGO)


_BODIES = {
    "box truck": _box_body,
    "flatbed truck": _flatbed,
    "cement truck": _mixer,
    "garbage truck": _garbage,
    "tanker truck": _tank,
    "dump truck": _dumper,
}


@lru_cache(maxsize=16)
def trailer(color: str) -> Mesh:
    """Return a semi-trailer without its tractor, 10 m long."""
    b = Builder()
    b.box((-5, 5), (-1.25, 1.25), (1.15, 3.7), plain(color), Part.CARGO)
    b.box((-5, 5), (-1.27, 1.27), (1.05, 1.2), STEEL, Part.CARGO)
    b.box((-4.6, 4.6), (-1.262, 1.262), (2.1, 2.7), plain("#c7512e"), Part.CARGO)
    b.box((-4.9, 4.5), (-0.45, 0.45), (0.7, 1.05), DARK, Part.BODY)
    for s in SIDES:
        b.box((2.9, 3.1), (s * 0.74, s * 0.86), (0.0, 1.1), STEEL, Part.BODY)
        b.box((-5.05, -4.95), (s * 0.8, s * 1.2), (0.8, 1.0), TAILLIGHT, Part.LIGHT)
    wheels(b, (-3.9, -2.7), 1.22, 0.5, width=0.36)
    return b.mesh()


@lru_cache(maxsize=8)
def excavator(color: str) -> Mesh:
    """Return an excavator on tracks."""
    b, coat = Builder(), paint(color)
    for s in SIDES:
        track = [(-1.7, 0.0), (1.7, 0.0), (2.0, 0.4), (1.7, 0.8), (-1.7, 0.8), (-2.0, 0.4)]
        b.slab(track, (s * 1.1 - 0.25, s * 1.1 + 0.25), TYRE, Part.WHEEL)
    b.box((-1.9, 1.2), (-1.2, 1.2), (0.95, 1.6), coat, Part.BODY)
    b.box((-1.9, -0.7), (-1.2, 1.2), (1.6, 2.1), coat, Part.BODY)
    b.frustum(((-0.2, 1.2), (0.2, 1.2)), ((-0.2, 0.9), (0.25, 1.15)), (1.6, 2.9), GLASS, Part.CAB)
    b.box((-0.25, 1.0), (0.2, 1.2), (2.88, 2.98), coat, Part.ROOF)
    b.box((-0.6, 0.6), (-0.6, 0.6), (0.7, 0.95), DARK, Part.BODY)
    b.tube((1.0, -0.4, 1.5), (3.0, -0.4, 3.9), (0.25, 0.2), coat, Part.BODY, sides=6)
    b.tube((3.0, -0.4, 3.9), (4.4, -0.4, 2.0), (0.2, 0.16), coat, Part.BODY, sides=6)
    b.slab([(4.0, 0.9), (4.8, 1.0), (4.9, 1.9), (4.2, 2.1)], (-0.9, 0.1), STEEL, Part.BODY)
    return b.mesh()


@lru_cache(maxsize=8)
def wheel_loader(color: str) -> Mesh:
    """Return a wheel loader, its bucket down."""
    b, coat = Builder(), paint(color)
    b.slab([(-2.6, 0.7), (0.2, 0.7), (0.2, 1.5), (-2.2, 1.7), (-2.6, 1.4)], (-0.9, 0.9), coat, Part.BODY)
    b.box((0.1, 1.4), (-0.6, 0.6), (0.7, 1.3), coat, Part.BODY)
    b.frustum(((-0.9, 0.4), (-0.7, 0.7)), ((-0.8, 0.2), (-0.65, 0.65)), (1.5, 3.0), GLASS, Part.CAB)
    b.box((-0.9, 0.3), (-0.75, 0.75), (2.98, 3.1), coat, Part.ROOF)
    for s in SIDES:
        b.path([(0.9, s * 0.5, 1.3), (2.0, s * 0.5, 1.1), (2.6, s * 0.5, 0.5)], 0.12, coat, Part.BODY)
    b.slab([(2.4, 0.1), (3.5, 0.05), (2.9, 0.3), (2.6, 1.1), (2.4, 0.9)], (-1.25, 1.25), STEEL, Part.CARGO)
    wheels(b, (1.0, -1.6), 1.15, 0.72, width=0.5)
    return b.mesh()
