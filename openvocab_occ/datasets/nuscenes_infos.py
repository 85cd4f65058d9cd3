"""mmdetection3d v1.1 info files of nuScenes: one file that names the images, sweeps and poses of many frames."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from openvocab_occ.datasets.frame import Frame, FrameSequence, View
from openvocab_occ.errors import ConfigError, DataError, NotFoundError, ShapeError
from openvocab_occ.geometry import Camera, as_pose, invert, transform
from openvocab_occ.io.files import PathLike, existing
from openvocab_occ.io.images import read_image
from openvocab_occ.io.plain_pickle import read_plain_pickle
from openvocab_occ.io.sweeps import read_sweep

_MICROSECONDS = 1e12  # a time above this is no number of seconds; some converters leave nuScenes' microseconds


def load_infos(
    root: PathLike | None, *, scene: str | None = None, cameras: Sequence[str] | None = None
) -> FrameSequence:
    """Read an info file, or the one in a folder (`.json` before `.pkl`); frames are read when asked for.

    Images and sweeps are looked for at the path the file gives, beside the file, and in `samples/CHANNEL`.

    Args:
        root: The file, or its folder.
        scene: Keep the frames whose `scene_token` or `scene_name` is this.
        cameras: Channels to read, in this order; all of them by default.
    """
    if root is None:
        raise ConfigError("nuscenes-infos needs a root", expected="an info file or its folder", got=None)
    file = _info_file(existing(root, "info file or folder"))
    entries = _entries(file)
    scenes = [entry.get("scene_name", entry.get("scene_token")) for entry in entries]
    if scene is not None:
        entries = [e for e, s in zip(entries, scenes, strict=True) if scene in (s, e.get("scene_token"))]
        if not entries:
            names = sorted({str(s) for s in scenes if s is not None})
            raise ConfigError(
                f"{file.name} has no scene {scene!r}", expected=", ".join(names[:8]) or "no scene: the file names none"
            )
    elif len(set(scenes)) == 1:
        scene = scenes[0]
    return FrameSequence(
        scene or file.stem,
        range(len(entries)),
        lambda index: _frame(entries[index], index, file, cameras),
        source="nuscenes-infos",
    )


def _info_file(root: Path) -> Path:
    if root.is_file():
        return root
    for ending in (".json", ".pkl"):
        found = sorted(root.glob(f"*{ending}"))
        named = [f for f in found if f.name == "info.json"] or found
        if len(named) > 1:
            names = ", ".join(f.name for f in named[:8])
            raise ConfigError(f"{root} has several info files", expected="one", got=names, fix="pass the file itself")
        if named:
            return named[0]
    raise NotFoundError("no info file", expected=f"a .json or .pkl in {root}", fix="pass the file itself")


def _entries(file: Path) -> list[dict[str, Any]]:
    if file.suffix == ".pkl":
        content = read_plain_pickle(file)
    else:
        try:
            content = json.loads(file.read_bytes())
        except ValueError as error:
            raise DataError(f"{file.name} is not JSON", got=error) from error
    if isinstance(content, dict) and "infos" in content:
        raise DataError(
            f"{file.name} is an info file of an older layout",
            expected="mmdetection3d v1.1 with the key data_list",
            got="the key infos",
            fix="convert it with mmdetection3d's tools/dataset_converters/update_infos_to_v2.py",
        )
    entries = content.get("data_list") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        got = ", ".join(map(str, list(content)[:8])) if isinstance(content, dict) else type(content).__name__
        raise DataError(f"{file.name} is no info file", expected="the key data_list, a list of frames", got=got)
    return entries


def _frame(entry: Mapping[str, Any], index: int, file: Path, cameras: Sequence[str] | None) -> Frame:
    token = str(entry.get("token", entry.get("sample_idx", index)))
    where = f"frame {index} ({token})"
    T_world_ego = _pose(entry, "ego2global", where)
    lidar = entry.get("lidar_points")
    T_ego_lidar = None if lidar is None else _pose(lidar, "lidar2ego", f"lidar_points of {where}")
    images: Mapping[str, Any] = _value(entry, "images", where)
    unknown = sorted(set(cameras or ()) - set(images))
    if unknown:
        raise ConfigError(f"{where} has no camera {', '.join(unknown)}", expected=", ".join(images))
    poses = {"lidar_ego": T_world_ego}
    if T_ego_lidar is not None:
        poses["lidar"] = T_world_ego @ T_ego_lidar
    if "CAM_FRONT_LEFT" in images and "cam2ego" in images["CAM_FRONT_LEFT"]:
        info = images["CAM_FRONT_LEFT"]
        T_world_cam = _camera_pose(info, T_world_ego, T_ego_lidar, f"CAM_FRONT_LEFT of {where}")
        poses["cam_front_left_ego"] = T_world_cam @ invert(_pose(info, "cam2ego", f"CAM_FRONT_LEFT of {where}"))
    views = tuple(
        _view(images[channel], channel, f"{channel} of {where}", file, T_world_ego, T_ego_lidar)
        for channel in cameras or images
    )
    timestamp = float(entry.get("timestamp", 0.0))
    return Frame(
        index,
        timestamp * 1e-6 if timestamp > _MICROSECONDS else timestamp,
        T_world_ego,
        views,
        points=None if lidar is None or T_ego_lidar is None else _points(lidar, T_ego_lidar, where, file),
        token=token,
        poses=poses,
    )


def _view(
    info: Mapping[str, Any],
    channel: str,
    where: str,
    file: Path,
    T_world_ego: Float[np.ndarray, "4 4"],
    T_ego_lidar: Float[np.ndarray, "4 4"] | None,
) -> View:
    image = read_image(_find(str(_value(info, "img_path", where)), channel, file, f"image of {where}"))
    K = _matrix(info, "cam2img", where)
    if K.ndim != 2 or min(K.shape) < 3:
        raise ShapeError(f"cam2img of {where} has the wrong shape", expected="3x3, 3x4 or 4x4", got=K.shape)
    height, width = image.shape[:2]
    camera = Camera(K[:3, :3], width, height, _camera_pose(info, T_world_ego, T_ego_lidar, where))
    return View(image, camera, name=channel)


def _camera_pose(
    info: Mapping[str, Any],
    T_world_ego: Float[np.ndarray, "4 4"],
    T_ego_lidar: Float[np.ndarray, "4 4"] | None,
    where: str,
) -> Float[np.ndarray, "4 4"]:
    """Return T_world_cam.

    `lidar2cam` holds the motion of the vehicle between the times of LiDAR and camera; `cam2ego` does not.
    """
    if "lidar2cam" in info and T_ego_lidar is not None:
        return T_world_ego @ T_ego_lidar @ invert(_pose(info, "lidar2cam", where))
    return T_world_ego @ _pose(info, "cam2ego", where)


def _points(
    lidar: Mapping[str, Any], T_ego_lidar: Float[np.ndarray, "4 4"], where: str, file: Path
) -> Float32[np.ndarray, "n 3"]:
    """Read a sweep into the ego frame; returns that are not finite are left out."""
    path = _find(str(_value(lidar, "lidar_path", where)), "LIDAR_TOP", file, f"LiDAR sweep of {where}")
    local = read_sweep(path, int(lidar.get("num_pts_feats", 5)))
    return transform(T_ego_lidar, local).astype(np.float32)


def _find(path: str, channel: str, file: Path, what: str) -> Path:
    given = Path(path)
    places = [file.parent / given, file.parent / given.name, file.parent / "samples" / channel / given.name]
    return next((place for place in places if place.is_file()), None) or existing(places[1], what)


def _value(entry: Mapping[str, Any], key: str, where: str) -> Any:
    if key not in entry:
        raise DataError(f"{where} lacks {key}", expected=key, got=", ".join(map(str, entry)) or "nothing")
    return entry[key]


def _matrix(entry: Mapping[str, Any], key: str, where: str) -> Float[np.ndarray, "..."]:
    try:
        return np.asarray(_value(entry, key, where), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ShapeError(f"{key} of {where} is no matrix", expected="rows of numbers", got=error) from error


def _pose(entry: Mapping[str, Any], key: str, where: str) -> Float[np.ndarray, "4 4"]:
    return as_pose(_matrix(entry, key, where), f"{key} of {where}")
