"""The shipped pair: what it may weigh, what it must know, and the honesty of how it was trained."""

import importlib.util
import sys

import numpy as np
import onnx
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ.evaluation.segmenter import EVALUATION_SEEDS, lexicon_of
from openvocab_occ.evaluation.words import CLASSES, NEVER_RENDERED, UNSEEN_ABSENT, UNSEEN_SYNONYMS
from openvocab_occ.segmentation.demo_models import demo_model
from openvocab_occ.segmentation.onnx import load_encoder

FOLDER = demo_model().parent


@pytest.fixture(scope="module")
def encoder():
    return load_encoder(demo_model())


@pytest.fixture(scope="module")
def lexicon():
    return yaml.safe_load((FOLDER / "lexicon.yaml").read_text())


@pytest.fixture(scope="module")
def script():
    """Import a training script by its file; they import each other by name."""
    sys.path.insert(0, str(FOLDER))
    yield lambda name: importlib.import_module(name)
    sys.path.remove(str(FOLDER))
    for name in ("phrases", "scenes"):
        sys.modules.pop(name, None)


def test_it_is_small():
    files = [FOLDER / name for name in ("segmenter.onnx", "text.onnx", "words.txt", "lexicon.yaml")]
    assert sum(file.stat().st_size for file in files) <= 5e6
    weights = onnx.load(str(FOLDER / "segmenter.onnx")).graph.initializer
    whole = sum(int(np.prod(w.dims)) for w in weights)
    assert sum(int(np.prod(w.dims)) for w in weights if w.data_type == onnx.TensorProto.INT8) > 0.98 * whole
    assert "Apache License 2.0" in (FOLDER / "NOTICE").read_text()


@pytest.mark.parametrize("name", ["segmenter.onnx", "text.onnx"])
def test_it_tells_nothing_of_the_machine_it_was_made_on(name):
    content = (FOLDER / name).read_bytes()
    for trace in (b"site-packages", b"stack_trace", b"/work", b"/home", b"/root", b"/tmp"):
        assert trace not in content


def test_cells_lie_every_four_pixels(encoder):
    found = encoder.encode([np.zeros((256, 704, 3), np.uint8), np.zeros((90, 160, 3), np.uint8)])
    assert [one.cells.shape for one in found] == [(64, 176, 64), (24, 40, 64)]
    assert found[0].scale == (0.25, 0.25)
    assert found[0].offset == (-0.375, -0.375)


def test_words_that_say_nothing_visible_change_nothing(encoder):
    """Parked or moving comes from observed motion; articles and politeness from nowhere."""
    plain = encoder.text.encode(["trucks"])
    for text in ("parked trucks", "the trucks", "Please find all trucks!", "moving TRUCKS"):
        np.testing.assert_allclose(encoder.text.encode([text]), plain, atol=1e-6)
    assert (encoder.text.encode(["red trucks"]) @ plain.T).item() < 0.99


def test_colours_and_things_add_up(encoder):
    """Colours have numbers of their own, so that a pair that was never seen together is as good as any."""
    blue, van, both = encoder.text.encode(["blue", "van", "blue van"])
    np.testing.assert_allclose(both, (blue + van) / 2**0.5, atol=0.01)
    assert abs(float(blue @ van)) < 1e-6
    cells = encoder.encode([np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)])[0].cells
    color = np.flatnonzero(blue)
    np.testing.assert_allclose((cells[..., color] ** 2).sum(axis=-1), 0.5, atol=1e-4)


def test_unknown_words_are_told(encoder):
    assert encoder.text.unknown_words("a frobnicated truck") == ("frobnicated",)
    assert encoder.text.unknown_words("parked lorries") == ()


def test_every_word_of_the_lexicon_is_in_the_table(encoder, lexicon):
    entries = [entry for part in ("things", "parts", "materials") for entry in lexicon[part].values()]
    for phrase in [w for entry in entries for w in entry["words"]] + lexicon["absent"] + lexicon["colors"]:
        assert encoder.text.unknown_words(phrase) == (), phrase


def test_what_is_judged_was_not_trained_on(lexicon, script):
    scenes = script("scenes")
    assert not set(EVALUATION_SEEDS) & {*scenes.TRAINING, *scenes.VALIDATION}
    taught = {w for part in ("things", "parts", "materials") for e in lexicon[part].values() for w in e["words"]}
    assert not taught & set(UNSEEN_SYNONYMS)
    assert not set(lexicon["absent"]) & set(UNSEEN_ABSENT)
    assert {tuple(pair) for pair in lexicon["never_rendered"]} == set(NEVER_RENDERED)
    assert set(UNSEEN_SYNONYMS.values()) <= set(CLASSES)
    phrases = script("phrases")
    states = [phrases.SKY, phrases.State("sedan", "green", "body", "paint")]
    texts = phrases.build(lexicon, states).texts
    for color, thing in NEVER_RENDERED:
        assert not [
            t for t in texts if t.split()[0] == color and set(t.split()) & set(lexicon["things"][thing]["words"])
        ]
    assert "red car" in texts
    assert "green truck" in texts


def test_pictures_hold_no_pair_that_is_kept_out(lexicon, script):
    from openvocab_occ.datasets.city import City

    scenes, phrases = script("scenes"), script("phrases")
    banned = {(k, color) for color, thing in NEVER_RENDERED for k in phrases.kinds_of(lexicon, thing)}

    def pairs(drive):
        return {(t.kind, t.color) for t in [*drive.still, *(m.thing for m in drive.movers)]}

    for seed in (1000, scenes.ENRICHED[0]):
        drive = City(seed).traversal(route=1, condition="heavy traffic")
        assert pairs(drive) & banned
        before = {kind for kind, _ in pairs(drive)}
        scenes.repaint(drive, lexicon, seed)
        assert not pairs(drive) & banned
        assert (len({kind for kind, _ in pairs(drive)} - before) > 0) == (seed in scenes.ENRICHED)


@settings(max_examples=50)
@given(st.lists(st.tuples(st.sampled_from([-1, 0, 1]), st.sampled_from([-1, 0, 1])), min_size=1, max_size=9))
def test_and_in_three_values(pairs):
    """Unsure is a truth between the others: "and" takes the least."""
    spec = importlib.util.spec_from_file_location("phrases_alone", FOLDER / "phrases.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    a, b = (np.array(x, np.int8) for x in zip(*pairs, strict=True))
    rank = {0: 0, -1: 1, 1: 2}
    least = [min(p, q, key=rank.get) for p, q in pairs]
    np.testing.assert_array_equal(module.both(a, b), least)


def test_lexicon_words_name_classes():
    words = lexicon_of(demo_model())
    assert words["lorry"] == "truck"
    assert set(words.values()) == set(CLASSES)
