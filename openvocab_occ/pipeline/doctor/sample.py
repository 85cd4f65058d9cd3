"""The frames that the doctor looks at."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from openvocab_occ.datasets.frame import Frame, FrameSequence, View
from openvocab_occ.errors import OpenVocabOccError
from openvocab_occ.geometry import transform
from openvocab_occ.occupancy.fusion import points_of_depth

_POINTS = 20000
"""Points of a frame that checks use: a share of them is known to half a percent."""


@dataclass(frozen=True)
class Sample:
    """Some frames of a drive, in pairs of neighbours, and what could not be read."""

    total: int
    frames: Sequence[Frame]
    failures: Sequence[tuple[int, OpenVocabOccError]]
    pairs: Sequence[tuple[Frame, Frame]]
    """Frames that follow each other in the drive."""

    @property
    def has_lidar(self) -> bool:
        """True where any frame has LiDAR points."""
        return any(frame.points is not None for frame in self.frames)

    @property
    def has_rig(self) -> bool:
        """True where the ego is a vehicle: it has a LiDAR or several cameras."""
        return self.has_lidar or any(len(frame.views) > 1 for frame in self.frames)


def take_sample(sequence: FrameSequence, count: int, progress: Callable[[int, int], object] | None = None) -> Sample:
    """Read about `count` frames, pairs of neighbours spread evenly; all of them where there are no more."""
    total = len(sequence)
    if total <= count:
        wanted = list(range(total))
    else:
        starts = np.linspace(0, total - 2, max(count // 2, 1)).astype(int)
        wanted = sorted({int(i) for start in starts for i in (start, start + 1)})
    found: dict[int, Frame] = {}
    failures: list[tuple[int, OpenVocabOccError]] = []
    for done, index in enumerate(wanted, start=1):
        try:
            found[index] = sequence[index]
        except OpenVocabOccError as error:
            failures.append((index, error))
        if progress is not None:
            progress(done, len(wanted))
    pairs = [(found[i], found[i + 1]) for i in wanted if i in found and i + 1 in found]
    return Sample(total, list(found.values()), failures, pairs)


def thinned(points: Float[np.ndarray, "n 3"], count: int = _POINTS) -> Float[np.ndarray, "m 3"]:
    """Return at most about `count` of the points, evenly from their list."""
    return points[:: max(1, len(points) // count)]


def world_points(frame: Frame) -> Float[np.ndarray, "n 3"]:
    """Return what was measured of a frame's surroundings: LiDAR returns, else the pixels with depth; none: no rows."""
    if frame.points is not None:
        return transform(frame.T_world_ego, thinned(frame.points))
    parts = [thinned(points_of_depth(v.depth, v.camera, stride=4)) for v in frame.views if v.depth is not None]
    return np.concatenate(parts) if parts else np.empty((0, 3))


def depth_views(frames: Sequence[Frame]) -> list[View]:
    """Return all views that have measured depth."""
    return [view for frame in frames for view in frame.views if view.depth is not None]
