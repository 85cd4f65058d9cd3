"""Other ways to the depth of a grid, each as well as it can be done: what `openvocab-occ bench depth` compares with.

A peer is prepared with rays made beforehand, which is not timed; its scene is built in the time that is.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt32

from openvocab_occ._jit import limit_threads
from openvocab_occ.depth.render import num_samples
from openvocab_occ.errors import MissingExtraError
from openvocab_occ.geometry import Camera, transform
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.occupancy.faces import exposed_faces
from openvocab_occ.occupancy.pixel_rays import PixelRays
from openvocab_occ.occupancy.rays import trace_lattice

Peer = Callable[[], list[np.ndarray]]
"""Builds what it needs of the grid, and returns the depth of each camera, f32[h*w]; infinite or max_depth for none."""


def triangles(grid: OccupancyGrid) -> tuple[Float32[np.ndarray, "v 3"], UInt32[np.ndarray, "t 3"]]:
    """Return the surface of a grid as two triangles a rectangle, world frame, metres."""
    faces = exposed_faces(grid.occupied)
    corners = np.empty((len(faces), 4, 3))
    for axis in range(3):
        mine = faces[:, 0] >> 1 == axis
        first, second = (k for k in range(3) if k != axis)
        corners[mine, :, axis] = faces[mine, 1, None]
        corners[mine, :, first] = faces[mine][:, [2, 3, 3, 2]]
        corners[mine, :, second] = faces[mine][:, [4, 4, 5, 5]]
    points = transform(grid.T_world_grid, corners * grid.spec.size + np.asarray(grid.spec.origin))
    quads = np.arange(4 * len(faces), dtype=np.uint32).reshape(-1, 4)
    index = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return points.reshape(-1, 3).astype(np.float32), index


def world_rays(camera: Camera) -> Float[np.ndarray, "n 3"]:
    """Return the rays of the pixels in the world, of z-depth 1, so that a hit's t is its depth."""
    return camera.rays().reshape(-1, 3) @ camera.T_world_cam[:3, :3].T


def open3d_scene(grid: OccupancyGrid, cameras: list[Camera], max_depth: float, threads: int) -> Peer:
    """Embree through Open3D's RaycastingScene."""
    import open3d

    o3d: Any = open3d
    rays = [
        o3d.core.Tensor(
            np.hstack([np.broadcast_to(c.position, (c.height * c.width, 3)), world_rays(c)]).astype(np.float32)
        )
        for c in cameras
    ]

    def run() -> list[np.ndarray]:
        vertices, index = triangles(grid)
        scene: Any = o3d.t.geometry.RaycastingScene(nthreads=threads)
        scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(index))
        return [scene.cast_rays(r, nthreads=threads)["t_hit"].numpy() for r in rays]

    return run


def embreex_scene(grid: OccupancyGrid, cameras: list[Camera], max_depth: float, threads: int) -> Peer:
    """Embree through embreex, its rays split over Python threads."""
    try:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise MissingExtraError("embreex is not installed", fix="pip install embreex, or drop this peer") from error

    embree: Any = rtcore_scene
    rays = [world_rays(c).astype(np.float32) for c in cameras]
    origins = [np.tile(c.position.astype(np.float32), (len(r), 1)) for c, r in zip(cameras, rays, strict=True)]

    def run() -> list[np.ndarray]:
        vertices, index = triangles(grid)
        scene = embree.EmbreeScene()
        TriangleMesh(scene, vertices[index])  # kept by the scene
        # an embreex scene is built by its first query, which must not be raced for
        scene.run(origins[0][:1], rays[0][:1], query="DISTANCE")
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(lambda o, d: scene.run(o, d, query="DISTANCE"), origins, rays))

    return run


def numba_walk(grid: OccupancyGrid, cameras: list[Camera], max_depth: float, threads: int) -> Peer:
    """Our own walk of every ray: the truth of the comparison."""
    views = [PixelRays.of(c, grid) for c in cameras]
    rays = [view.directions(np.arange(view.size[0] * view.size[1])) for view in views]

    def run() -> list[np.ndarray]:
        with limit_threads(threads):
            return [trace_lattice(grid, v.origin[None], d, max_depth)[0] for v, d in zip(views, rays, strict=True)]

    return run


def torch_sampling(
    grid: OccupancyGrid, cameras: list[Camera], max_depth: float, threads: int, step: float = 0.1
) -> Peer:
    """LMPOcc Eq. 5-9 in torch; rays that have hit something or left the grid are dropped."""
    import torch

    occupied = torch.from_numpy(grid.occupied).reshape(-1)
    shape = torch.tensor(grid.spec.shape)
    views = [PixelRays.of(c, grid) for c in cameras]
    rays = [
        torch.from_numpy(view.directions(np.arange(view.size[0] * view.size[1])).astype(np.float32)) for view in views
    ]

    def sample(view: PixelRays, d: "torch.Tensor") -> np.ndarray:
        o = torch.from_numpy(view.origin.astype(np.float32))
        ends = torch.maximum(-o / d, (shape - o) / d).nan_to_num(torch.inf).amin(1)  # when each ray leaves for good
        depth = torch.full((len(d),), max_depth)
        alive = torch.arange(len(d))
        for i in range(1, num_samples(max_depth, step) + 1):
            index = torch.floor(o + (i * step) * d).to(torch.int32)
            inside = ((index >= 0) & (index < shape)).all(1)
            flat = (index[:, 0] * shape[1] + index[:, 1]) * shape[2] + index[:, 2]
            hit = inside & occupied[torch.where(inside, flat, 0)]
            depth[alive[hit]] = i * step
            keep = ~hit & (ends > i * step)
            d, ends, alive = d[keep], ends[keep], alive[keep]
            if not len(alive):
                break
        return depth.numpy()

    def run() -> list[np.ndarray]:
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            return [sample(view, d) for view, d in zip(views, rays, strict=True)]
        finally:
            torch.set_num_threads(before)

    return run
