"""`model probe|check|bench|show|calibrate` as a user types them."""

import json

import numpy as np
import pytest
import yaml
from onnx import TensorProto, helper

from openvocab_occ.cli import main
from openvocab_occ.errors import CardError
from openvocab_occ.mapping import Lifted, VoxelMap
from openvocab_occ.objects import EncoderInfo, Provenance, SceneMap, group_objects
from openvocab_occ.segmentation.card_files import parse_card, read_card
from openvocab_occ.segmentation.demo_models import demo_model, street_model
from openvocab_occ.segmentation.onnx import load_encoder
from openvocab_occ.segmentation.probe import probe

FLOAT = TensorProto.FLOAT


def run(capsys, *arguments):
    assert main([*map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def confirmed(draft, **changes):
    """Fill a draft in, as a person would."""
    fields = yaml.safe_load(draft)
    fields["input"] |= {"color": "RGB", "range": [0, 1], "mean": [0, 0, 0], "std": [1, 1, 1]}
    return fields | {"license": "MIT"} | changes


def one_output(tiny, path, nodes, shape, **constants):
    return tiny.save(path, nodes, {"image": (FLOAT, ["n", 3, "h", "w"])}, {"out": (FLOAT, shape)}, constants)


@pytest.mark.parametrize("stride", [1, 4, 14])
def test_probe_finds_the_multiple_and_its_draft_is_nearly_a_card(tiny, tmp_path, stride):
    pool = helper.make_node("AveragePool", ["image"], ["small"], kernel_shape=[stride] * 2, strides=[stride] * 2)
    back = helper.make_node("Resize", ["small", "", "scales"], ["again"], mode="nearest")
    mixed = helper.make_node("Add", ["again", "image"], ["out"])  # fails unless sides are multiples
    scales = np.array([1, 1, stride, stride], np.float32)
    model = one_output(tiny, tmp_path / "m.onnx", [pool, back, mixed], ["n", 3, "h", "w"], scales=scales)
    found = probe(model)
    if stride == 14:
        assert "224 x 224" in found.notes[0] or "multiple that ran is 14" in found.notes[0]
    else:
        assert f"the least multiple that ran is {stride}" in found.notes[0]
    assert found.card is None
    with pytest.raises(CardError, match=r"is a draft: .*input\.color.*must be confirmed"):
        parse_card(found.draft, "draft")
    card = confirmed(found.draft, labels=["a", "b", "c"])
    card["output"]["kind"] = "logits"
    (tmp_path / "m.card.yaml").write_text(yaml.safe_dump(card))
    size = (stride * 20, stride * 30, 3)
    assert load_encoder(model).encode([np.zeros(size, np.uint8)])[0].cells.shape == size


def test_probe_tells_contracts_apart(tiny, tmp_path):
    many = np.zeros((512, 3, 1, 1), np.float32)
    dense = one_output(
        tiny, tmp_path / "d.onnx", [helper.make_node("Conv", ["image", "w"], ["out"])], ["n", 512, "h", "w"], w=many
    )
    assert yaml.safe_load(probe(dense).draft)["contract"] == "dense"
    whole = one_output(
        tiny,
        tmp_path / "c.onnx",
        [helper.make_node("ReduceMean", ["image"], ["out"], axes=[2, 3], keepdims=0)],
        ["n", 3],
    )
    assert yaml.safe_load(probe(whole).draft)["contract"] == "crops"
    soft = one_output(
        tiny, tmp_path / "s.onnx", [helper.make_node("Softmax", ["image"], ["out"], axis=1)], ["n", 3, "h", "w"]
    )
    assert yaml.safe_load(probe(soft).draft)["output"]["kind"] == "probabilities"
    words = tiny.text_model(tmp_path / "t.onnx", np.ones((5, 4)))
    assert "takes token ids" in probe(words).notes[0]
    assert probe(words).draft == ""


def test_probe_writes_a_draft_once(tiny, tmp_path, capsys):
    model = tiny.identity(tmp_path / "m.onnx")
    out = tmp_path / "m.card.yaml"
    assert main(["model", "probe", str(model), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "image tensor(float)[?, 3, ?, ?]" in said
    assert f"draft: {out}" in said
    assert out.read_text().startswith("# Drafted by")
    assert main(["model", "probe", str(model), "--out", str(out)]) == 2
    assert "m.card.yaml exists" in capsys.readouterr().err
    words = tiny.text_model(tmp_path / "t.onnx", np.ones((5, 4)))
    assert main(["model", "probe", str(words), "--out", str(tmp_path / "t.card.yaml")]) == 2
    assert "gives no draft" in capsys.readouterr().err


@pytest.mark.data
@pytest.mark.parametrize("name", ["road_adas/road-segmentation-adas-0001", "deeplabv3/deeplab_v3_voc"])
def test_real_models_through_probe_and_a_finished_card(data, capsys, tmp_path, name):
    """The draft, finished by what the shipped card knows, loads and gives what the shipped card gives."""
    model = data / "onnx" / f"{name}.onnx"
    report = run(capsys, "model", "probe", model)
    assert report["card"] == model.stem
    shipped = load_encoder(model).card
    draft = yaml.safe_load(report["draft"])
    assert draft["output"]["kind"] == shipped.output.kind
    assert draft["input"]["size"] == list(shipped.input.size)
    card = confirmed(report["draft"], labels=list(shipped.labels))
    card["input"] |= {"color": shipped.input.color, "range": list(shipped.input.range)}
    (tmp_path / "done.card.yaml").write_text(yaml.safe_dump(card))
    finished = load_encoder(model, tmp_path / "done.card.yaml")
    image = np.random.default_rng(0).integers(0, 256, (90, 160, 3)).astype(np.uint8)
    np.testing.assert_array_equal(finished.encode([image])[0].cells, load_encoder(model).encode([image])[0].cells)


@pytest.mark.parametrize("model", [street_model, demo_model])
def test_shipped_models_pass_their_check(capsys, model):
    report = run(capsys, "model", "check", model())
    assert report["passed"]
    assert all(check["off"] < 0.01 for check in report["checks"])


@pytest.mark.parametrize(
    "slip", [{"input": {"color": "BGR"}}, {"input": {"range": [-1, 1]}}, {"text": {"lowercase": False}}]
)
def test_a_slip_in_a_card_fails_the_check(capsys, tmp_path, slip):
    """What no shape shows: the order of colours, the range, the case of words."""
    for file in demo_model().parent.iterdir():
        if file.suffix in (".onnx", ".txt"):
            (tmp_path / file.name).write_bytes(file.read_bytes())
    fields = yaml.safe_load(demo_model().with_suffix(".card.yaml").read_text())
    for section, change in slip.items():
        fields[section] |= change
    fields["selftest"]["texts"][0]["text"] = fields["selftest"]["texts"][0]["text"].upper()
    (tmp_path / "segmenter.card.yaml").write_text(yaml.safe_dump(fields))
    assert main(["model", "check", str(tmp_path / "segmenter.onnx")]) == 2
    assert "off by" in (error := capsys.readouterr().err) or "knows no word" in error


def test_check_needs_a_test(tiny, tmp_path, capsys):
    tiny.write_card(tiny.identity(tmp_path / "m.onnx"))
    assert main(["model", "check", str(tmp_path / "m.onnx")]) == 2
    assert "has no self-test" in capsys.readouterr().err


def test_bench_and_show(capsys):
    report = run(capsys, "model", "bench", demo_model(), "--runs", "2", "--size", "64", "96", "--batch", "2")
    assert report["cells"] == [16, 24, 64]
    assert 0 < report["ms_best"] <= report["ms_median"]
    assert report["text_ms_median"] > 0
    assert main(["model", "bench", str(street_model()), "--runs", "0"]) == 2
    assert "at least 1" in capsys.readouterr().err
    assert run(capsys, "model", "show", demo_model())["contract"] == "dense"
    assert main(["model", "show", str(demo_model())]) == 0
    said = capsys.readouterr().out
    for part in (
        "features of each cell",
        "RGB NCHW",
        "multiples of 32",
        "sigmoid(",
        "probability",
        "synthetic city",
        "Apache-2.0",
    ):
        assert part in said


def test_calibrate_turns_scores_into_probabilities(capsys, tmp_path, tiny):
    """A toy map of three directions; labels say what is where, one in ten of them wrong."""
    model = tiny.identity(tmp_path / "m.onnx")
    tiny.text_model(tmp_path / "text.onnx", np.vstack([np.zeros(3), np.eye(3), np.zeros(3)]))
    tiny.tokenizer(tmp_path / "words.json", ["red", "green", "blue"])
    text = {"onnx": "text.onnx", "tokenizer": "words.json", "context_length": 4, "pad_id": 0,
            "inputs": {"mask": "attention_mask"}}  # fmt: skip
    card = tiny.write_card(model, contract="dense", labels=None, output__kind="features", text=text)
    encoder = load_encoder(model)
    rng = np.random.default_rng(0)
    kind = rng.integers(0, 3, 300)
    sums = (np.eye(3)[kind] + 0.2 * rng.normal(size=(300, 3))).astype(np.float32)
    keys = np.stack([np.arange(300), np.zeros(300), np.zeros(300)], axis=1).astype(np.int32)
    voxels = VoxelMap(0.5, 3, contract="dense")
    ones = np.ones(300, np.float32)
    voxels.integrate(keys, Lifted(sums, ones, ones.astype(np.int32)), time=0.0)
    scene = SceneMap(voxels, group_objects(voxels), EncoderInfo.of(encoder), (), Provenance(name="toy", synthetic=True))
    scene.save(tmp_path / "toy.ovmap")
    wrong = rng.random(300) < 0.1
    names = np.array(["red", "green", "blue"])[np.where(wrong, (kind + 1) % 3, kind)]
    np.savez(tmp_path / "labels.npz", points=keys * 0.5 + 0.25, names=names)
    arguments = ("model", "calibrate", tmp_path / "toy.ovmap", tmp_path / "labels.npz", "--encoder", model)
    report = run(capsys, *arguments, "--dataset", "toy labels")
    assert report["voxels"] == 900
    assert read_card(card).score.calibration.dataset == "toy labels"
    again = load_encoder(model)
    assert again.scoring.kind == "probability"
    assert again.fingerprint == encoder.fingerprint  # the map stays valid
    chance = again.scoring(scene.voxels.features, np.float32([1, 0, 0]))
    for low, high in ((0, 0.3), (0.7, 1)):
        some = (chance >= low) & (chance < high)
        true = names[scene.voxels.keys[:, 0]][some] == "red"
        assert abs(true.mean() - chance[some].mean()) < 0.08
    np.savez(tmp_path / "bad.npz", points=np.zeros((3, 2)), names=names)
    assert main([*map(str, arguments[:3]), str(tmp_path / "bad.npz"), *map(str, arguments[4:]), "--dataset", "x"]) == 2
    assert "points (n, 3) and names (n) as text" in capsys.readouterr().err
