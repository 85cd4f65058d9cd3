"""KITTI odometry and SemanticKITTI: calibrated images, poses of camera 0, Velodyne sweeps, semantic voxels.

The poses are of camera 0 in the frame of the first one (z forward). Here the ego lies on the road below camera 0, x
forward and z up, and the world is the ego of the origin: grids around the ego hold the road, as they do elsewhere.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from openvocab_occ.datasets.frame import Frame, FrameSequence, View
from openvocab_occ.errors import ConfigError, DataError, NotFoundError
from openvocab_occ.geometry import T_EGO_CAM_AXES, Camera, as_pose, invert, transform
from openvocab_occ.io.files import PathLike, existing
from openvocab_occ.io.images import read_image
from openvocab_occ.io.sweeps import read_sweep
from openvocab_occ.occupancy.formats import read_semantickitti

CAMERA_HEIGHT = 1.65
"""Metres from the road to camera 0, by the data set's sensor setup."""
T_EGO_CAM0 = T_EGO_CAM_AXES + np.array([[0, 0, 0, 0.0], [0, 0, 0, 0], [0, 0, 0, CAMERA_HEIGHT], [0, 0, 0, 0]])
_PARTS = {
    "image_2": (".png", ".jpg"), "image_3": (".png", ".jpg"), "image_0": (".png", ".jpg"),
    "image_1": (".png", ".jpg"), "velodyne": (".bin",), "voxels": (".label", ".bin"),
}  # fmt: skip
_PERIOD = 0.1  # s, where times.txt is absent
_SWEEP_COLUMNS = 4


@dataclass(frozen=True)
class _Drive:
    """One sequence before its files are read."""

    name: str
    parts: Mapping[str, Mapping[str, Path]]
    """Files of each part by frame name."""
    calibration: Mapping[str, Float[np.ndarray, "3 4"]]
    poses: Float[np.ndarray, "n 4 4"]
    times: Sequence[float]


def load_kitti(
    root: PathLike | None,
    *,
    scene: str | None = None,
    cameras: Sequence[str] | None = None,
    poses: PathLike | None = None,
    labels: bool = True,
) -> FrameSequence:
    """Open a sequence; parts that are absent (images, sweeps, voxels) are left out.

    Grids given by `occupancy=` in KITTI's own way are in the Velodyne's frame: pass `occupancy_frame="lidar"`.

    Args:
        root: The folder that holds `sequences/`, or a sequence folder with `calib.txt`.
        scene: Such as `00`; needed where the root holds several.
        cameras: Such as `image_2`; by default the colour ones that are there, else the grey ones.
        poses: A pose file; by default `poses/SCENE.txt`, else `poses.txt` in the sequence folder.
        labels: Read SemanticKITTI's voxels; frames without (it has every fifth) have no occupancy.
    """
    if root is None:
        raise ConfigError("kitti needs a root", expected="the folder that holds sequences/", got=None)
    folder = existing(root, "KITTI folder")
    sequence = _sequence_folder(folder, scene)
    parts = {name: _files(sequence / name, endings) for name, endings in _PARTS.items()}
    images = [name for name in parts if name.startswith("image_") and parts[name]]
    chosen = tuple(cameras or [name for name in ("image_2", "image_3") if name in images] or images)
    for name in chosen:
        if name not in images:
            raise ConfigError(f"{sequence} has no camera {name}", expected=" or ".join(images) or "none: no images")
    if not labels:
        parts["voxels"] = {}
    names = sorted({name for part in (*chosen, "velodyne") for name in parts[part]} or set(parts["voxels"]))
    if not names:
        raise NotFoundError("no frames", expected=f"image_2 or velodyne in {sequence}", fix="check the path")
    drive = _Drive(
        sequence.name,
        parts,
        _calibration(existing(sequence / "calib.txt", "KITTI calibration")),
        _poses(folder, sequence, poses),
        _times(sequence / "times.txt"),
    )
    count = len(drive.poses)
    last = max(int(name) for name in names if name.isdecimal()) if any(n.isdecimal() for n in names) else -1
    if last >= count:
        raise DataError(
            f"poses of sequence {drive.name} do not reach its last frame", expected=f"{last + 1} rows", got=count
        )
    return FrameSequence(
        drive.name,
        range(len(names)),
        lambda index: _frame(index, names[index], drive, chosen),
        source="kitti",
        files=lambda index: [
            drive.parts[part][names[index]]
            for part in (*chosen, "velodyne", "voxels")
            if names[index] in drive.parts[part]
        ],
    )


def _sequence_folder(folder: Path, scene: str | None) -> Path:
    if (folder / "calib.txt").is_file():
        if scene not in (None, folder.name):
            raise ConfigError(f"{folder} is one sequence", expected=f"no scene, or {folder.name}", got=scene)
        return folder
    sequences = folder / "sequences" if (folder / "sequences").is_dir() else folder / "dataset" / "sequences"
    if not sequences.is_dir():
        raise NotFoundError(
            "no KITTI sequence", expected=f"{folder}/sequences/SS, or calib.txt in {folder}", fix="check the path"
        )
    found = sorted(path.name for path in sequences.iterdir() if path.is_dir())
    if scene is None and len(found) != 1:
        raise ConfigError(f"{sequences} holds several sequences", expected="scene=", got=", ".join(found[:8]))
    chosen = found[0] if scene is None else scene
    if chosen not in found:
        raise ConfigError(f"{sequences} has no sequence {chosen!r}", expected=", ".join(found[:25]))
    return sequences / chosen


def _files(folder: Path, endings: tuple[str, ...]) -> dict[str, Path]:
    """List a folder once; where a name has several endings, the first of them is taken."""
    found: dict[str, Path] = {}
    if folder.is_dir():
        files = [path for path in folder.iterdir() if path.suffix in endings]
        for path in sorted(files, key=lambda path: -endings.index(path.suffix)):
            found[path.stem] = path
    return found


def _numbers(line: str, where: str) -> list[float]:
    try:
        return [float(word) for word in line.split()]
    except ValueError as error:
        raise DataError(f"{where} holds no numbers", expected="numbers", got=line[:60]) from error


def _calibration(file: Path) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    for line in file.read_text().splitlines():
        name, colon, rest = line.partition(":")
        if colon:
            values = _numbers(rest, f"{name} of {file.name}")
            if len(values) == 12:
                found[name.strip()] = np.array(values).reshape(3, 4)
    return found


def _poses(folder: Path, sequence: Path, given: PathLike | None) -> np.ndarray:
    """Return T_origin_cam0 of each frame."""
    places = [folder / "poses", sequence.parent.parent / "poses"]
    found = [place / f"{sequence.name}.txt" for place in places] + [sequence / "poses.txt"]
    file = Path(given) if given is not None else next((path for path in found if path.is_file()), found[-1])
    rows = [
        _numbers(line, f"row {i} of {file.name}")
        for i, line in enumerate(existing(file, "KITTI poses").read_text().splitlines())
        if line.strip()
    ]
    if not rows or any(len(row) != 12 for row in rows):
        raise DataError(f"{file} holds no poses of KITTI", expected="rows of 12 numbers, at least one")
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3] = np.array(rows).reshape(-1, 3, 4)
    return T


def _times(file: Path) -> list[float]:
    return [_numbers(line, file.name)[0] for line in file.read_text().splitlines() if line.strip()] if (
        file.is_file()
    ) else []  # fmt: skip


def _frame(index: int, name: str, drive: _Drive, cameras: Sequence[str]) -> Frame:
    row = int(name) if name.isdecimal() else index
    T_world_cam0 = T_EGO_CAM0 @ as_pose(drive.poses[row], f"pose of frame {name}")
    T_world_ego = T_world_cam0 @ invert(T_EGO_CAM0)
    poses = {"lidar_ego": T_world_ego}
    if "Tr" in drive.calibration:
        poses["lidar"] = T_world_cam0 @ as_pose(drive.calibration["Tr"], f"Tr of sequence {drive.name}")
    points = occupancy = None
    sweep, voxels = drive.parts["velodyne"].get(name), drive.parts["voxels"].get(name)
    if (sweep or voxels) and "lidar" not in poses:
        raise DataError(f"calib.txt of sequence {drive.name} lacks Tr", expected="Velodyne to camera 0")
    if sweep is not None:
        T_ego_lidar = invert(T_world_ego) @ poses["lidar"]
        points = transform(T_ego_lidar, read_sweep(sweep, _SWEEP_COLUMNS)).astype(np.float32)
    if voxels is not None:
        invalid = voxels.with_suffix(".invalid")
        hidden = invalid if voxels.suffix == ".label" and invalid.is_file() else None
        occupancy = read_semantickitti(voxels, hidden, poses["lidar"])
    views = tuple(_view(drive, camera, name, T_world_cam0) for camera in cameras)
    time = drive.times[row] if row < len(drive.times) else row * _PERIOD
    return Frame(index, time, T_world_ego, views, occupancy, points, name, poses)


def _view(drive: _Drive, camera: str, name: str, T_world_cam0: Float[np.ndarray, "4 4"]) -> View:
    """Read an image; its projection matrix P = K [I | K^-1 p] tells how far the camera stands from camera 0."""
    P = drive.calibration.get(f"P{camera[-1]}")
    if P is None:
        raise DataError(f"calib.txt of sequence {drive.name} lacks P{camera[-1]}", expected=f"that of {camera}")
    K = P[:, :3]
    T_cam_cam0 = np.eye(4)
    T_cam_cam0[:3, 3] = np.linalg.solve(K, P[:, 3])
    file = drive.parts[camera].get(name)
    if file is None:
        raise NotFoundError(f"image of frame {name} not found", expected=f"{camera}/{name}.png", fix="drop the camera")
    image = read_image(file)
    return View(image, Camera(K, image.shape[1], image.shape[0], T_world_cam0 @ invert(T_cam_cam0)), name=camera)
