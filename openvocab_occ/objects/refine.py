"""Batch refinement: what only the whole drive can tell. Each step can be switched off and says what it did."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from openvocab_occ.mapping.keys import unpack
from openvocab_occ.objects.box import principal_yaw
from openvocab_occ.objects.bridges import cut_bridge
from openvocab_occ.objects.kinds import Kind, kind_of, plausible_length
from openvocab_occ.objects.segments import neighbour_pairs
from openvocab_occ.objects.tracks import Track, coarse

Pair = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class RefineConfig:
    """Which steps are taken, and when."""

    merge: bool = True
    """Merge tracks of one thing."""
    split: bool = True
    """Cut tracks in which two things became one."""
    drop: bool = True
    """Drop tracks too thin to be things."""
    touch: float = 0.3
    """Touching tracks of one class that stands merge when their features are no further apart than this."""
    contact: int = 2
    """Pairs of neighbouring voxels from which tracks touch."""
    crumb: int = 20
    """Voxels below which a piece of what stands need not quite touch what it is a piece of."""
    shared: float = 0.5
    """Tracks of one class merge when one segment covered both in this share of the sightings of the shorter."""
    min_voxels: int = 4
    """A track with fewer voxels is noise."""
    min_weight: float = 20.0
    """So is one of a single sighting with fewer pixels."""


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """What was done."""

    tracks: int
    """Before."""
    merged: int = 0
    split: int = 0
    dropped: int = 0
    objects: int = 0
    """After."""


def refine(
    tracks: Mapping[int, Track],
    *,
    together: Mapping[Pair, int],
    apart: Mapping[Pair, int],
    names: Sequence[str],
    config: RefineConfig | None = None,
) -> tuple[list[Track], Refinement, dict[int, int]]:
    """Return refined copies of tracks by id, what was done to them, and the ids that went into others.

    The tracks themselves stay as they are.

    Args:
        tracks: By id.
        together: In how many frames one segment covered two tracks.
        apart: In how many frames two tracks were two segments; things that can move are not merged where that was as
            often as one segment covered both.
        names: Of the classes that tracks count votes for.
        config: Which steps are taken.
    """
    config = config or RefineConfig()
    done = Refinement(tracks=len(tracks))
    kept = {id: copy(track) for id, track in tracks.items()}
    into: dict[int, int] = {}
    if config.merge:
        into = _merge(kept, together, apart, names, config)
        touching = _merge_touching(kept, names, config)
        into = {id: touching.get(home, home) for id, home in into.items()} | touching
        done = replace(done, merged=len(into))
    if config.split:
        done = replace(done, split=_split(kept, names))
    if config.drop:
        done = replace(done, dropped=_drop(kept, config))
    return [kept[id] for id in sorted(kept)], replace(done, objects=len(kept)), into


def class_of(track: Track, names: Sequence[str]) -> str:
    """Return the class that most of the evidence names; empty where there is none."""
    return names[int(track.class_votes.argmax())] if len(names) and track.class_votes.any() else ""


def _merge(
    kept: dict[int, Track],
    together: Mapping[Pair, int],
    apart: Mapping[Pair, int],
    names: Sequence[str],
    config: RefineConfig,
) -> dict[int, int]:
    """Merge pairs that segments covered together, those most often so first; the lower id stays."""
    into: dict[int, int] = {}
    barred: defaultdict[int, set[int]] = defaultdict(set)
    for (a, b), frames in apart.items():
        if frames < together.get((a, b), 0):
            continue
        barred[a].add(b)
        barred[b].add(a)

    def home(id: int) -> int:
        while id in into:
            id = into[id]
        return id

    for (a, b), frames in sorted(together.items(), key=lambda item: (-item[1], item[0])):
        a, b = sorted((home(a), home(b)))
        if a == b or a not in kept or b not in kept:
            continue
        one, two = kept[a], kept[b]
        name = class_of(one, names)
        if name != class_of(two, names) or frames < config.shared * min(len(one.frames), len(two.frames)):
            continue
        if (kind_of(name) in (Kind.MOVABLE, Kind.UNKNOWN)) and b in barred[a]:
            continue
        one.absorb(two)
        del kept[b]
        into[b] = a
        others = barred.pop(b, set()) - {a, b}  # what stands may merge with what it was seen apart from
        barred[a] = (barred[a] - {b}) | others
        for other in others:
            barred[other].add(a)
    return {id: home(id) for id in into}


def _merge_touching(kept: dict[int, Track], names: Sequence[str], config: RefineConfig) -> dict[int, int]:
    """Merge pieces, of one class, of things that stand: of a wall seen bit by bit, of a bus behind trees.

    Pieces of what cannot move merge when they touch, or crumbs nearly do, and look alike. Pieces of what can
    move need not touch quite, nor look alike, for front and side of a truck differ; but together they must be no longer
    than such a thing can be.
    """
    into: dict[int, int] = {}

    def home(id: int) -> int:
        while id in into:
            id = into[id]
        return id

    for kind, near in ((Kind.FIXED, False), (Kind.FIXED, True), (Kind.MOVABLE, True)):
        movable = kind == Kind.MOVABLE
        ids = [i for i in sorted(kept) if kind_of(class_of(kept[i], names)) == kind and not kept[i].moved]
        contacts = _contacts([coarse(kept[i].voxels) if near else kept[i].voxels for i in ids])
        for (i, j), count in sorted(contacts.items(), key=lambda item: (-item[1], item[0])):
            a, b = sorted((home(ids[i]), home(ids[j])))
            if a == b or class_of(kept[a], names) != class_of(kept[b], names):
                continue
            if movable:
                one = _fits_one(kept[a], kept[b], class_of(kept[a], names))
            else:
                alike = 1 - float(kept[a].feature @ kept[b].feature) <= config.touch
                small = min(len(kept[a].voxels), len(kept[b].voxels)) < config.crumb
                one = alike and (small if near else count >= config.contact)
            if one:
                kept[a].absorb(kept.pop(b))
                into[b] = a
    return {id: home(id) for id in into}


def _contacts(packed: Sequence[np.ndarray]) -> Counter[Pair]:
    """Count the voxels that two sets share, and those of one that touch one of the other."""
    contacts: Counter[Pair] = Counter()
    if not packed:
        return contacts
    owner = np.repeat(np.arange(len(packed)), [len(p) for p in packed])
    keys = np.concatenate(packed)
    order = np.lexsort((owner, keys))
    keys, owner = keys[order], owner[order]
    same = np.flatnonzero(keys[1:] == keys[:-1])
    contacts.update(zip(owner[same].tolist(), owner[same + 1].tolist(), strict=True))
    single = np.r_[True, keys[1:] != keys[:-1]] if len(keys) else np.empty(0, bool)
    keys, owner = keys[single], owner[single]
    ends = np.sort(owner[neighbour_pairs(keys)], axis=1)
    ends = ends[ends[:, 0] != ends[:, 1]]
    contacts.update(zip(ends[:, 0].tolist(), ends[:, 1].tolist(), strict=True))
    return contacts


def _fits_one(a: Track, b: Track, name: str) -> bool:
    """Tell whether two pieces together are no longer and no wider than one thing called so."""
    lengths = plausible_length(name)
    if lengths is None:
        return False
    xy = (unpack(np.union1d(a.voxels, b.voxels))[:, :2] + 0.5) * a.voxel_size
    yaw = principal_yaw(xy)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    length, width = np.ptp(xy @ turn, axis=0) + a.voxel_size
    slack = 2 * a.voxel_size
    return bool(length <= lengths[1] + slack and width <= max(3.0, lengths[0]) + slack)


def _split(kept: dict[int, Track], names: Sequence[str]) -> int:
    """Cut tracks of things that stand at necks; the largest piece keeps the id, the others get new ones."""
    count, fresh = 0, max(kept, default=0) + 1
    for id in sorted(kept):
        track = kept[id]
        if track.moved or track.last is None:
            continue
        seen = track.voxels  # a thing is judged by its hidden side too
        whole = np.union1d(seen, track.body)
        pieces = [np.intersect1d(p, seen) for p in cut_bridge(whole, class_of(track, names), track.voxel_size)]
        pieces = [piece for piece in pieces if len(piece)]
        pieces.sort(key=len, reverse=True)
        for number, piece in enumerate(pieces if len(pieces) > 1 else []):
            part = track.of_voxels(piece, id if number == 0 else fresh)
            kept[part.id] = part
            fresh += number > 0
            count += number > 0
    return count


def _drop(kept: dict[int, Track], config: RefineConfig) -> int:
    noise = [
        id
        for id, track in kept.items()
        if len(track.voxels) < config.min_voxels or (len(track.frames) == 1 and track.weight < config.min_weight)
    ]
    for id in noise:
        del kept[id]
    return len(noise)


def owners(tracks: Sequence[Track]) -> list[np.ndarray]:
    """Return the packed keys of each track, each key given to one track only: the one that holds the fewest."""
    sizes: Counter[int] = Counter({n: len(t.voxels) for n, t in enumerate(tracks)})
    packed = [t.voxels for t in tracks]
    if not packed:
        return []
    keys = np.concatenate(packed)
    owner = np.repeat(np.arange(len(tracks)), [len(p) for p in packed])
    rank = np.array([sizes[n] for n in range(len(tracks))])[owner]
    order = np.lexsort((owner, rank, keys))
    first = np.ones(len(keys), dtype=bool)
    first[1:] = keys[order][1:] != keys[order][:-1]
    mine = np.zeros(len(keys), dtype=bool)
    mine[order[first]] = True
    ends = np.cumsum([len(p) for p in packed])[:-1]
    return [p[m] for p, m in zip(packed, np.split(mine, ends), strict=True)]
