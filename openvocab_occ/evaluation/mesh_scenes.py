"""Scenes of meshes, their voxels, and how far depth from voxels is off that of the meshes. All synthetic."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from openvocab_occ.datasets.city import City
from openvocab_occ.datasets.city.keyframes import frame, labels
from openvocab_occ.datasets.city.oracle import perceive
from openvocab_occ.datasets.frame import View
from openvocab_occ.depth.render import render_depth
from openvocab_occ.geometry import Camera, GridSpec, invert, look_at, transform
from openvocab_occ.occupancy import GEOMETRY_CLASSES, OccupancyGrid

SPEC = GridSpec((-8.0, -8.0, -1.2), 0.4, (40, 40, 16))
_PART = 4  # points along each axis of a voxel at which it is looked up
_MAX_DEPTH = 40.0


@dataclass(frozen=True)
class SurfaceError:
    """How far rendered depth is off that of a mesh, on the pixels where both see something; metres."""

    scene: str
    surface: str
    """`voxel`, `smooth labels` or `smooth logits`."""
    median_m: float
    p90_m: float
    bias_m: float
    """Median of rendered minus true."""
    misses: float
    """Share of the mesh's pixels on which nothing is rendered, or the other way round."""


def slope() -> Any:
    """A street of 7 degrees with a kerb, and a crate that stands askew on it."""
    return _joined([
        (_box(30.0, 30.0, 3.0), _turn(0.12, 0.03, 0.4), (0.0, 0.0, -1.7)),
        (_box(30.0, 4.0, 3.2), _turn(0.12, 0.03, 0.4), (-2.0, 5.0, -1.3)),
        (_box(2.2, 1.7, 1.6), _turn(0.12, 0.03, 1.0), (2.5, -1.2, 1.0)),
    ])  # fmt: skip


def balls() -> Any:
    """Three spheres on a level floor."""
    o3d = _open3d()
    sphere = o3d.geometry.TriangleMesh.create_sphere
    return _joined([
        (_box(30.0, 30.0, 2.0), np.eye(3), (0.0, 0.0, -1.37)),
        (sphere(1.8, 40), np.eye(3), (1.1, 2.3, 1.2)),
        (sphere(1.2, 40), np.eye(3), (3.3, -1.7, 0.9)),
        (sphere(0.9, 40), np.eye(3), (-1.4, -0.4, 0.6)),
    ])  # fmt: skip


def pipes() -> Any:
    """A trunk, a leaning pole and a lying pipe on a level floor."""
    o3d = _open3d()
    cylinder = o3d.geometry.TriangleMesh.create_cylinder
    return _joined([
        (_box(30.0, 30.0, 2.0), np.eye(3), (0.0, 0.0, -1.21)),
        (cylinder(0.9, 5.0, 60), np.eye(3), (2.2, 1.9, 2.0)),
        (cylinder(0.5, 6.0, 60), _turn(0.3, 0.2, 0.0), (0.3, -2.4, 2.0)),
        (cylinder(0.8, 5.0, 60), _turn(1.57, 0.0, 0.5), (4.3, -2.1, 0.5)),
    ])  # fmt: skip


SCENES: dict[str, Callable[[], Any]] = {"slope": slope, "balls": balls, "pipes": pipes}


def surface_errors(*, width: int = 160, height: int = 120) -> tuple[SurfaceError, ...]:
    """Render each scene from two places in every way, and compare with its mesh.

    Labels are occupied where half a voxel or more is filled; logits have the filled share for their probability, as an
    ideal network would give them.
    """
    errors: list[SurfaceError] = []
    for name, make in SCENES.items():
        mesh = make()
        filled = _filled(mesh)
        labels = (filled < 0.5).astype(np.uint8)
        share = np.clip(filled, 0.01, 0.99)
        logits = np.stack([np.log(share), np.log1p(-share)], axis=-1).astype(np.float32)
        plain = OccupancyGrid(labels, SPEC, free_label=1, class_names=GEOMETRY_CLASSES)
        soft = OccupancyGrid(labels, SPEC, free_label=1, logits=logits, class_names=GEOMETRY_CLASSES)
        K = np.array([[0.7 * width, 0, width / 2 - 0.3], [0, 0.7 * width, height / 2 + 0.2], [0, 0, 1]])
        cameras = [
            Camera(K, width, height, look_at(eye, [1.0, 0.0, 0.5])) for eye in ([-6.3, -0.7, 1.9], [-4.1, 6.2, 3.1])
        ]
        truth = np.stack([_mesh_depth(mesh, camera) for camera in cameras])
        images = {
            "voxel": render_depth(plain, cameras, max_depth=_MAX_DEPTH),
            "smooth labels": render_depth(plain, cameras, max_depth=_MAX_DEPTH, surface="smooth"),
            "smooth logits": render_depth(soft, cameras, max_depth=_MAX_DEPTH, surface="smooth"),
        }
        for surface, found in images.items():
            errors.append(_error(name, surface, np.stack([image.depth for image in found]), truth))
    return tuple(errors)


def city_errors(seed: int = 0, *, keyframes: Sequence[int] = (5, 20, 35)) -> tuple[SurfaceError, ...]:
    """Compare depth from Occ3D labels of the synthetic city, and from perceived logits, with its true depth.

    Six cameras of 704 x 256 at keyframes of the first drive; `perceived` are the oracle perception's logits in clear
    weather, wrong as its docstring states. Pixels whose surface lies beyond the grid count as empty.
    """
    drive = City(seed).traversal(route=0)
    depths: dict[str, list[np.ndarray]] = {}
    truth: list[np.ndarray] = []
    for index in keyframes:
        keyframe = frame(drive, index, depth=True)
        true = labels(drive, index)
        whole, seen = replace(true.grid, known=None), replace(perceive(true, seed=seed), known=None)
        cameras = [view.camera for view in keyframe.views]
        ways = {
            "voxel": render_depth(whole, cameras),
            "smooth labels": render_depth(whole, cameras, surface="smooth"),
            "voxel, perceived": render_depth(seen, cameras),
            "smooth logits, perceived": render_depth(seen, cameras, surface="smooth"),
        }
        for name, images in ways.items():
            depths.setdefault(name, []).extend(image.depth for image in images)
        truth += [_within(whole, view) for view in keyframe.views]
    both = np.stack(truth)
    return tuple(_error(f"city {seed}", name, np.stack(images), both, 100.0) for name, images in depths.items())


def _within(grid: OccupancyGrid, view: View) -> Float32[np.ndarray, "h w"]:
    """Return the true depth of a view, infinite beyond the grid."""
    assert view.depth is not None  # asked for
    there = view.depth > 0
    points = view.camera.position + view.camera.rays() @ view.camera.T_world_cam[:3, :3].T * view.depth[..., None]
    T = invert(grid.T_world_grid)
    inside = grid.spec.contains(grid.spec.index(transform(T, points.reshape(-1, 3)))).reshape(there.shape)
    return np.where(there & inside, view.depth, np.float32(np.inf)).astype(np.float32)


def _error(
    scene: str, surface: str, depth: Float32[np.ndarray, "n h w"], truth: np.ndarray, most: float = _MAX_DEPTH
) -> SurfaceError:
    seen, there = depth < most, truth < most
    off = (depth - truth)[seen & there]
    size = np.abs(off)
    misses = float((seen != there).mean())
    return SurfaceError(
        scene, surface, float(np.median(size)), float(np.quantile(size, 0.9)), float(np.median(off)), misses
    )


def _open3d() -> Any:
    import open3d

    return open3d


def _box(x: float, y: float, z: float) -> Any:
    box = _open3d().geometry.TriangleMesh.create_box(x, y, z)
    return box.translate((-x / 2, -y / 2, -z / 2))


def _turn(roll: float, pitch: float, yaw: float) -> Float[np.ndarray, "3 3"]:
    return _open3d().geometry.get_rotation_matrix_from_xyz((roll, pitch, yaw))


def _joined(parts: list[tuple[Any, np.ndarray, tuple[float, float, float]]]) -> list[Any]:
    """Place the parts; they stay apart, because what is inside is asked of each."""
    return [part.rotate(R, center=(0, 0, 0)).translate(place) for part, R, place in parts]


def _scene(meshes: list[Any]) -> Any:
    o3d = _open3d()
    scene = o3d.t.geometry.RaycastingScene()
    for mesh in meshes:
        scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    return scene


def _filled(meshes: list[Any]) -> Float32[np.ndarray, "x y z"]:
    """Return the share of each voxel that lies in a mesh."""
    o3d = _open3d()
    fine = np.stack(np.meshgrid(*[np.arange(n * _PART) for n in SPEC.shape], indexing="ij"), axis=-1)
    points = (np.asarray(SPEC.origin) + (fine + 0.5) / _PART * SPEC.size).astype(np.float32)
    inside = np.zeros(points.shape[:3], bool)
    for mesh in meshes:
        inside |= _scene([mesh]).compute_occupancy(o3d.core.Tensor(points)).numpy() > 0.5
    X, Y, Z = SPEC.shape
    return inside.reshape(X, _PART, Y, _PART, Z, _PART).mean(axis=(1, 3, 5), dtype=np.float32)


def _mesh_depth(meshes: list[Any], camera: Camera) -> Float32[np.ndarray, "h w"]:
    """Return the z-depth of the mesh, infinite beyond the grid, where there are no voxels."""
    rays = camera.rays() @ camera.T_world_cam[:3, :3].T
    both = np.concatenate([np.broadcast_to(camera.position, rays.shape), rays], axis=-1).astype(np.float32)
    depth = _scene(meshes).cast_rays(_open3d().core.Tensor(both))["t_hit"].numpy()
    points = camera.position + rays * np.where(np.isfinite(depth), depth, 0.0)[..., None]
    inside = SPEC.contains(SPEC.index(points)) & np.isfinite(depth)
    return np.where(inside, depth, np.float32(np.inf)).astype(np.float32)
