import json
from dataclasses import replace

import jaxtyping
import numpy as np
import pytest

from openvocab_occ.errors import ConfigError, EncoderMismatchError, ModelError, QueryError
from openvocab_occ.mapping import Lifted, VoxelMap
from openvocab_occ.objects import (
    EncoderInfo,
    ObjectTree,
    SceneMap,
    group_objects,
)  # fmt: skip
from openvocab_occ.query import algebra as q
from openvocab_occ.query import score_voxels
from openvocab_occ.query.find import find
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


def test_a_colour_is_what_was_measured_and_what_the_model_tells():
    """Of two things in the same light the model says which is white; without a scale it says nothing."""
    plain = scene_of([[1.0, 0.0], [0.0, 1.0]], contract="dense")
    light = np.array([[1.0, 178, 179, 180]], np.float32)  # nearly white
    lit = [replace(node, colors=light) for node in plain.objects]
    scene = replace(plain, objects=ObjectTree([plain.objects.root, *lit]))
    encoder = Encoder(Text())
    encoder.text.encode = lambda texts: np.array(
        [[float(t != "white"), float(t == "white")] for t in texts], np.float32
    )
    encoder.text.unknown_words = lambda text: tuple(w for w in text.split() if w not in ("white", "grey", "black"))
    assert find(scene, "white", encoder).verdict == "absent"
    encoder.scoring = Scoring(kind="sigmoid", threshold=0.5, scale=8.0)
    assert {hit.object.id for hit in find(scene, "white", encoder).hits} == {scene.objects.level("object")[1].id}
    assert {hit.object.id for hit in find(scene, "bright", encoder).hits} == {node.id for node in lit}
    encoder.text = None
    assert find(scene, "white", encoder).verdict == "absent"


def test_the_class_that_occupancy_names_is_a_second_opinion():
    """It raises what it speaks for by how near its name is, and leaves unknown names out."""
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


@pytest.mark.parametrize(
    ("angle", "against"),
    [
        (0, {"truck": (1 - 0.6) / 0.4 * (1 - 0.8), "tree": (1 - 0.6) / 0.4 * (1 - 0.6)}),  # "car" itself
        (-0.3, {"truck": (np.cos(0.3) - 0.6) / 0.4 * (np.cos(0.3) - max(np.cos(0.3 + np.arccos(0.8)), 0.6))}),
        (-1.2, {}),  # nothing like any class
    ],
)
def test_a_thing_of_another_class_is_less_likely_the_one_that_a_text_surely_names(angle, against):
    plain = scene_of([[0.6, 0.8]] * 4, contract="dense")
    vectors = {"car": [1, 0], "truck": [0.8, 0.6], "tree": [0, 1], "asked": [np.cos(angle), np.sin(angle)]}
    labels = ("car", "truck", "tree", "")
    named = [replace(node, label=name, score=0.5) for node, name in zip(plain.objects, labels, strict=True)]
    scene = replace(plain, objects=ObjectTree([plain.objects.root, *named]), class_names=("car", "truck", "tree"))
    encoder = Encoder(Text())
    encoder.text.encode = lambda texts: np.array([vectors[t] for t in texts], np.float32)
    encoder.scoring = Scoring(kind="probability", threshold=0.0, scale=4.0, bias=-1.0, others=30.0, neutral=0.6)
    score = {hit.object.label: hit.score for hit in find(scene, "asked", encoder).hits}
    look = 4 * np.dot([0.6, 0.8], vectors["asked"]) - 1
    for label in ("car", "", *against):
        logit = look - 30 * 0.5 * against.get(label, 0)
        assert score[label] == pytest.approx(1 / (1 + np.exp(-logit)), rel=1e-5)
    assert score["car"] == score[""], "neither the class itself nor a thing without one is less likely"
    if not against:
        assert len(set(score.values())) == 1


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


def test_options_and_kinds_that_make_no_sense_are_told(street, monkeypatch):
    with pytest.raises(ConfigError, match="limit is not usable"):
        find(street, "car", limit=0)
    with pytest.raises(ConfigError, match="threshold is not usable"):
        find(street, "car", threshold=float("nan"))
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(QueryError, match="query is not text: expected str, got int"):
        find(street, 7)


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
