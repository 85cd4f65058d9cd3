"""A dense model and its text side, end to end through onnxruntime and tokenizers."""

import numpy as np
import pytest
from onnx import TensorProto, helper

from openvocab_occ.errors import ModelError, NotFoundError, QueryError
from openvocab_occ.segmentation import TextEncoder
from openvocab_occ.segmentation.card import PromptCard, TextCard, TextInputs
from openvocab_occ.segmentation.onnx import load_encoder
from openvocab_occ.segmentation.text import OnnxTextEncoder

WORDS = ["red", "green", "blue", "dark"]
TABLE = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 0.5], [-1, -1, -1]])  # the first row is for unknown words
PURE = np.zeros((4, 6, 3), np.uint8)
PURE[:, :2, 0] = PURE[:, 2:4, 1] = PURE[:, 4:, 2] = 200


@pytest.fixture
def dense(tiny, tmp_path):
    """Colours as features, words for them as text."""

    def load(text=None, **changes):
        model = tiny.identity(tmp_path / "dense.onnx")
        tiny.text_model(tmp_path / "text.onnx", TABLE)
        tiny.tokenizer(tmp_path / "words.json", WORDS)
        section = {
            "onnx": "text.onnx", "tokenizer": "words.json", "context_length": 4, "pad_id": 4, "lowercase": True,
            "inputs": {"ids": "input_ids", "mask": "attention_mask"}, **(text or {}),
        }  # fmt: skip
        base = {"contract": "dense", "labels": None, "output__kind": "features", "text": section}
        tiny.write_card(model, **base, **changes)
        return load_encoder(model)

    return load


def test_words_find_their_colours(dense):
    encoder = dense()
    assert isinstance(encoder.text, TextEncoder)
    assert (encoder.contract, encoder.labels, encoder.dim, encoder.text.dim) == ("dense", (), 3, 3)
    cells = encoder.encode([PURE])[0].cells
    vectors = encoder.text.encode(["red", "GREEN", "blue blue"])
    assert vectors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-6)
    np.testing.assert_array_equal((cells @ vectors.T).argmax(axis=-1), np.tile([0, 0, 1, 1, 2, 2], (4, 1)))


def test_features_are_unit_or_zero(dense, rng):
    image = rng.integers(0, 256, (5, 5, 3)).astype(np.uint8)
    image[2, 2] = 0
    cells = dense().encode([image])[0].cells
    lengths = np.linalg.norm(cells, axis=-1)
    assert lengths[2, 2] == 0
    assert np.allclose(np.delete(lengths.ravel(), 12), 1, atol=1e-6)


def test_padding_and_truncation_come_from_the_card(dense):
    """The tokenizer.json pads to 128 and cuts to 1; the pad word is not summed, the fifth word is cut off."""
    text = dense().text
    np.testing.assert_allclose(text.encode(["red"]), [[1, 0, 0]])
    expected = np.array([2, 6, 0.5]) / np.linalg.norm([2, 6, 0.5])
    np.testing.assert_allclose(text.encode(["red green green blue red"])[0], expected, atol=1e-6)
    together = text.encode(["red", "green blue", "dark"])
    np.testing.assert_array_equal(together, np.concatenate([text.encode([t]) for t in ("red", "green blue", "dark")]))
    longest = dense({"padding": "longest"}).text
    np.testing.assert_array_equal(longest.encode(["red", "green blue", "dark"]), together)
    assert text.encode([]).shape == (0, 3)


def test_case_matters_where_the_card_says_so(dense):
    with pytest.raises(QueryError, match="knows no word of 'Red'"):
        dense({"lowercase": False}).text.encode(["green", "Red"])


def test_fingerprint_covers_the_text_side(dense, tmp_path):
    first = dense().fingerprint
    assert dense().fingerprint == first
    assert dense({"pad_id": 0}).fingerprint != first


def test_features_said_to_be_normalised_are_checked(dense, rng):
    image = rng.integers(1, 256, (5, 5, 3)).astype(np.uint8)
    with pytest.raises(ModelError, match=r"expected features of length 1.*write normalized: false"):
        dense(output__normalized=True).encode([image])


def test_bad_text_sides(dense, tiny, tmp_path):
    with pytest.raises(NotFoundError, match="ONNX model not found"):
        dense({"onnx": "gone.onnx"})
    with pytest.raises(NotFoundError, match="tokenizer not found"):
        dense({"tokenizer": "gone.json"})
    (tmp_path / "bad.json").write_text("{}")
    with pytest.raises(ModelError, match=r"tokenizer bad\.json cannot be read"):
        dense({"tokenizer": "bad.json"})
    with pytest.raises(ModelError, match=r"inputs that its card does not name.*attention_mask"):
        dense({"inputs": {"ids": "input_ids"}})
    with pytest.raises(ModelError, match="an output called pooled"):
        dense({"output": "pooled"})
    tiny.text_model(tmp_path / "wide.onnx", np.ones((5, 7)))
    with pytest.raises(
        ModelError, match="expected 7 channels in layout NCHW, as many as the text model's vectors have"
    ):
        dense({"onnx": "wide.onnx"})
    tiny.save(
        tmp_path / "tokens.onnx",
        [helper.make_node("Gather", ["table", "input_ids"], ["out"])],
        {"input_ids": (TensorProto.INT64, ["n", "t"])},
        {"out": (TensorProto.FLOAT, None)},
        {"table": TABLE.astype(np.float32)},
    )
    with pytest.raises(ModelError, match=r"one vector a text.*\(1, 4, 3\).*export it with its pooling"):
        dense({"onnx": "tokens.onnx", "inputs": {"ids": "input_ids"}})


@pytest.fixture
def tokens(tiny, tmp_path):
    """A text side that puts out one vector a token, with a pooling."""

    def load(**text):
        tiny.save(
            tmp_path / "tokens.onnx",
            [helper.make_node("Gather", ["table", "input_ids"], ["out"])],
            {"input_ids": (TensorProto.INT64, ["n", "t"])},
            {"out": (TensorProto.FLOAT, ["n", "t", "c"])},
            {"table": np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 0.5], [-1, -1, -1]], np.float32)},
        )
        tiny.tokenizer(tmp_path / "words.json", WORDS)
        card = TextCard(onnx="tokens.onnx", tokenizer="words.json", context_length=5, pad_id=4, **text)
        return OnnxTextEncoder(card, tmp_path)

    return load


@pytest.mark.parametrize("padding", ["max", "longest"])
@pytest.mark.parametrize(
    ("pooling", "wanted"),
    [("cls", [1, 0, 0]), ("last", [0, 0, 1]), ("mean", [2, 3, 0.5]), ("eos", [0, 1, 0])],
)
def test_pooling(tokens, pooling, wanted, padding):
    text = tokens(pooling=pooling, padding=padding, eos_id=2 if pooling == "eos" else None)
    sentence = "red green" if pooling == "eos" else "red green blue"
    np.testing.assert_allclose(text.encode([sentence, "red"])[0], wanted / np.linalg.norm(wanted), atol=1e-6)


def test_end_of_text_is_added_also_to_what_is_cut_off(tokens):
    text = tokens(pooling="eos", eos_id=2)
    np.testing.assert_allclose(text.encode(["red", "red red red red red red", "red green"]), [[0, 1, 0]] * 3)


def test_slice_takes_a_part_of_the_vector(tokens):
    text = tokens(pooling="mean", slice=(1, 3))
    assert text.dim == 2
    np.testing.assert_allclose(text.encode(["green"]), [[1, 0]])
    with pytest.raises(ModelError, match="expected channels 2..4, got 3 channels; check text.slice"):
        tokens(pooling="mean", slice=(2, 5))


def test_templates_are_averaged_after_normalising(tokens, tmp_path):
    card = tokens(pooling="mean").card
    text = OnnxTextEncoder(card, tmp_path, prompts=PromptCard(templates=("{}", "{} green", "blue {}")))
    single = OnnxTextEncoder(card, tmp_path)
    mean = single.encode(["red", "red green", "blue red"]).sum(axis=0)
    np.testing.assert_allclose(text.encode(["red"])[0], mean / np.linalg.norm(mean), atol=1e-6)


def test_punctuation_and_case(tokens):
    text = tokens(pooling="mean", lowercase=True, strip_punctuation=True)
    np.testing.assert_allclose(text.encode([" Red!,  GREEN. "]), text.encode(["red green"]), atol=1e-6)


def test_unknown_words_are_said(tokens):
    text = tokens(pooling="mean")
    assert text.unknown_words("red xyzzy green plugh") == ("xyzzy", "plugh")
    assert text.unknown_words("red") == ()


def test_a_list_of_words_is_a_tokenizer(tiny, tmp_path):
    """Words in a .txt, one a line, the first for what is unknown; pieces begin with ##."""
    (tmp_path / "words.txt").write_text("[UNK]\nred\ngreen\n##ish\n-\n")
    tiny.text_model(tmp_path / "text.onnx", np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 1], [0, 0, 0]]))
    inputs = TextInputs(mask="attention_mask")
    card = TextCard(onnx="text.onnx", tokenizer="words.txt", context_length=8, pad_id=0, lowercase=True, inputs=inputs)
    text = OnnxTextEncoder(card, tmp_path)
    np.testing.assert_allclose(text.encode(["Red", "GREEN"]), [[1, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(text.encode(["reddish-green"]), text.encode(["green"]))
    np.testing.assert_allclose(text.encode(["redish"])[0], np.array([2, 0, 1]) / np.sqrt(5), atol=1e-6)
    assert text.unknown_words("red lorry") == ("lorry",)
    (tmp_path / "words.txt").write_text("")
    with pytest.raises(ModelError, match="a .txt of words whose first is the unknown one"):
        OnnxTextEncoder(card, tmp_path)
