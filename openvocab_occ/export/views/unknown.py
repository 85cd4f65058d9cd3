"""What a view does not tell: where nobody looked."""

from typing import Any

import numpy as np
from jaxtyping import Float

from openvocab_occ.export.overhead import Overhead
from openvocab_occ.export.render import MapView
from openvocab_occ.geometry import Camera, transform
from openvocab_occ.mapping.keys import keys_of
from openvocab_occ.objects.scene_map import SceneMap

_RAYS, _REACH, _STEP = (48, 27), 40.0, 0.8  # rays across and down; metres
_AHEAD = 3.0  # metres before the camera from which on space counts


def unknown_of(scene: SceneMap, view: MapView, overhead: Overhead) -> dict[str, Any]:
    """Return shares of the view and of the ground around that nobody observed, with what they mean."""
    fraction = unknown_fraction(scene, view.camera, view)
    ground = float(1 - overhead.seen.mean())
    notes = ["where the picture shows nothing there may be sky, or nobody looked"]
    if fraction is None:
        notes.append("this map does not keep where space was seen to be empty")
    return {
        "fraction_of_view": None if fraction is None else round(fraction, 4),
        "fraction_of_view_means": f"rays that pass unobserved space within {_REACH:.0f} m before they meet anything",
        "fraction_of_ground": round(ground, 4),
        "fraction_of_ground_means": "of the picture from above, hatched there",
        "notes": notes,
    }


def unknown_fraction(scene: SceneMap, camera: Camera, view: MapView) -> float | None:
    """Return the share of rays that run through space that was never observed before they meet a voxel."""
    free = scene.voxels.free
    if not len(free):
        return None
    u = np.round(np.linspace(0, camera.width - 1, _RAYS[0])).astype(int)
    v = np.round(np.linspace(0, camera.height - 1, _RAYS[1])).astype(int)
    at = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays = camera.unproject(at.astype(np.float64))
    depth = view.depth[at[:, 1], at[:, 0]].astype(np.float64)
    good = np.isfinite(rays).all(axis=1)
    rays, depth = rays[good], depth[good]
    rays = rays @ camera.T_world_cam[:3, :3].T
    steps = np.arange(_AHEAD, _REACH, _STEP)
    points = camera.position + rays[:, None] * steps[:, None]
    before = steps[None] < depth[:, None] - 2 * scene.voxels.voxel_size
    low = points[..., 2] < ceiling(scene)  # nobody maps the sky
    asked = before & low
    known = np.ones(asked.shape, bool)
    keys = keys_of(points[asked], scene.voxels.voxel_size)
    known[asked] = (free.count(keys) > 0) | (scene.voxels.index(keys) >= 0)
    unknown = asked & ~known
    return float((unknown.sum(axis=1) >= 2).mean()) if len(unknown) else 0.0


def ceiling(scene: SceneMap) -> float:
    """Return the height in the world above which unobserved space says nothing, metres."""
    if not scene.frames:
        return np.inf
    return float(np.median([frame.T_world_ego[2, 3] for frame in scene.frames])) + 3.0


def to_ego(T_ego_world: Float[np.ndarray, "4 4"], point: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """Return a point of the world in the ego frame."""
    return transform(T_ego_world, np.asarray(point, np.float64)[None])[0]
