"""Writes frames of any source as a recording (docs/recording.md)."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from openvocab_occ.datasets.frame import Frame, View
from openvocab_occ.datasets.recording import DEPTH_SCALE, FORMAT, FRAMES_FILE, HEADER_FILE, VERSION, grid_entry
from openvocab_occ.errors import ConfigError
from openvocab_occ.io.files import PathLike, written_folder
from openvocab_occ.io.images import write_image
from openvocab_occ.occupancy import OccupancyGrid

_MAX_STEPS = 65535  # of a 16-bit depth image


def write_recording(
    folder: PathLike,
    frames: Iterable[Frame],
    *,
    name: str = "",
    image_ending: str = ".jpg",
    synthetic: bool | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> None:
    """Write frames to a folder, whole or not at all; an older recording there is replaced.

    Points become float32 in the ego frame, depth 16-bit millimetres (beyond 65.535 m there is none). Of a grid's logits
    and labels, the logits are kept where the labels are their best classes, else the labels.

    Args:
        folder: Where to.
        frames: Of any sequence, read one at a time.
        name: Of the drive; by default that of the sequence.
        image_ending: `.jpg`, or `.png` for pixels without loss.
        synthetic: Whether nobody drove it; by default what the sequence says.
        progress: Called with the number of frames done and their total (0 where it is not known).
    """
    if image_ending not in (".jpg", ".png"):
        raise ConfigError("image_ending is not known", expected=".jpg or .png", got=image_ending)
    total = len(frames) if hasattr(frames, "__len__") else 0  # pyright: ignore[reportArgumentType]
    header: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "name": name or str(getattr(frames, "name", "")),
        "synthetic": bool(getattr(frames, "synthetic", False)) if synthetic is None else synthetic,
        "depth_scale": DEPTH_SCALE,
    }
    with written_folder(folder, marker=HEADER_FILE) as scratch:
        with (scratch / FRAMES_FILE).open("w") as lines:
            for number, frame in enumerate(frames):
                entry = _write_frame(scratch, number, frame, header, image_ending)
                lines.write(json.dumps(entry) + "\n")
                if progress is not None:
                    progress(number + 1, total)
        (scratch / HEADER_FILE).write_text(json.dumps(header, indent=2) + "\n")


def _write_frame(folder: Path, number: int, frame: Frame, header: dict[str, Any], ending: str) -> dict[str, Any]:
    stem = f"{number:06d}"
    entry: dict[str, Any] = {
        "timestamp": frame.timestamp,
        "token": frame.token or stem,
        "T_world_ego": frame.T_world_ego.tolist(),
        "views": [_write_view(folder, stem, i, view, ending) for i, view in enumerate(frame.views)],
        "poses": {key: np.asarray(T).tolist() for key, T in frame.poses.items() if key != "lidar_ego"},
    }
    if frame.points is not None:
        entry["points"] = f"points/{stem}.npy"
        np.save(_ready(folder / entry["points"]), frame.points.astype(np.float32))
    if frame.occupancy is not None:
        entry["occupancy"] = f"occupancy/{stem}.npz"
        _write_grid(_ready(folder / entry["occupancy"]), frame.occupancy)
        told = grid_entry(frame.occupancy)
        if header.setdefault("grid", told) != told:
            entry["grid"] = told
        if not np.array_equal(frame.occupancy.T_world_grid, frame.T_world_ego):
            entry["T_world_grid"] = frame.occupancy.T_world_grid.tolist()
    return entry


def _write_view(folder: Path, stem: str, number: int, view: View, ending: str) -> dict[str, Any]:
    camera = view.camera
    name = view.name or f"camera{number}"
    place = "".join(c if c.isalnum() or c in "-_" else "_" for c in name) + f"/{stem}"
    entry: dict[str, Any] = {
        "name": name,
        "image": f"images/{place}{ending}",
        "K": camera.K.tolist(),
        "T_world_cam": camera.T_world_cam.tolist(),
    }
    if camera.lens != "pinhole":
        entry |= {"lens": camera.lens, "distortion": list(camera.distortion)}
    write_image(_ready(folder / entry["image"]), view.image)
    if view.depth is not None:
        entry["depth"] = f"depth/{place}.png"
        steps = np.rint(view.depth * DEPTH_SCALE)
        steps[~(steps <= _MAX_STEPS)] = 0
        write_image(_ready(folder / entry["depth"]), steps.astype(np.uint16))
    return entry


def _write_grid(file: Path, grid: OccupancyGrid) -> None:
    arrays: dict[str, np.ndarray] = {}
    if grid.logits is not None and np.array_equal(grid.logits.argmax(axis=-1), grid.labels):
        arrays["logits"] = grid.logits
    else:
        arrays["semantics"] = grid.labels
    if grid.known is not None:
        arrays["mask_lidar"] = grid.known.astype(np.uint8)
    with file.open("wb") as stream:
        np.savez_compressed(stream, **arrays)  # pyright: ignore[reportArgumentType]


def _ready(file: Path) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    return file
