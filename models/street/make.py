"""Make segmenter.onnx: a classifier of the flat colours of the synthetic street, and nothing more.

The mean colour x of each 4x4 block is scored for a class of colour c by -s |x - c|^2, less the term in |x|^2 that all
classes share: s (2 c x - |c|^2), which is a 1x1 convolution. Colours come from the street's own palette.

    python models/street/make.py
"""

from pathlib import Path

import numpy as np
import onnx
from msgspec import structs
from onnx import TensorProto, helper, numpy_helper

from openvocab_occ.datasets.street import PALETTE
from openvocab_occ.io.files import sha256
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_FREE
from openvocab_occ.segmentation.card import Card, InputCard, OutputCard
from openvocab_occ.segmentation.card_files import write_card
from openvocab_occ.segmentation.onnx import load_encoder
from openvocab_occ.segmentation.selftest import record

STRIDE = 4
SHARPNESS = 60.0  # 1 / (2 sigma^2) of colours in [0, 1]: sigma about 0.09, the spread that light and haze give


def make() -> onnx.ModelProto:
    """Build the graph: average pool, then a 1x1 convolution."""
    colors = np.array(list(PALETTE.values()), dtype=np.float32) / 255.0
    weight = (2 * SHARPNESS * colors)[:, :, None, None]  # k 3 1 1
    bias = -SHARPNESS * (colors**2).sum(axis=1)
    graph = helper.make_graph(
        [
            helper.make_node(
                "AveragePool", ["image"], ["mean"], kernel_shape=[STRIDE, STRIDE], strides=[STRIDE, STRIDE]
            ),
            helper.make_node("Conv", ["mean", "weight", "bias"], ["logits"], kernel_shape=[1, 1]),
        ],
        "synthetic_street_segmenter",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, ["batch", 3, "height", "width"])],
        [helper.make_tensor_value_info("logits", TensorProto.FLOAT, ["batch", len(colors), "rows", "columns"])],
        [numpy_helper.from_array(weight, "weight"), numpy_helper.from_array(bias, "bias")],
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8, producer_name="openvocab_occ"
    )
    onnx.checker.check_model(model, full_check=True)
    return model


def main(folder: Path = Path(__file__).parent) -> None:
    """Write the model and its card."""
    path = folder / "segmenter.onnx"
    onnx.save(make(), str(path))
    card = Card(
        schema=1, name="synthetic street segmenter", contract="logits",
        input=InputCard(name="image", layout="NCHW", color="RGB", range=(0.0, 1.0), multiple_of=STRIDE),
        output=OutputCard(name="logits", layout="NCHW", kind="logits", stride=float(STRIDE)),
        labels=tuple("sky" if label == OCC3D_FREE else OCC3D_CLASSES[label] for label in PALETTE),
        license="Apache-2.0", sha256=sha256(path),
        source="synthetic: made by models/street/make.py from the palette of the street; knows no real image",
    )  # fmt: skip
    comment = "Made by models/street/make.py. Synthetic: it tells the flat colours of the made-up street apart."
    write_card(card, path.with_suffix(".card.yaml"), comment=comment)
    card = structs.replace(card, selftest=record(load_encoder(path)))
    write_card(card, path.with_suffix(".card.yaml"), comment=comment)


if __name__ == "__main__":
    main()
