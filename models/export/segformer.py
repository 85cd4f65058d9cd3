"""SegFormer: logits of its labels, a quarter of the image's size.

python models/export/segformer.py WEIGHTS OUT --size 512 1024
"""

from pathlib import Path
from typing import Any

import torch
from local import finish, input_card, load
from torch import Tensor, nn

from openvocab_occ.segmentation.card import Card, OutputCard
from openvocab_occ.segmentation.export import export_module


class _Logits(nn.Module):
    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, pixel_values: Tensor) -> Tensor:
        return self.model(pixel_values=pixel_values).logits


def main(folder: Path, out: Path, size: tuple[int, int] = (512, 1024)) -> Path:
    """Write OUT/segformer.onnx and its card; return the card."""
    import transformers

    out.mkdir(parents=True, exist_ok=True)
    model = load(transformers.SegformerForSemanticSegmentation, folder)
    path, axes = out / "segformer.onnx", {"pixel_values": {0: torch.export.Dim("images")}}
    export_module(_Logits(model), path, {"pixel_values": torch.rand(2, 3, *size)}, outputs=["logits"], dynamic=axes)
    labels = tuple(str(model.config.id2label[i]) for i in range(model.config.num_labels))
    card = Card(
        schema=1, name=folder.name, contract="logits", input=input_card(folder, size=size), labels=labels,
        output=OutputCard(name="logits", layout="NCHW", kind="logits", stride=4.0), source=str(folder.name),
    )  # fmt: skip
    return finish(card, path)


if __name__ == "__main__":
    import tyro

    print(tyro.cli(main))
