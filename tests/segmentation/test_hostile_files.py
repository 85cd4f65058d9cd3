"""Files made to do harm: each is refused, or stopped, with a message that says what it wanted. All are built here."""

import time

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from openvocab_occ.errors import CardError, ModelError, UnsafeFileError
from openvocab_occ.segmentation.card_files import METADATA_KEY, embed_card, read_card
from openvocab_occ.segmentation.onnx import load_encoder
from openvocab_occ.segmentation.sandbox import SandboxedEncoder
from openvocab_occ.segmentation.session import Limits, Session, inspect_model

FLOAT = TensorProto.FLOAT
IMAGE = {"image": (FLOAT, ["n", 3, "h", "w"])}
OUT = {"out": (FLOAT, ["n", 3, "h", "w"])}


def constant(name, values, kind=np.int64):
    return helper.make_node("Constant", [], [name], value=numpy_helper.from_array(np.array(values, kind), name))


def endless(tiny, path):
    """A loop of 2^62 turns around the image."""
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["on"]), helper.make_node("Identity", ["x"], ["y"])],
        "body",
        [
            helper.make_tensor_value_info("i", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            helper.make_tensor_value_info("x", FLOAT, None),
        ],
        [helper.make_tensor_value_info("on", TensorProto.BOOL, []), helper.make_tensor_value_info("y", FLOAT, None)],
    )
    loop = helper.make_node("Loop", ["turns", "yes", "image"], ["out"], body=body)
    return tiny.save(path, [loop], IMAGE, OUT, {"turns": np.array(2**62), "yes": np.array(True)})


@pytest.mark.parametrize(
    ("nodes", "constants", "what"),
    [
        ([helper.make_node("ConstantOfShape", ["n"], ["out"])], {"n": [10**10]}, "made by ConstantOfShape"),
        ([helper.make_node("ConstantOfShape", ["n"], ["out"])], {"n": [10**6] * 4}, "made by ConstantOfShape"),
        ([helper.make_node("Expand", ["image", "n"], ["out"])], {"n": [1, 3, 10**5, 10**5]}, "made by Expand"),
        ([helper.make_node("Tile", ["image", "n"], ["out"])], {"n": [1, 1, 10**6, 10**6]}, "made by Tile"),
        ([constant("n", [10**12]), helper.make_node("ConstantOfShape", ["n"], ["out"])], {}, "made by ConstantOfShape"),
        (
            [helper.make_node("Range", ["a", "b", "c"], ["r"]), helper.make_node("Cast", ["r"], ["out"], to=FLOAT)],
            {"a": 0, "b": 10**13, "c": 1},
            "made by Range",
        ),
    ],
)
def test_memory_bombs_are_refused_before_a_session(tiny, tmp_path, nodes, constants, what):
    path = tiny.save(
        tmp_path / "bomb.onnx", nodes, IMAGE, {"out": (FLOAT, None)}, {k: np.array(v) for k, v in constants.items()}
    )
    with pytest.raises(UnsafeFileError, match=rf"asks for a tensor beyond all measure, {what}: expected at most"):
        inspect_model(path)


def test_bombs_inside_branches_are_seen(tiny, tmp_path):
    inner = helper.make_graph(
        [constant("n", [10**12]), helper.make_node("ConstantOfShape", ["n"], ["big"])],
        "b", [], [helper.make_tensor_value_info("big", FLOAT, None)],
    )  # fmt: skip
    flag = helper.make_node("Constant", [], ["f"], value=helper.make_tensor("f", TensorProto.BOOL, [], [True]))
    path = tiny.save(
        tmp_path / "if.onnx",
        [flag, helper.make_node("If", ["f"], ["out"], then_branch=inner, else_branch=inner)],
        IMAGE,
        {"out": (FLOAT, None)},
    )
    with pytest.raises(UnsafeFileError, match="beyond all measure"):
        inspect_model(path)


def test_declared_sizes_are_capped(tiny, tmp_path):
    path = tiny.identity(tmp_path / "m.onnx", (1, 3, 10**5, 10**5))
    with pytest.raises(
        UnsafeFileError, match=r"value 'image': expected at most 1,073,741,824 elements, got 30,000,000,000"
    ):
        inspect_model(path)
    tensor = numpy_helper.from_array(np.zeros(2, np.float32), "w")
    tensor.dims[0] = -5
    model = onnx.load(str(tiny.identity(tmp_path / "n.onnx")))
    model.graph.initializer.append(tensor)
    (tmp_path / "n.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(UnsafeFileError, match=r"weight 'w'.*got a negative size"):
        inspect_model(tmp_path / "n.onnx")


def test_files_and_metadata_are_capped(tiny, tmp_path):
    path = tiny.identity(tmp_path / "m.onnx")
    with pytest.raises(UnsafeFileError, match=r"model m\.onnx is too large: expected below 50 bytes"):
        inspect_model(path, Limits(file_bytes=50))
    model = onnx.load(str(path))
    model.metadata_props.add(key="notes", value="x" * 2_000_000)
    path.write_bytes(model.SerializeToString())
    with pytest.raises(UnsafeFileError, match="carries too much metadata: expected at most 1,000,000 characters"):
        inspect_model(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("__import__('os').system('true')", "card inside m.onnx is not usable|is not YAML"),
        ("!!python/object/apply:os.system ['true']", "card inside m.onnx is not YAML"),
        ("[" * 3000, "card inside m.onnx is not (YAML|usable)"),
        ('{"schema": 1, "name": 3}', "card inside m.onnx"),
        ("", "card inside m.onnx is not usable"),
    ],
)
def test_metadata_is_read_as_plain_data(tiny, tmp_path, content, message):
    path = tiny.identity(tmp_path / "m.onnx")
    model = onnx.load(str(path))
    model.metadata_props.add(key=METADATA_KEY, value=content)
    path.write_bytes(model.SerializeToString())
    with pytest.raises(CardError, match=message):
        load_encoder(path)


def test_a_card_travels_in_its_model_and_one_beside_it_goes_before(tiny, tmp_path):
    path = tiny.identity(tmp_path / "m.onnx")
    card = read_card(tiny.write_card(path, labels=["x", "y", "z"]))
    embed_card(card, path)
    embed_card(card, path)
    assert [entry.key for entry in onnx.load(str(path)).metadata_props] == [METADATA_KEY]
    path.with_suffix(".card.yaml").unlink()
    assert load_encoder(path).labels == ("x", "y", "z")
    beside = tiny.write_card(path, labels=["a", "b", "c"])
    assert load_encoder(path).labels == ("a", "b", "c")
    named = tiny.write_card(tmp_path / "other.onnx", labels=["p", "q", "r"])
    assert load_encoder(path, named).labels == ("p", "q", "r")
    assert beside.is_file()


def test_runs_without_end_are_stopped(tiny, tmp_path):
    session = Session(endless(tiny, tmp_path / "loop.onnx"), limits=Limits(seconds=0.5))
    started = time.monotonic()
    with pytest.raises(ModelError, match=r"loop\.onnx was stopped: expected a run within 0\.5 s, got no end"):
        session.run("out", {"image": np.zeros((1, 3, 4, 4), np.float32)})
    assert time.monotonic() - started < 30


def test_outputs_beyond_the_limit_are_refused(tiny, tmp_path):
    session = Session(tiny.identity(tmp_path / "m.onnx"), limits=Limits(elements=100))
    assert session.run("out", {"image": np.ones((1, 3, 4, 4), np.float32)}).size == 48
    with pytest.raises(ModelError, match=r"output out of m\.onnx is too large: expected at most 100 numbers, got 300"):
        session.run("out", {"image": np.ones((1, 3, 10, 10), np.float32)})


def test_a_tensor_sent_as_a_sequence_is_refused(tiny, tmp_path):
    path = tiny.save(
        tmp_path / "s.onnx",
        [helper.make_node("SequenceConstruct", ["image"], ["out"])],
        IMAGE,
        {"out": (FLOAT, None)},
    )
    model = onnx.load(str(path))
    model.graph.output[0].CopyFrom(helper.make_tensor_sequence_value_info("out", FLOAT, None))
    path.write_bytes(model.SerializeToString())
    with pytest.raises(ModelError, match="is no tensor of numbers"):
        Session(path).run("out", {"image": np.ones((1, 3, 2, 2), np.float32)})


@pytest.mark.slow
def test_the_sandbox_gives_the_same_and_dies_alone(tiny, tmp_path):
    """Grown by Resize from what the image says, so that no inspection can see it; only memory stops it."""
    image = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)
    plain = tiny.identity(tmp_path / "m.onnx")
    tiny.write_card(plain)
    outside, inside = load_encoder(plain), load_encoder(plain, sandbox=True)
    assert (inside.labels, inside.fingerprint, inside.dim) == (outside.labels, outside.fingerprint, outside.dim)
    a, b = outside.encode([image])[0], inside.encode([image])[0]
    np.testing.assert_array_equal(a.cells, b.cells)
    assert (a.scale, a.offset) == (b.scale, b.offset)
    inside.close()
    with pytest.raises(ModelError, match=r"m\.onnx was stopped in its sandbox: expected an answer within"):
        inside.encode([image])
    grow = [
        helper.make_node("ReduceSum", ["image"], ["sum"], keepdims=0),
        helper.make_node("Cast", ["sum"], ["whole"], to=TensorProto.INT64),
        helper.make_node("Mul", ["whole", "many"], ["count"]),
        helper.make_node("Unsqueeze", ["count", "zero"], ["rows"]),
        helper.make_node("Concat", ["first", "rows", "last"], ["shape"], axis=0),
        helper.make_node("ConstantOfShape", ["shape"], ["out"]),
    ]
    constants = {"many": 10**8, "zero": [0], "first": [1, 3], "last": [1]}
    arrays = {name: np.array(value) for name, value in constants.items()}
    bomb = tiny.save(tmp_path / "bomb.onnx", grow, IMAGE, {"out": (FLOAT, None)}, arrays)
    tiny.write_card(bomb)
    boxed = SandboxedEncoder(bomb, None)
    with pytest.raises(ModelError, match=r"bomb\.onnx|sandbox"):
        boxed.encode([np.full((8, 8, 3), 255, np.uint8)])
    boxed.close()
    (tmp_path / "x.onnx").write_bytes(b"hello")
    with pytest.raises(ModelError, match=r"x\.onnx is not ONNX"):
        load_encoder(tmp_path / "x.onnx", sandbox=True)
