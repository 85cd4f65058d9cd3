"""Tiny ONNX models and cards, made on the spot, as one fixture."""

import copy
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import pytest
import yaml
from onnx import TensorProto, helper, numpy_helper

CARD = {
    "schema": 1,
    "name": "tiny",
    "contract": "logits",
    "input": {"layout": "NCHW", "color": "RGB", "range": [0, 255], "multiple_of": 1},
    "output": {"layout": "NCHW", "kind": "logits"},
    "labels": ["red", "green", "blue"],
}


def card(**changes):
    """The card above with changes such as input__size=[2, 3]; None removes a key."""
    result = copy.deepcopy(CARD)
    for path, value in changes.items():
        inner = result
        *way, last = path.split("__")
        for key in way:
            inner = inner[key]
        if value is None:
            inner.pop(last)
        else:
            inner[last] = value
    return result


def write_card(model: Path, **changes) -> Path:
    path = model.with_suffix(".card.yaml")
    path.write_text(yaml.safe_dump(card(**changes)))
    return path


def save(path: Path, nodes, inputs, outputs, constants=None, *, domain="", opset=17, functions=()) -> Path:
    """Save a graph; inputs and outputs as name -> (type, shape)."""
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info(name, *facts) for name, facts in inputs.items()],
        [helper.make_tensor_value_info(name, *facts) for name, facts in outputs.items()],
        [numpy_helper.from_array(array, name) for name, array in (constants or {}).items()],
    )
    opsets = [helper.make_opsetid("", opset)] + ([helper.make_opsetid(domain, 1)] if domain else [])
    onnx.save(helper.make_model(graph, opset_imports=opsets, ir_version=8), str(path))
    return path


def identity(path: Path, shape=("n", 3, "h", "w"), dtype=TensorProto.FLOAT) -> Path:
    """A model whose output is its input."""
    return save(
        path,
        [helper.make_node("Identity", ["image"], ["out"])],
        {"image": (dtype, list(shape))},
        {"out": (dtype, list(shape))},
    )


def pooled(path: Path, stride: int) -> Path:
    """Mean colours of blocks."""
    size = [stride, stride]
    return save(
        path,
        [helper.make_node("AveragePool", ["image"], ["out"], kernel_shape=size, strides=size)],
        {"image": (TensorProto.FLOAT, ["n", 3, "h", "w"])},
        {"out": (TensorProto.FLOAT, ["n", 3, "a", "b"])},
    )


def text_model(path: Path, table: np.ndarray, *, length: int | str = "t") -> Path:
    """Sum of a vector a token, where the mask is set."""
    nodes = [
        helper.make_node("Gather", ["table", "input_ids"], ["vectors"]),
        helper.make_node("Cast", ["attention_mask"], ["weights"], to=TensorProto.FLOAT),
        helper.make_node("Unsqueeze", ["weights", "last"], ["column"]),
        helper.make_node("Mul", ["vectors", "column"], ["kept"]),
        helper.make_node("ReduceSum", ["kept", "tokens"], ["embedding"], keepdims=0),
    ]
    ids = (TensorProto.INT64, ["n", length])
    constants = {"table": table.astype(np.float32), "last": np.array([-1]), "tokens": np.array([1])}
    return save(
        path,
        nodes,
        {"input_ids": ids, "attention_mask": ids},
        {"embedding": (TensorProto.FLOAT, ["n", table.shape[1]])},
        constants,
    )


def tokenizer(path: Path, words) -> Path:
    """A tokenizer.json of whole words, with padding of its own that the card must override."""
    vocabulary = {word: number for number, word in enumerate(["[UNK]", *words])}
    content = {
        "version": "1.0",
        "truncation": {"direction": "Right", "max_length": 1, "strategy": "LongestFirst", "stride": 0},
        "padding": {
            "strategy": {"Fixed": 128}, "direction": "Right", "pad_to_multiple_of": None, "pad_id": 1,
            "pad_type_id": 0, "pad_token": "[UNK]",
        },
        "added_tokens": [],
        "normalizer": None,
        "pre_tokenizer": {"type": "Whitespace"},
        "post_processor": None,
        "decoder": None,
        "model": {"type": "WordLevel", "vocab": vocabulary, "unk_token": "[UNK]"},
    }  # fmt: skip
    path.write_text(json.dumps(content))
    return path


@pytest.fixture(scope="session")
def tiny() -> SimpleNamespace:
    return SimpleNamespace(
        card=card, write_card=write_card, save=save, identity=identity, pooled=pooled, text_model=text_model,
        tokenizer=tokenizer,
    )  # fmt: skip
