"""Questions about a small town of known things: states, colours, relations, places."""

from dataclasses import replace

import numpy as np
import pytest

from openvocab_occ.errors import ConfigError, QueryError
from openvocab_occ.mapping import Lifted, VoxelMap
from openvocab_occ.objects import (
    Box,
    EncoderInfo,
    KeyFrame,
    ObjectTree,
    SceneMap,
    SceneObject,
    group_objects,
)  # fmt: skip
from openvocab_occ.query import algebra as q
from openvocab_occ.query import score_voxels
from openvocab_occ.query.find import find
from openvocab_occ.query.relations import Viewpoint

LABELS = ("road", "curb", "truck", "traffic cone", "bus", "person")


def placed(things, labels=LABELS, *, frames=(), ground=None):
    """A map of cuboids: (label, center, size, state, colour), each one object; `ground` is a square of road."""
    voxels, keys_of = VoxelMap(0.5, len(labels), contract="logits"), []
    rows = [*things, *([("road", (0, 0, -0.25), (ground, ground, 0.5), "fixed", (90, 90, 90))] if ground else [])]
    for label, center, size, _, color in rows:
        low = np.round((np.array(center) - np.array(size) / 2) / 0.5).astype(int)
        keys = np.argwhere(np.ones(np.maximum(np.round(np.array(size) / 0.5).astype(int), 1))) + low
        one_hot = np.tile(np.float32([name == label for name in labels]), (len(keys), 1))
        n = len(keys)
        lifted = Lifted(
            one_hot, np.ones(n, np.float32), np.ones(n, np.int32), color_sum=np.tile(np.float32(color), (n, 1))
        )
        voxels.integrate(keys.astype(np.int32), lifted, time=0.0)
        keys_of.append(keys)
    nodes = [group_objects(voxels, labels=labels).root]
    for id, ((label, _, _, state, _), keys) in enumerate(zip(rows, keys_of, strict=True), start=1):
        members = np.sort(voxels.index(keys.astype(np.int32)))
        nodes.append(SceneObject(
            id=id, label=label, score=1.0, box=Box.around(keys, 0.5), voxels=members, state=state, parent=0,
            points=voxels.centers[members].astype(np.float32), embedding=voxels.features[members].mean(axis=0),
        ))  # fmt: skip
    nodes[0] = replace(nodes[0], children=tuple(range(1, len(nodes))))
    info = EncoderInfo(name="toy", contract="logits", dim=len(labels), labels=tuple(labels), fingerprint="f" * 64)
    return SceneMap(voxels, ObjectTree(nodes), info, frames)


RED, BLUE, GREY = (200, 30, 35), (30, 70, 185), (120, 120, 120)


EGO = (KeyFrame(0, 5.0, np.eye(4)),)


@pytest.fixture(scope="module")
def town():
    return placed(
        [
            ("truck", (20, 0, 1.5), (7, 2.5, 3), "parked", RED),
            ("truck", (40, 10, 1.5), (7, 2.5, 3), "moving", BLUE),
            ("truck", (40, -12, 1), (5, 2, 2), "unknown", GREY),
            ("bus", (20, 5, 1.5), (10, 2.5, 3), "stopped", BLUE),
            ("person", (20, -4, 1), (0.5, 0.5, 2), "moving", RED),
            ("traffic cone", (30, 5, 0.5), (0.5, 0.5, 1), "fixed", RED),
        ],
        frames=EGO,
        ground=100,
    )


def test_a_row_of_things_is_not_named_beside_them(town):
    """A region without voxels of its own answers only to its level; one of ground answers as a thing does."""
    first = town.objects[1]
    row = replace(first, id=90, level="region", voxels=np.empty(0, np.int64), children=(), parent=0)
    lot = replace(first, id=91, level="region", children=(), parent=0)
    nodes = list(town.objects.nodes)
    nodes[0] = replace(nodes[0], children=(*nodes[0].children, 90, 91))
    scene = SceneMap(town.voxels, ObjectTree([*nodes, row, lot]), town.encoder, town.frames)
    assert sorted(hit.object.id for hit in find(scene, "trucks").hits) == [1, 2, 3, 91]
    in_regions = q.Level(q.Noun("truck"), "region")
    assert sorted(hit.object.id for hit in find(scene, in_regions).hits) == [90, 91]


@pytest.mark.parametrize(
    ("text", "ids"),
    [
        ("trucks", [1, 2, 3]),
        ("lorries", [1, 2, 3]),
        ("red trucks", [1]),
        ("red or blue trucks", [1, 2]),
        ("moving trucks", [2]),
        ("trucks on the road", [1, 2, 3]),
        ("truck next to the bus", [1]),
        ("what is left of the truck within 10 m of me", []),
        ("person right of the truck", [5]),
        ("bus left of the red truck", [4]),
        ("truck behind the cone", [2]),
        ("largest truck", [1]),
        ("the smallest truck", [3]),
        ("nearest truck", [1]),
        ("second nearest truck", [2]),
        ("truck farthest from the bus", [3]),
        ("leftmost truck", [2]),
        ("trucks within 25 m", [1]),
        ("trucks more than 25 m from me", [2, 3]),
        ("trucks longer than 6 m", [1, 2]),
        ("cone between the red truck and the blue truck", [6]),
        ("two trucks", [1, 2]),
        ("trucks and buses", [1, 2, 3, 4]),
        ("people or cones", [5, 6]),
        ("anything but trucks", [4, 5, 6, 7]),
        ("trucks except the red one", [2, 3]),
        ("#4", [4]),
        ("something like #1", [2, 3]),
        ("truck near #4", [1]),
        ("objects between 1.5 and 2.5 m tall", [3, 5]),
        ("trucks within 3 m of (20, 0, 1)", [1]),
    ],
)
def test_a_town_is_read(town, text, ids):
    answer = find(town, text)
    sure = [hit.object.id for hit in answer.hits if not hit.undecided]
    assert sorted(sure) == ids
    assert answer.verdict == ("found" if ids else "absent")
    assert answer.count == len(ids)


def test_motion_is_observed_or_unknown_never_guessed(town):
    answer = find(town, "parked trucks")
    assert [(hit.object.id, hit.undecided) for hit in answer.hits] == [(1, False), (3, True)]
    assert (answer.count, answer.counted.high) == (1, 2)
    assert [hit.object.id for hit in find(town, "trucks -parked").hits if not hit.undecided] == [2]
    blind = placed([("truck", (5, 0, 1), (4, 2, 2), "unknown", RED)])
    answer = find(blind, "parked trucks")
    assert answer.verdict == "unobserved"
    assert answer.count == 0
    assert "nothing was observed about motion" in answer.explain()
    assert find(blind, "parked buses").verdict == "absent"


def test_the_viewer_may_stand_elsewhere(town):
    assert [h.object.id for h in find(town, "person left of the red truck").hits] == []
    other = Viewpoint(np.array([60.0, 0.0, 0.0]), np.pi)
    assert [h.object.id for h in find(town, "person left of the red truck", viewpoint=other).hits] == [5]
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    assert find(town, "trucks in front of me").count == 3
    assert find(town, "trucks in front of me", viewpoint=turned).count == 0
    assert find(town, "trucks behind me", viewpoint=turned).count == 3
    assert "as seen from ego at frame 0" in find(town, "trucks behind me", viewpoint=5.0).explain()
    with pytest.raises(ConfigError, match="viewpoint is not usable"):
        find(town, "car", viewpoint=float("nan"))
    with pytest.raises(ConfigError, match="keeps no frames"):
        find(placed([("truck", (5, 0, 1), (4, 2, 2), "unknown", RED)]), "car", viewpoint=1.0)


def test_what_was_not_looked_at_is_not_absent(town):
    inside, outside = find(town, "buses within 5 m of (-30, -30)"), find(town, "buses within 5 m of (500, 500)")
    assert (inside.verdict, inside.region_seen) == ("absent", 1.0)
    assert (outside.verdict, outside.region_seen) == ("unobserved", 0.0)
    edge = find(town, "buses within 10 m of (53, 0)")
    assert edge.region_seen is not None
    assert 0 < edge.region_seen < 0.5
    assert edge.verdict == "unobserved"
    assert find(town, "curb").verdict == "absent"
    assert find(town, "curb").observed_area == pytest.approx(10_000, rel=0.02)
    assert find(town, "curb behind the flumox").verdict == "absent"
    assert find(town, "truck behind the flumox").verdict == "unknown words"
    assert "there is no 'curb'" in find(town, "truck near the curb").explain()


def test_the_algebra_and_its_text_agree(town):
    query = q.And((q.Noun("truck"), q.State("moving")))
    for ask in (query, "moving truck"):
        answer = find(town, ask)
        assert [hit.object.id for hit in answer.hits if not hit.undecided] == [2]
        assert answer.query == query
    with pytest.raises(QueryError, match="no object #99"):
        find(town, "anything like #99")
    with pytest.raises(QueryError, match="viewpoint or place"):
        find(town, q.Me())


def test_voxels_are_scored_like_their_objects(town):
    heat = score_voxels(town, "red trucks on the road")
    assert set(np.flatnonzero(heat)) == set(town.objects[1].voxels)
    assert set(np.flatnonzero(score_voxels(town, "moving trucks") > 0.6)) == set(town.objects[2].voxels)
    assert not score_voxels(town, "flumox").any()


def test_an_answer_gives_its_evidence(town):
    hit = find(town, "red truck next to the bus").hits[0]
    assert [clause.clause for clause in hit.clauses] == ["'truck'", "of colour red", "next to 'bus'"]
    assert all(clause.low >= 0.5 for clause in hit.clauses)
    assert hit.times == (0.0, 0.0)
    assert hit.probability is None
    assert "next to 'bus': 0." in find(town, "red truck next to the bus").explain()
