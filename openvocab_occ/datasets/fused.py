"""Occupancy for drives that have none: what LiDAR sweeps and depth images of several frames saw, in one grid."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from openvocab_occ.datasets.frame import Frame, FrameSequence
from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.geometry import GridSpec, transform
from openvocab_occ.occupancy import OCC3D_SPEC, OccupancyGrid
from openvocab_occ.occupancy.fusion import LogOdds, OccupancyFuser

MIN_LIDAR_RANGE = 2.2
"""Metres; nearer returns are of the car under the LiDAR (nuScenes: its bonnet, up to 2.05 m)."""
_DEPTH_STRIDE = 2  # pixels; voxels of decimetres get several rays each all the same


def fuse_frames(
    frames: Iterable[Frame],
    spec: GridSpec,
    T_world_grid: Float[np.ndarray, "4 4"],
    *,
    odds: LogOdds | None = None,
    min_range: float = MIN_LIDAR_RANGE,
    max_depth: float = np.inf,
) -> OccupancyGrid:
    """Return a grid of what the LiDAR sweeps and the measured depth of frames saw.

    What moves leaves no trail as long as later frames see through where it was.

    Args:
        frames: With points and a pose `lidar`, or with views that have depth.
        spec: The lattice.
        T_world_grid: Where it is.
        odds: How scans are weighed.
        min_range: LiDAR returns nearer to the sensor are dropped, metres.
        max_depth: Pixels beyond it are dropped, metres.

    Raises:
        DataError: A frame has neither.
    """
    fuser = OccupancyFuser(spec, T_world_grid, odds=odds)
    for frame in frames:
        measured = [view for view in frame.views if view.depth is not None]
        if frame.points is not None and "lidar" in frame.poses:
            points = transform(frame.T_world_ego, frame.points)
            fuser.add_points(points, frame.poses["lidar"][:3, 3], min_range=min_range)
        elif not measured:
            raise DataError(
                f"frame {frame.index} has nothing to carve a grid from",
                expected="LiDAR points and the pose of the LiDAR, or views with depth",
                fix="pass load_sequence(..., occupancy=PATTERN)",
            )
        for view in measured:
            assert view.depth is not None
            fuser.add_depth(view.depth, view.camera, stride=_DEPTH_STRIDE, max_depth=max_depth)
    return fuser.grid()


def join_fused(
    sequence: FrameSequence,
    *,
    before: int = 0,
    after: int = 0,
    spec: GridSpec = OCC3D_SPEC,
    odds: LogOdds | None = None,
) -> FrameSequence:
    """Return the drive with a grid on each frame, in its ego frame, fused of the frames around it.

    Args:
        sequence: The drive. Its neighbours of a frame are read with it: they cost time, not memory.
        before: How many frames before each one count.
        after: How many after it.
        spec: The lattice in the ego frame.
        odds: How scans are weighed.
    """
    if before < 0 or after < 0:
        raise ConfigError("the window makes no sense", expected="0 or more frames", got=(before, after))

    def read(index: int) -> Frame:
        frame = sequence[index]
        others: Sequence[int] = [i for i in range(index - before, index + after + 1) if 0 <= i < len(sequence)]
        window = (frame if i == index else sequence[i] for i in others)
        return replace(frame, occupancy=fuse_frames(window, spec, frame.T_world_ego, odds=odds))

    return FrameSequence(
        sequence.name, range(len(sequence)), read, source=sequence.source, synthetic=sequence.synthetic,
        files=sequence.files, info=sequence.info,
    )  # fmt: skip
