import json
from dataclasses import replace

import jaxtyping
import numpy as np
import pytest

from openvocab_occ.errors import ConfigError, EncoderMismatchError, ModelError, QueryError
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
from openvocab_occ.query.scoring import DENSE_THRESHOLD
from openvocab_occ.segmentation.scoring import Scoring

LABELS = ("road", "curb", "truck", "traffic cone", "bus", "person")


def scene_of(features, *, contract="logits", labels=LABELS):
    """One object of 2 x 2 x 2 voxels for each feature, the first the largest."""
    voxels = VoxelMap(0.5, len(features[0]), contract=contract)
    for i, feature in enumerate(features):
        keys = np.argwhere(np.ones((2, 2, 2 + len(features) - i))).astype(np.int32) + np.int32([10 * i, 0, 0])
        n = len(keys)
        lifted = Lifted(np.tile(np.float32(feature), (n, 1)), np.ones(n, np.float32), np.ones(n, np.int32))
        voxels.integrate(keys, lifted, time=0.0)
    names = tuple(labels) if contract == "logits" else ()
    info = EncoderInfo(name="toy", contract=contract, dim=voxels.dim, labels=names, fingerprint="f" * 64)
    return SceneMap(voxels, group_objects(voxels, labels=names), info)


@pytest.fixture
def street():
    return scene_of([
        [0.6, 0.3, 0.1, 0, 0, 0], [0, 0, 0.7, 0.1, 0.2, 0], [0, 0, 0.9, 0, 0.1, 0], [0, 0, 0.2, 0, 0.8, 0],
    ])  # fmt: skip


class Text:
    dim = 2

    def encode(self, texts):
        vectors = {"tree": [0.0, 2.0], "broken": [np.nan, 0.0]}
        return np.array([vectors.get(text, [1.0, 0.0]) for text in texts], np.float32)


class Encoder:
    name, contract, dim, labels, fingerprint = "toy", "dense", 2, (), "f" * 64

    def __init__(self, text=None, fingerprint="f" * 64):
        self.text, self.fingerprint = text, fingerprint

    def encode(self, images):
        raise NotImplementedError


def test_hits_are_ranked_by_mean_probability(street):
    answer = find(street, "trucks that glimmer")
    assert answer.verdict == "found"
    assert [hit.object.id for hit in answer.hits] == [3, 2]
    np.testing.assert_allclose([hit.score for hit in answer.hits], [0.9, 0.7], rtol=1e-5)
    for hit in answer.hits:
        mean = score_voxels(street, "trucks")[hit.object.voxels].mean()
        assert hit.score == pytest.approx(float(mean), rel=1e-5)
    assert answer.unknown == ("glimmer",)
    assert answer.score_kind == "class probability"
    assert [hit.object.id for hit in find(street, "truck", limit=1).hits] == [3]
    assert find(street, "road or curb").best == pytest.approx(0.6)
    assert len(find(street, "truck", threshold=0.0).hits) == 4


def test_understood_but_not_there_is_absent(street):
    answer = find(street, "person")
    assert (answer.verdict, answer.hits, answer.best) == ("absent", (), 0.0)
    assert answer.threshold == 0.5


def test_words_no_one_knows_are_never_absent(street):
    answer = find(street, "purple buss stations")
    assert answer.verdict == "unknown words"
    assert answer.nearest["buss"] == ("bus",)
    assert answer.best is None
    assert answer.known == LABELS
    assert not score_voxels(street, "purple").any()


def test_an_answer_explains_itself_and_is_json(street):
    answer = find(street, "trucks that glimmer")
    text = answer.explain()
    for part in (
        "read as: 'trucks",
        'not understood: "glimmer"',
        "not calibrated",
        "1. truck #3  0.90",
        "state unknown",
    ):
        assert part in text
    assert "this map knows: road, curb" in find(street, "unicorn").explain()
    report = json.loads(json.dumps(answer.to_dict(), allow_nan=False))
    assert [hit["id"] for hit in report["hits"]] == [3, 2]
    assert report["unknown"] == ["glimmer"]
    assert report["verdict"] == "found"


def test_dense_maps_rank_by_cosine():
    scene = scene_of([[1.0, 0.0], [0.6, 0.8], [0.0, 1.0]], contract="dense")
    answer = find(scene, "tree", Encoder(Text()), threshold=0.5)
    assert [hit.object.id for hit in answer.hits] == [3, 2]
    np.testing.assert_allclose([hit.score for hit in answer.hits], [1.0, 0.8], rtol=1e-6)
    assert answer.score_kind == "cosine"
    assert find(scene, "tree", Encoder(Text())).threshold == DENSE_THRESHOLD
    np.testing.assert_allclose(score_voxels(scene, "tree", Encoder(Text())), scene.voxels.features[:, 1])


def test_dense_maps_score_as_their_card_says():
    scene = scene_of([[1.0, 0.0], [0.6, 0.8], [0.0, 1.0]], contract="dense")
    encoder = Encoder(Text())
    encoder.scoring = Scoring(kind="sigmoid", threshold=0.6, scale=10.0, bias=-6.0)
    answer = find(scene, "tree", encoder)
    assert (answer.score_kind, answer.threshold, answer.verdict) == ("sigmoid", 0.6, "found")
    np.testing.assert_allclose([hit.score for hit in answer.hits], 1 / (1 + np.exp([-4.0, -2.0])), rtol=1e-5)
    assert "sigmoid, not calibrated" in answer.explain()
    np.testing.assert_allclose(score_voxels(scene, "tree", encoder)[scene.voxels.features[:, 1] == 1], 0.982, atol=1e-3)


def test_the_class_that_occupancy_names_is_a_second_opinion():
    """It raises what it speaks for by how near its name is, lowers nothing, and leaves unknown names out."""
    plain = scene_of([[1.0, 0.0], [0.8, 0.6], [0.6, 0.8]], contract="dense")
    names = ("car", "tree", "xyzzy")
    named = [replace(node, label=name, score=0.5) for node, name in zip(plain.objects, names, strict=True)]
    scene = replace(plain, objects=ObjectTree([plain.objects.root, *named]), class_names=names)
    encoder = Encoder(Text())
    encoder.text.unknown_words = lambda text: tuple(w for w in text.split() if w == "xyzzy")
    encoder.scoring = Scoring(kind="probability", threshold=0.01, scale=4.0, bias=-3.0, classes=5.0, neutral=0.6)
    answer = find(scene, "tree", encoder)
    score = {hit.object.label: hit.score for hit in answer.hits}
    logits = {"car": -3.0, "tree": 4 * 0.6 - 3 + 5 * (1 - 0.6) * 0.5, "xyzzy": 4 * 0.8 - 3}
    for label, logit in logits.items():
        assert score[label] == pytest.approx(1 / (1 + np.exp(-logit)), rel=1e-5)
    assert [hit.probability for hit in answer.hits] == [hit.score for hit in answer.hits]


def test_things_that_are_likelier_there_than_not_are_counted():
    scene = scene_of([[0.6, 0.8], [0.8, 0.6], [0.9, 0.436]], contract="dense")
    encoder = Encoder(Text())
    encoder.scoring = Scoring(kind="probability", threshold=0.2, scale=10.0, bias=-5.5)
    answer = find(scene, "how many trees", encoder)
    assert len(answer.hits) == 3
    assert (answer.counted.value, answer.counted.high) == (2, 3)
    assert answer.counted.expected == pytest.approx(sum(hit.probability for hit in answer.hits), rel=1e-6)
    encoder.scoring = Scoring(kind="probability", threshold=0.2, scale=10.0, bias=-9.0)
    assert find(scene, "tree", encoder).counted.value == 1, "what is found is at least one"


def test_words_that_the_text_model_does_not_know_are_told():
    scene = scene_of([[1.0, 0.0], [0.0, 1.0]], contract="dense")
    encoder = Encoder(Text())
    encoder.text.unknown_words = lambda text: tuple(w for w in text.split() if w == "xyzzy")
    answer = find(scene, "the xyzzy", encoder)
    assert (answer.verdict, answer.unknown, answer.hits, answer.best) == ("unknown words", ("xyzzy",), (), None)
    assert not score_voxels(scene, "xyzzy", encoder).any()
    partly = find(scene, "xyzzy tree", encoder)
    assert (partly.verdict, partly.unknown) == ("found", ("xyzzy",))


def test_an_encoder_that_is_missing_mute_other_or_broken_is_told(street):
    scene = scene_of([[1.0, 0.0]], contract="dense")
    with pytest.raises(ConfigError, match=r"needs its text encoder.*got no encoder; pass the model that made it"):
        find(scene, "tree")
    with pytest.raises(ConfigError, match="an encoder without a text side"):
        find(scene, "tree", Encoder())
    with pytest.raises(ModelError, match="gave no usable vector"):
        find(scene, "broken", Encoder(Text()))
    for each in (scene, street):
        with pytest.raises(EncoderMismatchError, match="is not the one that made this map"):
            find(each, "tree", Encoder(Text(), fingerprint="0" * 64))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "query is empty"),
        (" \n ", "query is empty"),
        ("a" * 1001, "query is too long: expected at most 1000 characters, got 1001"),
        ("car\x00", r"control characters: expected one line of text, got U\+0000"),
        ("a\nb", r"got U\+000A"),
    ],
)
def test_text_that_is_no_query_is_told(street, text, message):
    for ask in (find, score_voxels):
        with pytest.raises(QueryError, match=message):
            ask(street, text)


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


def test_options_and_kinds_that_make_no_sense_are_told(street, monkeypatch):
    with pytest.raises(ConfigError, match="limit is not usable"):
        find(street, "car", limit=0)
    with pytest.raises(ConfigError, match="threshold is not usable"):
        find(street, "car", threshold=float("nan"))
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(QueryError, match="query is not text: expected str, got int"):
        find(street, 7)


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


def test_examples_vectors_pictures_and_clicks():
    scene = scene_of([[1.0, 0.0], [0.95, 0.31], [0.0, 1.0]], contract="dense")
    for query in (q.Vector((2.0, 0.0)), q.Click((-5.0, 0.25, 0.25), (1.0, 0.0, 0.0))):
        assert [hit.object.id for hit in find(scene, query, Encoder(Text()), threshold=0.9).hits] == [1, 2]
    big = max(scene.objects, key=lambda item: float(item.embedding[0]))
    assert big.id not in [hit.object.id for hit in find(scene, q.Like(big.id)).hits]
    with pytest.raises(QueryError, match="vector does not fit"):
        find(scene, q.Vector((1.0,)), Encoder(Text()))
    with pytest.raises(QueryError, match="click hits no object"):
        find(scene, q.Click((0.0, 0.0, 90.0), (0.0, 0.0, 1.0)))
    for image in (b"12345678", b"\x89PNG\r\n\x1a\n" + b"\0" * 16, b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + b"\xff" * 8):
        with pytest.raises(QueryError, match="picture"):
            find(scene, q.Crop(image), Encoder(Text()))


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
