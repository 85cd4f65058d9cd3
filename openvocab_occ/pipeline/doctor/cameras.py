"""Intrinsics against the size of images, and how cameras stand on their vehicle and in the world."""

import math

import numpy as np
from jaxtyping import Float

from openvocab_occ.datasets.frame import View
from openvocab_occ.geometry import T_OPENGL_OPENCV, Camera, invert
from openvocab_occ.pipeline.doctor.finding import Finding
from openvocab_occ.pipeline.doctor.sample import Sample

_OFF_CENTRE = 0.25
"""Share of the image's size by which a principal point may lie off its middle; real cameras seldom reach it."""
_SIZE_RATIO = 1.15  # K of another size is off by this factor at least, and by the same in both directions
_MIN_FOV_DEG, _MAX_FOV_DEG = 8.0, 160.0
_UPRIGHT = 0.5  # cosine: a camera on a vehicle may pitch and roll by 60 degrees
_ALIKE = 0.8  # length of the mean of unit vectors that point about the same way
_FAR = 12.0  # metres from the ego to a camera: a long truck
_AXES = {"x": (1, 0, 0), "-x": (-1, 0, 0), "y": (0, 1, 0), "-y": (0, -1, 0), "z": (0, 0, 1), "-z": (0, 0, -1)}


def check_intrinsics(sample: Sample) -> list[Finding]:
    """K must be that of images of this size."""
    views = {view.name: view for frame in reversed(sample.frames) for view in frame.views}
    found = [finding for view in views.values() if (finding := _intrinsics(view)) is not None]
    if views and not found:
        fov = ", ".join(f"{_fov(view.camera):.0f}" for view in views.values())
        found.append(Finding("ok", "intrinsics", f"K fits the images: {len(views)} cameras of {fov} degrees"))
    return found


def _fov(camera: Camera) -> float:
    """Return the horizontal field of view in degrees, of a pinhole with this K."""
    return math.degrees(2 * math.atan(camera.width / (2 * camera.K[0, 0])))


def _intrinsics(view: View) -> Finding | None:
    camera = view.camera
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    w, h = camera.width, camera.height
    where = f"{view.name or 'camera'} ({w} x {h}, principal point {cx:.0f}, {cy:.0f})"
    across, down = (cx + 0.5) / (w / 2), (cy + 0.5) / (h / 2)
    if w != h and abs(cx / h - 0.5) < 0.1 and abs(cy / w - 0.5) < 0.1 and max(w, h) > _SIZE_RATIO * min(w, h):
        return Finding(
            "error", "intrinsics", f"{where}: K is of an image turned by 90 degrees",
            "its middle is that of height x width",
            "swap cx with cy and fx with fy, or turn the images",
        )  # fmt: skip
    scaled = across > 0 and down > 0 and max(across / down, down / across) < _SIZE_RATIO
    if scaled and not 1 / _SIZE_RATIO < math.sqrt(across * down) < _SIZE_RATIO:
        factor = math.sqrt(across * down)
        return Finding(
            "error", "intrinsics", f"{where}: K is of an image {factor:.3g} times this size",
            "the principal point is off by the same factor both ways",
            f"scale K by {1 / factor:.3g} (Camera.resized), or use the images it was calibrated on",
        )  # fmt: skip
    if abs(across - 1) > 2 * _OFF_CENTRE or abs(down - 1) > 2 * _OFF_CENTRE:
        return Finding(
            "warning", "intrinsics", f"{where}: the principal point is far off the middle",
            "only crops have that", "check K, its order fx fy cx cy, and crops",
        )  # fmt: skip
    if camera.lens != "fisheye" and not _MIN_FOV_DEG < _fov(camera) < _MAX_FOV_DEG:
        return Finding(
            "warning", "intrinsics", f"{where}: a field of view of {_fov(camera):.1f} degrees",
            f"the focal length is {fx:.0f} pixels", "is it in millimetres, or of another size?",
        )  # fmt: skip
    if not 1 / 1.3 < fx / fy < 1.3:
        return Finding(
            "note", "intrinsics", f"{where}: pixels are not square, fx / fy = {fx / fy:.2f}", "squashed images are so"
        )  # fmt: skip
    return None


def check_rig(sample: Sample) -> list[Finding]:
    """Cameras on a vehicle stand upright in its frame, near it, and do not move on it."""
    if not sample.has_rig:
        return _check_free_cameras(sample)
    found: list[Finding] = []
    frame = next((f for f in sample.frames if f.views), None)
    if frame is None:
        return []
    tilted = []
    for view in frame.views:
        T = invert(frame.T_world_ego) @ view.camera.T_world_cam
        if -T[2, 1] < _UPRIGHT and not abs(T[2, 2]) > 0.8:  # unless it looks straight up or down
            tilted.append((view.name, T))
        away = float(np.linalg.norm(T[:3, 3]))
        if away > _FAR:
            found.append(
                Finding(
                    "error",
                    "rig",
                    f"{view.name} is {away:.1f} m from the ego",
                    "no vehicle is that large",
                    "are its extrinsics in millimetres, or in the world?",
                )
            )
    if tilted:
        name, T = tilted[0]
        angle = math.degrees(math.acos(np.clip(-T[2, 1], -1, 1)))
        T_ego_lidar = invert(frame.T_world_ego) @ frame.poses.get("lidar", frame.T_world_ego)
        upright = {
            "extrinsics look inverted (they seem to take ego to camera)": [-invert(T)[2, 1] for _, T in tilted],
            "extrinsics look inverted (they seem to take LiDAR to camera)": [
                -(T_ego_lidar @ invert(invert(T_ego_lidar) @ T))[2, 1] for _, T in tilted
            ],
            "camera axes look like OpenGL's (y up, z backward)": [-(T @ T_OPENGL_OPENCV)[2, 1] for _, T in tilted],
            "the ego's axes look like a camera's (y down)": [T[1, 1] for _, T in tilted],
        }
        says = next((words for words, up in upright.items() if min(up) > _UPRIGHT), "extrinsics look wrong")
        found.append(
            Finding(
                "error",
                "rig",
                f"{len(tilted)} of {len(frame.views)} cameras are not upright: {name} is tilted by {angle:.0f} degrees",
                f"{says}: on a vehicle, up in the image is about up",
                "T_ego_cam takes camera (x right, y down, z forward) to ego (x forward, y left, z up)",
            )
        )
    found += _check_other_poses(sample)
    return found or [Finding("ok", "rig", f"{len(frame.views)} cameras stand upright near the ego")]


def _check_other_poses(sample: Sample) -> list[Finding]:
    """The frames that grids are given in all lie on the vehicle, and those of an ego at other times hardly turn."""
    found = []
    for frame in sample.frames[:1]:
        for name, T_world_f in frame.poses.items():
            T = invert(frame.T_world_ego) @ T_world_f
            turned = math.degrees(math.acos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
            away = float(np.linalg.norm(T[:3, 3]))
            if away > _FAR or (name.endswith("_ego") and turned > 20):
                found.append(
                    Finding(
                        "error",
                        "rig",
                        f"pose {name!r} is {away:.1f} m and {turned:.0f} degrees from the ego",
                        "it is of the same vehicle within a moment",
                        "is this pose, or the ego's, inverted?",
                    )
                )
            elif name == "lidar" and T[2, 2] < -_UPRIGHT:
                found.append(
                    Finding(
                        "warning",
                        "rig",
                        "the LiDAR hangs upside down in the ego frame",
                        "its z axis points down",
                        "is its pose inverted, or its roll off by 180 degrees?",
                    )
                )
    return found


def _check_free_cameras(sample: Sample) -> list[Finding]:
    """Cameras without a vehicle keep up about up; which way that is tells the world's up, and inverted poses."""
    poses = np.array([view.camera.T_world_cam for frame in sample.frames for view in frame.views])
    if len(poses) < 2:
        return []
    up, up_inverted = _mean(-poses[:, :3, 1]), _mean(-invert(poses)[:, :3, 1])
    if np.linalg.norm(up) < 0.5 and np.linalg.norm(up_inverted) > 0.9:
        return [
            Finding(
                "warning",
                "rig",
                "cameras roll all over, but would not if their poses were inverted",
                "people and vehicles keep the image's up about up",
                "poses must take camera to world",
            )
        ]
    if np.linalg.norm(up) < _ALIKE:
        return [Finding("note", "rig", "cameras have no common up: whether the world's z is up cannot be told")]
    axis = max(_AXES, key=lambda name: float(np.dot(_AXES[name], up)))
    if axis != "z":
        return [
            Finding(
                "note",
                "rig",
                f"the world's up seems to be {axis}, not z",
                "most images have it up",
                f"pass the option up={axis}: viewer, prompts and heights expect z",
            )
        ]
    return [Finding("ok", "rig", "the world's z is up in the images")]


def _mean(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " 3"]:
    return vectors.mean(axis=0)
