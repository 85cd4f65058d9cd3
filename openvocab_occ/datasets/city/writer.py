"""Traversals written as files: nuScenes' tables and samples, Occ3D's gts beside them.

    ROOT/v1.0-city/*.json                   tables
    ROOT/samples/CAM_FRONT/*.jpg, ...       images; samples/LIDAR_TOP/*.pcd.bin sweeps (x, y, z, intensity, ring)
    ROOT/gts/SCENE/SAMPLE/labels.npz        semantics, mask_lidar, mask_camera; instances: int32 numbers of things
    ROOT/truth/CAM_FRONT/*.npz              if asked for: depth (uint16, 1/256 m), semantic, instance, part
    ROOT/annotations.json                   splits by traversal
    ROOT/lanes.json, ROOT/maps/*.png        lane graph, a picture of the plan
    ROOT/city/                              what the writer remembers: options, attributes, boxes of each keyframe
    ROOT/sheets/SCENE.png                   a contact sheet

A keyframe is done when its record in `city/` is there, which is written last; what is done is never written again.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from openvocab_occ.datasets.city.city import City
from openvocab_occ.datasets.city.keyframes import Box, Sweep, boxes, instant_of, labels, sweep
from openvocab_occ.datasets.city.render import Rendering
from openvocab_occ.datasets.city.sensors import PERIOD, T_EGO_LIDAR
from openvocab_occ.datasets.city.sheet import contact_sheet, plan_picture
from openvocab_occ.datasets.city.tables import LIDAR, build_tables, file_name, sample_token
from openvocab_occ.datasets.city.traversal import MAX_FRAMES, Instant, Traversal
from openvocab_occ.datasets.city.weather import CONDITIONS
from openvocab_occ.errors import AlreadyExistsError, ConfigError
from openvocab_occ.geometry import transform
from openvocab_occ.io.files import PathLike, written_file, written_folder
from openvocab_occ.io.images import write_image

VERSION = "v1.0-city"
_FORMAT = 1


@dataclass(frozen=True, kw_only=True)
class CityOptions:
    """What is written. The number of routes and traversals may grow later, all else is fixed once writing began."""

    seed: int = 7
    routes: int = 1
    traversals: int = 1
    conditions: tuple[str, ...] = ("clear",)
    """Of the traversals, in turn."""
    frames: int = MAX_FRAMES
    size: tuple[int, int] = (704, 256)
    truth: bool = False
    """Write depth, semantic, instance and part images too."""

    def __post_init__(self) -> None:
        if not 1 <= self.frames <= MAX_FRAMES:
            raise ConfigError("a traversal is too short", expected=f"1 to {MAX_FRAMES} frames", got=self.frames)
        if self.routes < 1 or self.traversals < 1:
            raise ConfigError("nothing to write", expected="1 or more", got=f"{self.routes} x {self.traversals}")
        unknown = [name for name in self.conditions if name not in CONDITIONS]
        if unknown or not self.conditions:
            raise ConfigError("condition is not known", expected=" or ".join(CONDITIONS), got=unknown or "none")

    def condition(self, traversal: int) -> str:
        """Return the condition of a traversal."""
        return self.conditions[traversal % len(self.conditions)]


def write_city(
    out: PathLike, options: CityOptions, *, progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Write traversals, or what is missing of them; return a summary.

    Raises:
        AlreadyExistsError: The folder holds other things, or a city of other options.
        ConfigError: An option is out of range.
    """
    root = Path(out).expanduser()
    _claim(root, options)
    city = City(options.seed)
    drives = [
        city.traversal(route, number, options.condition(number))
        for route in range(options.routes)
        for number in range(options.traversals)
    ]
    total, done, written, records = len(drives) * options.frames, 0, 0, []
    for drive in drives:
        scene: list[dict[str, Any]] = []
        for index in range(options.frames):
            file = root / "city" / "keyframes" / drive.name / f"{index:03d}.json"
            if not file.is_file():
                _write_keyframe(root, drive, index, options, file)
                written += 1
            scene += msgspec.json.decode(file.read_bytes())
            done += 1
            if progress is not None:
                progress(done, total)
        records.append(scene)
        sheet = root / "sheets" / f"{drive.name}.png"
        if not sheet.is_file():
            write_image(sheet, contact_sheet(root, drive, options.frames))
        things = {str(number): asdict(a) for number, a in drive.attributes().items()}
        _write_json(root / "city" / "attributes" / f"{drive.name}.json", things)
        drive.forget()
    _write_json(root / "lanes.json", city.town.lanes.to_dict())
    write_image(root / "maps" / f"city-{options.seed}.png", plan_picture(city.town))
    names = [drive.name for drive in drives]
    last = [d.name for d in drives if d.number == options.traversals - 1 and options.traversals > 1]
    _write_json(
        root / "annotations.json", {"train_split": [n for n in names if n not in last], "val_split": last or names}
    )
    tables = build_tables(drives, records, options.frames, options.size)
    with written_folder(root / VERSION, marker="scene.json") as folder:
        for name, rows in tables.items():
            (folder / f"{name}.json").write_bytes(msgspec.json.format(msgspec.json.encode(rows), indent=1))
    return {
        "root": str(root), "scenes": names, "keyframes": total, "written": written,
        "boxes": len(tables["sample_annotation"]), "synthetic": True,
    }  # fmt: skip


def _claim(root: Path, options: CityOptions) -> None:
    """Remember the options in a new folder, or compare them with those remembered."""
    file = root / "city" / "options.json"
    fixed = {
        "format": _FORMAT, "seed": options.seed, "conditions": list(options.conditions), "frames": options.frames,
        "size": list(options.size), "truth": options.truth,
    }  # fmt: skip
    if file.is_file():
        held = msgspec.json.decode(file.read_bytes())
        if held != fixed:
            differ = ", ".join(k for k in fixed if held.get(k) != fixed[k])
            raise AlreadyExistsError(
                f"{root} holds a city of other options", expected=f"the same {differ}",
                got=", ".join(f"{k} {held.get(k)}" for k in fixed if held.get(k) != fixed[k]),
                fix="use the same options to resume, or another folder",
            )  # fmt: skip
        return
    if root.is_dir() and any(root.iterdir()):
        raise AlreadyExistsError(
            f"{root} is not empty", expected="a new folder, or one that holds a city", fix="choose another output path"
        )
    _write_json(file, fixed)


def _write_json(path: Path, data: object) -> None:
    with written_file(path) as scratch:
        scratch.write_bytes(msgspec.json.encode(data))


def _write_keyframe(root: Path, drive: Traversal, index: int, options: CityOptions, record: Path) -> None:
    instant = instant_of(drive, index)
    for name, camera, time in drive.cameras(index, options.size):
        picture = drive.render(camera, time, instant=instant)
        path = root / file_name(drive, index, name)
        write_image(path, picture.image)
        if options.truth:
            _write_truth(root / "truth" / name / f"{path.stem}.npz", picture)
    scan = sweep(drive, index, instant)
    columns = np.column_stack([scan.points, scan.intensity, scan.ring]).astype("<f4")
    with written_file(root / file_name(drive, index, LIDAR)) as scratch:
        scratch.write_bytes(columns.tobytes())
    truth = labels(drive, index, instant)
    with (
        written_file(root / "gts" / drive.name / sample_token(drive, index) / "labels.npz") as scratch,
        scratch.open("wb") as stream,
    ):
        np.savez_compressed(
            stream, semantics=truth.grid.labels, mask_lidar=truth.mask_lidar.astype(np.uint8),
            mask_camera=truth.mask_camera.astype(np.uint8), instances=truth.instances,
        )  # fmt: skip
    found = boxes(drive, index)
    seen = visibility(drive, index, instant, found)
    rows = [
        {**asdict(box), "index": index, "lidar_points": _inside(box, scan, drive, index), "visibility": level}
        for box, level in zip(found, seen, strict=True)
    ]
    _write_json(record, rows)


def _write_truth(path: Path, picture: Rendering) -> None:
    depth = np.clip(np.rint(picture.depth * 256), 0, 65535).astype(np.uint16)
    with written_file(path) as scratch, scratch.open("wb") as stream:
        np.savez_compressed(
            stream, depth=depth, semantic=picture.semantic, instance=picture.instance, part=picture.part
        )


def _inside(box: Box, scan: Sweep, drive: Traversal, index: int) -> int:
    """Count the LiDAR returns from a thing, as nuScenes counts those in its box."""
    own = scan.points[scan.instances == box.id]
    if not len(own):
        return 0
    points = transform(drive.T_world_ego(index * PERIOD) @ T_EGO_LIDAR, own) - np.array(box.center)
    c, s = np.cos(box.yaw), np.sin(box.yaw)
    local = np.abs(points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]))
    return int((local <= np.array(box.size) / 2 + 0.05).all(axis=1).sum())


def visibility(drive: Traversal, index: int, instant: Instant, found: Sequence[Box]) -> list[int]:
    """Return nuScenes' visibility levels 1 to 4: the share of 27 points in a box to which nothing else blocks the view.

    The view is from the middle of the rig, 1.6 m above the ground.
    """
    if not found:
        return []
    T = drive.T_world_ego(index * PERIOD)
    eye = T[:3, :3] @ np.array([0.9, 0.0, 1.6]) + T[:3, 3]
    steps = np.stack(np.meshgrid(*[[-0.35, 0.0, 0.35]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    rays = np.empty((len(found), 27, 6), np.float32)
    for row, box in zip(rays, found, strict=True):
        c, s = np.cos(box.yaw), np.sin(box.yaw)
        points = steps * np.array(box.size) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]) + np.array(box.center)
        row[:, :3], row[:, 3:] = eye - instant.surroundings.origin, points - eye
    hits = instant.moment.cast(rays.reshape(-1, 6))
    hit = instant.triangles.instance[hits.face].reshape(len(found), 27)
    free = (hits.t.reshape(len(found), 27) >= 1.0) | (hit == np.array([box.id for box in found])[:, None])
    return [1 + int(np.searchsorted((0.4, 0.6, 0.8), share, side="right")) for share in free.mean(axis=1)]
