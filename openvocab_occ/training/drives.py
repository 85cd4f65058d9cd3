"""Samples of a drive in one file, and drives of the demo city made once and kept."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from openvocab_occ.datasets.frame import FrameSequence
from openvocab_occ.datasets.registry import load_sequence
from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.geometry import GridSpec
from openvocab_occ.io.files import PathLike, existing, written_file
from openvocab_occ.networks.flashocc import FlashOccConfig
from openvocab_occ.training.samples import CameraMasks, Sample, crop, network_spec, sample_of

Advance = Callable[[int, int], None]
_ARRAYS = ("images", "K", "T_ego_cam", "T_net_image", "labels", "mask", "poses", "stamps", "origins")
_FORMAT = 1


@dataclass(frozen=True, kw_only=True)
class DriveInfo:
    """What is known of a drive."""

    name: str
    place: str
    """City: maps of different places never meet."""
    log: str
    """A drive or day of one vehicle; several scenes may belong to it."""
    scene: str
    condition: str = ""
    """Weather and light, where the source says them."""
    visit: int = 0
    """Number of the traversal of the place."""
    synthetic: bool = False


class Drive:
    """Frames of a drive as arrays; read from the file when first asked for.

    With `spec` labels and masks are cut to the grid of a network that sees less far than the labels reach.
    """

    def __init__(self, path: PathLike, spec: GridSpec | None = None) -> None:
        self.path = existing(path, "drive")
        try:
            with self.path.open("rb") as stream, np.load(stream, allow_pickle=False) as content:
                meta: dict[str, Any] = json.loads(str(content["meta"]))
                missing = [name for name in _ARRAYS if name not in content.files]
        except (ValueError, OSError, KeyError, EOFError) as error:
            raise DataError(f"{self.path.name} is not a drive", expected="a file of write_drive",
                            got=type(error).__name__, fix="remove it; it is made anew") from error  # fmt: skip
        except Exception as error:  # a damaged zip raises many kinds
            raise DataError(f"{self.path.name} is damaged", got=type(error).__name__,
                            fix="remove it; it is made anew") from error  # fmt: skip
        if missing or meta.pop("format", None) != _FORMAT or not {"lower", "cell"} <= meta.keys():
            raise DataError(f"{self.path.name} is not a drive of this version", expected=", ".join(_ARRAYS),
                            got=f"without {', '.join(missing)}" if missing else "another format",
                            fix="remove it; it is made anew")  # fmt: skip
        self._lower, self._cell = meta.pop("lower"), meta.pop("cell")
        self._spec = spec
        self.info = DriveInfo(**meta)

    @cached_property
    def _content(self) -> dict[str, np.ndarray]:
        with np.load(self.path, allow_pickle=False) as content:
            found = {name: content[name] for name in _ARRAYS}
        shape = found["labels"].shape
        found["mask"] = np.unpackbits(found["mask"], axis=-1, count=shape[-1]).astype(np.bool_)
        if self._spec is not None:
            lower = self._lower
            x, y, z = crop(
                GridSpec((lower[0], lower[1], lower[2]), self._cell, (shape[1], shape[2], shape[3])), self._spec
            )
            for name in ("labels", "mask"):
                found[name] = np.ascontiguousarray(found[name][:, x, y, z])
        return found

    @cached_property
    def began(self) -> float:
        """Time of the first frame, Unix seconds; read alone."""
        with np.load(self.path, allow_pickle=False) as content:
            return float(content["stamps"][0])

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def images(self) -> UInt8[np.ndarray, "f n h w 3"]:
        """Fitted to the network."""
        return self._content["images"]

    @property
    def rigs(
        self,
    ) -> tuple[Float32[np.ndarray, "f n 3 3"], Float32[np.ndarray, "f n 4 4"], Float32[np.ndarray, "f n 3 3"]]:
        """K, T_ego_cam and T_net_image of each frame."""
        return self._content["K"], self._content["T_ego_cam"], self._content["T_net_image"]

    @property
    def labels(self) -> UInt8[np.ndarray, "f x y z"]:
        """Occ3D classes on the network's voxels."""
        return self._content["labels"]

    @property
    def mask(self) -> Bool[np.ndarray, "f x y z"]:
        """What the cameras see."""
        return self._content["mask"]

    @property
    def poses(self) -> Float64[np.ndarray, "f 4 4"]:
        """T_world_ego."""
        return self._content["poses"]

    @property
    def stamps(self) -> Float64[np.ndarray, " f"]:
        """Unix seconds."""
        return self._content["stamps"]

    @property
    def origins(self) -> Float64[np.ndarray, "f 3"]:
        """LiDAR in the ego frame."""
        return self._content["origins"]


def write_drive(
    path: PathLike,
    sequence: FrameSequence,
    info: DriveInfo,
    config: FlashOccConfig,
    *,
    masks: CameraMasks | None = None,
) -> Drive:
    """Make samples of all frames of a drive and keep them in a file, whole or not at all."""
    found: list[Sample] = []
    lowest = None
    for frame in sequence:
        found.append(sample_of(frame, config, masks=masks))
        lowest = frame.occupancy.spec.origin if frame.occupancy is not None else lowest
    if not found:
        raise DataError(f"drive {info.name} has no frames", expected="1 or more")
    if len({sample.views.images.shape for sample in found}) > 1:
        raise DataError(
            f"frames of {info.name} differ in their cameras", expected="the same number of views in each",
            got=sorted({len(s.views.images) for s in found}), fix="leave incomplete frames out",
        )  # fmt: skip
    arrays = {
        "images": [s.views.images for s in found], "K": [s.views.K for s in found],
        "T_ego_cam": [s.views.T_ego_cam for s in found], "T_net_image": [s.views.T_net_image for s in found],
        "labels": [s.labels for s in found], "mask": [np.packbits(s.mask, axis=-1) for s in found],
        "poses": [s.T_world_ego for s in found], "stamps": [s.stamp for s in found],
        "origins": [s.origin for s in found],
    }  # fmt: skip
    with written_file(path) as scratch, scratch.open("wb") as stream:
        lower = list(map(float, lowest or (0.0, 0.0, 0.0)))
        meta = json.dumps({"format": _FORMAT, "lower": lower, "cell": config.cell, **asdict(info)})
        content: dict[str, Any] = {name: np.stack(a) for name, a in arrays.items()}
        np.savez_compressed(stream, meta=np.array(meta), **content)
    return Drive(path, network_spec(config))


@dataclass(frozen=True, kw_only=True)
class CityPlan:
    """Which drives of the demo city, by the small rig."""

    cities: tuple[int, ...]
    """Seeds."""
    visits: int = 5
    """Traversals of each, a day apart."""
    frames: int = 12
    every: int = 3
    """Keyframes (half a second) from one frame to the next."""
    conditions: tuple[str, ...] = ("clear", "rain", "night")
    """City c has condition (c + visit) modulo their number on a visit, so that each comes early and late."""
    route: int = 0

    def __post_init__(self) -> None:
        if not self.cities or min(self.visits, self.frames, self.every) < 1 or self.frames * self.every > 40:
            raise ConfigError("plan of drives is not usable", expected="cities, and at most 40 keyframes", got=self)

    def drives(self) -> Iterator[tuple[DriveInfo, dict[str, Any]]]:
        """Yield each drive and the options of `load_sequence` that make it."""
        for city in self.cities:
            for visit in range(self.visits):
                condition = self.conditions[(city + visit) % len(self.conditions)]
                log = f"city-{city}-day-{visit}"
                info = DriveInfo(
                    name=f"{log}-r{self.route}-{self.frames}x{self.every}", place=f"city-{city}", log=log,
                    scene=f"{log}-r{self.route}", condition=condition, visit=visit, synthetic=True,
                )  # fmt: skip
                yield info, {"seed": city, "route": self.route, "traversal": visit, "condition": condition}


def city_drives(
    plan: CityPlan, config: FlashOccConfig, folder: PathLike, *, progress: Advance | None = None
) -> list[Drive]:
    """Open the drives of a plan, making those that are not there; stopped, it goes on where it was."""
    height, width = config.image_size
    wanted = list(plan.drives())
    found: list[Drive] = []
    for done, (info, options) in enumerate(wanted):
        path = Path(folder) / f"{info.name}.npz"
        if not path.exists():
            frames = load_sequence("city", size=(width, height), quick=True, frames=plan.frames * plan.every, **options)
            write_drive(path, frames[:: plan.every], info, config)
        found.append(Drive(path, network_spec(config)))
        if progress is not None:
            progress(done + 1, len(wanted))
    return found


def by_place(drives: Sequence[Drive]) -> dict[str, list[Drive]]:
    """Group drives by city, in the order of time."""
    places: dict[str, list[Drive]] = {}
    for drive in sorted(drives, key=lambda d: (d.info.place, d.began, d.info.scene)):
        places.setdefault(drive.info.place, []).append(drive)
    return places
