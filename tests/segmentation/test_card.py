"""Cards are strict: every slip is named, with the file and what was expected."""

import json

import pytest
import yaml

from openvocab_occ.errors import CardError, NotFoundError
from openvocab_occ.segmentation.card import Card
from openvocab_occ.segmentation.card_files import SHIPPED, read_card

TEXT = {"onnx": "t.onnx", "tokenizer": "t.json", "context_length": 8, "pad_id": 0}


def test_yaml_and_json_read_alike(tiny, tmp_path):
    content = tiny.card(input__mean=[1, 2, 3], score={"scale": 14})
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(content))
    (tmp_path / "b.yaml").write_text(json.dumps(content))
    card = read_card(tmp_path / "a.yaml")
    assert card == read_card(tmp_path / "b.yaml")
    assert isinstance(card, Card)
    assert card.input.mean == (1.0, 2.0, 3.0)
    assert card.score.scale == 14.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"nome": "x"}, "has the unknown key 'nome': expected one of schema, name, labels"),
        ({"input__colour": "RGB"}, "has the unknown key 'input.colour': expected one of layout, color, range"),
        ({"contract": "dense", "text": {**TEXT, "inputs": {"id": "x"}}}, "unknown key 'text.inputs.id'"),
        ({"name": None}, "lacks the key 'name': expected str"),
        ({"input": None}, "lacks the key 'input': expected a section with layout"),
        ({"input__layout": None}, "lacks the key 'input.layout': expected NCHW or NHWC"),
        ({"schema": 2}, "wrong value at 'schema': expected 1, got 2"),
        ({"input__color": "rgb"}, "wrong value at 'input.color': expected RGB or BGR, got 'rgb'"),
        ({"input__resize": "crop"}, "wrong value at 'input.resize': expected squash or letterbox or pad, got 'crop'"),
        ({"input__resize": "letterbox"}, "letterbox needs `size`; with `multiple_of` write pad"),
        ({"input__tile": {"size": [8, 8], "overlap": 5}}, "at most half a tile"),
        ({"input__tile": {"size": [8, 9]}, "input__multiple_of": 2}, "its size is a multiple of that"),
        ({"output__prefix_tokens": -1}, "wrong value at 'output.prefix_tokens'"),
        ({"score": {"kind": "sigmoid"}}, "sigmoid needs `score.scale` above 0"),
        ({"score": {"kind": "relevancy", "scale": 10}}, "`score.negatives` are for kind relevancy, which needs some"),
        ({"prompts": {"templates": ["a photo"]}}, "holds {} once"),
        ({"input__range": "CONFIRM: [0, 1] or [0, 255]?"}, "is a draft: input.range must be confirmed"),
        ({"contract": "tokens", "output": {"layout": "NTC", "kind": "features"}, "labels": None}, "`output.patch`"),
        ({"crops": {"windows": [2.0]}}, "at most 1"),
        ({"contract": "prompted"}, "expected dense or tokens or masks or crops or logits, got 'prompted'"),
        ({"input__range": [0, "one"]}, r"wrong value at 'input.range\[1\]': expected float, got str"),
        ({"input__mean": [1, 2]}, "wrong value at 'input.mean': .*length 3, got 2"),
        ({"labels": "road"}, "wrong value at 'labels': expected array, got str"),
        ({"input__size": [2, 2]}, "either `size` or `multiple_of`"),
        ({"input__multiple_of": 0}, "at least 1"),
        ({"input__std": [1, 0, 1]}, "`input.std` above 0"),
        ({"input__mean": [float("nan"), 0, 0]}, "all of them finite"),
        ({"input__range": [1, 0]}, "low < high"),
        (
            {"output__kind": "features"},
            "logits or probabilities or classes for contract logits",
        ),
        ({"output__layout": "NHW"}, "NHW is for kind `classes`"),
        ({"labels": ["a", "a"]}, "at least two, each once"),
        ({"contract": "dense", "output__kind": "features", "labels": None}, "contract dense needs `text`"),
        ({"text": {**TEXT, "onnx": "../t.onnx"}}, r"lie beside the card, got '\.\./t\.onnx'"),
        ({"text": {**TEXT, "tokenizer": "/etc/passwd"}}, "lie beside the card"),
    ],
)
def test_slips_are_named(tiny, tmp_path, changes, message):
    path = tiny.write_card(tmp_path / "m.onnx", **changes)
    with pytest.raises(CardError, match=rf"card .*m\.card\.yaml .*{message}"):
        read_card(path)


@pytest.mark.parametrize(
    "content", [b"a: [", b"- a", b"", b"\xff\xfe\xfa", b"!!python/object/apply:os.system ['true']"]
)
def test_no_yaml_mapping(tmp_path, content):
    (tmp_path / "x.card.yaml").write_bytes(content)
    with pytest.raises(CardError, match=r"x\.card\.yaml is not (YAML|usable)"):
        read_card(tmp_path / "x.card.yaml")
    with pytest.raises(NotFoundError, match="model card not found"):
        read_card(tmp_path / "y.card.yaml")


def test_behaviour_ignores_names_only(tiny, tmp_path):
    def behaviour(**changes):
        return read_card(tiny.write_card(tmp_path / "m.onnx", **changes)).behaviour()

    assert behaviour() == behaviour(name="other", license="MIT", source="here", score={"scale": 2})
    assert len({behaviour(), behaviour(input__color="BGR"), behaviour(labels=["red", "green", "sky"])}) == 3


def test_shipped_cards_are_right():
    cards = [read_card(path) for path in SHIPPED.glob("*.card.yaml")]
    assert {card.name for card in cards} == {"road-segmentation-adas-0001", "deeplab_v3_voc"}
    assert all(card.sha256 and card.license == "Apache-2.0" for card in cards)
