"""Where a view of a map is taken from, and why there."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from openvocab_occ.errors import ConfigError
from openvocab_occ.export.render import overview_camera, pinhole
from openvocab_occ.geometry import Camera, as_pose, invert
from openvocab_occ.objects.scene_map import KeyFrame, NamedCamera, SceneMap

FRONT = "CAM_FRONT"
_EYE = np.array([[0.0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1]])  # T_ego_cam where no rig tells
_FOV = np.deg2rad(43.0)  # vertical, of such a camera: 70 degrees across 16:9


@dataclass(frozen=True, eq=False, kw_only=True)
class Lookout:
    """A camera, the pose that left, right and ahead are said from, and what chose them."""

    camera: Camera
    T_world_ego: Float[np.ndarray, "4 4"]
    """x forward, y left, z up; on the ground where a rig is known."""
    name: str = "given"
    method: str = "given"
    """given, frame, overview, trajectory, ahead, object or cover."""
    reason: str = "a camera was given"
    """Why this place, in words."""
    time: float | None = None
    """Of the frame that was stood at, seconds; None away from the drive."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_ego", as_pose(self.T_world_ego, "T_world_ego of a lookout"))

    @property
    def heading(self) -> float:
        """Radians from the world's x axis."""
        return float(np.arctan2(self.T_world_ego[1, 0], self.T_world_ego[0, 0]))


def given(camera: Camera) -> Lookout:
    """Stand at a camera that somebody else chose."""
    return Lookout(camera=camera, T_world_ego=levelled(camera))


def at_frame(frame: KeyFrame, camera: NamedCamera, width: int, height: int) -> Lookout:
    """Stand where a camera stood in a keyframe; its image is scaled to fit into width x height."""
    reason = f"{camera.name} of frame {frame.index}"
    return Lookout(camera=fitted(camera, width, height), T_world_ego=frame.T_world_ego, name=camera.name,
                   method="frame", reason=reason, time=frame.timestamp)  # fmt: skip


def default_lookout(scene: SceneMap, width: int, height: int) -> Lookout:
    """Return CAM_FRONT (else the first camera) of the middle frame; of a map without cameras, an overview."""
    frames = [frame for frame in scene.frames if frame.cameras]
    if not frames:
        camera = overview_camera(scene, width, height)
        reason = "the map keeps no cameras, so all of it from behind and above"
        return Lookout(camera=camera, T_world_ego=levelled(camera), name="overview", method="overview", reason=reason)
    frame = frames[len(frames) // 2]
    return at_frame(frame, front_of(frame), width, height)


def rig(scene: SceneMap, frame: int, width: int = 1024, height: int = 576) -> list[Lookout]:
    """Return all cameras of a keyframe, by its index.

    Raises ConfigError where the map has no such frame, or it has no cameras.
    """
    found = next((f for f in scene.frames if f.index == frame), None)
    if found is None or not found.cameras:
        known = [f.index for f in scene.frames if f.cameras]
        raise ConfigError("no keyframe with cameras has this index", expected=f"one of {known[:8]}", got=frame)
    return [at_frame(found, camera, width, height) for camera in found.cameras]


def standing_at(
    scene: SceneMap, T_world_ego: Float[np.ndarray, "4 4"], width: int, height: int
) -> Lookout:  # fmt: skip
    """Stand at a pose of the ego with the front camera of the map's rig, or 1.6 m up where it has none."""
    frame = next((f for f in scene.frames if f.cameras), None)
    if frame is None:
        camera = pinhole(width, height, _FOV, T_world_ego @ _EYE)
    else:
        front = front_of(frame)
        mount = invert(frame.T_world_ego) @ front.T_world_cam
        camera = fitted(front, width, height).at(T_world_ego @ mount)
    return Lookout(camera=camera, T_world_ego=T_world_ego)


def front_of(frame: KeyFrame) -> NamedCamera:
    """Return CAM_FRONT of a frame with cameras, else its first."""
    return next((camera for camera in frame.cameras if camera.name == FRONT), frame.cameras[0])


def fitted(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera of the whole image scaled to fit into width x height."""
    scale = min(width / camera.width, height / camera.height)
    plain = Camera(camera.K, camera.width, camera.height, camera.T_world_cam, camera.distortion, camera.lens)
    return plain.resized(max(round(camera.width * scale), 1), max(round(camera.height * scale), 1))


def levelled(camera: Camera) -> Float[np.ndarray, "4 4"]:
    """Return the pose at a camera with x forward and level, y left, z up."""
    forward = camera.T_world_cam[:3, 2] * [1.0, 1.0, 0.0]
    if np.linalg.norm(forward) < 1e-6:  # it looks straight up or down: what is up in the picture is forward
        forward = -camera.T_world_cam[:3, 1] * [1.0, 1.0, 0.0]
    forward /= np.linalg.norm(forward)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 3] = forward, [-forward[1], forward[0], 0.0], camera.position
    return T


def lookouts_of(viewpoints: Camera | Lookout | Sequence[Camera | Lookout]) -> list[Lookout]:
    """Return cameras and lookouts as lookouts, with names that differ."""
    many = [viewpoints] if isinstance(viewpoints, Camera | Lookout) else list(viewpoints)
    found = [given(one) if isinstance(one, Camera) else one for one in many]
    return [replace(one, name=one.name or "view") for one in found]


def ground_height(scene: SceneMap, xy: Float[np.ndarray, " 2"]) -> float:
    """Return about where the ground is, metres: at the frame nearest to a place, else below most voxels."""
    if scene.frames:
        egos = np.array([frame.T_world_ego[:3, 3] for frame in scene.frames])
        return float(egos[np.linalg.norm(egos[:, :2] - xy, axis=1).argmin(), 2])
    keys = scene.voxels.keys
    return float(np.percentile(keys[:, 2], 5) * scene.voxels.voxel_size) if len(keys) else 0.0
