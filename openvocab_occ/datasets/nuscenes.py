"""nuScenes as it is downloaded: JSON tables, samples/, and Occ3D's gts/ beside them where there are any."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from openvocab_occ.datasets.frame import Frame, FrameSequence, View
from openvocab_occ.datasets.nuscenes_tables import (
    DataRow,
    LogRow,
    MountRow,
    PoseRow,
    SampleRow,
    SceneRow,
    SensorRow,
    find_tables,
    read_rows,
    scene_names_of,
)  # fmt: skip
from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.geometry import Camera, pose, transform
from openvocab_occ.io.files import PathLike, existing
from openvocab_occ.io.images import read_image
from openvocab_occ.io.sweeps import read_sweep
from openvocab_occ.occupancy.occ3d import read_occ3d

LIDAR = "LIDAR_TOP"
_SWEEP_COLUMNS = 5
_MADE_UP = "v1.0-city"  # what `openvocab-occ city` writes


@dataclass(frozen=True)
class _Shot:
    """One sensor's file of a keyframe, and where it was taken."""

    path: Path
    T_world_ego: Float[np.ndarray, "4 4"]
    T_ego_sensor: Float[np.ndarray, "4 4"]
    K: list[list[float]]


@dataclass(frozen=True)
class _Key:
    """A keyframe before its files are read."""

    sample: SampleRow
    scene: str
    shots: Callable[[], dict[str, _Shot]]


def load_nuscenes(
    root: PathLike | None,
    *,
    scene: str | None = None,
    version: str | None = None,
    split: str | None = None,
    cameras: Sequence[str] | None = None,
    lidar: bool = True,
    labels: bool = True,
) -> FrameSequence:
    """Open the keyframes of a scene, or of all scenes, in order of time; files are read when a frame is.

    The ego of a frame is that of LIDAR_TOP; every camera stands where the vehicle was when it took its picture. A part
    whose folder is absent (`samples/LIDAR_TOP`, `gts/SCENE`) is left out; a missing file in a folder that is there is
    an error of its frame. `sequence.info` tells location, description and log of a single scene.

    Args:
        root: The folder that holds `v1.0-*`, `samples` and perhaps `gts`.
        scene: Name or token.
        version: Such as `v1.0-mini`, where the root holds several.
        split: `train`, `val` or `test`: by Occ3D's `annotations.json` where it is, else the official ones.
        cameras: Channels to read, in this order; all of them by default.
        lidar: Read the sweeps.
        labels: Read Occ3D's labels.
    """
    if root is None:
        raise ConfigError("nuscenes needs a root", expected="the folder that holds v1.0-*", got=None)
    folder = existing(root, "nuScenes folder")
    tables = find_tables(folder, version)
    folder = tables.parent if tables == folder else folder
    scenes = read_rows(tables, "scene", SceneRow)
    if split is not None:
        names = scene_names_of(folder, tables, split)
        scenes = [row for row in scenes if row.name in names]
    if scene is not None:
        known = scenes
        scenes = [row for row in scenes if scene in (row.name, row.token)]
        if not scenes:
            few = ", ".join(row.name for row in known[:8]) + (", ..." if len(known) > 8 else "")
            raise ConfigError(f"{tables.name} has no scene {scene!r}", expected=few or "no scene: it holds none")
    keys = _keys(folder, tables, scenes)
    has_lidar = lidar and (folder / "samples" / LIDAR).is_dir()

    def labels_of(key: _Key) -> Path | None:
        gts = folder / "gts" / key.scene
        return gts / key.sample.token / "labels.npz" if labels and gts.is_dir() else None

    def files(index: int) -> list[Path]:
        shots, target = keys[index].shots(), labels_of(keys[index])
        wanted = [name for name in cameras or shots if name in shots and shots[name].K] + [LIDAR] * has_lidar
        return [shots[name].path for name in wanted if name in shots] + ([target] if target else [])

    return FrameSequence(
        scenes[0].name if len(scenes) == 1 else tables.name,
        range(len(keys)),
        lambda index: _frame(index, keys[index], cameras, has_lidar, labels_of(keys[index])),
        source="nuscenes",
        synthetic=tables.name == _MADE_UP,
        files=files,
        info=_info(tables, scenes),
    )


def _keys(folder: Path, tables: Path, scenes: Sequence[SceneRow]) -> list[_Key]:
    names = {row.token: row.name for row in scenes}
    rank = {row.token: i for i, row in enumerate(scenes)}
    samples = read_rows(tables, "sample", SampleRow, lambda row: row.scene_token in names)
    samples.sort(key=lambda row: (rank[row.scene_token], row.timestamp))
    wanted = {row.token for row in samples}
    data = read_rows(tables, "sample_data", DataRow, lambda row: row.is_key_frame and row.sample_token in wanted)
    used = {row.ego_pose_token for row in data}
    egos = {row.token: row for row in read_rows(tables, "ego_pose", PoseRow, lambda row: row.token in used)}
    mounts = {row.token: row for row in read_rows(tables, "calibrated_sensor", MountRow)}
    sensors = {row.token: row for row in read_rows(tables, "sensor", SensorRow)}
    shots: dict[str, list[DataRow]] = {token: [] for token in wanted}
    for row in data:
        shots[row.sample_token].append(row)

    def shots_of(token: str) -> dict[str, _Shot]:
        """Join the tables of one keyframe, when it is asked for."""
        found: dict[str, _Shot] = {}
        for row in shots[token]:
            ego, mount = egos.get(row.ego_pose_token), mounts.get(row.calibrated_sensor_token)
            sensor = None if mount is None else sensors.get(mount.sensor_token)
            if ego is None or mount is None or sensor is None:
                gone = "ego_pose" if ego is None else "calibrated_sensor" if mount is None else "sensor"
                raise DataError(f"table {gone} lacks a row", expected=f"that of {row.filename} (sample {token})")
            found[sensor.channel] = _Shot(
                folder / row.filename,
                pose(ego.translation, ego.rotation),
                pose(mount.translation, mount.rotation),
                mount.camera_intrinsic,
            )
        return dict(sorted(found.items(), key=lambda item: _CHANNELS.get(item[0], len(_CHANNELS))))

    return [_Key(row, names[row.scene_token], lambda token=row.token: shots_of(token)) for row in samples]


_CHANNELS = {
    name: i
    for i, name in enumerate(
        ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT")
    )
}


def _frame(index: int, key: _Key, cameras: Sequence[str] | None, has_lidar: bool, target: Path | None) -> Frame:
    shots = key.shots()
    where = f"frame {index} ({key.sample.token})"
    known = [name for name, shot in shots.items() if shot.K]
    unknown = sorted(set(cameras or ()) - set(known))
    if unknown:
        raise ConfigError(f"{where} has no camera {', '.join(unknown)}", expected=", ".join(known) or "no camera")
    if not shots:
        raise DataError(f"{where} has no sensor data", expected="rows of it in sample_data")
    reference = shots[LIDAR] if LIDAR in shots else next(iter(shots.values()))
    poses = {"lidar_ego": reference.T_world_ego}
    points = None
    if LIDAR in shots:
        poses["lidar"] = reference.T_world_ego @ reference.T_ego_sensor
        if has_lidar:
            sweep = read_sweep(reference.path, _SWEEP_COLUMNS, what=f"LiDAR sweep of {where}")
            points = transform(reference.T_ego_sensor, sweep).astype(np.float32)
    if "CAM_FRONT_LEFT" in shots:
        poses["cam_front_left_ego"] = shots["CAM_FRONT_LEFT"].T_world_ego
    return Frame(
        index,
        key.sample.timestamp * 1e-6,
        reference.T_world_ego,
        tuple(_view(shots[name], name) for name in cameras or known),
        None if target is None else read_occ3d(target, reference.T_world_ego),
        points,
        key.sample.token,
        poses,
    )


def _view(shot: _Shot, channel: str) -> View:
    image = read_image(shot.path)
    T_world_cam = shot.T_world_ego @ shot.T_ego_sensor
    return View(image, Camera(np.asarray(shot.K), image.shape[1], image.shape[0], T_world_cam), name=channel)


def _info(tables: Path, scenes: Sequence[SceneRow]) -> dict[str, str]:
    if len(scenes) != 1:
        return {"version": tables.name}
    logs = {row.token: row for row in read_rows(tables, "log", LogRow)}
    log = logs.get(scenes[0].log_token, LogRow(token=""))
    return {
        "version": tables.name,
        "location": log.location,
        "log": log.logfile,
        "vehicle": log.vehicle,
        "date": log.date_captured,
        "description": scenes[0].description,
    }
