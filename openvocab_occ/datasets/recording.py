"""Our own plain folder, for people with data of their own: images, grids, and one JSON line a frame.

docs/recording.md tells the format; `write_recording` writes it.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float, Float32

from openvocab_occ.datasets.frame import Frame, FrameSequence, View
from openvocab_occ.datasets.predictions import GridFormat, read_prediction
from openvocab_occ.errors import ConfigError, DataError, ShapeError, UnsafeFileError
from openvocab_occ.geometry import Camera, GridSpec, as_pose
from openvocab_occ.io.files import PathLike, existing
from openvocab_occ.io.images import read_depth, read_image
from openvocab_occ.io.numbers import read_arrays
from openvocab_occ.occupancy import OccupancyGrid

FRAMES_FILE = "frames.jsonl"
HEADER_FILE = "recording.json"
FORMAT = "openvocab_occ recording"
VERSION = 1
DEPTH_SCALE = 1000.0
"""Steps of a depth image in a metre, where the header does not say."""


class _When(msgspec.Struct):
    """All that is read of a line before its frame is asked for."""

    timestamp: float


def load_recording(root: PathLike | None, *, scene: str | None = None) -> FrameSequence:
    """Open a recording; its frames come in order of time.

    Args:
        root: The folder with `frames.jsonl`, or one of several such folders.
        scene: The sub-folder, where the root holds several.
    """
    if root is None:
        raise ConfigError("recording needs a root", expected=f"the folder of {FRAMES_FILE}", got=None)
    folder = existing(root, "recording")
    folder = existing(folder / scene, f"recording {scene}") if scene is not None else folder
    lines = existing(folder / FRAMES_FILE, "list of frames").read_bytes().splitlines()
    lines = [line for line in lines if line.strip()]
    header = _header(folder)
    times = [_when(line, number) for number, line in enumerate(lines, start=1)]
    order = sorted(range(len(lines)), key=lambda i: times[i])

    def entry(index: int) -> dict[str, Any]:
        return json.loads(lines[order[index]])

    return FrameSequence(
        str(header.get("name") or folder.name),
        range(len(lines)),
        lambda index: _frame(index, entry(index), folder, header),
        source="recording",
        synthetic=bool(header.get("synthetic", False)),
        files=lambda index: [folder / name for name in _names(entry(index))],
    )


def grid_entry(grid: OccupancyGrid) -> dict[str, Any]:
    """Return what a grid's arrays mean, as JSON."""
    return {
        "origin": list(grid.spec.origin),
        "voxel_size": grid.spec.voxel_size,
        "shape": list(grid.spec.shape),
        "class_names": list(grid.class_names),
        "free_label": grid.free_label,
    }


def _header(folder: Path) -> dict[str, Any]:
    file = folder / HEADER_FILE
    if not file.is_file():
        return {}
    try:
        header = json.loads(file.read_bytes())
    except ValueError as error:
        raise DataError(f"{HEADER_FILE} is not JSON", got=error) from error
    if not isinstance(header, dict) or header.get("format", FORMAT) != FORMAT:
        raise DataError(f"{HEADER_FILE} is of another kind", expected=f"an object of format {FORMAT!r}")
    if int(header.get("version", VERSION)) > VERSION:
        raise DataError(f"{HEADER_FILE} is from the future", expected=f"version {VERSION}", got=header["version"])
    return header


def _when(line: bytes, number: int) -> float:
    try:
        return msgspec.json.decode(line, type=_When).timestamp
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise DataError(
            f"line {number} of {FRAMES_FILE} cannot be read", expected="a JSON object with a timestamp", got=error
        ) from error


def _names(entry: Mapping[str, Any]) -> list[str]:
    views = [view[key] for view in entry.get("views", ()) for key in ("image", "depth") if view.get(key)]
    return [*views, *[entry[key] for key in ("points", "occupancy") if entry.get(key)]]


def _inside(folder: Path, name: object) -> Path:
    """Return a file below the folder; a recording may come from anyone."""
    path = folder / str(name)
    if not path.resolve().is_relative_to(folder.resolve()):
        raise UnsafeFileError("the recording names a file outside its folder", expected="a path below it", got=name)
    return path


def _frame(index: int, entry: Mapping[str, Any], folder: Path, header: Mapping[str, Any]) -> Frame:
    where = f"frame {index} ({entry.get('token', '')})"
    T_world_ego = _pose(entry, "T_world_ego", where)
    poses = {"lidar_ego": T_world_ego}
    poses |= {
        name: as_pose(np.asarray(value, dtype=np.float64), f"pose {name} of {where}")
        for name, value in entry.get("poses", {}).items()
    }
    views = tuple(_view(view, T_world_ego, folder, header, where) for view in entry.get("views", ()))
    points = None if not entry.get("points") else _points(_inside(folder, entry["points"]), where)
    occupancy = None if not entry.get("occupancy") else _occupancy(entry, T_world_ego, folder, header, where)
    token = str(entry.get("token", index))
    return Frame(index, float(entry["timestamp"]), T_world_ego, views, occupancy, points, token, poses)


def _view(
    entry: Mapping[str, Any],
    T_world_ego: Float[np.ndarray, "4 4"],
    folder: Path,
    header: Mapping[str, Any],
    where: str,
) -> View:
    """Read an image; what the line does not say of its camera, the header's `cameras` does."""
    name = str(entry.get("name", "camera"))
    entry = {**header.get("cameras", {}).get(name, {}), **entry}
    what = f"view {name} of {where}"
    if "image" not in entry or "K" not in entry:
        raise DataError(f"{what} is incomplete", expected="image and K", got=", ".join(entry))
    image = read_image(_inside(folder, entry["image"]))
    if "T_world_cam" in entry:
        T_world_cam = _pose(entry, "T_world_cam", what)
    else:
        T_world_cam = T_world_ego @ _pose(entry, "T_ego_cam", what)
    camera = Camera(
        np.asarray(entry["K"], dtype=np.float64), image.shape[1], image.shape[0], T_world_cam,
        tuple(float(k) for k in entry.get("distortion", ())), entry.get("lens", "pinhole"),
    )  # fmt: skip
    depth = None
    if entry.get("depth"):
        scale = float(header.get("depth_scale", DEPTH_SCALE))
        depth = read_depth(_inside(folder, entry["depth"])).astype(np.float32) / np.float32(scale)
    return View(image, camera, depth, name)


def _points(file: Path, where: str) -> Float32[np.ndarray, "n 3"]:
    array = read_arrays(file, f"points of {where}").get("")
    if array is None or array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind != "f":
        got = "several arrays" if array is None else f"{array.dtype} {array.shape}"
        raise ShapeError(f"points of {where} are of another kind", expected="an .npy of floats (n, 3)", got=got)
    array = array[:, :3].astype(np.float32)
    return np.ascontiguousarray(array[np.isfinite(array).all(axis=1)])


def _occupancy(
    entry: Mapping[str, Any],
    T_world_ego: Float[np.ndarray, "4 4"],
    folder: Path,
    header: Mapping[str, Any],
    where: str,
) -> OccupancyGrid:
    told = entry.get("grid", header.get("grid"))
    grid = GridFormat()
    if told is not None:
        try:
            size = told["voxel_size"]
            spec = GridSpec(
                _three(told["origin"], float), _three(size, float) if isinstance(size, list) else float(size),
                _three(told["shape"], int),
            )  # fmt: skip
            grid = GridFormat(spec=spec, class_names=tuple(told["class_names"]), free_label=told.get("free_label"))
        except (KeyError, TypeError, ValueError) as error:
            if isinstance(error, DataError):
                raise
            raise DataError(
                f"grid of {where} is not told", expected="origin, voxel_size, shape, class_names", got=error
            ) from error
    T = _pose(entry, "T_world_grid", where) if "T_world_grid" in entry else T_world_ego
    return read_prediction(_inside(folder, entry["occupancy"]), grid, T, f"occupancy of {where}")


def _three(values: Any, kind: Callable[[Any], Any]) -> tuple[Any, Any, Any]:
    a, b, c = values
    return kind(a), kind(b), kind(c)


def _pose(entry: Mapping[str, Any], key: str, where: str) -> Float[np.ndarray, "4 4"]:
    if key not in entry:
        raise DataError(f"{where} lacks {key}", expected=key, got=", ".join(entry) or "nothing")
    try:
        return as_pose(np.asarray(entry[key], dtype=np.float64), f"{key} of {where}")
    except (TypeError, ValueError) as error:
        if isinstance(error, DataError):
            raise
        raise ShapeError(f"{key} of {where} is no matrix", expected="4 rows of 4 numbers", got=error) from error
