"""The builder of objects: frames come in one by one, a tree comes out at any time."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from time import perf_counter, process_time

import numpy as np
from jaxtyping import Int64

from openvocab_occ.mapping import VoxelMap
from openvocab_occ.mapping.keys import unpack
from openvocab_occ.objects.describe import describe, state_of
from openvocab_occ.objects.frame_voxels import FrameVoxels
from openvocab_occ.objects.refine import RefineConfig, Refinement, owners, refine
from openvocab_occ.objects.segments import Segment, SegmentConfig, segment_frame
from openvocab_occ.objects.state import StateConfig
from openvocab_occ.objects.tracker import TrackConfig, Tracker
from openvocab_occ.objects.tree import ObjectTree, SceneObject


@dataclass(frozen=True, kw_only=True)
class ObjectConfig:
    """How voxels become objects, stage by stage."""

    segments: SegmentConfig = field(default_factory=SegmentConfig)
    tracks: TrackConfig = field(default_factory=TrackConfig)
    states: StateConfig = field(default_factory=StateConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)


@dataclass(frozen=True, eq=False, kw_only=True)
class Observation:
    """What one frame gave."""

    frame: int
    """Its index."""
    seen: Int64[np.ndarray, " n"]
    """Packed keys of the voxels that a camera saw, ascending."""
    segments: tuple[Segment, ...]
    tracks: tuple[int, ...]
    """Track of each segment, before batch refinement."""


class ObjectBuilder:
    """Follows the things of a drive. Mutable."""

    def __init__(
        self, voxel_size: float, *, names: Sequence[str] = (), labels: Sequence[str] = (),
        config: ObjectConfig | None = None,
    ) -> None:  # fmt: skip
        """Begin without objects.

        Args:
            voxel_size: Metres.
            names: Classes of the occupancy; none where it knows shapes only.
            labels: Channels of a `logits` model; they stand in for classes where the occupancy names none.
            config: Options of all stages.
        """
        self.config = config or ObjectConfig()
        self.names = tuple(names) if len(names) > 2 else tuple(labels)
        self.labels = tuple(labels)
        self.report = Refinement(tracks=0)
        """What the last batch refinement did."""
        self.merged: dict[int, int] = {}
        """Tracks that the last batch refinement merged into others, and into which."""
        self.seconds = 0.0
        """What segments and tracks of the last frame took."""
        self.cpu_seconds = 0.0
        """The same in processor time, of all threads of the process."""
        self.latest: Observation | None = None
        """What the last frame gave."""
        self._tracker = Tracker(voxel_size, self.names, self.config.tracks)

    @property
    def tracker(self) -> Tracker:
        """The tracks as they are, before batch refinement."""
        return self._tracker

    def observe(self, frame: FrameVoxels) -> Observation:
        """Add a frame and return what was seen in it."""
        start, cpu = perf_counter(), process_time()
        segments = segment_frame(frame, self.names, self.config.segments)
        ids = self._tracker.observe(segments, frame=frame.index, time=frame.timestamp)
        self.seconds, self.cpu_seconds = perf_counter() - start, process_time() - cpu
        self.latest = Observation(
            frame=frame.index, seen=frame.packed[frame.seen], segments=tuple(segments), tracks=tuple(ids)
        )
        return self.latest

    def objects(self, voxels: VoxelMap) -> list[SceneObject]:
        """Return the objects of all frames so far, after batch refinement; ids are those of the tracks."""
        tracks = {id: copy(track) for id, track in self._tracker.tracks.items()}
        for track in tracks.values():
            track.moved = state_of(track, voxels, self.names, self.config.states)[0] in ("moving", "stopped")
        refined, self.report, self.merged = refine(
            tracks, together=self._tracker.together, apart=self._tracker.apart, names=self.names,
            config=self.config.refine,
        )  # fmt: skip
        return [
            describe(track, packed, voxels, names=self.names, labels=self.labels, config=self.config.states)
            for track, packed in zip(refined, owners(refined), strict=True)
            if len(packed) and (track.moved or self._stands(packed, voxels))
        ]

    def _stands(self, packed: Int64[np.ndarray, " n"], voxels: VoxelMap) -> bool:
        """Tell whether the map still holds enough of a thing that did not move: the rest was seen through since."""
        config = self.config.refine
        return not config.drop or int((voxels.index(unpack(packed)) >= 0).sum()) >= config.min_voxels

    def tree(self, voxels: VoxelMap, ego: Sequence[np.ndarray] = ()) -> ObjectTree:
        """Return the tree of all frames so far; `ego` are the poses of the frames, which tell where the road leads."""
        from openvocab_occ.objects.hierarchy import build_tree

        return build_tree(self.objects(voxels), voxels, names=self.names, labels=self.labels, ego=ego)


def claimed(objects: Sequence[SceneObject], voxels: VoxelMap) -> np.ndarray:
    """Tell which voxels of a map belong to an object, bool[n]."""
    taken = np.zeros(len(voxels), dtype=bool)
    for item in objects:
        taken[item.voxels] = True
    return taken
