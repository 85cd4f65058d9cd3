"""What every data set becomes: a sequence of frames, each with views and, where there is one, an occupancy grid."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, overload

import numpy as np
from jaxtyping import Float, Float32, UInt8

from openvocab_occ.arrays import check_shape
from openvocab_occ.errors import ShapeError
from openvocab_occ.geometry import Camera, as_pose
from openvocab_occ.occupancy import OccupancyGrid


@dataclass(frozen=True, eq=False)
class View:
    """An image and the camera that took it."""

    image: UInt8[np.ndarray, "h w 3"]
    """RGB."""
    camera: Camera
    depth: Float32[np.ndarray, "h w"] | None = None
    """Measured z-depth in metres, 0 where there is none. The lift uses it instead of a grid's."""
    name: str = ""
    """Channel, such as CAM_FRONT."""

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        if self.image.shape != (*size, 3) or self.image.dtype != np.uint8:
            raise ShapeError(
                f"image of view {self.name!r} does not fit its camera",
                expected=f"uint8 {(*size, 3)}",
                got=f"{self.image.dtype} {self.image.shape}",
                fix="use Camera.resized for a scaled image",
            )
        if self.depth is not None:
            check_shape(self.depth, size, f"depth of view {self.name!r}")


@dataclass(frozen=True, eq=False)
class Frame:
    """One moment of a drive."""

    index: int
    timestamp: float
    """Unix seconds, or seconds since the start where the source has no clock."""
    T_world_ego: Float[np.ndarray, "4 4"]
    """Ego (x forward, y left, z up) to world, at LiDAR time where there is a LiDAR."""
    views: tuple[View, ...] = ()
    occupancy: OccupancyGrid | None = None
    points: Float32[np.ndarray, "n 3"] | None = None
    """LiDAR returns in the ego frame, metres."""
    token: str = ""
    """The source's own name of this frame."""
    poses: Mapping[str, Float[np.ndarray, "4 4"]] = field(default_factory=dict[str, np.ndarray])
    """T_world_f of other frames f that grids are given in: `lidar`, `cam_front_left_ego`, ..."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_ego", as_pose(self.T_world_ego, f"T_world_ego of frame {self.index}"))


if TYPE_CHECKING:
    _Frames = Sequence[Frame]
else:
    _Frames = Sequence  # told the items' type, a run-time checker reads a frame to see whether it is one


class FrameSequence(_Frames):
    """Frames of one drive, each read when it is asked for; a slice is a sequence again."""

    def __init__(
        self,
        name: str,
        indices: Sequence[int],
        read: Callable[[int], Frame],
        *,
        source: str = "",
        synthetic: bool = False,
        files: Callable[[int], Sequence[Path]] | None = None,
        info: Mapping[str, str] | None = None,
    ) -> None:
        self.name = name
        """Of the drive."""
        self.source = source
        """Kind of the data set."""
        self.synthetic = synthetic
        """True when nobody drove it."""
        self.info: Mapping[str, str] = dict(info or {})
        """What else the source says of the drive, such as its location."""
        self._files = files
        self._indices = indices
        self._read = read

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> "FrameSequence": ...
    def __getitem__(self, index: int | slice) -> "Frame | FrameSequence":
        if isinstance(index, slice):
            return self._like(self._indices[index], self._read)
        return self._read(self._indices[index])

    def __iter__(self) -> Iterator[Frame]:
        return map(self._read, self._indices)

    def files(self, index: int) -> Sequence[Path]:
        """Return the files that frame `index` is read from, without reading them; none where the source cannot tell."""
        return () if self._files is None else self._files(self._indices[index])

    def map(self, change: Callable[[Frame], Frame]) -> "FrameSequence":
        """Return the sequence whose frames are `change(frame)`, each made when it is asked for."""
        return self._like(self._indices, lambda index: change(self._read(index)))

    def _like(self, indices: Sequence[int], read: Callable[[int], Frame]) -> "FrameSequence":
        return FrameSequence(
            self.name,
            indices,
            read,
            source=self.source,
            synthetic=self.synthetic,
            files=self._files,
            info=self.info,
        )
