"""The tracker: which segment of a new frame is which thing seen before.

One assignment a frame (SciPy) over overlap in 3D, cosine of features, likeness of classes, and distance from where a
motion model of constant velocity expects a thing. Things that stand are found through an index of coarse cells, things
that move among the few seen lately, so that a frame costs what it sees and not what the map holds.
"""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float64

from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.objects.kinds import Kind, kinds_of
from openvocab_occ.objects.segments import Segment
from openvocab_occ.objects.tracks import Track, coarse, joined


@dataclass(frozen=True, kw_only=True)
class TrackConfig:
    """How segments become tracks."""

    overlap: float = 1.0
    """Weight of the share of coarse cells that segment and track have in common, of the smaller of the two."""
    feature: float = 0.4
    """Weight of the cosine of features."""
    classes: float = 0.4
    """Weight of the cosine of class votes."""
    motion: float = 0.5
    """Weight of exp(-(d / s)^2 / 2), d the distance from the predicted place and s `motion_sigma`."""
    motion_sigma: float = 2.0
    """Metres."""
    least: float = 0.95
    """A pair that scores less is none: likeness alone (0.8) never makes one."""
    top_speed: float = 16.0
    """Metres a second: how far from its last place a thing of still unknown velocity is looked for."""
    occlusion: float = 4.0
    """Seconds for which a thing that moves is looked for while nothing shows it."""
    stays: float = 0.3
    """A thing not seen to move so far is looked for elsewhere only while less than this share of its coarse cells shows
    anything: a piece of a parked car does not jump to the next one."""
    piece: float = 0.5
    """A segment left over joins a track that holds this share of its coarse cells, for something in front cut it."""

    def __post_init__(self) -> None:
        for option in fields(self):
            value = getattr(self, option.name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"track option {option.name} is not usable", expected=">= 0", got=value)


class Tracker:
    """Turns segments, frame by frame, into tracks. Mutable."""

    def __init__(self, voxel_size: float, names: Sequence[str] = (), config: TrackConfig | None = None) -> None:
        """Begin without tracks; `names` are the classes that `Segment.class_votes` count."""
        self.config = config or TrackConfig()
        self.names = tuple(names)
        self.tracks: dict[int, Track] = {}
        self.apart: Counter[tuple[int, int]] = Counter()
        """Pairs of tracks, and in how many frames they were two segments."""
        self.together: Counter[tuple[int, int]] = Counter()
        """Pairs of tracks, and in how many frames one segment covered both."""
        self._voxel_size = voxel_size
        self._kinds = kinds_of(names)
        self._cells: defaultdict[int, set[int]] = defaultdict(set)  # coarse cell -> tracks
        self._lately: dict[int, float] = {}  # tracks that may be elsewhere by now, and when they were seen
        self._next = 1

    def observe(self, segments: Sequence[Segment], *, frame: int, time: float) -> list[int]:
        """Give each segment its track, new or known; return their ids.

        Frames may come in any order, but what moves is followed best in order of time.
        """
        if not np.isfinite(time):
            raise DataError(f"time of frame {frame} is not finite", expected="seconds", got=time)
        cells = [coarse(s.body).tolist() for s in segments]
        shared = [self._shared(c) for c in cells]
        ids = self._assign(segments, cells, shared, time)
        for number, found in enumerate(ids):
            if found == 0:
                ids[number] = self._piece_of(segments[number], cells[number], shared[number])
        parts: defaultdict[int, list[int]] = defaultdict(list)
        for number, found in enumerate(ids):
            if found:
                parts[found].append(number)
        for id, numbers in parts.items():
            whole = segments[numbers[0]]
            for number in numbers[1:]:
                whole = joined(whole, segments[number])
            track = self.tracks[id]
            track.stands = not self._may_move(track.class_votes + whole.class_votes)
            track.add(whole, frame, time)
            self._enter(self.tracks[id])
        for number, found in enumerate(ids):
            if found == 0:
                ids[number] = self._birth(segments[number], frame, time)
        self._remember(segments, ids, cells, shared)
        self._lately = {id: t for id, t in self._lately.items() if abs(time - t) <= self.config.occlusion}
        return ids

    def forget(self, id: int, into: int | None = None) -> None:
        """Drop a track, or merge it into another."""
        gone = self.tracks.pop(id)
        for cell in gone.cells:
            self._cells[cell].discard(id)
        self._lately.pop(id, None)
        if into is not None:
            self.tracks[into].absorb(gone)
            for cell in gone.cells:
                self._cells[cell].add(into)
        for pair in [pair for pair in self.apart if id in pair]:
            count = self.apart.pop(pair)
            other = pair[0] if pair[1] == id else pair[1]
            if into is not None and other != into:
                self.apart[_ordered(into, other)] += count

    def _shared(self, cells: Sequence[int]) -> Counter[int]:
        """Return how many of the cells each track is known to hold."""
        found: Counter[int] = Counter()
        for cell in cells:
            if cell in self._cells:
                found.update(self._cells[cell])
        return found

    def _assign(
        self, segments: Sequence[Segment], cells: Sequence[list[int]], shared: Sequence[Counter[int]], time: float
    ) -> list[int]:
        from scipy.optimize import linear_sum_assignment
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        ids = [0] * len(segments)
        scores: dict[tuple[int, int], float] = {}
        held: Counter[int] = Counter()  # cells of each track in which something is seen now
        for counts in shared:
            held.update(counts)
        for number, segment in enumerate(segments):
            gone = [id for id in self._near(segment, time) if not self._still_there(id, held[id])]
            for id in {*shared[number], *gone}:
                score = self._score(segment, cells[number], shared[number][id], self.tracks[id], time)
                if score >= self.config.least:
                    scores[number, id] = score
        if not scores:
            return ids
        # pairs that share no segment and no track are decided apart: most pairs are alone
        numbers, inverse = np.unique([n for n, _ in scores], return_inverse=True)
        tracks, column = np.unique([i for _, i in scores], return_inverse=True)
        total = len(numbers) + len(tracks)
        graph = coo_array((np.ones(len(scores), bool), (inverse, len(numbers) + column)), shape=(total, total))
        count, part = connected_components(graph, directed=False)
        groups: list[list[tuple[int, int]]] = [[] for _ in range(count)]
        for pair, at in zip(scores, inverse, strict=True):
            groups[part[at]].append(pair)
        for pairs in groups:
            rows, columns = sorted({n for n, _ in pairs}), sorted({i for _, i in pairs})
            table = np.zeros((len(rows), len(columns)))
            for n, i in pairs:
                table[rows.index(n), columns.index(i)] = scores[n, i]
            for r, c in zip(*linear_sum_assignment(table, maximize=True), strict=True):
                if table[r, c] > 0:
                    ids[rows[r]] = columns[c]
        return ids

    def _near(self, segment: Segment, time: float) -> list[int]:
        """Return tracks that may have come here since they were seen."""
        if not self._may_move(segment.class_votes):
            return []
        near = []
        for id in self._lately:
            track = self.tracks[id]
            reach = 2 * self.config.motion_sigma
            if len(track.bounds) < 2:
                reach += self.config.top_speed * abs(time - track.last_time)
            if np.linalg.norm(segment.center[:2] - self._expected(track, time)) <= reach:
                near.append(id)
        return near

    def _still_there(self, id: int, held: int) -> bool:
        """Tell whether a track that was never seen to move is, by what is seen now, where it was."""
        track = self.tracks[id]
        return not track.moved and held >= self.config.stays * len(track.cells)

    def _expected(self, track: Track, time: float) -> Float64[np.ndarray, " 2"]:
        assert track.last is not None
        return track.last.center[:2] + track.predicted(time)

    def _score(self, segment: Segment, cells: Sequence[int], shared: int, track: Track, time: float) -> float:
        assert track.last is not None
        config = self.config
        size = min(len(cells), max(len(track.cells), 1))
        overlap = shared / size
        likeness = config.feature * max(0.0, float(segment.feature @ track.feature)) + config.classes * _cosine(
            segment.class_votes, track.class_votes
        )
        if not self._may_move(segment.class_votes) and not self._may_move(track.class_votes):
            return config.overlap * overlap + likeness if shared else 0.0
        if track.moved:
            steps = np.rint(track.predicted(time) / self._voxel_size).astype(int)
            there = coarse(track.last.body, (int(steps[0]), int(steps[1])))
            moved = len(np.intersect1d(there, np.array(cells))) / min(len(there), len(cells))
            overlap = max(overlap, moved)
        off = float(np.linalg.norm(segment.center[:2] - self._expected(track, time)))
        sigma = config.motion_sigma
        if len(track.bounds) < 2:  # it may be anywhere within reach; the nearest is the likeliest
            sigma += config.top_speed * abs(time - track.last_time) / 3
        alike = _ratio(segment, track.last) if not overlap else 1.0
        return config.overlap * overlap + likeness + config.motion * alike * float(np.exp(-0.5 * (off / sigma) ** 2))

    def _may_move(self, votes: np.ndarray) -> bool:
        """True unless the class evidence speaks for a thing that stands."""
        kinds = self._kinds[: len(votes)]
        return bool(votes[kinds == Kind.MOVABLE].sum() >= votes[kinds == Kind.FIXED].sum())

    def _piece_of(self, segment: Segment, cells: Sequence[int], shared: Counter[int]) -> int:
        """Return the track that a segment left over is a piece of; 0 for none."""
        best, most = 0, 0.0
        for id, count in shared.items():
            track = self.tracks[id]
            held = count / len(cells)
            alike = _cosine(segment.class_votes, track.class_votes) > 0.5 if track.class_votes.any() else True
            if alike and held >= self.config.piece and held > most and float(segment.feature @ track.feature) > 0.5:
                best, most = id, held
        return best

    def _birth(self, segment: Segment, frame: int, time: float) -> int:
        id, self._next = self._next, self._next + 1
        self.tracks[id] = Track.born(
            id, self._voxel_size, segment, frame=frame, time=time, stands=not self._may_move(segment.class_votes)
        )
        self._enter(self.tracks[id])
        return id

    def _enter(self, track: Track) -> None:
        """Write into the index where a track is now; what moves is where it was seen last, and nowhere else."""
        assert track.last is not None
        now = set(coarse(track.last.body).tolist())
        if track.moved:
            for cell in track.cells - now:
                self._cells[cell].discard(track.id)
            track.cells = now
        else:
            track.cells |= now
        for cell in now:
            self._cells[cell].add(track.id)
        if self._may_move(track.class_votes):
            self._lately[track.id] = track.last_time

    def _remember(
        self,
        segments: Sequence[Segment],
        ids: Sequence[int],
        cells: Sequence[list[int]],
        shared: Sequence[Counter[int]],
    ) -> None:
        """Note which tracks one segment covered, and which movable ones were seen as two."""
        for number, id in enumerate(ids):
            for other, count in shared[number].items():
                if other != id and other in self.tracks and not self.tracks[other].moved:
                    size = min(len(cells[number]), max(len(self.tracks[other].cells), 1))
                    if count >= 0.5 * size:
                        self.together[_ordered(id, other)] += 1
        by_cell: defaultdict[int, set[int]] = defaultdict(set)
        for number, id in enumerate(ids):
            for other in shared[number]:
                if other != id:
                    by_cell[other].add(id)
        present, together = set(ids), set[tuple[int, int]]()
        for other, near in by_cell.items():
            together.update(_ordered(id, other) for id in near if other in present)
        self.apart.update(together)


def _ratio(a: Segment, b: Segment) -> float:
    """Return how near the sizes of two segments are, 1 for the same: what goes elsewhere keeps its size."""
    small, large = sorted((len(a.body), len(b.body)))
    return small / large


def _ordered(a: int, b: int) -> tuple[int, int]:
    return (a, b) if a < b else (b, a)


def _cosine(a: np.ndarray, b: np.ndarray) -> float:
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / norm if norm > 0 else 0.0
