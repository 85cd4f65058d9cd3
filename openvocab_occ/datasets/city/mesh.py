"""Labelled triangles, and the few solids that every thing of the city is built from."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8

from openvocab_occ.arrays import ArrayLike
from openvocab_occ.datasets.city.surfaces import Part, Surface, linear

_HEXAHEDRON = np.array([
    (0, 2, 1), (0, 3, 2), (4, 5, 6), (4, 6, 7), (0, 1, 5), (0, 5, 4),
    (1, 2, 6), (1, 6, 5), (2, 3, 7), (2, 7, 6), (3, 0, 4), (3, 4, 7),
])  # fmt: skip
Span = Sequence[float | int]
"""Two numbers, from and to."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in metres, counter-clockwise seen from outside, with what the renderer and the labels need of each."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int32[np.ndarray, "f 3"]
    uv: Float32[np.ndarray, "f 3 2"]
    """Texture coordinates of the corners, metres along the face."""
    material: UInt8[np.ndarray, " f"]
    part: UInt8[np.ndarray, " f"]
    color: Float32[np.ndarray, "f 3"]
    """Linear albedo."""
    solid: Bool[np.ndarray, " f"]
    """True for faces of closed surfaces, whose inside counts as occupied."""
    fine: Bool[np.ndarray, " f"]
    """True for detail that is left out far away."""

    @property
    def bounds(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Lower and upper corner of the box, along the axes, that holds all vertices."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    def scaled(self, factor: float) -> "Mesh":
        """Return the mesh enlarged about the origin; textures grow with it."""
        return replace(self, vertices=self.vertices * factor)


class Builder:
    """Collects solids; `mesh()` joins them. Mutable."""

    def __init__(self) -> None:
        self._vertices: list[np.ndarray] = []
        self._faces: list[np.ndarray] = []
        self._looks: list[tuple[int, int, np.ndarray, bool, bool]] = []
        self._count = 0
        self.fine = False
        """While true, what is added counts as detail."""

    def add(self, vertices: ArrayLike, faces: ArrayLike, surface: Surface, part: Part, *, solid: bool = True) -> None:
        """Add triangles."""
        points = np.asarray(vertices, dtype=np.float64)
        corners = np.asarray(faces, dtype=np.int32).reshape(-1, 3)
        self._vertices.append(points)
        self._faces.append(corners + np.int32(self._count))
        self._looks.append((int(surface.material), int(part), linear(surface.color), solid, self.fine))
        self._count += len(points)

    def frustum(self, low: Sequence[Span], high: Sequence[Span], z: Span, surface: Surface, part: Part) -> None:
        """Add a box with rectangular ends ((x0, x1), (y0, y1)) at z[0] and z[1]."""
        corners = [
            (x, y, height)
            for ((x0, x1), (y0, y1)), height in ((low, z[0]), (high, z[1]))
            for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
        ]
        self.add(corners, _HEXAHEDRON, surface, part)

    def box(self, x: Span, y: Span, z: Span, surface: Surface, part: Part) -> None:
        """Add a box from spans, in any order of their ends."""
        ends = (sorted(x), sorted(y))
        self.frustum(ends, ends, sorted(z), surface, part)

    def slab(self, profile: Sequence[Span], y: Span, surface: Surface, part: Part) -> None:
        """Extrude an (x, z) polygon along y; it is counter-clockwise seen from -y and star-shaped about its mean."""
        outline = np.asarray(profile, dtype=np.float64)
        count = len(outline)
        center = outline.mean(axis=0)
        y0, y1 = min(y), max(y)
        vertices = np.empty((2 * count + 2, 3))
        vertices[:count], vertices[count : 2 * count] = [np.insert(outline, 1, side, axis=1) for side in (y0, y1)]
        vertices[-2:] = [(center[0], y0, center[1]), (center[0], y1, center[1])]
        i = np.arange(count)
        j = (i + 1) % count
        first, last = np.full(count, 2 * count), np.full(count, 2 * count + 1)
        faces = [(i, count + j, j), (i, count + i, count + j), (first, i, j), (last, count + j, count + i)]
        self.add(vertices, np.concatenate([np.stack(f, axis=1) for f in faces]), surface, part)

    def tube(
        self, a: ArrayLike, b: ArrayLike, radii: float | Span, surface: Surface, part: Part, *, sides: int = 10
    ) -> None:
        """Add a capped cone from point a to point b."""
        start, end = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
        axis = (end - start) / np.linalg.norm(end - start)
        across = np.cross(axis, (0.0, 0.0, 1.0) if abs(axis[2]) < 0.9 else (1.0, 0.0, 0.0))
        across /= np.linalg.norm(across)
        angle = np.arange(sides) * 2 * np.pi / sides
        ring = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(axis, across)
        r0, r1 = (radii, radii) if isinstance(radii, float | int) else radii
        i = np.arange(sides)
        j = (i + 1) % sides
        first, last = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
        faces = [(i, j, sides + j), (i, sides + j, sides + i), (first, j, i), (last, sides + i, sides + j)]
        vertices = np.concatenate([start + r0 * ring, end + r1 * ring, [start, end]])
        self.add(vertices, np.concatenate([np.stack(f, axis=1) for f in faces]), surface, part)

    def path(self, points: Sequence[ArrayLike], radius: float, surface: Surface, part: Part, *, sides: int = 6) -> None:
        """Add tubes from point to point."""
        for a, b in pairwise(points):
            self.tube(a, b, radius, surface, part, sides=sides)

    def ball(
        self,
        center: ArrayLike,
        radii: ArrayLike,
        surface: Surface,
        part: Part,
        *,
        level: int = 1,
        bumps: ArrayLike = 1.0,
    ) -> None:
        """Add an ellipsoid of 20 x 4^level triangles; `bumps` multiplies the radius at each vertex."""
        vertices, faces = icosphere(level)
        self.add(vertices * np.asarray(bumps) * np.asarray(radii) + np.asarray(center), faces, surface, part)

    def sheet(self, corners: Sequence[ArrayLike], surface: Surface, part: Part) -> None:
        """Add a flat quadrilateral that encloses nothing."""
        self.add(np.asarray(corners, dtype=np.float64), [(0, 1, 2), (0, 2, 3)], surface, part, solid=False)

    def mesh(self) -> Mesh:
        """Return everything added, as one mesh."""
        vertices, faces = np.concatenate(self._vertices), np.concatenate(self._faces)
        counts = [len(f) for f in self._faces]
        material, part, color, solid, fine = (list(column) for column in zip(*self._looks, strict=True))
        return Mesh(
            vertices=vertices,
            faces=faces,
            uv=face_uv(vertices[faces]),
            material=np.repeat(np.array(material, dtype=np.uint8), counts),
            part=np.repeat(np.array(part, dtype=np.uint8), counts),
            color=np.repeat(np.array(color, dtype=np.float32), counts, axis=0),
            solid=np.repeat(np.array(solid, dtype=np.bool_), counts),
            fine=np.repeat(np.array(fine, dtype=np.bool_), counts),
        )


def face_uv(corners: Float[np.ndarray, "f 3 3"]) -> Float32[np.ndarray, "f 3 2"]:
    """Return metres along the horizontal tangent of each face and along the direction across it."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    tangent = np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=1)  # z cross normal
    tangent[np.linalg.norm(tangent, axis=1) < 1e-3] = (1.0, 0.0, 0.0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.cross(normal, tangent)
    return np.stack(
        [np.einsum("fij,fj->fi", corners, tangent), np.einsum("fij,fj->fi", corners, across)], axis=-1
    ).astype(np.float32)


@lru_cache(maxsize=4)
def icosphere(level: int) -> tuple[Float[np.ndarray, "v 3"], Int32[np.ndarray, "f 3"]]:
    """Return the unit icosahedron, each face split `level` times into four."""
    g = (1 + 5**0.5) / 2
    corners = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g), (0, -1, -g), (0, 1, -g),
               (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]  # fmt: skip
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2),
             (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5),
             (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]  # fmt: skip
    vertices = [np.array(c, dtype=np.float64) / np.sqrt(1 + g * g) for c in corners]
    for _ in range(level):
        middle: dict[tuple[int, int], int] = {}
        finer = []
        for face in faces:
            halves = []
            for a, b in pairwise((*face, face[0])):
                key = (min(a, b), max(a, b))
                if key not in middle:
                    point = vertices[a] + vertices[b]
                    middle[key] = len(vertices)
                    vertices.append(point / np.linalg.norm(point))
                halves.append(middle[key])
            (a, b, c), (x, y, z) = face, halves
            finer += [(a, x, z), (b, y, x), (c, z, y), (x, y, z)]
        faces = finer
    return np.array(vertices), np.array(faces, dtype=np.int32)
