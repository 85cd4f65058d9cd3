"""Write the demo pair from the checkpoint of train.py: text.onnx, words.txt, segmenter.onnx and its card.

python models/demo/export.py
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import onnx
import torch
import yaml
from network import DIM, Segmenter, WordHead
from onnx import TensorProto, helper, numpy_helper
from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process
from scenes import TRAINING, VALIDATION
from torch import Tensor, nn
from train import CHECKPOINT, Drives
from words import Words

from openvocab_occ.io.files import sha256
from openvocab_occ.segmentation.card import Card, InputCard, OutputCard, ScoreCard, TextCard, TextInputs
from openvocab_occ.segmentation.card_files import write_card
from openvocab_occ.segmentation.export import export_module, strip
from openvocab_occ.segmentation.onnx import load_encoder
from openvocab_occ.segmentation.selftest import record
from openvocab_occ.segmentation.session import Session

HERE = Path(__file__).parent
PICTURES = 96
CONTEXT = 32  # words of a text
THRESHOLD = 0.5
COMMENT = """Made by models/demo/export.py. Trained on synthetic streets only; says nothing about real images.
The word table is distilled from all-MiniLM-L6-v2; see NOTICE."""


def table(head: WordHead, words: Words) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Return words, int8 rows and the scale of each, with the linear head folded in; rows of silent words are zero."""
    rows = head.words(words.vectors, words.colors).detach().numpy()
    scale = np.abs(rows).max(axis=1) / 127
    return words.words, np.round(rows / np.maximum(scale, 1e-9)[:, None]).astype(np.int8), scale.astype(np.float32)


def text_model(rows: np.ndarray, scale: np.ndarray) -> onnx.ModelProto:
    """Build the graph: the sum of the rows of a text's words, normalised."""
    ids, mask = (helper.make_tensor_value_info(n, TensorProto.INT64, ["texts", "words"]) for n in ("input_ids", "mask"))
    nodes = [
        helper.make_node("Gather", ["rows", "input_ids"], ["whole"]),
        helper.make_node("Cast", ["whole"], ["row"], to=TensorProto.FLOAT),
        helper.make_node("Gather", ["scale", "input_ids"], ["gain"]),
        helper.make_node("Cast", ["mask"], ["there"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["gain", "there"], ["weight"]),
        helper.make_node("Unsqueeze", ["weight", "last"], ["column"]),
        helper.make_node("Mul", ["row", "column"], ["kept"]),
        helper.make_node("ReduceSum", ["kept", "words"], ["text_embeds"], keepdims=0),
    ]
    constants = {"rows": rows, "scale": scale, "last": np.array([2]), "words": np.array([1])}
    graph = helper.make_graph(
        nodes, "table_of_words", [ids, mask],
        [helper.make_tensor_value_info("text_embeds", TensorProto.FLOAT, ["texts", DIM])],
        [numpy_helper.from_array(array, name) for name, array in constants.items()],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    model.producer_name = "openvocab_occ"
    onnx.checker.check_model(model, full_check=True)
    return model


class CellsLast(nn.Module):
    """The network with its features last, as they are used."""

    def __init__(self, net: Segmenter) -> None:
        super().__init__()
        self.net = net

    def forward(self, image: Tensor) -> Tensor:
        """Return [n, h / 4, w / 4, 64]."""
        return self.net(image).permute(0, 2, 3, 1)


class Pictures(CalibrationDataReader):
    """Training pictures, from which the ranges of activations are told."""

    def __init__(self, drives: Drives) -> None:
        chosen = np.random.default_rng(0).choice(len(drives.images), PICTURES, replace=False)
        self._images = (drives.images[at] for at in chosen)

    def get_next(self) -> dict[str, np.ndarray] | None:
        """Return the next one."""
        image = next(self._images, None)
        return None if image is None else {"image": image.transpose(2, 0, 1)[None].astype(np.float32) / 255}


def quantize(whole: Path, path: Path, drives: Drives) -> None:
    """Write a model with convolutions in int8, but for the last one, whose features stay float.

    Weights use seven bits: with eight, sums of products overflow on processors without VNNI.
    """
    nodes = list(onnx.load(str(whole)).graph.node)
    last = max(at for at, node in enumerate(nodes) if node.op_type == "Conv")
    with TemporaryDirectory() as scratch:
        ready = Path(scratch) / "ready.onnx"
        quant_pre_process(str(whole), str(ready), skip_symbolic_shape=True)
        quantize_static(
            str(ready), str(path), Pictures(drives), per_channel=True, reduce_range=True,
            activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8,
            nodes_to_exclude=[node.name for node in nodes[last:]],
        )  # fmt: skip
    model = onnx.load(str(path))
    strip(model)
    model.producer_name, model.producer_version = "openvocab_occ", ""
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(path))


def agreement(one: Path, other: Path, image: np.ndarray) -> float:
    """Return the mean cosine of the features of two models for one picture."""
    feed = {"image": image.transpose(2, 0, 1)[None].astype(np.float32) / 255}
    a, b = (Session(path).run_many(["features"], feed)[0] for path in (one, other))
    return float((a * b).sum(axis=-1).mean())


def main() -> None:
    """Write all files."""
    words = Words.read()
    net, head = Segmenter(), WordHead(words.dim)
    saved = torch.load(CHECKPOINT, weights_only=True, map_location="cpu")
    torch.nn.ModuleList([net, head]).load_state_dict(saved["mean"])
    names, rows, scale = table(head, words)
    (HERE / "words.txt").write_text("\n".join(names) + "\n")
    onnx.save(text_model(rows, scale), str(HERE / "text.onnx"))
    dim = torch.export.Dim
    sides = {0: dim("batch"), 2: 32 * dim("h32", min=1, max=128), 3: 32 * dim("w32", min=1, max=128)}
    path = HERE / "segmenter.onnx"
    lexicon = yaml.safe_load((HERE / "lexicon.yaml").read_text())
    with TemporaryDirectory() as scratch:
        whole, example = Path(scratch) / "whole.onnx", {"image": torch.rand(2, 3, 96, 160)}
        off = export_module(CellsLast(net).eval(), whole, example, outputs=["features"], dynamic={"image": sides})
        quantize(whole, path, Drives(TRAINING[::8], lexicon))
        alike = np.mean([agreement(whole, path, image) for image in Drives(VALIDATION, lexicon).images[::16]])
    card = Card(
        schema=1, name="synthetic city segmenter", contract="dense",
        input=InputCard(layout="NCHW", color="RGB", range=(0.0, 1.0), name="image", multiple_of=32),
        output=OutputCard(layout="NHWC", kind="features", name="features", normalized=True, stride=4.0),
        text=TextCard(onnx="text.onnx", tokenizer="words.txt", context_length=CONTEXT, pad_id=0, padding="longest",
                      lowercase=True, inputs=TextInputs(ids="input_ids", mask="mask")),
        score=ScoreCard(kind="sigmoid", scale=round(head.log_scale.exp().item(), 3), bias=round(head.bias.item(), 3),
                        threshold=THRESHOLD),
        license="Apache-2.0",
        source=f"models/demo/train.py, {saved['step']} steps on synthetic streets; words from all-MiniLM-L6-v2",
        sha256=sha256(path),
    )  # fmt: skip
    target = path.with_suffix(".card.yaml")
    write_card(card, target, comment=COMMENT)
    from msgspec import structs

    test = record(load_encoder(path), texts=("parked trucks", "red car", "wheel"))
    write_card(structs.replace(card, selftest=test), target, comment=COMMENT)
    total = sum((HERE / name).stat().st_size for name in ("segmenter.onnx", "text.onnx", "words.txt"))
    print(f"{len(names)} words, {total / 1e6:.2f} MB; PyTorch and ONNX Runtime differ by {off:.1e}, "
          f"float and int8 agree to a cosine of {alike:.4f}")  # fmt: skip
    assert yaml.safe_load(target.read_text())["sha256"] == card.sha256, "the card is of this file"


if __name__ == "__main__":
    main()
