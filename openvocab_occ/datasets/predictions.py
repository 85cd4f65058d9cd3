"""A user's own occupancy, joined to the frames of any drive."""

import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from string import Formatter
from typing import Any

import numpy as np

from openvocab_occ.arrays import check_finite, check_shape
from openvocab_occ.datasets.frame import Frame, FrameSequence
from openvocab_occ.errors import ConfigError, DataError, GridError, OpenVocabOccError, ShapeError, UnsafeFileError
from openvocab_occ.geometry import GridSpec
from openvocab_occ.io.files import PathLike, existing
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_SPEC, OccupancyGrid

GRID_FRAMES = ("lidar_ego", "cam_front_left_ego", "lidar", "world")
"""Frames of grids: ego at LiDAR time (Occ3D), ego at the time of the front left camera, LiDAR, or the world itself."""
PLACEHOLDERS = ("token", "index", "scene", "timestamp")
OccupancySource = str | Callable[[Frame], OccupancyGrid | np.ndarray | PathLike | None]
"""A pattern of file names, or what gives a frame its grid, array or file; None leaves the frame without."""


@dataclass(frozen=True, kw_only=True)
class GridFormat:
    """What the arrays of a prediction mean."""

    spec: GridSpec = OCC3D_SPEC
    class_names: tuple[str, ...] = OCC3D_CLASSES
    free_label: int | None = None
    """The class that means empty; by default the one named `free`."""
    frame: str = "lidar_ego"
    """The frame of the grid, one of GRID_FRAMES."""

    def __post_init__(self) -> None:
        if self.frame not in GRID_FRAMES:
            raise ConfigError("occupancy_frame is not known", expected=" or ".join(GRID_FRAMES), got=repr(self.frame))
        if self.free_label is None:
            if "free" not in self.class_names:
                raise ConfigError(
                    "which class is free is not told",
                    expected="a class named free, or occupancy_free",
                    got=", ".join(self.class_names),
                )
            object.__setattr__(self, "free_label", self.class_names.index("free"))


def join_occupancy(
    sequence: FrameSequence, source: OccupancySource, *, root: PathLike | None = None, grid: GridFormat | None = None
) -> FrameSequence:
    """Return the drive with an occupancy grid on each frame, read when the frame is.

    Args:
        sequence: The drive.
        source: A file name with {token}, {index}, {scene} and {timestamp}, Python format specs allowed
            (`{index:06d}`), relative to `root`; or a function of the frame.
        root: Folder of relative names; the working folder by default.
        grid: Lattice, classes and frame of the arrays; Occ3D-nuScenes by default.
    """
    grid = grid or GridFormat()
    folder = Path(root) if root is not None else Path()
    if not callable(source):
        _check_pattern(source, len(sequence))

    def join(frame: Frame) -> Frame:
        if callable(source):
            found = source(frame)
        else:
            found = source.format(token=frame.token, index=frame.index, scene=sequence.name, timestamp=frame.timestamp)
        if found is None or isinstance(found, OccupancyGrid):
            return replace(frame, occupancy=found)
        T = _grid_pose(frame, grid.frame)
        if isinstance(found, np.ndarray):
            return replace(frame, occupancy=_grid(found, None, grid, T, f"occupancy of frame {frame.index}"))
        return replace(frame, occupancy=read_prediction(folder / found, grid, T, f"occupancy of frame {frame.index}"))

    return sequence.map(join)


def read_prediction(
    path: PathLike, grid: GridFormat | None = None, T_world_grid: np.ndarray | None = None, what: str = "occupancy"
) -> OccupancyGrid:
    """Read labels or logits from an `.npz` (`semantics`, `pred`, `logits`, any 4-D floats, `arr_0`) or `.npy`.

    Integers [x, y, z] are labels, floats [x, y, z, class] logits. `mask_lidar`, where present, becomes `known`.
    Nothing is unpickled.
    """
    grid = grid or GridFormat()
    T = np.eye(4) if T_world_grid is None else T_world_grid
    file = existing(path, f"{what} file")
    try:
        with file.open("rb") as stream:
            content: Any = np.load(stream, allow_pickle=False)
            if isinstance(content, np.lib.npyio.NpzFile):
                content = {key: content[key] for key in content.files}
            return _grid(*_choose(file.name, content), grid, T, file.name)
    except OpenVocabOccError:
        raise
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        if "allow_pickle" in str(error):
            raise UnsafeFileError(
                f"{file.name} holds pickled objects", expected="arrays of numbers", fix="save labels as uint8"
            ) from error
        raise DataError(f"{file.name} cannot be read", expected="an .npz or .npy of numbers", got=error) from error


def _check_pattern(pattern: str, frames: int) -> None:
    try:
        names = [name for _, name, _, _ in Formatter().parse(pattern) if name is not None]
    except ValueError as error:
        raise ConfigError(f"occupancy pattern {pattern!r} cannot be read", got=error) from error
    allowed = " ".join(f"{{{name}}}" for name in PLACEHOLDERS)
    for name in names:
        if name not in PLACEHOLDERS:
            raise ConfigError(
                f"occupancy pattern {pattern!r} has an unknown placeholder", expected=allowed, got=f"{{{name}}}"
            )
    if not names and frames > 1:
        raise ConfigError(
            f"occupancy pattern {pattern!r} names one file for {frames} frames", expected=f"one of {allowed}"
        )


def _grid_pose(frame: Frame, name: str) -> np.ndarray:
    poses = {"lidar_ego": frame.T_world_ego, "world": np.eye(4), **frame.poses}
    if name not in poses:
        raise ConfigError(
            f"frame {frame.index} has no pose of the grid frame {name!r}",
            expected=" or ".join(poses),
            fix="pass another occupancy_frame",
        )
    return poses[name]


def _choose(name: str, content: np.ndarray | dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the array of labels or logits of a file, and its mask of known voxels."""
    if isinstance(content, np.ndarray):
        return content, None
    known = content.get("mask_lidar")
    for key in ("semantics", "pred", "logits"):
        if key in content:
            return content[key], known
    scores = [a for key, a in content.items() if a.ndim == 4 and a.dtype.kind == "f" and key != "arr_0"]
    if len(scores) == 1:
        return scores[0], known
    if "arr_0" in content:
        return content["arr_0"], known
    raise DataError(
        f"{name} has no array of labels or logits",
        expected="semantics, pred, logits, one 4-D array of floats, or arr_0",
        got=", ".join(f"{key} {a.dtype} {a.shape}" for key, a in content.items()) or "an empty file",
        fix="np.savez_compressed(path, semantics=labels)",
    )


def _grid(array: np.ndarray, known: np.ndarray | None, grid: GridFormat, T: np.ndarray, what: str) -> OccupancyGrid:
    shape, count = grid.spec.shape, len(grid.class_names)
    free = int(grid.free_label or 0)
    is_labels = array.ndim == 3 and array.dtype.kind in "iu"
    is_logits = array.ndim == 4 and array.dtype.kind == "f"
    if not ((is_labels and array.shape == shape) or (is_logits and array.shape == (*shape, count))):
        raise ShapeError(
            f"{what} is neither labels nor logits of this grid",
            expected=f"integers {shape} or floats {(*shape, count)}",
            got=f"{array.dtype} {array.shape}",
            fix=_advice(array, shape, count),
        )
    if known is not None:
        check_shape(known, shape, f"mask_lidar of {what}")
        known = known != 0
    if is_logits:
        check_finite(array, f"logits of {what}")
        return OccupancyGrid.from_logits(
            array, grid.spec, T, free_label=free, known=known, class_names=grid.class_names
        )
    low, high = int(array.min()), int(array.max())
    if low < 0 or high >= count:
        raise GridError(
            f"{what} has labels out of range",
            expected=f"0..{count - 1} ({count} classes)",
            got=f"{low}..{high}",
            fix="for other classes pass occupancy_classes and occupancy_free",
        )
    return OccupancyGrid(array.astype(np.uint8), grid.spec, T, free, None, known, grid.class_names)


def _advice(array: np.ndarray, shape: tuple[int, int, int], count: int) -> str:
    squeezed = tuple(n for n in array.shape if n != 1)
    if len(squeezed) < array.ndim and squeezed in (shape, (*shape, count)):
        return "drop the axis of length 1: array.squeeze()"
    if array.ndim == 4 and array.shape == (count, *shape):
        return "classes come last: np.moveaxis(array, 0, -1)"
    if array.ndim == 3 and array.shape != shape and sorted(array.shape) == sorted(shape):
        return "the array is likely transposed, axes are [x, y, z]: (z, y, x) becomes so by array.transpose(2, 1, 0)"
    if array.ndim == 3 and array.shape == shape:
        return "save class numbers as uint8"
    return "for another grid pass occupancy_spec and occupancy_classes"
