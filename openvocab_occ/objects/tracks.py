"""Tracks: segments of many frames that are one thing."""

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from openvocab_occ.mapping.keys import pack, unpack
from openvocab_occ.objects.kinds import Kind, kinds_of
from openvocab_occ.objects.looks import Look, added
from openvocab_occ.objects.segments import Crop, Segment
from openvocab_occ.objects.state import Motion, StateConfig, observe_motion, shift

BEST_CROPS = 5
_BODIES = 6
_HISTORY = 64  # sightings kept for motion; every other one goes when there are more

_AROUND = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)])


@dataclass(eq=False)
class Track:
    """One thing, and what was seen of it. Mutable: grows by `add` and `absorb`."""

    id: int
    voxel_size: float
    feature_sum: Float32[np.ndarray, " c"]
    class_votes: Float32[np.ndarray, " k"]
    weight: float = 0.0
    look: Look | None = None
    """What its own pixels show."""
    agreement_sum: float = 0.0
    """Frame features' lengths along the mean, by weight: how far the frames agree."""
    frames: list[int] = field(default_factory=list[int])
    times: list[float] = field(default_factory=list[float])
    """Of each sighting."""
    bound_times: list[float] = field(default_factory=list[float])
    bounds: list[Float64[np.ndarray, " 4"]] = field(default_factory=list[np.ndarray])
    """Low x, low y, high x, high y of sightings that show where the thing ends."""
    crops: list[Crop] = field(default_factory=list[Crop])
    cells: set[int] = field(default_factory=set[int])
    """Coarse cells of its body, as the tracker's index holds them."""
    first: Segment | None = None
    last: Segment | None = None
    last_time: float = -np.inf
    previous: tuple[float, Float64[np.ndarray, " 2"], Float64[np.ndarray, " 2"]] | None = None
    velocity: Float64[np.ndarray, " 2"] = field(default_factory=lambda: np.zeros(2))
    """Of the motion model, metres a second."""
    moved: bool = False
    """True once it moved further than sightings err; its older voxels are then a trail, not the thing."""
    stands: bool = False
    """True while the class evidence says that such a thing cannot move."""
    bodies: list[Int64[np.ndarray, " _"]] = field(default_factory=list[np.ndarray])
    """Packed keys, hidden ones included, of its latest sightings that show where it ends."""
    _pieces: list[Int64[np.ndarray, " _"]] = field(default_factory=list[np.ndarray])
    _compacted: int = 0

    @classmethod
    def born(cls, id: int, voxel_size: float, segment: Segment, *, frame: int, time: float, stands: bool) -> "Track":
        """Begin with one segment."""
        track = cls(
            id, voxel_size, np.zeros_like(segment.feature_sum), np.zeros_like(segment.class_votes), stands=stands
        )
        track.add(segment, frame, time)
        return track

    def add(self, segment: Segment, frame: int, time: float) -> None:
        """Add the segment of another frame."""
        self._add_evidence(segment)
        if not segment.cut_off:
            self._measure(segment, time)
        if self.first is None or time < min(self.times):
            self.first = segment
        self.frames.append(frame)
        self.times.append(time)
        if time >= self.last_time:
            self.last, self.last_time = segment, time
            if not segment.cut_off or not self.bodies:
                self.bodies = [*self.bodies, segment.body][-_BODIES:]
        self._pieces.append(segment.seen)
        self._compact()

    def absorb(self, other: "Track") -> None:
        """Become what both are."""
        self.feature_sum = self.feature_sum + other.feature_sum
        self.class_votes = self.class_votes + other.class_votes
        self.weight += other.weight
        self.look = added(self.look, other.look)
        self.agreement_sum += other.agreement_sum
        if min(other.times) < min(self.times):
            self.first = other.first
        order = np.argsort(self.times + other.times, kind="stable")
        frames, times = self.frames + other.frames, self.times + other.times
        merged = {frames[i]: times[i] for i in order}
        self.frames, self.times = list(merged), list(merged.values())
        bounds: dict[float, np.ndarray] = {}
        for time, bound in zip(self.bound_times + other.bound_times, self.bounds + other.bounds, strict=True):
            both = bounds.get(time)
            bounds[time] = bound if both is None else np.r_[np.minimum(both[:2], bound[:2]),
                                                            np.maximum(both[2:], bound[2:])]  # fmt: skip
        self.bound_times = sorted(bounds)
        self.bounds = [bounds[time] for time in self.bound_times]
        self._keep_crops(other.crops)
        self.cells = self.cells | other.cells
        self.stands = self.stands and other.stands
        self.moved = (self.moved or other.moved) and not self.stands
        if other.last is not None and (self.last is None or other.last_time > self.last_time):
            self.last, self.last_time = other.last, other.last_time
            self.velocity = other.velocity
            self.bodies = other.bodies
        self._pieces = self._pieces + other._pieces
        self._compacted = 0

    def of_voxels(self, packed: Int64[np.ndarray, " n"], id: int) -> "Track":
        """Return a track of some of the voxels, with the rest of what is known of the whole."""
        part = copy(self)
        part.id, part._pieces, part._compacted = id, [packed], len(packed)
        part.bodies = [body[near(body, packed)] for body in self.bodies]
        part.bodies = [body for body in part.bodies if len(body)]
        return part

    @property
    def voxels(self) -> Int64[np.ndarray, " n"]:
        """Packed keys of its voxels: all that were seen of a thing that stands, the latest of one that moved."""
        if self.moved and self.last is not None:
            return self.last.seen
        self._compact(force=True)
        return self._pieces[0]

    @property
    def body(self) -> Int64[np.ndarray, " n"]:
        """Packed keys, hidden ones included, that most of `bodies` hold; of a thing that moved those of the latest."""
        bodies = self.bodies[-1:] if self.moved else self.bodies
        if not bodies:
            return np.empty(0, dtype=np.int64)
        keys, counts = np.unique(np.concatenate(bodies), return_counts=True)
        return keys[2 * counts > len(bodies)]

    @property
    def feature(self) -> Float32[np.ndarray, " c"]:
        """Mean feature as a unit vector."""
        return (self.feature_sum / max(float(np.linalg.norm(self.feature_sum)), 1e-12)).astype(np.float32)

    def movable(self, names: Sequence[str]) -> float:
        """Return the share of class evidence that speaks for a thing that can move; NaN where there is none."""
        kinds = kinds_of(names)[: len(self.class_votes)]
        known = float(self.class_votes[kinds != Kind.UNKNOWN].sum())
        return float(self.class_votes[kinds == Kind.MOVABLE].sum()) / known if known > 0 else float("nan")

    def motion(self, config: StateConfig | None = None) -> Motion:
        """Sum up what was seen of its motion."""
        times, bounds = self._history()
        return observe_motion(
            times, bounds[:, :2], bounds[:, 2:], sightings=len(self.frames),
            time_observed=max(self.times) - min(self.times), voxel_size=self.voxel_size, config=config,
        )  # fmt: skip

    def heading(self) -> float | None:
        """Return the direction of its latest clear motion, radians; None where there was none."""
        _, bounds = self._history()
        for back in range(2, len(bounds) + 1):
            way = shift(bounds[-back, :2], bounds[-back, 2:], bounds[-1, :2], bounds[-1, 2:])
            if np.linalg.norm(way) >= max(1.0, 2 * self.voxel_size):
                return float(np.arctan2(way[1], way[0]))
        return None

    def predicted(self, time: float) -> Float64[np.ndarray, " 2"]:
        """Return how far it went since it was last seen if it kept its velocity, metres along x and y."""
        return self.velocity * (time - self.last_time)

    def _history(self) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n 4"]]:
        """Return times and bounds of the sightings that tell motion, in order of time."""
        order = np.argsort(self.bound_times, kind="stable")
        bounds = np.array(self.bounds, dtype=np.float64).reshape(-1, 4)
        return np.array(self.bound_times, dtype=np.float64)[order], bounds[order]

    def _add_evidence(self, segment: Segment) -> None:
        self.feature_sum = self.feature_sum + segment.feature_sum
        self.class_votes = self.class_votes + segment.class_votes
        self.weight += segment.weight
        self.look = added(self.look, segment.look)
        self._keep_crops(segment.crops)

    def _measure(self, segment: Segment, time: float) -> None:
        low, high = segment.low[:2], segment.high[:2]
        if self.previous is not None and time > self.previous[0]:
            before, low0, high0 = self.previous
            measured = shift(low0, high0, low, high) / (time - before)
            fresh = 1.0 if len(self.bounds) < 2 else 0.6  # a steady-state alpha-beta filter of constant velocity
            self.velocity = self.velocity + fresh * (measured - self.velocity)
        if self.previous is None or time > self.previous[0]:
            self.previous = (time, low, high)
        self.bound_times.append(time)
        self.bounds.append(np.r_[low, high])
        if len(self.bounds) > _HISTORY:
            self.bounds, self.bound_times = self.bounds[::2], self.bound_times[::2]
        first = self.bounds[0]
        way = shift(first[:2], first[2:], low, high)
        far = float(np.linalg.norm(way)) > max(1.0, 2.0 * self.voxel_size)
        self.moved = (self.moved or far) and not self.stands

    def _keep_crops(self, crops: Iterable[Crop]) -> None:
        ranked = sorted([*self.crops, *crops], key=lambda c: (-c.score, c.frame, c.view))
        self.crops = ranked[:BEST_CROPS]

    def _compact(self, *, force: bool = False) -> None:
        """Unite the pieces once they are twice what they were, so that a long look costs little each frame."""
        size = sum(map(len, self._pieces))
        if len(self._pieces) > 1 and (force or size > 2 * self._compacted + 64):
            self._pieces = [np.unique(np.concatenate(self._pieces))]
            self._compacted = len(self._pieces[0])


def near(packed: Int64[np.ndarray, " n"], others: Int64[np.ndarray, " m"]) -> Bool[np.ndarray, " n"]:
    """Tell which keys have one of the others among the coarse cells about them."""
    cells = unpack(coarse(others))
    around = np.unique(pack((cells[:, None] + _AROUND).reshape(-1, 3).astype(np.int32)))
    return np.isin(pack(unpack(packed) >> 1), around)


def joined(a: Segment, b: Segment) -> Segment:
    """Return two pieces of one frame as one segment."""
    return Segment(
        seen=np.union1d(a.seen, b.seen),
        body=np.union1d(a.body, b.body),
        feature_sum=a.feature_sum + b.feature_sum,
        weight=a.weight + b.weight,
        class_votes=a.class_votes + b.class_votes,
        low=np.minimum(a.low, b.low),
        high=np.maximum(a.high, b.high),
        cut_off=a.cut_off or b.cut_off,
        crops=a.crops + b.crops,
        look=added(a.look, b.look),
    )


def coarse(packed: Int64[np.ndarray, " n"], shift_vox: tuple[int, int] = (0, 0)) -> Int64[np.ndarray, " m"]:
    """Return the cells, two voxels a side, that packed keys lie in after a shift along x and y in voxels."""
    keys = unpack(packed) + np.array([*shift_vox, 0], dtype=np.int32)
    return np.unique(pack(keys >> 1))
