"""RGB-D recordings: 7-Scenes and 3DMatch, TUM, and what ScanNet's exporter writes.

A frame is one view with measured depth, so no occupancy is needed. The ego is the camera, its axes turned to x forward,
y left, z up of the camera. The world is the source's own; `up=` turns it where its up is not z (3DMatch: often `y`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8

from openvocab_occ.datasets.frame import Frame, FrameSequence, View
from openvocab_occ.errors import ConfigError, DataError, NotFoundError
from openvocab_occ.geometry import T_EGO_CAM_AXES, Camera, Trajectory, as_pose, invert, pose, turn_up
from openvocab_occ.io.files import PathLike, existing
from openvocab_occ.io.images import read_depth, read_image

INVALID_DEPTHS = (0, 65535)
"""Raw values that mean there is none."""
_SCALES = {"7scenes": 1000.0, "tum": 5000.0, "scannet": 1000.0}
_DEFAULT_INTRINSICS = {"7scenes": (585.0, 585.0, 320.0, 240.0), "tum": (525.0, 525.0, 319.5, 239.5)}
_DEFAULT_SIZE = (640, 480)
_COLOR_ENDINGS = (".color.png", ".color.jpg")


@dataclass(frozen=True)
class _Shot:
    """A frame before its files are read."""

    token: str
    timestamp: float
    color: Path
    depth: Path
    pose: Path | Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class _Lenses:
    """fx, fy, cx, cy of both cameras; None where the file does not say and the size must tell."""

    color: tuple[float, float, float, float] | None
    depth: tuple[float, float, float, float] | None
    layout: str


def load_rgbd(
    root: PathLike | None,
    *,
    scene: str | None = None,
    layout: str | None = None,
    depth_scale: float | int | None = None,
    intrinsics: Sequence[float] | None = None,
    tolerance: float | int = 0.02,
    up: str = "z",
) -> FrameSequence:
    """Open a recording.

    Layouts, told apart by their files: `7scenes` (`frame-000000.color.png`, `.depth.png`, `.pose.txt`; also 3DMatch),
    `tum` (`rgb.txt`, `depth.txt`, `groundtruth.txt`) and `scannet` (`color/`, `depth/`, `pose/`, `intrinsic/`; frames
    without a finite pose are left out). Where colour and depth differ in size, the colour is resampled to the depth.

    Args:
        root: Folder of the recording, or of several.
        scene: Its sub-folder, where the root holds several, such as `seq-01`.
        layout: Only where it cannot be told from the files.
        depth_scale: Raw depth of a metre: 1000, for `tum` 5000.
        intrinsics: fx, fy, cx, cy, before those of a file; without either, the data set's published ones for 640 x 480.
        tolerance: Seconds between colour, depth and pose of `tum`.
        up: Axis of the source's world that points up.
    """
    if root is None:
        raise ConfigError("rgbd needs a root", expected="the folder of a recording", got=None)
    top = existing(root, "RGB-D folder")
    folder = _recording(top, scene)
    layout = layout or _layout(folder)
    if layout not in _SCALES:
        raise ConfigError("layout is not known", expected=" or ".join(_SCALES), got=repr(layout))
    scale = float(depth_scale if depth_scale is not None else _SCALES[layout])
    if not (np.isfinite(scale) and scale > 0):
        raise ConfigError("depth_scale is not usable", expected="the raw depth of a metre, above 0", got=depth_scale)
    shots = {"7scenes": _seven_scenes, "scannet": _scannet, "tum": lambda f: _tum(f, tolerance)}[layout](folder)
    lenses = _lenses(top, folder, layout, intrinsics)
    turn = turn_up(up)
    return FrameSequence(
        folder.name,
        range(len(shots)),
        lambda index: _frame(index, shots[index], lenses, scale, turn),
        source="rgbd",
        files=lambda index: [
            shots[index].color, shots[index].depth, *([p] if isinstance(p := shots[index].pose, Path) else []),
        ],
    )  # fmt: skip


def _layout(folder: Path) -> str:
    if (folder / "rgb.txt").is_file():
        return "tum"
    if (folder / "color").is_dir() and (folder / "pose").is_dir():
        return "scannet"
    if next(folder.glob("frame-*.depth.png"), None) is not None:
        return "7scenes"
    raise NotFoundError(
        f"no RGB-D recording in {folder}",
        expected="frame-*.depth.png (7-Scenes, 3DMatch), rgb.txt (TUM) or color/ and pose/ (ScanNet)",
        fix="pass the folder of the frames, or scene=",
    )


def _recording(top: Path, scene: str | None) -> Path:
    if scene is not None:
        return existing(top / scene, f"recording {scene}")
    try:
        _layout(top)
    except NotFoundError:
        inner = []
        for path in sorted(p for p in top.iterdir() if p.is_dir()):
            try:
                _layout(path)
            except NotFoundError:
                continue
            inner.append(path)
        if len(inner) > 1:
            names = ", ".join(path.name for path in inner[:8])
            raise ConfigError(f"{top} holds several recordings", expected="scene=", got=names) from None
        if not inner:
            raise
        return inner[0]
    return top


def _seven_scenes(folder: Path) -> list[_Shot]:
    """List the frames; which of a frame's files is there is looked at when it is read."""
    names = {path.name for path in folder.iterdir()}
    stems = sorted({name.split(".")[0] for name in names if name.startswith("frame-")})
    shots = []
    for i, stem in enumerate(stems):
        ending = next((e for e in _COLOR_ENDINGS if stem + e in names), _COLOR_ENDINGS[0])
        number = stem.removeprefix("frame-")
        time = int(number) / 30 if number.isdecimal() else i / 30
        shots.append(
            _Shot(stem, time, folder / (stem + ending), folder / f"{stem}.depth.png", folder / f"{stem}.pose.txt")
        )
    return shots


def _scannet(folder: Path) -> list[_Shot]:
    colors = {path.stem: path for path in (folder / "color").iterdir() if path.suffix in (".jpg", ".png")}
    shots = []
    for name in sorted(colors, key=lambda n: (int(n) if n.isdecimal() else -1, n)):
        file = folder / "pose" / f"{name}.txt"
        if file.is_file() and b"inf" in file.read_bytes().lower():
            continue  # tracking was lost there
        time = int(name) / 30 if name.isdecimal() else float(len(shots))
        shots.append(_Shot(name, time, colors[name], folder / "depth" / f"{name}.png", file))
    return shots


def _tum(folder: Path, tolerance: float) -> list[_Shot]:
    """Match each colour image with the nearest depth image, and with the ground truth of its own time."""
    colors, depths = (sorted(_timed(folder / name), key=lambda row: row[0]) for name in ("rgb.txt", "depth.txt"))
    rows = _timed(folder / "groundtruth.txt")
    if not colors or not depths:
        return []
    try:
        values = np.array([[float(word) for word in words] for _, words in rows]).reshape(-1, 7)
    except ValueError as error:
        raise DataError("groundtruth.txt cannot be read", expected="time tx ty tz qx qy qz qw", got=error) from error
    truth = Trajectory(
        [time for time, _ in rows],
        np.array([pose(row[:3], row[[6, 3, 4, 5]]) for row in values]).reshape(-1, 4, 4),
        "groundtruth.txt",
    )
    stamps = np.array([time for time, _ in depths])
    shots = []
    for time, words in colors:
        after = int(np.searchsorted(stamps, time))
        nearest = min((i for i in (after - 1, after) if 0 <= i < len(stamps)), key=lambda i: abs(stamps[i] - time))
        if abs(stamps[nearest] - time) > tolerance:
            continue  # a colour image without depth
        try:
            T = truth.at(time, tolerance=tolerance, max_gap=2 * max(tolerance, 0.05))
        except NotFoundError:
            continue  # the camera was not tracked then
        shots.append(_Shot(f"{time:.6f}", time, folder / words[0], folder / depths[nearest][1][0], T))
    return shots


def _timed(file: Path) -> list[tuple[float, list[str]]]:
    rows = []
    for line in existing(file, "TUM list").read_text().splitlines():
        words = line.replace(",", " ").split("#")[0].split()
        if not words:
            continue
        try:
            rows.append((float(words[0]), words[1:]))
        except ValueError as error:
            raise DataError(
                f"{file.name} cannot be read", expected="a time first in each row", got=line[:60]
            ) from error
        if not words[1:]:
            raise DataError(f"{file.name} cannot be read", expected="a time and more in each row", got=line[:60])
    return rows


def _lenses(top: Path, folder: Path, layout: str, given: Sequence[float] | None) -> _Lenses:
    if given is not None:
        values = tuple(float(v) for v in given)
        if len(values) != 4:
            raise ConfigError("intrinsics are not usable", expected="fx, fy, cx, cy", got=list(given))
        return _Lenses(values, values, layout)
    if layout == "scannet":
        color, depth = (folder / "intrinsic" / f"intrinsic_{name}.txt" for name in ("color", "depth"))
        found = _read_lens(existing(depth, "ScanNet intrinsics"))
        return _Lenses(_read_lens(color) if color.is_file() else found, found, layout)
    for place in (folder, top, folder.parent):
        for name in ("camera-intrinsics.txt", "intrinsics.txt"):
            if (place / name).is_file():
                found = _read_lens(place / name)
                return _Lenses(found, found, layout)
    return _Lenses(None, None, layout)


def _read_lens(file: Path) -> tuple[float, float, float, float]:
    try:
        K = np.array(file.read_text().split(), dtype=np.float64)
    except ValueError as error:
        raise DataError(f"{file.name} holds no camera matrix", expected="3x3 or 4x4 numbers", got=error) from error
    if K.size not in (9, 16):
        raise DataError(f"{file.name} holds no camera matrix", expected="3x3 or 4x4 numbers", got=f"{K.size} numbers")
    side = 3 if K.size == 9 else 4
    K = K.reshape(side, side)
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def _frame(index: int, shot: _Shot, lenses: _Lenses, scale: float, turn: Float[np.ndarray, "4 4"]) -> Frame:
    image, raw = read_image(shot.color), read_depth(shot.depth)
    T_world_cam = turn @ (_read_pose(shot.pose) if isinstance(shot.pose, Path) else shot.pose)
    depth = raw.astype(np.float32) / np.float32(scale)
    depth[np.isin(raw, INVALID_DEPTHS)] = 0.0
    size = (raw.shape[1], raw.shape[0])
    camera = _camera(lenses.depth, size, lenses.layout).at(T_world_cam)
    if image.shape[:2] != raw.shape:
        image = _resampled(image, _camera(lenses.color, (image.shape[1], image.shape[0]), lenses.layout), camera)
    T_world_ego = T_world_cam @ invert(T_EGO_CAM_AXES)
    view = View(image, camera, depth, name="camera")
    return Frame(index, shot.timestamp, T_world_ego, (view,), token=shot.token, poses={"lidar_ego": T_world_ego})


def _camera(lens: tuple[float, float, float, float] | None, size: tuple[int, int], layout: str) -> Camera:
    if lens is None:
        if size != _DEFAULT_SIZE:
            raise ConfigError(
                "the camera is not told",
                expected="intrinsics=(fx, fy, cx, cy) or camera-intrinsics.txt",
                got=f"images of {size[0]} x {size[1]}",
            )
        lens = _DEFAULT_INTRINSICS[layout]
    fx, fy, cx, cy = lens
    return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), *size)


def _resampled(image: UInt8[np.ndarray, "h w 3"], color: Camera, depth: Camera) -> UInt8[np.ndarray, "y x 3"]:
    """Return the colour that each pixel of the depth camera sees; the two share one place."""
    import cv2

    rays = depth.rays().reshape(-1, 3)
    where: Float32[np.ndarray, "n 2"] = (rays @ color.K.T)[:, :2].astype(np.float32)
    maps = where.reshape(depth.height, depth.width, 2)
    return cv2.remap(image, maps, None, cv2.INTER_LINEAR)  # pyright: ignore[reportCallIssue, reportArgumentType, reportReturnType]


def _read_pose(file: Path) -> Float[np.ndarray, "4 4"]:
    try:
        values = np.array(existing(file, "pose file").read_text().split(), dtype=np.float64)
    except ValueError as error:
        raise DataError(f"{file.name} holds no pose", expected="4x4 numbers", got=error) from error
    if values.size != 16:
        raise DataError(f"{file.name} holds no pose", expected="4x4 numbers", got=f"{values.size} numbers")
    return as_pose(values.reshape(4, 4), f"pose in {file.name}")
