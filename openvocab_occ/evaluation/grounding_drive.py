"""Questions to maps that were made as a user makes them: a drive, a model, an occupancy.

The drive leads through the synthetic city. Things are named by the classes of `evaluation.words`; only what the map saw
enough of is asked for, and what it saw less of may be named or not. A hit is right by the IoU of voxels observed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from openvocab_occ.datasets.city import City, Traversal, keyframes
from openvocab_occ.datasets.city.oracle import perceive
from openvocab_occ.datasets.city.things import Thing
from openvocab_occ.datasets.frame import Frame
from openvocab_occ.datasets.registry import load_sequence
from openvocab_occ.evaluation.grounding import Outcome, Overlap, judge
from openvocab_occ.evaluation.grounding_queries import Question, plural, questions_about
from openvocab_occ.evaluation.grounding_truth import TrueThing, Truth, box_of
from openvocab_occ.evaluation.object_truth import CityTruth
from openvocab_occ.evaluation.objects import MIN_TIME, MIN_VOXELS, Record
from openvocab_occ.evaluation.words import CLASSES
from openvocab_occ.mapping import keys_of
from openvocab_occ.mapping.keys import pack
from openvocab_occ.objects import SceneMap, SceneObject
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.pipeline.build import MapBuilder
from openvocab_occ.query.find import viewpoint_of
from openvocab_occ.segmentation.encoder import PixelEncoder

STUFF = ("sky", "road", "sidewalk", "grass")
"""Classes that are no things."""
Occupancy = Literal["oracle", "perceived"] | Callable[[Frame], OccupancyGrid]
_PERIOD = 0.5  # seconds between keyframes
_CLASS_OF = {kind: name for name, kinds in CLASSES.items() if name not in STUFF for kind in kinds}
ALSO = {"car": ("van",), "wall": ("building", "fence", "shed"), "building": ("wall", "shed"),
        "street lamp": ("traffic sign", "traffic signal")}  # fmt: skip
"""Classes, and kinds of no class, whose things may count as another: a person may call a van a car, a shed a building.
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Drive:
    """A map of a drive, and what is true of what it saw."""

    scene: SceneMap
    truth: Truth
    """Things of which anything was observed; their boxes are where they were seen last."""
    sets: Mapping[int, np.ndarray]
    """Packed voxel keys observed of each thing."""
    sure: frozenset[int]
    """Things of which enough voxels were observed to be asked for."""
    watched: frozenset[int]
    """Things observed long enough for their state."""
    others: Mapping[int, str] = field(default_factory=dict[int, str])
    """Kinds of the things that no class names."""

    def overlap(self) -> Overlap:
        """Return the IoU of voxels, remembered by object."""
        size, kept = self.scene.voxels.voxel_size, dict[int, np.ndarray]()

        def of(item: SceneObject, id: int) -> float:
            if item.id not in kept:
                kept[item.id] = np.unique(pack(keys_of(item.points, size)))
            shared = len(np.intersect1d(kept[item.id], self.sets[id], assume_unique=True))
            return shared / max(len(kept[item.id]) + len(self.sets[id]) - shared, 1)

        return of


def drive_city(
    seed: int,
    encoder: PixelEncoder,
    *,
    condition: str = "clear",
    occupancy: Occupancy = "oracle",
    route: int = 0,
    frames: int = 20,
    progress: Callable[[int, int], object] | None = None,
) -> Drive:
    """Map a drive through the city.

    Args:
        seed: Of the city, and of the errors of perceived occupancy.
        encoder: The 2D model.
        condition: Weather, of the images and of what is perceived.
        occupancy: `oracle`, the true grid; `perceived`, with the errors of `city.perceive`; or what a network says of
            a frame.
        route: Of the city.
        frames: Keyframes, two a second.
        progress: Called with the frames done and their number.
    """
    way = City(seed).traversal(route, 0, condition)
    facts, record, builder = CityTruth(way), Record(), MapBuilder(encoder)
    for done, frame in enumerate(load_sequence("city", seed=seed, route=route, condition=condition, frames=frames), 1):
        seen = frame
        if occupancy == "perceived":
            seen = replace(frame, occupancy=perceive(keyframes.labels(way, frame.index), condition, seed=seed))
        elif callable(occupancy):
            seen = replace(frame, occupancy=occupancy(frame))
        builder.integrate(seen)
        record.add(frame, facts, builder)
        if progress is not None:
            progress(done, frames)
    scene = builder.snapshot()
    sets = {id: keys for id, keys in record.sets(scene).items() if id in record.things}
    states, last = record.states(), {id: seen[-1][0] for id, seen in record.things.items()}
    found = [_true(way, id, states[id], last[id] - way.start_time()) for id in sets]
    things = tuple(thing for thing in found if thing.kind in CLASSES)
    known = {thing.id for thing in things}
    viewer = viewpoint_of(scene, None)
    truth = Truth(name=f"city {seed}, route {route}, {condition}", things=things, viewer=viewer, ground=60.0)
    long = (id for id, seen in record.things.items() if seen[-1][0] - seen[0][0] >= MIN_TIME)
    return Drive(
        scene=scene,
        truth=truth,
        sets=sets,
        sure=frozenset(id for id in known if len(sets[id]) >= MIN_VOXELS),
        watched=frozenset(long) & known,
        others={thing.id: thing.kind for thing in found if thing.kind not in CLASSES},
    )


def questions_of(drive: Drive, seed: int, *, synonyms: Mapping[str, str] | None = None) -> list[Question]:
    """Return questions about a drive; `synonyms` are words and the class that each names."""
    asked = [q for q in questions_about(drive.truth, seed) if q.category != "synonym"]
    there = {thing.kind for thing in drive.truth.things}
    for word, name in sorted((synonyms or {}).items()):
        if name in there and word != name and not name.startswith(word):
            wanted = frozenset(thing.id for thing in drive.truth.things if thing.kind == name)
            asked.append(Question(text=word, category="synonym", wanted=wanted))
    near = {other for name in there for other in ALSO.get(name, ())}
    asked += [
        Question(text=plural(name), category="absent", wanted=frozenset(), verdict="absent")
        for name in sorted(set(CLASSES) - set(STUFF) - there - near)
    ]
    kind = {thing.id: thing.kind for thing in drive.truth.things}
    found = []
    for question in asked:
        if not question.wanted:
            found.append(question)
            continue
        wanted = question.wanted & drive.sure
        if question.category == "state":
            wanted &= drive.watched
        names = {kind[id] for id in question.wanted}
        also = {other for name in names for other in ALSO.get(name, ())}
        doubt = {t.id for t in drive.truth.things if t.kind in also or (t.kind in names and t.id not in drive.sure)}
        doubt |= {id for id, other in drive.others.items() if other in also}
        if question.category == "state":
            doubt |= {t.id for t in drive.truth.things if t.kind in names and t.id not in drive.watched}
        if wanted:
            found.append(replace(question, wanted=wanted, either=(question.either | doubt | question.wanted) - wanted))
    return found


def judge_drive(
    drive: Drive, encoder: PixelEncoder | None, seed: int, *, synonyms: Mapping[str, str] | None = None
) -> list[Outcome]:
    """Ask a map of a drive.

    Relations are asked only where the nouns themselves were found rightly, and nothing in words that the model says it
    does not know: such a question is not answered at all.
    """
    overlap = drive.overlap()
    unknown = getattr(encoder.text, "unknown_words", None) if encoder is not None else None
    questions = questions_of(drive, seed, synonyms=synonyms)
    questions = [q for q in questions if q.category != "absent" or unknown is None or not unknown(q.text)]
    plain = judge(
        drive.scene, drive.truth, [q for q in questions if q.category != "relation"], encoder, overlap=overlap
    )
    right = {q.wanted for o in plain if (q := o.question).category == "class" and o.iou >= 0.25}
    kinds = {t.kind for t in drive.truth.things if any(t.id in wanted for wanted in right)}
    placed = [q for q in questions if q.category == "relation" and _nouns(q, drive.truth.things) <= kinds]
    return plain + judge(drive.scene, drive.truth, placed, encoder, overlap=overlap)


def _nouns(question: Question, things: Sequence[TrueThing]) -> set[str]:
    return {thing.kind for thing in things if thing.kind in question.text}


def _true(way: Traversal, id: int, state: str, time: float) -> TrueThing:
    """Return a thing where it is at a time, called by its class, or by its own kind where no class names it."""
    things: dict[int, tuple[Thing, np.ndarray]] = {thing.id: (thing, thing.pose()) for thing in way.still}
    things |= {mover.thing.id: (mover.thing, way.mover_pose(mover, time)) for mover in way.movers}
    thing, pose = things[id]
    name = _CLASS_OF.get(thing.kind, thing.kind)
    return TrueThing(id=id, kind=name, color=thing.color, state=state, box=box_of(thing, pose))
