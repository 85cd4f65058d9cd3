"""CLIP as a dense model, in MaskCLIP's way (arXiv 2112.01071): features of each patch without training.

In the last layer a patch keeps its own value vector instead of what attention mixes into it, and goes through the layer
norm and projection that CLIP trained for its class token. The size of images is fixed at export.

    python models/export/maskclip.py WEIGHTS OUT --size 448 448
"""

from pathlib import Path
from typing import Any

import torch
from local import finish, input_card, load
from torch import Tensor, nn
from towers import TEMPLATES, export_text, score

from openvocab_occ.errors import ConfigError
from openvocab_occ.segmentation.card import Card, OutputCard, PromptCard
from openvocab_occ.segmentation.export import export_module


class DenseClip(nn.Module):
    """The image tower with its last attention left out, at one size of images."""

    def __init__(self, model: Any, size: tuple[int, int]) -> None:
        super().__init__()
        self.vision, self.project = model.vision_model, model.visual_projection
        patch = model.config.patch_size
        self.grid = (size[0] // patch, size[1] // patch)
        self.position = nn.Parameter(_resized(self.vision.embeddings.position_embedding.weight, self.grid))

    def forward(self, pixel_values: Tensor) -> Tensor:
        """Return [n, channels, rows, columns]."""
        embeddings = self.vision.embeddings
        patches = embeddings.patch_embedding(pixel_values).flatten(2).transpose(1, 2)
        token = embeddings.class_embedding.expand(patches.shape[0], 1, -1)
        x = self.vision.pre_layrnorm(torch.cat([token, patches], dim=1) + self.position)
        for layer in self.vision.encoder.layers[:-1]:
            found = layer(x, attention_mask=None)
            x = found[0] if isinstance(found, tuple) else found
        last = self.vision.encoder.layers[-1]
        values = last.self_attn.out_proj(last.self_attn.v_proj(last.layer_norm1(x)))[:, 1:]
        found = self.project(self.vision.post_layernorm(values))
        return found.transpose(1, 2).unflatten(2, self.grid)


def _resized(position: Tensor, grid: tuple[int, int]) -> Tensor:
    """Return the learned positions for another grid of patches; the class token's stays."""
    side = round((len(position) - 1) ** 0.5)
    square = position[1:].reshape(1, side, side, -1).permute(0, 3, 1, 2)
    fitted = nn.functional.interpolate(square, grid, mode="bicubic", align_corners=False)
    return torch.cat([position[:1], fitted[0].flatten(1).T]).detach()


def main(folder: Path, out: Path, size: tuple[int, int] = (448, 448)) -> Path:
    """Write OUT/dense.onnx and OUT/text.onnx; return the card."""
    import transformers

    out.mkdir(parents=True, exist_ok=True)
    model = load(transformers.CLIPVisionModelWithProjection, folder)
    patch = model.config.patch_size
    if size[0] % patch or size[1] % patch:
        raise ConfigError("the size does not fit the model", expected=f"multiples of {patch}", got=size)
    dense = DenseClip(model, size).eval()
    path, axes = out / "dense.onnx", {"pixel_values": {0: torch.export.Dim("images")}}
    export_module(dense, path, {"pixel_values": torch.rand(2, 3, *size)}, outputs=["features"], dynamic=axes)
    card = Card(
        schema=1, name=f"{folder.name} as MaskCLIP", contract="dense", input=input_card(folder, size=size),
        output=OutputCard(name="features", layout="NCHW", kind="features", stride=float(patch)),
        text=export_text(folder, out), prompts=PromptCard(templates=TEMPLATES), score=score(folder),
        source=str(folder.name),
    )  # fmt: skip
    return finish(card, path)


if __name__ == "__main__":
    import tyro

    print(tyro.cli(main))
