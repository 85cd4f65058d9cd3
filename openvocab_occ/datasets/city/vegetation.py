"""Trees and bushes: lumpy crowns, with loose leaves around them that break up the outline."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from openvocab_occ.datasets.city.mesh import Builder, Mesh, icosphere
from openvocab_occ.datasets.city.surfaces import Material, Part, Surface

_GREENS = ("#4f7a2e", "#5d8a34", "#3f6b2f", "#76913a")
_BARK = Surface(Material.BARK, "#5a4634")
TREE_KINDS = ("broadleaf", "poplar", "conifer")


def _shade(color: str, factor: float) -> str:
    """Scale #rrggbb in linear light."""
    values = [min(255, round(int(color[i : i + 2], 16) * factor ** (1 / 2.2))) for i in (1, 3, 5)]
    return "#" + "".join(f"{v:02x}" for v in values)


def _leaves(b: Builder, center: np.ndarray, radii: np.ndarray, color: str, rng: np.random.Generator, *,
            count: int = 170, size: float = 0.23) -> None:  # fmt: skip
    """Scatter cards about an ellipsoid."""
    out = rng.normal(size=(count, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    middle = center + out * radii * rng.uniform(0.85, 1.12, (count, 1))
    a = np.cross(rng.normal(size=(count, 3)), out + 0.6 * rng.normal(size=(count, 3)))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    c = np.cross(a, out)
    reach = size * rng.uniform(0.6, 1.3, (count, 1))
    corners = np.stack([middle - reach * a, middle + reach * c * 0.7, middle + reach * a, middle - reach * c * 0.7], 1)
    first = np.arange(count)[:, None] * 4
    faces = (first + np.array([0, 1, 2, 0, 2, 3])).reshape(-1, 3)
    b.fine = True
    b.add(corners.reshape(-1, 3), faces, Surface(Material.LEAF, color), Part.CROWN, solid=False)
    b.fine = False


def _lump(b: Builder, center: np.ndarray, radii: np.ndarray, color: str, rng: np.random.Generator, *,
          level: int = 1) -> None:  # fmt: skip
    bumps = 1 + 0.25 * (rng.random((len(icosphere(level)[0]), 1)) - 0.5)
    b.ball(center, radii * 0.94, Surface(Material.LEAF, _shade(color, 0.62)), Part.CROWN, level=level, bumps=bumps)


def _mottled(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """Give each leaf a tint of its own."""
    tint = np.repeat(rng.uniform(0.75, 1.3, (len(mesh.faces) + 1) // 2), 2)[: len(mesh.faces), None]
    color = np.where(mesh.fine[:, None], mesh.color * tint, mesh.color).astype(np.float32)
    return replace(mesh, color=color)


@lru_cache(maxsize=32)
def tree(kind: str, height: float, look: int) -> Mesh:
    """Return a tree; `look` is any number and picks its shape."""
    rng = np.random.default_rng(look)
    color = _GREENS[rng.integers(4)] if kind != "conifer" else "#2f5a34"
    b = Builder()
    if kind == "conifer":
        b.tube((0, 0, -0.1), (0, 0, height * 0.9), (0.17, 0.05), _BARK, Part.TRUNK)
        for k in range(5):
            z0, z1 = height * (0.18 + 0.15 * k), height * (0.46 + 0.14 * k)
            r = height * 0.2 * (1 - 0.17 * k)
            green = Surface(Material.LEAF, _shade(color, rng.uniform(0.6, 0.8)))
            b.tube((0, 0, z0), (0, 0, min(z1, height)), (r, 0.05), green, Part.CROWN, sides=12)
            ring = np.array([r, r, 0.25])
            _leaves(b, np.array([0, 0, z0 + 0.2]), ring, color, rng, count=90, size=0.2)
        return _mottled(b.mesh(), rng)
    slim = kind == "poplar"
    top, crown = (0.22 if slim else 0.42) * height, (0.16 if slim else 0.3) * height
    b.tube((0, 0, -0.1), (0.05, 0.03, top + 0.3), (0.17, 0.1), _BARK, Part.TRUNK)
    b.tube((0, 0, -0.05), (0, 0, 0.35), (0.26, 0.16), _BARK, Part.TRUNK)
    for k in range(6):
        angle = k * 2 * np.pi / 5 + rng.uniform(-0.4, 0.4)
        if slim:
            center = np.array([0.12 * np.cos(angle), 0.12 * np.sin(angle), top + height * 0.12 * (k + 0.6)])
            radii = np.array([1, 1, 1.5]) * crown * (0.8 - 0.09 * abs(k - 1.5))
        else:
            out = crown * 0.52 if k < 5 else 0.05
            lift = rng.uniform(0.4, 0.9) if k < 5 else 1.35
            center = np.array([out * np.cos(angle), out * np.sin(angle), top + crown * lift])
            radii = np.array([1, 1, 0.85]) * crown * rng.uniform(0.58, 0.72)
        tint = _shade(color, rng.uniform(0.85, 1.15))
        _lump(b, center, radii, tint, rng)
        _leaves(b, center, radii, tint, rng)
        b.tube((0.03, 0.02, top * 0.85), center, (0.07, 0.03), _BARK, Part.TRUNK, sides=5)
    return _mottled(b.mesh(), rng)


@lru_cache(maxsize=64)
def bush(length: float, look: int) -> Mesh:
    """Return a bush, or with more length a hedge along x."""
    rng = np.random.default_rng(look)
    color = ("#47702c", "#557d33", "#3a6030")[rng.integers(3)]
    b = Builder()
    for x in np.arange(-length / 2, length / 2 + 0.01, 0.55):
        center = np.array([x, rng.uniform(-0.1, 0.1), 0.42])
        radii: Float[np.ndarray, " 3"] = np.array([0.5, 0.46, 0.48]) * rng.uniform(0.9, 1.15)
        _lump(b, center, radii, color, rng)
        _leaves(b, center, radii, color, rng, count=60, size=0.13)
    return _mottled(b.mesh(), rng)
