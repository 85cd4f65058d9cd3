"""`transforms.json` of nerfstudio and instant-ngp: one camera a frame, poses camera to world in OpenGL's axes.

The world stays the file's (z up in nerfstudio; `up=` turns another). The ego is the camera, its axes turned to x
forward, y left, z up of the camera. Principal points count from the corner of the image there, half a pixel less here.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from openvocab_occ.datasets.frame import Frame, FrameSequence, View
from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.geometry import T_EGO_CAM_AXES, T_OPENGL_OPENCV, Camera, as_pose, invert, turn_up
from openvocab_occ.geometry.camera import Lens
from openvocab_occ.io.files import PathLike, existing
from openvocab_occ.io.images import read_depth, read_image

DEPTH_UNIT = 0.001
"""Metres of one step of a depth image, where the file gives no `depth_unit_scale_factor`."""
_LENSES: Mapping[str, tuple[Lens, tuple[str, ...]]] = {
    "OPENCV": ("brown", ("k1", "k2", "p1", "p2", "k3")),
    "PINHOLE": ("pinhole", ()),
    "SIMPLE_PINHOLE": ("pinhole", ()),
    "OPENCV_FISHEYE": ("fisheye", ("k1", "k2", "k3", "k4")),
}


def load_nerfstudio(root: PathLike | None, *, scene: str | None = None, up: str = "z") -> FrameSequence:
    """Open a capture; frames keep the file's order and have a second each, unless they name a `time`.

    Args:
        root: `transforms.json` or its folder.
        scene: A sub-folder that holds it.
        up: Axis of the file's world that points up.
    """
    if root is None:
        raise ConfigError("nerfstudio needs a root", expected="transforms.json or its folder", got=None)
    top = existing(root, "capture")
    folder = top / scene if scene is not None else top
    file = folder if folder.is_file() else existing(folder / "transforms.json", "capture")
    try:
        content = json.loads(file.read_bytes())
        entries = content["frames"]
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{file.name} is no capture", expected="JSON with the key frames", got=error) from error
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise DataError(f"{file.name} is no capture", expected="a list of frames", got=type(entries).__name__)
    turn = turn_up(up)
    return FrameSequence(
        file.parent.name,
        range(len(entries)),
        lambda index: _frame(index, {**content, **entries[index]}, file, turn),
        source="nerfstudio",
        files=lambda index: [
            _image_file(file, str(entries[index].get("file_path", ""))),
            *([file.parent / entries[index]["depth_file_path"]] if "depth_file_path" in entries[index] else []),
        ],
    )


def _image_file(file: Path, name: str) -> Path:
    """Return where the image is; captures of Blender leave out the ending `.png`."""
    path = file.parent / name
    return path if path.suffix or path.is_file() else path.with_name(path.name + ".png")


def _frame(index: int, entry: Mapping[str, Any], file: Path, turn: Float[np.ndarray, "4 4"]) -> Frame:
    where = f"frame {index} of {file.name}"
    missing = [key for key in ("file_path", "transform_matrix") if key not in entry]
    if missing:
        raise DataError(f"{where} lacks {' and '.join(missing)}", expected="file_path and transform_matrix")
    image = read_image(_image_file(file, str(entry["file_path"])))
    try:
        matrix = np.asarray(entry["transform_matrix"], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"transform_matrix of {where} is no matrix", expected="4x4 numbers", got=error) from error
    T_world_cam = turn @ as_pose(matrix, f"transform_matrix of {where}") @ T_OPENGL_OPENCV
    camera = _camera(entry, image.shape[1], image.shape[0], where).at(T_world_cam)
    depth = None
    if "depth_file_path" in entry:
        unit = float(entry.get("depth_unit_scale_factor", DEPTH_UNIT))
        depth = read_depth(file.parent / str(entry["depth_file_path"])).astype(np.float32) * np.float32(unit)
    T_world_ego = T_world_cam @ invert(T_EGO_CAM_AXES)
    view = View(image, camera, depth, name="camera")
    time, token = float(entry.get("time", index)), Path(str(entry["file_path"])).stem
    return Frame(index, time, T_world_ego, (view,), token=token, poses={"lidar_ego": T_world_ego})


def _camera(entry: Mapping[str, Any], width: int, height: int, where: str) -> Camera:
    told = (int(entry.get("w", width)), int(entry.get("h", height)))
    if told != (width, height):
        raise DataError(
            f"image of {where} has another size than its camera",
            expected=f"{told[0]} x {told[1]}",
            got=f"{width} x {height}",
            fix="is it from a folder of smaller copies?",
        )
    try:
        fx = float(entry["fl_x"]) if "fl_x" in entry else 0.5 * width / math.tan(0.5 * float(entry["camera_angle_x"]))
        fy = float(entry.get("fl_y", fx))
        cx, cy = float(entry.get("cx", width / 2)) - 0.5, float(entry.get("cy", height / 2)) - 0.5
        model = str(entry.get("camera_model", "OPENCV"))
        if model not in _LENSES:
            raise DataError(
                f"camera model of {where} is not supported", expected=" or ".join(_LENSES), got=model,
                fix="undistort the images first",
            )  # fmt: skip
        lens, names = _LENSES[model]
        distortion = tuple(float(entry.get(name, 0.0)) for name in names)
    except KeyError as error:
        raise DataError(f"{where} lacks its focal length", expected="fl_x or camera_angle_x") from error
    except (TypeError, ValueError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"camera of {where} cannot be read", expected="numbers", got=error) from error
    if lens == "brown" and not any(distortion):
        lens, distortion = "pinhole", ()
    return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), width, height, np.eye(4), distortion, lens)
