"""Write the demo pair from the checkpoint of train.py: text.onnx, words.txt, segmenter.onnx and its card.

python models/demo/export.py
"""

from pathlib import Path

import numpy as np
import onnx
import torch
import yaml
from network import DIM, Segmenter, WordHead
from onnx import TensorProto, helper, numpy_helper
from train import CHECKPOINT
from words import Words

from openvocab_occ.io.files import sha256
from openvocab_occ.segmentation.card import Card, InputCard, OutputCard, ScoreCard, TextCard, TextInputs
from openvocab_occ.segmentation.card_files import write_card
from openvocab_occ.segmentation.export import export_module
from openvocab_occ.segmentation.onnx import load_encoder
from openvocab_occ.segmentation.selftest import record

HERE = Path(__file__).parent
CONTEXT = 32  # words of a text
THRESHOLD = 0.5
COMMENT = """Made by models/demo/export.py. Trained on synthetic streets only; says nothing about real images.
The word table is distilled from all-MiniLM-L6-v2; see NOTICE."""


def table(head: WordHead, words: Words) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Return words, int8 rows and the scale of each, with the linear head folded in; rows of silent words are zero."""
    rows = (words.vectors @ head.linear.weight.detach().T).numpy()
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


def main() -> None:
    """Write all files."""
    words = Words.read()
    net, head = Segmenter(), WordHead(words.dim)
    saved = torch.load(CHECKPOINT, weights_only=True, map_location="cpu")
    torch.nn.ModuleList([net, head]).load_state_dict(saved["mean"])
    net.eval()
    names, rows, scale = table(head, words)
    (HERE / "words.txt").write_text("\n".join(names) + "\n")
    onnx.save(text_model(rows, scale), str(HERE / "text.onnx"))
    dim = torch.export.Dim
    sides = {0: dim("batch"), 2: 32 * dim("h32", min=1, max=128), 3: 32 * dim("w32", min=1, max=128)}
    path = HERE / "segmenter.onnx"
    off = export_module(net, path, {"image": torch.rand(2, 3, 96, 160)}, outputs=["features"], dynamic={"image": sides})
    card = Card(
        schema=1, name="synthetic city segmenter", contract="dense",
        input=InputCard(layout="NCHW", color="RGB", range=(0.0, 1.0), name="image", multiple_of=32),
        output=OutputCard(layout="NCHW", kind="features", name="features", normalized=True, stride=4.0),
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
    print(f"{len(names)} words, {total / 1e6:.2f} MB; PyTorch and ONNX Runtime differ by {off:.1e}")
    assert yaml.safe_load(target.read_text())["sha256"] == card.sha256, "the card is of this file"


if __name__ == "__main__":
    main()
