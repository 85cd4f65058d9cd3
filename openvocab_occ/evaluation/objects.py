"""Objects of a synthetic drive against its truth: sets of voxels, identities, states, boxes.

Truth and prediction are held against each other on what was observed. The voxels of a true thing are those of the map
that frames saw and whose thing it was in most of them; of a thing that moved, those of the last frame that saw it. The
true state comes from the same rule as the predicted one, applied to exact positions at the frames that saw the thing.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from openvocab_occ.datasets.frame import Frame
from openvocab_occ.depth.render import render_depth
from openvocab_occ.evaluation.identity import IdentityScores, Sight, score_identity
from openvocab_occ.evaluation.instances import InstanceScores, overlaps, score_instances
from openvocab_occ.evaluation.object_truth import TrueThing, Truth
from openvocab_occ.mapping import cover_grid, keys_of
from openvocab_occ.mapping.keys import pack
from openvocab_occ.objects.builder import ObjectConfig
from openvocab_occ.objects.kinds import Kind, kind_of
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.state import Motion, StateConfig, judge
from openvocab_occ.objects.tree import SceneObject
from openvocab_occ.pipeline.build import MapBuilder
from openvocab_occ.segmentation.encoder import Contract, FeatureMap, PixelEncoder, TextEncoder

MIN_VOXELS = 10
"""Things of which fewer voxels were seen are neither missed nor hit."""
MIN_TIME = 2.0
"""Seconds a thing must be observed for its state to be judged."""


@dataclass(frozen=True, kw_only=True)
class BoxErrors:
    """Medians over matched things that have true boxes and can move; NaN where there are none."""

    things: int
    center_m: float
    yaw_deg: float
    """Front and back not told apart."""
    size_m: float
    """Mean over length, width and height."""


@dataclass(frozen=True, kw_only=True)
class ObjectReport:
    """All scores of one drive."""

    frames: int
    instances: InstanceScores
    identity: IdentityScores
    state_accuracy: float
    """Among matched things observed long enough."""
    states: Mapping[str, Mapping[str, tuple[int, int]]]
    """By class and true state: right, all."""
    boxes: BoxErrors
    seconds_per_frame: float
    """Median time of a frame for segments and tracks."""
    missed: tuple[str, ...] = field(repr=False)
    """Counted things without a prediction of IoU 0.5: class, voxels, IoU."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return asdict(self)


def judge_objects(
    frames: Sequence[Frame],
    truth: Truth,
    encoder: PixelEncoder,
    *,
    config: ObjectConfig | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> tuple[ObjectReport, SceneMap]:
    """Build a map of a drive and score its objects; return the scores and the map."""
    builder = MapBuilder(encoder, objects=config)
    record = Record()
    seconds: list[float] = []
    for done, frame in enumerate(frames, start=1):
        if isinstance(encoder, TruthEncoder):
            encoder.prepare(frame, truth)
        builder.integrate(frame)
        assert builder.objects is not None, "there is a first frame"
        seconds.append(builder.objects.seconds)
        record.add(frame, truth, builder)
        if progress is not None:
            progress(done, len(frames))
    scene = builder.snapshot()
    assert builder.objects is not None, "there is a first frame"
    return record.report(scene, builder.objects.merged, seconds), scene


class Record:
    """What was true and what was found, frame by frame. Mutable."""

    def __init__(self) -> None:
        self.votes: defaultdict[int, Counter[int]] = defaultdict(Counter)  # key -> things
        self.last: dict[int, set[int]] = {}  # keys of a thing in the last frame that saw it
        self.sights: list[tuple[dict[int, np.ndarray], dict[int, np.ndarray]]] = []
        self.things: dict[int, list[tuple[float, TrueThing]]] = defaultdict(list)

    def add(self, frame: Frame, truth: Truth, builder: MapBuilder) -> None:
        """Note a frame after the builder has seen it."""
        grid, objects = frame.occupancy, builder.objects
        assert grid is not None, "built from grids"
        assert objects is not None, "a frame was integrated"
        assert objects.latest is not None, "a frame was integrated"
        instances = truth.instances(frame).reshape(-1)
        flat = np.flatnonzero(instances)
        size = builder.voxel_size
        cover = cover_grid(flat, grid, size)
        keys, first = np.unique(pack(cover.keys), return_index=True)
        ids = instances[flat[cover.row[first]]]
        seen = np.isin(keys, objects.latest.seen)
        keys, ids = keys[seen], ids[seen]
        for key, id in zip(keys.tolist(), ids.tolist(), strict=True):
            self.votes[key][id] += 1
        true = {int(id): keys[ids == id] for id in np.unique(ids)}
        there = truth.things(frame)
        for id, members in true.items():
            self.last[id] = set(members.tolist())
            if id in there:
                self.things[id].append((frame.timestamp, there[id]))
        found: dict[int, list[np.ndarray]] = defaultdict(list)
        for segment, id in zip(objects.latest.segments, objects.latest.tracks, strict=True):
            found[id].append(segment.seen)
        self.sights.append((true, {id: np.unique(np.concatenate(parts)) for id, parts in found.items()}))

    def report(self, scene: SceneMap, merged: Mapping[int, int], seconds: Sequence[float]) -> ObjectReport:
        """Sum up."""
        states, true = self.states(), self.sets(scene)
        ids = sorted(true)
        sets = [true[id] for id in ids]
        ignored = [len(true[id]) < MIN_VOXELS or id not in self.things for id in ids]
        objects = [o for o in scene.objects if kind_of(o.label) not in (Kind.GROUND, Kind.NOTHING)]
        predicted = [np.unique(pack(keys_of(o.points, scene.voxels.voxel_size))) for o in objects]
        sure = [float(o.times_seen) + len(p) / 1e6 for o, p in zip(objects, predicted, strict=True)]
        iou, _ = overlaps(predicted, sets)
        counted = [n for n in range(len(ids)) if not ignored[n]]
        pairs = _pairs(iou, counted)
        matched = {ids[t]: objects[p] for t, p in pairs.items()}
        table, accuracy = self._states(states, matched)
        missed = tuple(
            f"{self.things[ids[n]][0][1].label}, {len(sets[n])} voxels, IoU {iou[:, n].max(initial=0):.2f}, "
            f"{states[ids[n]]}"
            for n in counted
            if iou[:, n].max(initial=0) < 0.5
        )
        return ObjectReport(
            frames=len(self.sights),
            instances=score_instances(predicted, sure, sets, ignored),
            identity=score_identity(self._sights(merged)),
            state_accuracy=accuracy,
            states=table,
            boxes=self._boxes(matched),
            seconds_per_frame=float(np.median(seconds)) if len(seconds) else 0.0,
            missed=missed,
        )

    def states(self) -> dict[int, str]:
        """Return the true state of each thing, from where it was when frames saw it."""
        return {id: true_state(seen) for id, seen in self.things.items()}

    def sets(self, scene: SceneMap) -> dict[int, np.ndarray]:
        """Return the packed keys of each true thing."""
        moved = {id for id, state in self.states().items() if state in ("moving", "stopped")}
        keys = pack(scene.voxels.keys)
        here = set(keys.tolist())
        sets: defaultdict[int, list[int]] = defaultdict(list)
        for key, votes in self.votes.items():
            id = min(votes, key=lambda i: (-votes[i], i))
            if id not in moved and key in here:
                sets[id].append(key)
        for id in moved:
            sets[id] = list(self.last[id])
        return {id: np.unique(np.array(members, dtype=np.int64)) for id, members in sets.items() if members}

    def _sights(self, merged: Mapping[int, int]) -> list[Sight]:
        sights = []
        for true, found in self.sights:
            parts: dict[int, list[np.ndarray]] = defaultdict(list)
            for id, keys in found.items():
                parts[merged.get(id, id)].append(keys)
            whole = {id: np.unique(np.concatenate(keys)) for id, keys in parts.items()}
            names, mine = list(true), list(whole)
            iou, share = overlaps([whole[id] for id in mine], [true[id] for id in names])
            counted = np.array([len(true[id]) >= MIN_VOXELS and id in self.things for id in names], dtype=bool)
            keep = (share[:, counted].sum(axis=1) >= 0.5) | (iou[:, counted].max(axis=1, initial=0.0) >= 0.5)
            pairs = {(names[t], mine[p]): float(iou[p, t]) for p, t in np.argwhere(iou > 0) if counted[t] and keep[p]}
            sights.append(Sight(
                tuple(id for id, c in zip(names, counted, strict=True) if c),
                tuple(id for id, k in zip(mine, keep, strict=True) if k), pairs,
            ))  # fmt: skip
        return sights

    def _states(
        self, states: Mapping[int, str], matched: Mapping[int, SceneObject]
    ) -> tuple[dict[str, dict[str, tuple[int, int]]], float]:
        table: dict[str, dict[str, tuple[int, int]]] = {}
        for id, item in matched.items():
            seen = self.things[id]
            if seen[-1][0] - seen[0][0] < MIN_TIME:
                continue
            row = table.setdefault(seen[0][1].label, {})
            right, count = row.get(states[id], (0, 0))
            row[states[id]] = (right + (item.state == states[id]), count + 1)
        cells = [cell for row in table.values() for cell in row.values()]
        count = sum(n for _, n in cells)
        return table, sum(r for r, _ in cells) / count if count else float("nan")

    def _boxes(self, matched: Mapping[int, SceneObject]) -> BoxErrors:
        rows = []
        for id, item in matched.items():
            thing = self.things[id][-1][1]
            if thing.box is None or kind_of(thing.label) != Kind.MOVABLE:
                continue
            off = float(np.linalg.norm(thing.box.center[:2] - item.box.center[:2]))
            turn = np.rad2deg(abs((thing.box.yaw - item.box.yaw + np.pi / 2) % np.pi - np.pi / 2))
            rows.append((off, float(turn), float(np.abs(thing.box.size - item.box.size).mean())))
        center, yaw, size = np.median(rows, axis=0) if rows else (float("nan"),) * 3
        return BoxErrors(things=len(rows), center_m=float(center), yaw_deg=float(yaw), size_m=float(size))


def true_state(seen: Sequence[tuple[float, TrueThing]], config: StateConfig | None = None) -> str:
    """Return the state by the rule of `judge`, from exact positions at the times a thing was seen."""
    config = config or StateConfig()
    times = np.array([time for time, _ in seen])
    thing = seen[0][1]
    at = np.array([t.box.center[:2] if t.box is not None else (0.0, 0.0) for _, t in seen])
    way = np.linalg.norm(at[:, None] - at[None], axis=2)
    a, b = np.unravel_index(int(way.argmax()), way.shape)
    end = len(times) - 1
    start = max(min(int(np.searchsorted(times, times[-1] - config.recent - 1e-6)), end - 1), 0)
    lasted = times[end] - times[start]
    motion = Motion(
        extent=float(way.max()), sigma=0.0, speed=float(way[start, end] / lasted) if lasted > 0 else 0.0,
        velocity=np.zeros(2), mean_speed=float(way[a, b] / max(abs(times[a] - times[b]), 1e-9)),
        time_observed=float(times[-1] - times[0]), sightings=len(times),
    )  # fmt: skip
    return judge(motion, movable=float(kind_of(thing.label) == Kind.MOVABLE), config=config)[0]


def _pairs(iou: np.ndarray, counted: Sequence[int], threshold: float = 0.25) -> dict[int, int]:
    """Pair true sets with predictions one to one, for the greatest sum of IoU."""
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(iou[:, counted], maximize=True)
    return {counted[c]: int(r) for r, c in zip(rows, columns, strict=True) if iou[r, counted[c]] >= threshold}


class TruthEncoder:
    """Stands in for a network: each pixel gets the vector of the true thing that depth says it sees."""

    contract: Contract = "dense"
    labels: tuple[str, ...] = ()
    text: TextEncoder | None = None
    name = "truth"
    fingerprint = "truth" * 12

    def __init__(self, dim: int = 24) -> None:
        self.dim = dim
        self._maps: list[FeatureMap] = []

    def prepare(self, frame: Frame, truth: Truth) -> None:
        """Take the truth of the frame whose images come next."""
        assert frame.occupancy is not None, "the truth is given on a grid"
        grid, instances = frame.occupancy, truth.instances(frame).reshape(-1)
        codes = np.where(instances > 0, instances.astype(np.int64) + 1000, grid.labels.reshape(-1))
        self._maps = []
        for view in frame.views:
            voxel = render_depth(grid, view.camera).voxel
            code = np.where(voxel >= 0, codes[voxel], -1)
            numbers, inverse = np.unique(code, return_inverse=True)
            vectors = np.stack([self._vector(int(n)) for n in numbers])
            cells = vectors[inverse.reshape(voxel.shape)]
            self._maps.append(FeatureMap(cells, (1.0, 1.0), (0.0, 0.0)))

    def encode(self, images: Sequence[UInt8[np.ndarray, "h w 3"]]) -> list[FeatureMap]:
        """Return the cells of the frame that was prepared."""
        assert len(images) == len(self._maps), "prepare comes first"
        return self._maps

    def _vector(self, number: int) -> Float32[np.ndarray, " c"]:
        vector = np.random.default_rng([number + 1, 77]).standard_normal(self.dim)
        return (vector / np.linalg.norm(vector)).astype(np.float32)
