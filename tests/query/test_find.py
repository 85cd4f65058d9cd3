import json

import jaxtyping
import numpy as np
import pytest

from openvocab_occ.errors import ConfigError, EncoderMismatchError, ModelError, QueryError
from openvocab_occ.mapping import Lifted, VoxelMap
from openvocab_occ.objects import EncoderInfo, SceneMap, group_objects
from openvocab_occ.query import score_voxels
from openvocab_occ.query.find import find
from openvocab_occ.query.scoring import DENSE_THRESHOLD
from openvocab_occ.query.words import match_labels

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


@pytest.mark.parametrize(
    ("text", "labels", "unknown"),
    [
        ("truck", {"truck"}, ()),
        ("TRUCKS", {"truck"}, ()),
        ("buses", {"bus"}, ()),
        ("bus", {"bus"}, ()),
        ("people", {"person"}, ()),
        ("traffic cones", {"traffic cone"}, ()),
        ("  Traffic-Cone ", {"traffic cone"}, ()),
        ("trafficcone", {"traffic cone"}, ()),
        ("traffic", set(), ("traffic",)),
        ("parked trucks", {"truck"}, ("parked",)),
        ("where are the trucks?", {"truck"}, ()),
        ("road or curb", {"road", "curb"}, ()),
        ("not a truck", {"truck"}, ("not",)),
        ("the", set(), ("the",)),
        ("?!", set(), ("?!",)),
        ("unicorns", set(), ("unicorns",)),
    ],
)
def test_words_are_read_as_labels_or_reported(text, labels, unknown):
    match = match_labels(text, LABELS)
    assert {name for name, meant in zip(LABELS, match.channels, strict=True) if meant} == labels
    assert match.unknown == unknown


@pytest.mark.parametrize(
    ("label", "plural"),
    [("truck", "trucks"), ("bus", "buses"), ("person", "people"), ("dining table", "dining tables"),
     ("bench", "benches"),
     ("mouse", "mice"), ("sheep", "sheep"), ("leaf", "leaves"), ("glass", "glasses"), ("tv/monitor", "tv/monitors"),
     ("lorry", "lorries"), ("traffic cone", "traffic cones"), ("building", "buildings"), ("people", "people")],
)  # fmt: skip
def test_every_label_and_its_plural_name_it(label, plural):
    for text in (label, plural, label.upper(), f"the {plural}!"):
        assert match_labels(text, ["x", label, "y"]).channels.tolist() == [False, True, False], text


def test_the_longest_label_wins_also_inflected():
    assert match_labels("traffic cones", ["traffic", "traffic cone"]).channels.tolist() == [False, True]


def test_compound_labels_are_found_written_apart():
    assert match_labels("dining tables", ["diningtable"]).channels.all()


def test_hits_are_ranked_by_mean_probability(street):
    answer = find(street, "parked trucks")
    assert answer.verdict == "found"
    assert [hit.object.id for hit in answer.hits] == [3, 2]
    np.testing.assert_allclose([hit.score for hit in answer.hits], [0.9, 0.7], rtol=1e-5)
    for hit in answer.hits:
        mean = score_voxels(street, "trucks")[hit.object.voxels].mean()
        assert hit.score == pytest.approx(float(mean), rel=1e-5)
    assert answer.unknown == ("parked",)
    assert answer.score_kind == "class probability"
    assert [hit.object.id for hit in find(street, "truck", limit=1).hits] == [3]
    assert find(street, "road or curb").best == pytest.approx(0.9)
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
    answer = find(street, "parked trucks")
    text = answer.explain()
    for part in ("read as: truck", 'not understood: "parked"', "not calibrated", "1. truck #3  0.90", "state unknown"):
        assert part in text
    assert "this map knows: road, curb" in find(street, "unicorn").explain()
    report = json.loads(json.dumps(answer.to_dict(), allow_nan=False))
    assert [hit["id"] for hit in report["hits"]] == [3, 2]
    assert report["unknown"] == ["parked"]
    assert report["verdict"] == "found"


def test_dense_maps_rank_by_cosine():
    scene = scene_of([[1.0, 0.0], [0.6, 0.8], [0.0, 1.0]], contract="dense")
    answer = find(scene, "tree", Encoder(Text()), threshold=0.5)
    assert [hit.object.id for hit in answer.hits] == [3, 2]
    np.testing.assert_allclose([hit.score for hit in answer.hits], [1.0, 0.8], rtol=1e-6)
    assert answer.score_kind == "cosine"
    assert find(scene, "tree", Encoder(Text())).threshold == DENSE_THRESHOLD
    np.testing.assert_allclose(score_voxels(scene, "tree", Encoder(Text())), scene.voxels.features[:, 1])


def test_an_encoder_that_is_missing_mute_other_or_broken_is_told(street):
    scene = scene_of([[1.0, 0.0]], contract="dense")
    with pytest.raises(
        ConfigError, match=r"needs its text encoder.*got no encoder; pass it: find\(scene, text, encoder"
    ):
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
