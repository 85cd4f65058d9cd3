"""Models by their cards: geometry, colours, kinds of output, and every way a file can be wrong."""

import hashlib

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

from openvocab_occ.datasets import load_sequence
from openvocab_occ.datasets.street import PALETTE
from openvocab_occ.errors import CardError, ConfigError, ModelError, NotFoundError, UnsafeFileError
from openvocab_occ.segmentation import FeatureMap, PixelEncoder
from openvocab_occ.segmentation.card import InputCard
from openvocab_occ.segmentation.demo_models import street_model
from openvocab_occ.segmentation.onnx import load_encoder, prepare
from openvocab_occ.segmentation.session import PROVIDERS

FLOAT = TensorProto.FLOAT


@pytest.fixture
def encoder(tiny, tmp_path):
    """Write the identity model, or another, with a changed card, and load it."""

    def load(model=None, **changes):
        model = model or tiny.identity(tmp_path / "m.onnx")
        tiny.write_card(model, **changes)
        return load_encoder(model)

    return load


@pytest.fixture
def image(rng):
    return rng.integers(0, 256, (6, 8, 3)).astype(np.uint8)


def softmax(x):
    e = np.exp(x - x.max(axis=-1, keepdims=True))
    return e / e.sum(axis=-1, keepdims=True)


def ramp(height, width):
    """An image whose red is its column and green its row."""
    v, u = np.mgrid[:height, :width]
    return np.stack([u, v, np.zeros_like(u)], axis=-1).astype(np.uint8)


def assert_ramp(one: FeatureMap, height, width, gain=255.0):
    """Every cell, at the pixel the map says it lies, holds that pixel's coordinates (away from the border)."""
    rows, columns = one.cells.shape[:2]
    u = (np.arange(columns) - one.offset[0]) / one.scale[0]
    v = (np.arange(rows) - one.offset[1]) / one.scale[1]
    inner_u, inner_v = (u >= 0.5) & (u <= width - 1.5), (v >= 0.5) & (v <= height - 1.5)
    found = one.cells * gain
    np.testing.assert_allclose(found[:, inner_u, 0], np.tile(u[inner_u], (rows, 1)), atol=0.51)
    np.testing.assert_allclose(found[inner_v, :, 1], np.tile(v[inner_v, None], (1, columns)), atol=0.51)


@settings(max_examples=50)
@given(st.integers(20, 200), st.integers(20, 200), st.integers(10, 200), st.integers(10, 200))
def test_resizing_keeps_pixel_positions(height, width, rows, columns):
    """`prepare` and the law cell = (u + 0.5) w_cells / W - 0.5 agree; uint8 rounding leaves half a pixel."""
    card = InputCard(layout="NHWC", color="RGB", range=(0.0, 1.0), size=(rows, columns))
    scale = (columns / width, rows / height)
    offset = (0.5 * scale[0] - 0.5, 0.5 * scale[1] - 0.5)
    assert_ramp(FeatureMap(prepare(ramp(height, width), card), scale, offset), height, width)


@pytest.mark.parametrize("stride", [1, 2, 4])
@pytest.mark.parametrize("interpolation", ["bilinear", "area"])
def test_cells_lie_where_the_map_says(encoder, tiny, tmp_path, stride, interpolation):
    """Through a real model of a stride and a resize: undo the softmax by its ratios to the zero blue channel."""
    model = tiny.pooled(tmp_path / "pool.onnx", stride)
    found = encoder(
        model, input__range=[0, 1], input__multiple_of=None, input__size=[60, 84], input__interpolation=interpolation
    ).encode([ramp(120, 210)])
    one = found[0]
    assert one.cells.shape == (60 // stride, 84 // stride, 3)
    logits = np.log(one.cells / one.cells[:, :, 2:])
    assert_ramp(FeatureMap(logits.astype(np.float32), one.scale, one.offset), 120, 210)
    if stride > 1 or interpolation == "area":
        u = (np.arange(one.cells.shape[1]) - one.offset[0]) / one.scale[0]
        np.testing.assert_allclose(u[0], (210 / 84 * stride - 1) / 2, atol=1e-9)  # middle of the first block


@pytest.mark.parametrize("layout", ["NCHW", "NHWC"])
@pytest.mark.parametrize("color", ["RGB", "BGR"])
def test_colours_range_mean_std_and_layout(encoder, tiny, tmp_path, image, layout, color):
    shape = ("n", 3, "h", "w") if layout == "NCHW" else ("n", "h", "w", 3)
    mean, std, span = np.array([0.1, 0.2, 0.3]), np.array([0.5, 1.0, 2.0]), (-1.0, 1.0)
    found = encoder(
        tiny.identity(tmp_path / "m.onnx", shape), input__layout=layout, output__layout=layout, input__color=color,
        input__range=list(span), input__mean=mean.tolist(), input__std=std.tolist(),
    ).encode([image])[0]  # fmt: skip
    seen = image[:, :, ::-1] if color == "BGR" else image
    np.testing.assert_allclose(found.cells, softmax((seen / 127.5 - 1 - mean) / std), atol=1e-6)
    assert found.scale == (1, 1)
    assert found.offset == (0, 0)


@pytest.mark.parametrize("first", ["n", 1])
def test_batches_of_many_sizes_equal_single_images(encoder, tiny, tmp_path, rng, first):
    sizes = [(6, 8)] * 11 + [(5, 4), (6, 8)]
    images = [rng.integers(0, 256, (*size, 3)).astype(np.uint8) for size in sizes]
    both = encoder(tiny.identity(tmp_path / "m.onnx", (first, 3, "h", "w")))
    together = both.encode(images)
    for image, found in zip(images, together, strict=True):
        np.testing.assert_array_equal(found.cells, both.encode([image])[0].cells)
    assert both.encode([]) == []


def test_uint8_and_half_models(encoder, tiny, tmp_path, image):
    half = encoder(tiny.identity(tmp_path / "h.onnx", dtype=TensorProto.FLOAT16), input__range=[0, 1])
    np.testing.assert_allclose(half.encode([image])[0].cells, softmax(image / 255), atol=1e-3)
    model = tiny.save(
        tmp_path / "u.onnx",
        [helper.make_node("Cast", ["image"], ["out"], to=FLOAT)],
        {"image": (TensorProto.UINT8, [1, 3, "h", "w"])},
        {"out": (FLOAT, [1, 3, "h", "w"])},
    )
    np.testing.assert_allclose(encoder(model).encode([image])[0].cells, softmax(image.astype(float)), atol=1e-6)


def test_probabilities_pass_and_others_do_not(encoder, tiny, tmp_path, image):
    model = tiny.save(
        tmp_path / "p.onnx",
        [helper.make_node("Softmax", ["image"], ["out"], axis=1)],
        {"image": (FLOAT, [1, 3, "h", "w"])},
        {"out": (FLOAT, [1, 3, "h", "w"])},
    )
    found = encoder(model, output__kind="probabilities", input__range=[0, 1]).encode([image])[0]
    np.testing.assert_allclose(found.cells, softmax(image / 255), atol=1e-6)
    with pytest.raises(ModelError, match=r"expected probabilities that sum to 1.*is it kind: logits\?"):
        encoder(output__kind="probabilities").encode([image])


@pytest.mark.parametrize("rank", [3, 4])
def test_class_numbers_become_one_hot(encoder, tiny, tmp_path, image, rank):
    model = tiny.save(
        tmp_path / "c.onnx",
        [helper.make_node("ArgMax", ["image"], ["out"], axis=1, keepdims=rank - 3)],
        {"image": (FLOAT, [1, 3, "h", "w"])},
        {"out": (TensorProto.INT64, None)},
    )
    layout = "NHW" if rank == 3 else "NCHW"
    found = encoder(model, output__kind="classes", output__layout=layout).encode([image])[0]
    np.testing.assert_array_equal(found.cells, np.eye(3)[image.argmax(axis=-1)])
    with pytest.raises(ModelError, match=r"classes 0\.\.1, one a label"):
        encoder(model, output__kind="classes", output__layout=layout, labels=["a", "b"]).encode([image])


def test_fingerprint_follows_model_and_card(encoder, tiny, tmp_path):
    first = encoder()
    assert isinstance(first, PixelEncoder)
    assert encoder(name="renamed").fingerprint == first.fingerprint
    other = encoder(tiny.pooled(tmp_path / "pool.onnx", 2))
    assert len({first.fingerprint, encoder(input__color="BGR").fingerprint, other.fingerprint}) == 3


@pytest.mark.parametrize(
    ("shape", "changes", "message"),
    [
        (("n", 4, "h", "w"), {}, "expected 3 colours in layout NCHW.*check input.layout"),
        (("n", 3, "h", "w"), {"input__layout": "NHWC"}, "expected 3 colours in layout NHWC.*check input.layout"),
        (("n", "h", "w", 3), {}, "expected 3 colours in layout NCHW.*check input.layout"),
        (("n", 3, "h", "w"), {"labels": ["a", "b"]}, "expected 2 channels in layout NCHW, one a label, got 3"),
        (("n", 3, "h", "w"), {"input__name": "pixels"}, "input of m.onnx .*expected an input called pixels, got image"),
        (("n", 3, "h", "w"), {"output__name": "logits"}, "output of m.onnx .*called logits, got out"),
        ((1, 3, 4, 6), {}, "height free as in the card.*write input.size"),
        ((1, 3, 4, 6), {"input__size": [6, 4], "input__multiple_of": None}, "height 6 as in the card"),
        ((2, 3, "h", "w"), {}, "a batch of 1 or of any size"),
        (("n", 3, "w"), {}, "images of 4 axes"),
        (("n", 3, "h", "w"), {"sha256": "0" * 64}, "is for another file than m.onnx"),
    ],
)
def test_declared_mismatch(encoder, tiny, tmp_path, shape, changes, message):
    model = tiny.identity(tmp_path / "m.onnx", shape)
    with pytest.raises(ModelError, match=message):
        encoder(model, **changes)


def test_mismatch_that_only_a_run_shows(encoder, tiny, tmp_path, image):
    model = tiny.identity(tmp_path / "m.onnx", ("n", "c", "h", "w"))
    with pytest.raises(ModelError, match=r"m\.onnx does not fit its card: expected 2 channels, one a label, got 3 in"):
        encoder(model, labels=["a", "b"]).encode([image])
    fixed = tiny.save(
        tmp_path / "add.onnx",
        [helper.make_node("Add", ["image", "c"], ["out"])],
        {"image": (FLOAT, ["n", 3, "h", "w"])},
        {"out": (FLOAT, ["n", 3, "h", "w"])},
        {"c": np.zeros((1, 3, 5, 5), np.float32)},
    )
    with pytest.raises(ModelError, match=r"model add\.onnx failed on image \(1, 3, 6, 8\)"):
        encoder(fixed).encode([image])


def test_nan_output(encoder, tiny, tmp_path, image):
    model = tiny.save(
        tmp_path / "nan.onnx",
        [helper.make_node("Log", ["image"], ["out"])],
        {"image": (FLOAT, ["n", 3, "h", "w"])},
        {"out": (FLOAT, ["n", 3, "h", "w"])},
    )
    with pytest.raises(ModelError, match=r"output out of nan\.onnx is not finite: .*144 of 144 values NaN"):
        encoder(model, input__range=[-2, -1]).encode([image])


def test_missing_card_says_what_to_write(tiny, tmp_path):
    model = tiny.identity(tmp_path / "m.onnx")
    with pytest.raises(CardError, match=r"(?s)m\.onnx has no card.*m\.card\.yaml.*schema: 1.*contract.*labels:"):
        load_encoder(model)
    card = tiny.write_card(tmp_path / "elsewhere.onnx")
    assert load_encoder(model, card).labels == ("red", "green", "blue")
    tiny.write_card(model, labels=["a", "b", "c"])
    assert load_encoder(model).labels == ("a", "b", "c")
    assert load_encoder(model, card).labels == ("red", "green", "blue")  # the argument wins


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04" + bytes(100), b"\x08\x08"])
def test_files_that_are_no_models(tmp_path, content):
    (tmp_path / "x.onnx").write_bytes(content)
    with pytest.raises(ModelError, match=r"x\.onnx is not ONNX"):
        load_encoder(tmp_path / "x.onnx")
    with pytest.raises(NotFoundError, match="ONNX model not found"):
        load_encoder(tmp_path / "y.onnx")
    with pytest.raises(ModelError, match="is not a file"):
        load_encoder(tmp_path)


def external(tiny, path, location, *, inside=False, **facts):
    """A model that adds a constant kept in another file, as initializer or in a subgraph's node."""
    images = (FLOAT, ["n", 3, "h", "w"])
    add = helper.make_node("Add", ["image", "c"], ["out"])
    tiny.save(path, [add], {"image": images}, {"out": images}, {"c": np.zeros((1, 3, 1, 1), "f4")})
    model = onnx.load(str(path))
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in {"location": location, "offset": 0, "length": 12, **facts}.items():
        tensor.external_data.add(key=key, value=str(value))
    if inside:
        hidden = onnx.TensorProto()
        hidden.CopyFrom(tensor)
        del model.graph.initializer[:]
        inner = helper.make_node("Constant", [], ["k"], value=hidden)
        branch = helper.make_graph([inner], "b", [], [helper.make_tensor_value_info("k", FLOAT, None)])
        flag = helper.make_node("Constant", [], ["flag"], value=helper.make_tensor("f", TensorProto.BOOL, [], [True]))
        chosen = helper.make_node("If", ["flag"], ["c"], then_branch=branch, else_branch=branch)
        nodes = [flag, chosen, add]
        del model.graph.node[:]
        model.graph.node.extend(nodes)
    path.write_bytes(model.SerializeToString())
    tiny.write_card(path)
    return path


@pytest.mark.parametrize("inside", [False, True])
@pytest.mark.parametrize(
    "place", ["../secret.bin", "/etc/passwd", "sub/w.bin", "..", "", "a\\b", "C:w", "*/_ORT_MEM_ADDR_/*"]
)
def test_weights_outside_the_folder_are_refused(tiny, tmp_path, place, inside):
    (tmp_path / "secret.bin").write_bytes(bytes(12))
    (tmp_path / "m").mkdir()
    with pytest.raises(UnsafeFileError, match="refers to a file outside its folder"):
        load_encoder(external(tiny, tmp_path / "m" / "m.onnx", place, inside=inside))


def test_weights_behind_a_link_missing_or_cut_off(tiny, tmp_path):
    (tmp_path / "real.bin").write_bytes(bytes(12))
    (tmp_path / "link.bin").symlink_to(tmp_path / "real.bin")
    with pytest.raises(UnsafeFileError, match="weights behind a link"):
        load_encoder(external(tiny, tmp_path / "m.onnx", "link.bin"))
    with pytest.raises(ModelError, match=r"lacks its weights: expected gone\.bin"):
        load_encoder(external(tiny, tmp_path / "m.onnx", "gone.bin"))
    with pytest.raises(ModelError, match=r"real\.bin of m\.onnx are cut off: expected at least 16 bytes, got 12 bytes"):
        load_encoder(external(tiny, tmp_path / "m.onnx", "real.bin", offset=4))
    with pytest.raises(ModelError, match="at no position"):
        load_encoder(external(tiny, tmp_path / "m.onnx", "real.bin", offset="x"))


def test_plain_external_weights_work_and_count(tiny, tmp_path, image):
    path = external(tiny, tmp_path / "m.onnx", "w.bin")
    prints = []
    for value in (0.0, 1.0):
        np.full(3, value, "f4").tofile(tmp_path / "w.bin")
        encoder = load_encoder(path)
        prints.append(encoder.fingerprint)
    np.testing.assert_allclose(encoder.encode([image])[0].cells, softmax(image.astype(float)), atol=1e-6)
    assert prints[0] != prints[1]


@pytest.mark.parametrize(("domain", "kind"), [("evil.ops", "Run"), ("com.microsoft", "EPContext")])
def test_foreign_operators_are_refused(tiny, tmp_path, domain, kind):
    model = tiny.save(
        tmp_path / "m.onnx",
        [helper.make_node(kind, ["image"], ["out"], domain=domain)],
        {"image": (FLOAT, [1, 3, 4, 4])},
        {"out": (FLOAT, [1, 3, 4, 4])},
        domain=domain,
    )
    tiny.write_card(model)
    with pytest.raises(UnsafeFileError, match=rf"needs the operator {domain}\.{kind}"):
        load_encoder(model)


def test_providers_that_are_not_there_fall_back_with_a_warning(tiny, tmp_path, image):
    import onnxruntime

    missing = [short for short, name in PROVIDERS.items() if name not in onnxruntime.get_available_providers()]
    if not missing:
        pytest.skip("this onnxruntime has every provider")
    model = tiny.identity(tmp_path / "m.onnx")
    tiny.write_card(model)
    with pytest.warns(RuntimeWarning, match="falling back to CPUExecutionProvider"):
        encoder = load_encoder(model, providers=(*missing, "cpu"))
    assert encoder.session.providers == ("CPUExecutionProvider",)
    np.testing.assert_array_equal(encoder.encode([image])[0].cells, load_encoder(model).encode([image])[0].cells)
    with pytest.raises(ConfigError, match="threads is not usable: expected at least 1, got 0"):
        load_encoder(model, threads=0)


def test_unknown_provider(tiny, tmp_path):
    model = tiny.identity(tmp_path / "m.onnx")
    with pytest.raises(ConfigError, match=r"onnxruntime has no WarpExecutionProvider: expected .*CPUExecutionProvider"):
        load_encoder(model, providers=("WarpExecutionProvider",))


def test_street_model_knows_the_street():
    encoder = load_encoder(street_model())
    assert encoder.labels[-1] == "sky"
    assert len(encoder.labels) == len(PALETTE) == encoder.dim
    flat = [np.full((8, 8, 3), color, np.uint8) for color in PALETTE.values()]
    for channel, found in enumerate(encoder.encode(flat)):
        assert found.cells.shape == (2, 2, len(PALETTE))
        assert (found.cells.argmax(axis=-1) == channel).all()
    view = load_sequence("street")[0].views[0]
    cells = encoder.encode([view.image])[0].cells.argmax(axis=-1)
    assert encoder.labels[cells[-1].min()] == "driveable surface"  # in front of the car
    assert encoder.labels[cells[0, 40]] == "sky"


@pytest.mark.data
def test_road_model_sees_the_road(data):
    """With no card beside the file: the shipped one is found by the file's sha256."""
    encoder = load_encoder(data / "onnx" / "road_adas" / "road-segmentation-adas-0001.onnx")
    assert encoder.labels == ("background", "road", "curb", "mark")
    frame = load_sequence("nuscenes-infos", data / "nuscenes_keyframe", cameras=["CAM_FRONT"])[0]
    found = encoder.encode([frame.views[0].image])[0]
    assert found.cells.shape == (512, 896, 4)
    v, u = np.mgrid[600:850:10, 600:1100:10]  # the lane ahead
    cells = found.cells[
        np.rint(found.scale[1] * v + found.offset[1]).astype(int),
        np.rint(found.scale[0] * u + found.offset[0]).astype(int),
    ]
    assert (cells[..., 1] + cells[..., 3] > 0.5).mean() > 0.95
    assert (found.cells[:150, :, 0] > 0.5).mean() > 0.99  # no road in the sky


@pytest.mark.data
def test_voc_model_sees_the_lorry(data):
    """It calls the lorry on the left a bus; VOC has no truck."""
    encoder = load_encoder(data / "onnx" / "deeplabv3" / "deeplab_v3_voc.onnx")
    frame = load_sequence("nuscenes-infos", data / "nuscenes_keyframe", cameras=["CAM_FRONT"])[0]
    cells = encoder.encode([frame.views[0].image])[0].cells
    np.testing.assert_allclose(cells.sum(axis=-1), 1, atol=1e-5)
    u, v = int(320 * 257 / 1600), int(400 * 257 / 900)
    assert encoder.labels[cells[v, u].argmax()] == "bus"


def test_sha256_of_the_demo_card_is_the_files():
    digest = hashlib.sha256(street_model().read_bytes()).hexdigest()
    assert digest in street_model().with_suffix(".card.yaml").read_text()
