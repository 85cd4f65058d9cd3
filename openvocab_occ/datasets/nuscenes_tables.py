"""The JSON tables of nuScenes, read only as far as keyframes need them.

`sample_data.json` and `ego_pose.json` of the full data set hold 2.6 million rows, nearly all of them between keyframes:
rows are decoded into slim records, and only those of wanted keyframes are kept.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from openvocab_occ.errors import ConfigError, DataError, NotFoundError
from openvocab_occ.io.files import existing

_VAL = (
    "3 12-18 35-36 38-39 92-110 221 268-278 329-332 344-346 519-524 552-565 625-627 629-630 632-638 770-771 775 "
    "777-778 780-784 794-800 802 904-917 919-931 962-963 966-969 971-972 1059-1073"
)  # scene numbers of the official validation split; of v1.0-mini, 103 and 916 are in it, and it names them alone
_MINI_VAL = "103 916"
"""The validation scenes of v1.0-mini; its other eight are for training."""


class SceneRow(msgspec.Struct, frozen=True):
    """A drive of about 20 s."""

    token: str
    name: str
    log_token: str
    description: str = ""


class LogRow(msgspec.Struct, frozen=True):
    """A drive of hours that scenes are cut from."""

    token: str
    location: str = ""
    vehicle: str = ""
    date_captured: str = ""
    logfile: str = ""


class SampleRow(msgspec.Struct, frozen=True):
    """A keyframe."""

    token: str
    timestamp: int
    scene_token: str


class DataRow(msgspec.Struct, frozen=True):
    """A file of one sensor."""

    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    filename: str
    timestamp: int
    is_key_frame: bool


class PoseRow(msgspec.Struct, frozen=True):
    """Ego to world."""

    token: str
    translation: list[float]
    rotation: list[float]


class MountRow(msgspec.Struct, frozen=True):
    """Sensor to ego, and K of a camera."""

    token: str
    sensor_token: str
    translation: list[float]
    rotation: list[float]
    camera_intrinsic: list[list[float]] = []


class SensorRow(msgspec.Struct, frozen=True):
    """What a mount carries."""

    token: str
    channel: str
    modality: str = ""


_Row = TypeVar("_Row", bound=msgspec.Struct)


def find_tables(root: Path, version: str | None) -> Path:
    """Return the folder of tables: `root/VERSION`, the only `root/v1.0-*`, or `root` itself."""
    if version is not None:
        return existing(root / version, "nuScenes version")
    if (root / "scene.json").is_file():
        return root
    found = sorted(folder for folder in root.glob("v1.0-*") if (folder / "scene.json").is_file())
    if not found:
        raise NotFoundError(
            "no nuScenes tables", expected=f"{root}/v1.0-*/scene.json", fix="pass the folder that holds v1.0-trainval"
        )
    if len(found) > 1:
        raise ConfigError(
            f"{root} holds several versions", expected="version=", got=", ".join(folder.name for folder in found)
        )
    return found[0]


def read_rows(tables: Path, name: str, row: type[_Row], keep: Callable[[Any], bool] | None = None) -> list[_Row]:
    """Read the rows of a table that `keep` admits.

    Raises:
        DataError: The file is no JSON list, or a row lacks a field.
    """
    file = existing(tables / f"{name}.json", "nuScenes table")
    try:
        rows = msgspec.json.decode(file.read_bytes(), type=list[row])
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise DataError(f"table {file.name} cannot be read", expected="rows of nuScenes v1.0", got=error) from error
    return rows if keep is None else [r for r in rows if keep(r)]


def scene_names_of(root: Path, tables: Path, split: str) -> frozenset[str]:
    """Return the scenes of a split: from Occ3D's `annotations.json` where it is, else the official ones."""
    file = root / "annotations.json"
    if file.is_file():
        try:
            lists: dict[str, Any] = msgspec.json.decode(file.read_bytes(), type=dict[str, Any])
        except msgspec.DecodeError as error:
            raise DataError(f"{file.name} is not JSON", got=error) from error
        if f"{split}_split" in lists:
            return frozenset(lists[f"{split}_split"])
        names = [key.removesuffix("_split") for key in lists if key.endswith("_split")]
        raise ConfigError(f"{file.name} has no split {split!r}", expected=" or ".join(names) or "none: it lists none")
    names = [scene.name for scene in read_rows(tables, "scene", SceneRow)]
    val = _scene_names(_MINI_VAL if tables.name == "v1.0-mini" else _VAL)
    if split in ("train", "val") and tables.name != "v1.0-test":
        return frozenset(name for name in names if (name in val) == (split == "val"))
    if split == "test" and tables.name == "v1.0-test":
        return frozenset(names)
    raise ConfigError(
        f"{tables.name} has no split {split!r}",
        expected="test" if tables.name == "v1.0-test" else "train or val",
        fix=f"put Occ3D's {file.name} into {root}, or name a scene",
    )


def _scene_names(numbers: str) -> frozenset[str]:
    """Turn numbers and ranges, such as `3 12-18`, into names of scenes."""
    ranges = [(int(part.split("-")[0]), int(part.split("-")[-1])) for part in numbers.split()]
    return frozenset(f"scene-{n:04d}" for first, last in ranges for n in range(first, last + 1))
