"""Tokens, masks, crops, tiles and feature files: each law against a second way to the same numbers."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper

from openvocab_occ.datasets.frame import Frame, View
from openvocab_occ.errors import CardError, DataError, ModelError, NotFoundError, UnsafeFileError
from openvocab_occ.geometry import Camera, GridSpec, look_at
from openvocab_occ.mapping import PixelWeights, Segments, lift
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.pipeline import MapBuilder, build_map
from openvocab_occ.segmentation import FeatureMap, MaskMap, PixelEncoder
from openvocab_occ.segmentation.card import CropCard, InputCard, Tile
from openvocab_occ.segmentation.crops import windows
from openvocab_occ.segmentation.feature_files import read_array
from openvocab_occ.segmentation.onnx import load_encoder
from openvocab_occ.segmentation.picture import place
from openvocab_occ.segmentation.tiles import run_in_tiles

FLOAT = TensorProto.FLOAT
WORDS = ["red", "green", "blue", "dark"]
TABLE = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 0.5], [-1, -1, -1]])
TEXT = {
    "onnx": "text.onnx", "tokenizer": "words.json", "context_length": 4, "pad_id": 4, "lowercase": True,
    "inputs": {"ids": "input_ids", "mask": "attention_mask"},
}  # fmt: skip


@pytest.fixture
def load(tiny, tmp_path):
    """Load a model with a text side of colours."""

    def one(model, contract, output, **changes):
        tiny.text_model(tmp_path / "text.onnx", TABLE)
        tiny.tokenizer(tmp_path / "words.json", WORDS)
        tiny.write_card(model, contract=contract, labels=None, output=output, text=TEXT, **changes)
        return load_encoder(model)

    return one


@pytest.fixture
def image(rng):
    return rng.integers(1, 256, (24, 32, 3)).astype(np.uint8)


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def patches(path, tiny, size, *, prefix=0):
    """Mean colours of blocks of `size`, as tokens behind some others."""
    nodes = [
        helper.make_node("AveragePool", ["image"], ["mean"], kernel_shape=[size, size], strides=[size, size]),
        helper.make_node("Reshape", ["mean", "flat"], ["rows"]),
        helper.make_node("Transpose", ["rows"], ["patches"], perm=[0, 2, 1]),
        helper.make_node("Concat", ["others", "patches"], ["out"], axis=1),
    ]
    constants = {"flat": np.array([1, 3, -1]), "others": np.full((1, prefix, 3), 9.0, np.float32)}
    return tiny.save(path, nodes, {"image": (FLOAT, [1, 3, "h", "w"])}, {"out": (FLOAT, [1, "t", 3])}, constants)


@pytest.mark.parametrize("prefix", [0, 1, 5])
def test_tokens_are_the_dense_cells(load, tiny, tmp_path, image, prefix):
    tokens = load(
        patches(tmp_path / "t.onnx", tiny, 4, prefix=prefix),
        "tokens",
        {"layout": "NTC", "kind": "features", "patch": 4, "prefix_tokens": prefix},
        input__multiple_of=4,
    ).encode([image])[0]
    dense = load(tiny.pooled(tmp_path / "d.onnx", 4), "dense", {"layout": "NCHW", "kind": "features"}).encode([image])[
        0
    ]
    np.testing.assert_allclose(tokens.cells, dense.cells, atol=1e-6)
    assert (tokens.scale, tokens.offset) == (dense.scale, dense.offset)


def test_tokens_of_another_number_or_width_are_refused(load, tiny, tmp_path, image):
    model = patches(tmp_path / "t.onnx", tiny, 4, prefix=1)
    card = {"layout": "NTC", "kind": "features", "patch": 8}
    with pytest.raises(ModelError, match=r"0 \+ 3 x 4 tokens of 8 pixels .* got 49 tokens; check output.patch"):
        load(model, "tokens", card, input__multiple_of=8).encode([image])
    pool = helper.make_node("AveragePool", ["image"], ["mean"], kernel_shape=[4, 4], strides=[4, 4])
    rows = helper.make_node("Reshape", ["mean", "shape"], ["out"])
    wide = tiny.save(
        tmp_path / "wide.onnx",
        [pool, rows],
        {"image": (FLOAT, [1, 3, "h", "w"])},
        {"out": (FLOAT, [1, "t", "c"])},
        {"shape": np.array([1, -1, 6])},
    )
    with pytest.raises(ModelError, match="expected 3 channels.*text model's vectors have, got 6 .*not aligned"):
        load(
            wide,
            "tokens",
            {"layout": "NTC", "kind": "features", "patch": 8},
            input__multiple_of=None,
            input__size=[32, 48],
        ).encode([image])


def test_stride_is_checked(load, tiny, tmp_path, image):
    model = tiny.pooled(tmp_path / "d.onnx", 4)
    output = {"layout": "NCHW", "kind": "features", "stride": 8}
    with pytest.raises(ModelError, match=r"a cell every 8 pixels, about 3 along the height, got 6 cells"):
        load(model, "dense", output).encode([image])
    load(model, "dense", {**output, "stride": 4}).encode([image])


def halves(path, tiny, *, scores=(8.0, 8.0)):
    """Two masks, what is redder than 0.5 and what is not, with a vector each."""
    nodes = [
        helper.make_node("Slice", ["image", "zero", "one", "axis"], ["red"]),
        helper.make_node("Sub", ["red", "half"], ["above"]),
        helper.make_node("Mul", ["above", "sharp"], ["masks"]),
        helper.make_node("Identity", ["v"], ["vectors"]),
        helper.make_node("Identity", ["s"], ["sure"]),
    ]
    constants = {
        "zero": np.array([0]), "one": np.array([1]), "axis": np.array([1]), "half": np.float32(0.5),
        "sharp": np.array([100.0, -100.0], np.float32).reshape(1, 2, 1, 1),
        "v": np.array([[[3.0, 0, 0], [0, 0, 2]]], np.float32), "s": np.array([scores], np.float32),
    }  # fmt: skip
    outputs = {"masks": (FLOAT, [1, 2, "h", "w"]), "vectors": (FLOAT, [1, 2, 3]), "sure": (FLOAT, [1, 2])}
    return tiny.save(path, nodes, {"image": (FLOAT, [1, 3, "h", "w"])}, outputs, constants)


MASKS = {"name": "masks", "layout": "NCHW", "kind": "masks", "embeddings": "vectors", "scores": "sure"}


def test_masks_become_ids_and_cells_alike(load, tiny, tmp_path):
    image = np.zeros((6, 8, 3), np.uint8)
    image[:, 3:, 0] = 250
    encoder = load(halves(tmp_path / "m.onnx", tiny), "masks", MASKS, input__range=[0, 1])
    assert isinstance(encoder, PixelEncoder)
    assert encoder.contract == "dense"
    wanted = np.where((np.arange(8) >= 3)[None, :, None], [1.0, 0, 0], [0, 0, 1.0]) * np.ones((6, 1, 1))
    np.testing.assert_allclose(encoder.encode([image])[0].cells, wanted, atol=1e-4)
    found = encoder.encode_masks([image])[0]
    assert isinstance(found, MaskMap)
    assert set(np.unique(found.ids)) == {0, 1}
    np.testing.assert_allclose(found.densify().cells, wanted, atol=1e-6)
    np.testing.assert_allclose(found.scores, 1 / (1 + np.exp(-8.0)), atol=1e-5)


def test_a_mask_that_is_nothing_leaves_its_cells(load, tiny, tmp_path):
    """Void near 1 takes the weight away: the cells keep a vector by share only where another mask has some."""
    image = np.full((4, 4, 3), 250, np.uint8)
    model = halves(tmp_path / "m.onnx", tiny, scores=(-30.0, 30.0))
    sure = load(model, "masks", {**MASKS, "scores": None, "void": "sure"}, input__range=[0, 1])
    found = sure.encode_masks([image])[0]
    np.testing.assert_allclose(found.embeddings[found.ids[0, 0]], [1, 0, 0])
    with pytest.raises(ModelError, match=r"an output called gone"):
        load(model, "masks", {**MASKS, "embeddings": "gone"}, input__range=[0, 1])


def test_only_mask_models_have_masks(load, tiny, tmp_path, image):
    encoder = load(tiny.pooled(tmp_path / "d.onnx", 4), "dense", {"layout": "NCHW", "kind": "features"})
    with pytest.raises(ModelError, match="puts out no masks"):
        encoder.encode_masks([image])


def mean_color(path, tiny):
    """One vector an image: its mean colour."""
    nodes = [helper.make_node("ReduceMean", ["image"], ["out"], axes=[2, 3], keepdims=0)]
    return tiny.save(path, nodes, {"image": (FLOAT, ["n", 3, 16, 16])}, {"out": (FLOAT, ["n", 3])})


CROPS = {"layout": "NC", "kind": "embedding"}
SQUARE = {"input__multiple_of": None, "input__size": [16, 16]}


@settings(max_examples=30)
@given(st.integers(8, 80), st.integers(8, 80), st.floats(0.1, 1), st.floats(0, 0.9))
def test_windows_cover_every_pixel(height, width, part, overlap):
    seen = np.zeros((height, width), int)
    for one in windows(height, width, CropCard(windows=(part,), overlap=overlap)):
        assert one.top >= 0
        assert one.left >= 0
        assert one.top + one.edge <= height
        assert one.left + one.edge <= width
        seen[one.top : one.top + one.edge, one.left : one.left + one.edge] += 1
    assert seen.min() >= 1


def test_windows_put_colours_where_they_are(load, tiny, tmp_path):
    image = np.zeros((64, 128, 3), np.uint8)
    image[:, :64, 0] = image[:, 64:, 2] = 200
    found = load(mean_color(tmp_path / "c.onnx", tiny), "crops", CROPS, **SQUARE).encode([image])[0]
    np.testing.assert_allclose(np.linalg.norm(found.cells, axis=2), 1, atol=1e-6)
    assert (found.cells[:, 0] == [1, 0, 0]).all()
    assert (found.cells[:, -1] == [0, 0, 1]).all()


def test_crops_of_mask_images(load, tiny, tmp_path):
    image = np.zeros((40, 60, 3), np.uint8)
    image[:, :30, 0] = image[:, 30:, 2] = 200
    ids = np.zeros((20, 30), np.uint8)
    ids[5:15, 2:12], ids[5:15, 18:28] = 7, 9
    for folder, picture in (("images", image[:, :, ::-1]), ("ids", ids)):
        (tmp_path / folder).mkdir()
        cv2.imwrite(str(tmp_path / folder / "a.png"), picture)
    crops = {"mask_images": "ids", "images": "images", "margin": 0.0}
    encoder = load(mean_color(tmp_path / "c.onnx", tiny), "crops", CROPS, crops=crops, **SQUARE)
    found = encoder.encode_masks([image])[0]
    assert found.ids.shape == (20, 30)
    np.testing.assert_allclose(found.embeddings, [[1, 0, 0], [0, 0, 1]], atol=1e-6)
    np.testing.assert_array_equal(found.ids, ids.astype(int) // 8 - (ids == 0))
    cells = encoder.encode([image])[0].cells
    assert (cells[ids == 0] == 0).all()
    assert (cells[ids == 9] == [0, 0, 1]).all()
    with pytest.raises(NotFoundError, match="not among those that features were computed for"):
        encoder.encode([image[:, ::-1]])


def test_crops_of_a_second_model(load, tiny, tmp_path):
    image = np.zeros((16, 32, 3), np.uint8)
    image[:, 16:, 0], image[:, :16, 1] = 250, 120
    masks = halves(tmp_path / "masks.onnx", tiny)
    load(masks, "masks", MASKS, input__range=[0, 1])  # writes its card
    crops = {"masks_onnx": "masks.onnx", "margin": 0.0, "blank": True}
    encoder = load(mean_color(tmp_path / "c.onnx", tiny), "crops", CROPS, crops=crops, **SQUARE)
    found = encoder.encode([image])[0]
    np.testing.assert_allclose(found.cells[0, 0], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(found.cells[0, -1], [1, 0, 0], atol=1e-6)


@settings(max_examples=40)
@given(st.integers(1, 9), st.integers(1, 9), st.sampled_from([(8, 8, 0), (8, 16, 4), (16, 16, 8), (24, 8, 2)]))
def test_tiles_of_a_local_model_change_nothing(rows, columns, shape):
    """A model that looks at single blocks gives the same with and without tiles."""
    fed = np.random.default_rng(rows * 10 + columns).integers(1, 255, (4 * rows, 4 * columns, 3)).astype(np.uint8)

    def run(images):
        n, h, w, _ = images.shape
        return unit(images.reshape(n, h // 4, 4, w // 4, 4, 3).mean(axis=(2, 4)).astype(np.float32))

    height, width, overlap = shape
    cells, span = run_in_tiles(fed, Tile(size=(height, width), overlap=overlap), run, unit=True)
    assert span == fed.shape[:2]
    np.testing.assert_allclose(cells, run(fed[None])[0], atol=1e-6)


def test_tiles_through_a_card(load, tiny, tmp_path, image):
    model = tiny.pooled(tmp_path / "d.onnx", 4)
    output = {"layout": "NCHW", "kind": "features"}
    whole = load(model, "dense", output, input__multiple_of=4).encode([image])[0]
    tile = {"size": [12, 16], "overlap": 4}
    parts = load(model, "dense", output, input__multiple_of=4, input__tile=tile).encode([image])[0]
    np.testing.assert_allclose(parts.cells, whole.cells, atol=1e-6)
    assert (parts.scale, parts.offset) == (whole.scale, whole.offset)


@settings(max_examples=60)
@given(st.integers(20, 90), st.integers(20, 90), st.sampled_from(["letterbox", "pad", "short", "squash"]))
def test_placing_keeps_pixel_positions(height, width, how):
    """Wherever `place` puts a pixel of a ramp, the fed image holds that pixel's coordinates."""
    common = {"layout": "NHWC", "color": "RGB", "range": (0.0, 1.0)}
    card = {
        "letterbox": InputCard(**common, size=(96, 96), resize="letterbox"),
        "pad": InputCard(**common, multiple_of=16, resize="pad"),
        "short": InputCard(**common, multiple_of=8, short_side=64, max_side=200, resize="pad"),
        "squash": InputCard(**common, multiple_of=8, short_side=64),
    }[how]
    v, u = np.mgrid[:height, :width]
    ramp = np.stack([2 * u, 2 * v, np.full_like(u, 255)], axis=-1).astype(np.uint8)
    placed = place(ramp, card)
    inside = placed.fed[..., 2] == 255
    y, x = np.nonzero(inside)
    u = (x - placed.offset[0]) / placed.scale[0]
    v = (y - placed.offset[1]) / placed.scale[1]
    keep = (u >= 0.5) & (u <= width - 1.5) & (v >= 0.5) & (v <= height - 1.5)
    np.testing.assert_allclose(placed.fed[y[keep], x[keep], 0], 2 * u[keep], atol=1.01)
    np.testing.assert_allclose(placed.fed[y[keep], x[keep], 1], 2 * v[keep], atol=1.01)
    assert keep.any()


def safetensors(array):
    header = json.dumps({"x": {"dtype": "F32", "shape": list(array.shape), "data_offsets": [0, array.nbytes]}}).encode()
    return len(header).to_bytes(8, "little") + header + array.tobytes()


@pytest.fixture
def computed(tiny, tmp_path):
    """A folder of images and features, and the card of them."""
    rng = np.random.default_rng(3)
    images = [rng.integers(0, 256, (12, 16, 3)).astype(np.uint8) for _ in range(2)]
    features = [rng.normal(size=(3, 4, 3)).astype(np.float32) for _ in range(2)]
    for folder in ("images", "features"):
        (tmp_path / folder).mkdir()
    for number, image in enumerate(images):
        cv2.imwrite(str(tmp_path / "images" / f"f{number}.png"), image[:, :, ::-1])
    np.save(tmp_path / "features" / "f0.npy", features[0])
    (tmp_path / "features" / "f1.safetensors").write_bytes(safetensors(features[1]))
    tiny.text_model(tmp_path / "text.onnx", TABLE)
    tiny.tokenizer(tmp_path / "words.json", WORDS)
    card = {"schema": 1, "name": "elsewhere", "contract": "files", "images": "images", "features": "features",
            "kind": "features", "layout": "HWC", "text": TEXT}  # fmt: skip
    (tmp_path / "c.card.yaml").write_text(json.dumps(card))
    return tmp_path, images, features


def test_feature_files_are_found_by_pixels(computed):
    folder, images, features = computed
    encoder = load_encoder(folder / "c.card.yaml")
    assert isinstance(encoder, PixelEncoder)
    for found, wanted in zip(encoder.encode(images), features, strict=True):
        assert isinstance(found, FeatureMap)
        np.testing.assert_allclose(found.cells, unit(wanted), atol=1e-6)
        assert found.scale == (0.25, 0.25)
    before = encoder.fingerprint
    np.save(folder / "features" / "f0.npy", np.ones((5, 4, 3), np.float32))
    assert load_encoder(folder / "c.card.yaml").fingerprint != before


def test_bad_feature_files(computed, tmp_path):
    folder, images, _ = computed
    encoder = load_encoder(folder / "c.card.yaml")
    with pytest.raises(NotFoundError, match="an image of the drive is not among those"):
        encoder.encode([images[0][:, ::-1]])
    file = folder / "features" / "f0.npy"
    np.save(file, np.ones((3, 4, 5), np.float32))
    with pytest.raises(ModelError, match=r"f0\.npy does not fit its card: expected 3 channels"):
        encoder.encode(images[:1])
    np.save(file, np.array([{"a": 1}]), allow_pickle=True)
    with pytest.raises(UnsafeFileError, match=r"f0\.npy holds a pickle"):
        encoder.encode(images[:1])
    file.write_bytes(b"no array")
    with pytest.raises((DataError, UnsafeFileError), match=r"f0\.npy"):
        encoder.encode(images[:1])
    np.save(file, np.full((3, 4, 3), np.nan, np.float32))
    with pytest.raises(DataError, match="is not finite"):
        encoder.encode(images[:1])
    file.unlink()
    with pytest.raises(NotFoundError, match=r"image f0 has no features"):
        encoder.encode(images[:1])
    for content in (b"", b"\xff" * 8, (99).to_bytes(8, "little") + b"{}", safetensors(np.zeros(4, "f4"))[:-8]):
        (tmp_path / "x.safetensors").write_bytes(content)
        with pytest.raises(DataError, match=r"x\.safetensors cannot be read"):
            read_array(tmp_path / "x.safetensors")
    with pytest.raises(CardError, match="contract dense needs `text`"):
        card = json.loads((folder / "c.card.yaml").read_text())
        (folder / "c.card.yaml").write_text(json.dumps({k: v for k, v in card.items() if k != "text"}))
        load_encoder(folder / "c.card.yaml")


def wall_of_halves():
    """A wall of one class 6 m ahead, painted red on its right half."""
    labels = np.full((16, 16, 16), 17, np.uint8)
    labels[12] = 15
    grid = OccupancyGrid(labels, GridSpec((0.0, -4.0, -4.0), 0.5, labels.shape), np.eye(4))
    camera = Camera(np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]), 64, 48,
                    look_at(np.array([0.2, 0.0, 0.0]), np.array([6.0, 0.0, 0.0])))  # fmt: skip
    image = np.zeros((48, 64, 3), np.uint8)
    image[:, 32:, 0] = 250
    return Frame(0, 0.0, np.eye(4), (View(image, camera, name="FRONT"),), grid), image


def test_masks_reach_the_map_as_masks(load, tiny, tmp_path, monkeypatch):
    encoder = load(halves(tmp_path / "m.onnx", tiny), "masks", MASKS, input__range=[0, 1])
    frame, image = wall_of_halves()
    (masks,) = encoder.encode_masks([image])
    dense = SimpleNamespace(
        name="dense", contract="dense", dim=3, labels=(), fingerprint="f" * 64, text=None,
        encode=lambda images: [masks.densify() for _ in images],
    )  # fmt: skip
    wanted = build_map([frame], dense, weights=PixelWeights.none())
    calls = []
    monkeypatch.setattr(encoder, "encode", lambda images: calls.append("cells"))
    monkeypatch.setattr(encoder, "encode_masks", lambda images: calls.append("masks") or [masks for _ in images])
    builder = MapBuilder(encoder, weights=PixelWeights.none())
    builder.integrate(frame)
    found = builder.snapshot()
    assert calls == ["masks"]  # once a frame, and never a vector a cell
    np.testing.assert_array_equal(found.voxels.keys, wanted.voxels.keys)
    np.testing.assert_allclose(found.voxels.features, wanted.voxels.features, atol=1e-5)
    right = found.voxels.centers[:, 1] < 0
    np.testing.assert_allclose(found.voxels.features[right & (found.voxels.centers[:, 1] < -0.5)][:, 0], 1, atol=1e-6)
    # one wall of one class is two segments, for the masks are two
    assert len(builder.objects.latest.segments) == 2


def test_pixels_without_a_mask_are_seen_all_the_same():
    ids = np.full((48, 64), -1, np.int32)
    ids[:, 32:] = 0
    found = MaskMap(ids, np.array([[1.0, 0, 0]], np.float32), np.ones(1, np.float32), (1.0, 1.0), (0.0, 0.0))
    rows = np.repeat(np.arange(3, dtype=np.int32), [16, 32, 16])[None].repeat(48, axis=0)
    lifted = lift(np.ascontiguousarray(rows), 3, Segments.of(found, 48, 64), view=2)
    np.testing.assert_allclose(lifted.sums, [[0, 0, 0], [48 * 16, 0, 0], [48 * 16, 0, 0]])
    np.testing.assert_array_equal(lifted.pixels, [48 * 16, 48 * 32, 48 * 16])
    np.testing.assert_array_equal(lifted.mask, [-1, 2 * 65536, 2 * 65536])
