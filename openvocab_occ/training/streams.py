"""Cities as parallel streams: a batch holds frames of different cities, and each city's map grows in order of time."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Float64

from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import Camera, GridSpec
from openvocab_occ.memory.filters import remove_dynamic
from openvocab_occ.networks.flashocc import FlashOccConfig
from openvocab_occ.networks.predictor import OccupancyNetwork
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_FREE, OccupancyGrid, visibility_mask
from openvocab_occ.training.drives import Drive
from openvocab_occ.training.samples import network_spec
from openvocab_occ.training.stream_map import Gate, StreamMap, StreamPrior, WritePolicy

PriorSource = Literal["all", "other_scenes", "other_logs", "own_log", "none"]
"""Whose writes a frame reads: everyone's before it (the paper's protocol, mostly the same drive's last frames), those
of other scenes, those of other logs (only these are long-term memory), only its own drive's, or nobody's."""


@dataclass(frozen=True, kw_only=True)
class MemoryConfig:
    """How a memory is read and written."""

    prior_from: PriorSource | Literal["mixed"] = "mixed"
    """`mixed`, for training: `all` or `other_logs`, drawn for each drive."""
    policy: WritePolicy = "newest"
    mask_from: Literal["prediction", "truth", "none"] = "prediction"
    """What counts as seen when a prediction is written: what cameras see of it, the truth's mask, or everything."""
    dynamic: Literal["retained", "v1", "v2"] = "retained"
    """Of written predictions; see `memory.filters.remove_dynamic`."""
    dropout: float = 0.15
    """Share of frames, in training, that read nothing: an empty map must cost nothing."""
    misplaced: float = 0.15
    """Share of frames, in training, that read elsewhere: a wrong prior must be distrusted. In evaluation 0 or 1."""
    noise: tuple[float, float] = (0.0, 0.0)
    """Standard deviations of the pose at each read: metres along x and y, degrees of heading."""

    def __post_init__(self) -> None:
        if self.prior_from not in (*get_args(PriorSource), "mixed"):
            raise ConfigError("prior_from is not known", expected=", ".join((*get_args(PriorSource), "mixed")),
                              got=self.prior_from)  # fmt: skip
        if not (0 <= self.dropout <= 1 and 0 <= self.misplaced <= 1 and min(self.noise) >= 0):
            raise ConfigError("shares lie between 0 and 1", got=self)


@dataclass(frozen=True, eq=False)
class Visit:
    """A frame in its turn."""

    stream: "Stream"
    drive: Drive
    frame: int

    @property
    def T_world_ego(self) -> Float64[np.ndarray, "4 4"]:
        """Where it is."""
        return self.drive.poses[self.frame]


class Stream:
    """The drives of a place one after the other, and the maps that grow with them."""

    def __init__(self, place: str, drives: Sequence[Drive], spec: GridSpec, classes: int) -> None:
        self.place = place
        self.drives = list(drives)
        at = np.concatenate([drive.poses[:, :2, 3] for drive in drives])
        self._empty = StreamMap(at.min(axis=0), at.max(axis=0), spec, classes)
        self.live = self._empty.copy()
        self._before_log = self._before_scene = self._empty
        self._own = self._empty
        self._last: tuple[str, str] = ("", "")

    def visits(self) -> Iterator[Visit]:
        """Yield its frames in order, maps being kept as they were before each scene and log."""
        for drive in self.drives:
            log, scene = drive.info.log, drive.info.scene
            if log != self._last[0]:
                self._before_log, self._own = self.live.copy(), self._empty.copy()
            if (log, scene) != self._last:
                self._before_scene = self.live.copy()
            self._last = (log, scene)
            for frame in range(len(drive)):
                yield Visit(self, drive, frame)

    def read(self, source: PriorSource, T_world_ego: Float[np.ndarray, "4 4"]) -> StreamPrior:
        """Return what others knew of a window before it."""
        maps = {"all": self.live, "other_scenes": self._before_scene, "other_logs": self._before_log,
                "own_log": self._own, "none": self._empty}  # fmt: skip
        return maps[source].read(T_world_ego)

    def write(self, T: Float[np.ndarray, "4 4"], logits: np.ndarray, mask: np.ndarray, policy: WritePolicy,
              *, gate: Gate | None = None, stamp: float = 0.0, own: bool = False) -> None:  # fmt: skip
        """Put what a frame saw into the maps that later frames read; `own` is kept only for who asks for it."""
        for city in (self.live, self._own) if own else (self.live,):
            city.write(T, logits, mask, policy=policy, gate=gate, stamp=stamp)


def make_streams(
    places: Mapping[str, Sequence[Drive]], config: FlashOccConfig, rng: np.random.Generator | None = None
) -> list[Stream]:
    """Begin a pass over places with empty maps; with `rng` the order of each place's drives is permuted."""
    spec = network_spec(config)
    found: list[Stream] = []
    for place, drives in places.items():
        order = range(len(drives)) if rng is None else rng.permutation(len(drives))
        found.append(Stream(place, [drives[i] for i in order], spec, config.classes))
    return found


def batches(streams: Sequence[Stream], size: int, rng: np.random.Generator | None = None) -> Iterator[list[Visit]]:
    """Yield frames of different places, all streams going on at the same pace."""
    running = [stream.visits() for stream in streams]
    while running:
        turn: list[Visit] = []
        going: list[Iterator[Visit]] = []
        for visits in running:
            found = next(visits, None)
            if found is not None:
                turn.append(found)
                going.append(visits)
        running = going
        if rng is not None:
            turn = [turn[i] for i in rng.permutation(len(turn))]
        for start in range(0, len(turn), size):
            yield turn[start : start + size]


def read_prior(
    visit: Visit, source: PriorSource, config: MemoryConfig, rng: np.random.Generator, *, training: bool
) -> StreamPrior:
    """Read what a frame may see, with the faults that the configuration asks for."""
    T = visit.T_world_ego.copy()
    lost, elsewhere = rng.random(2)
    if training and lost < config.dropout:
        return visit.stream.read("none", T)
    if elsewhere < config.misplaced:
        T = misplaced(T)
    if any(config.noise):
        shift, turn = config.noise[0] * rng.standard_normal(2), np.deg2rad(config.noise[1]) * rng.standard_normal()
        T[:2, 3] += shift
        T[:3, :3] = _turn(turn) @ T[:3, :3]
    return visit.stream.read(source, T)


def misplaced(T_world_ego: Float[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
    """Return a pose of a place that looks otherwise but is known as well: 12 m ahead, turned by 100 degrees."""
    T = T_world_ego.astype(np.float64)
    T[:3, 3] += 12.0 * T[:3, 0]
    T[:3, :3] = _turn(np.deg2rad(100.0)) @ T[:3, :3]
    return T


def written_mask(
    visit: Visit, labels: np.ndarray, config: FlashOccConfig, mask_from: Literal["prediction", "truth", "none"]
) -> Bool[np.ndarray, "x y z"]:
    """Return what of a prediction counts as seen."""
    if mask_from == "none":
        return np.ones(labels.shape, np.bool_)
    if mask_from == "truth":
        return visit.drive.mask[visit.frame]
    grid = OccupancyGrid(labels, network_spec(config))
    return visibility_mask(grid, cameras_of(visit.drive, visit.frame, config), mode="pixel", stride=1)


def cameras_of(drive: Drive, frame: int, config: FlashOccConfig) -> list[Camera]:
    """Return the cameras of a frame as the network sees through them, in the ego frame."""
    K, T, move = (rig[frame].astype(np.float64) for rig in drive.rigs)
    height, width = config.image_size
    return [Camera(m @ k, width, height, _rigid(t)) for k, t, m in zip(K, T, move, strict=True)]


def without_dynamic(logits: np.ndarray, mask: np.ndarray, version: Literal["retained", "v1", "v2"], seed: int
                    ) -> np.ndarray:  # fmt: skip
    """Return logits to be written, their moving things removed as asked."""
    if version == "retained":
        return logits
    return remove_dynamic(logits, mask, OCC3D_CLASSES, version=1 if version == "v1" else 2, seed=seed)


def hidden(truth: np.ndarray, mask: np.ndarray) -> Bool[np.ndarray, "x y z"]:
    """Return voxels that no camera sees and that are not inside a thing: free ones, or with a free neighbour."""
    free = np.pad(truth == OCC3D_FREE, 1, constant_values=False)
    inner = free[1:-1, 1:-1, 1:-1]
    open_side = inner.copy()
    for axis in range(3):
        for step in (-1, 1):
            open_side |= np.roll(free, step, axis=axis)[1:-1, 1:-1, 1:-1]
    return open_side & ~mask


def check_memory(network: OccupancyNetwork, drives: Sequence[Drive]) -> None:
    """Refuse drives that do not fit a network.

    Raises:
        ConfigError: Their labels are on another grid.
    """
    for drive in drives[:1]:
        if drive.labels.shape[1:] != network.config.shape:
            raise ConfigError("drives were made for another network", expected=network.config.shape,
                              got=drive.labels.shape[1:], fix="make them anew, in another folder")  # fmt: skip


def _turn(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _rigid(T: np.ndarray) -> np.ndarray:
    """Mend the rotation of a pose that was kept in float32."""
    U, _, V = np.linalg.svd(T[:3, :3])
    fixed = T.copy()
    fixed[:3, :3] = U @ V
    return fixed
