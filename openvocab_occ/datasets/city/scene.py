"""Things around a place as one table of triangles, and rays through them (Embree, by Open3D).

Coordinates are float32 relative to a local origin: at 10 km from it depth would be off by 4 mm.
What stands still and what moves are two ray-casting scenes, because the second is built anew for every camera's moment.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8, UInt32

from openvocab_occ.datasets.city.mesh import Mesh
from openvocab_occ.datasets.city.things import Thing

_SIGHT = 175.0  # m beyond which things are left out
_FURNITURE_SIGHT = 90.0  # for what is less than 3 m high
_FINE_SIGHT = 42.0  # for leaves and frames of windows


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles with the attributes of each, metres from a local origin."""

    vertices: Float32[np.ndarray, "v 3"]
    faces: UInt32[np.ndarray, "f 3"]
    uv: Float32[np.ndarray, "f 3 2"]
    color: Float32[np.ndarray, "f 3"]
    material: UInt8[np.ndarray, " f"]
    part: UInt8[np.ndarray, " f"]
    label: UInt8[np.ndarray, " f"]
    """Occ3D class."""
    instance: Int32[np.ndarray, " f"]
    solid: np.ndarray

    def __len__(self) -> int:
        return len(self.faces)


class Hits(NamedTuple):
    """First hits of rays."""

    t: Float32[np.ndarray, " n"]
    """Along the direction as it is given; infinite where nothing is hit."""
    face: Int32[np.ndarray, " n"]
    """Row of the table, 0 where nothing is hit."""
    corners: Float32[np.ndarray, "n 2"]
    """Barycentric coordinates of the second and third corner."""
    normal: Float32[np.ndarray, "n 3"]


def placed(mesh: Mesh, T_world_thing: Float[np.ndarray, "4 4"], origin: Float[np.ndarray, " 3"]) -> np.ndarray:
    """Return the vertices of a mesh at a pose, float32 from an origin."""
    T = T_world_thing
    return (mesh.vertices @ T[:3, :3].T + (T[:3, 3] - origin)).astype(np.float32)


def gather(
    things: Sequence[Thing], poses: Sequence[np.ndarray], origin: Float[np.ndarray, " 3"], *, cull: bool = True
) -> Triangles:
    """Join things at poses into one table; when culling, far ones without their detail, very far ones not at all."""
    vertices, columns, start = [], [], 0
    for thing, pose in zip(things, poses, strict=True):
        mesh = _detail(thing.mesh, pose, origin) if cull else thing.mesh
        if mesh is None:
            continue
        vertices.append(placed(mesh, pose, origin))
        n = len(mesh.faces)
        columns.append((
            (mesh.faces + start).astype(np.uint32), mesh.uv, mesh.color, mesh.material, mesh.part,
            np.full(n, thing.label, np.uint8), np.full(n, thing.id, np.int32), mesh.solid,
        ))  # fmt: skip
        start += len(mesh.vertices)
    if not columns:
        none = np.zeros(0, np.uint8)
        points, faces = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32)
        return Triangles(points, faces, np.zeros((0, 3, 2), np.float32), points, none, none, none,
                         np.zeros(0, np.int32), np.zeros(0, np.bool_))  # fmt: skip
    faces, *rest = (np.concatenate(column) for column in zip(*columns, strict=True))
    return Triangles(np.concatenate(vertices), faces, *rest)


def _detail(mesh: Mesh, pose: np.ndarray, origin: np.ndarray) -> Mesh | None:
    """Return what of a mesh is drawn from a place."""
    if len(mesh.faces) > 8000 or np.abs(mesh.vertices[:, :2]).max() > 60.0:  # ground: cut out what is near
        corners = mesh.vertices[mesh.faces][:, :, :2] - origin[:2]
        low, high = corners.min(axis=1), corners.max(axis=1)
        return _chosen(mesh, (np.maximum(np.maximum(low, -high), 0) < _SIGHT).all(axis=1))
    distance = float(np.hypot(*(pose[:2, 3] - origin[:2])))
    sight = _SIGHT if mesh.bounds[1][2] > 3.0 else _FURNITURE_SIGHT
    if distance > sight:
        return None
    return mesh if distance < _FINE_SIGHT else plain_mesh(mesh)


@lru_cache(maxsize=512)
def plain_mesh(mesh: Mesh) -> Mesh:
    """Return a mesh without its detail."""
    return _chosen(mesh, ~mesh.fine) if mesh.fine.any() else mesh


def _chosen(mesh: Mesh, keep: np.ndarray) -> Mesh:
    faces = mesh.faces[keep]
    used, renumbered = np.unique(faces, return_inverse=True)
    columns = (mesh.uv[keep], mesh.material[keep], mesh.part[keep], mesh.color[keep], mesh.solid[keep], mesh.fine[keep])
    return Mesh(mesh.vertices[used], renumbered.reshape(-1, 3).astype(np.int32), *columns)


def joined(a: Triangles, b: Triangles) -> Triangles:
    """Return both tables, b's rows after a's."""
    faces = np.concatenate([a.faces, b.faces + np.uint32(len(a.vertices))])
    rest = (
        np.concatenate([getattr(a, name), getattr(b, name)])
        for name in ("uv", "color", "material", "part", "label", "instance", "solid")
    )
    return Triangles(np.concatenate([a.vertices, b.vertices]), faces, *rest)


class Caster:
    """Casts rays at triangles; the search tree is built at once."""

    def __init__(self, vertices: Float32[np.ndarray, "v 3"], faces: UInt32[np.ndarray, "f 3"]) -> None:
        import open3d as o3d

        self._tensor: Any = o3d.core.Tensor.from_numpy
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self.empty = len(faces) == 0
        if not self.empty:
            self._scene.add_triangles(
                self._tensor(np.ascontiguousarray(vertices)), self._tensor(np.ascontiguousarray(faces))
            )
            self._scene.cast_rays(self._tensor(np.zeros((1, 6), np.float32)))

    def cast(self, rays: Float32[np.ndarray, "n 6"]) -> Hits:
        """Return the first hit of each ray."""
        found = self._scene.cast_rays(self._tensor(rays))
        t = found["t_hit"].numpy()
        face = found["primitive_ids"].numpy().astype(np.int32)
        face[np.isinf(t)] = 0
        return Hits(t, face, found["primitive_uvs"].numpy(), found["primitive_normals"].numpy())

    def blocked(self, rays: Float32[np.ndarray, "n 6"]) -> np.ndarray:
        """Tell which rays hit anything, bool[n]."""
        return self._scene.test_occlusions(self._tensor(rays)).numpy()


class Moment:
    """What stands still and what moves, at one time."""

    def __init__(self, still: Caster, moving: Caster, num_still: int) -> None:
        self._still, self._moving, self._offset = still, moving, num_still

    def cast(self, rays: Float32[np.ndarray, "n 6"]) -> Hits:
        """Return the first hit of each ray; rows of moving triangles come after those of still ones."""
        hits = self._still.cast(rays)
        if self._moving.empty:
            return hits
        other = self._moving.cast(rays)
        nearer = np.flatnonzero(other.t < hits.t)
        for mine, theirs in zip(hits, other, strict=True):
            mine[nearer] = theirs[nearer]
        hits.face[nearer] += self._offset
        return hits

    def blocked(self, rays: Float32[np.ndarray, "n 6"]) -> np.ndarray:
        """Tell which rays hit anything, bool[n]."""
        blocked = self._still.blocked(rays)
        if not self._moving.empty:
            blocked = blocked | self._moving.blocked(rays)
        return blocked
