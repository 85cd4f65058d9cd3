"""Masks with one CLIP vector each, in SAN's way (arXiv 2302.12242), from a mask proposer and an image tower.

Each mask gets a copy of CLIP's class token; in the last layers it attends to the patches with the mask's logits added
to its attention, while patches go on as ever. Masks come from MaskFormer of `transformers`; the classes it was trained
on are not used. SAN's own checkpoints need its own code: wrap them as a module that returns (masks, embeddings) and
pass it to `openvocab_occ.segmentation.export.export_module`; the card is the same.

    python models/export/masks.py CLIP MASKFORMER OUT --size 448 448 --layers 3
"""

from pathlib import Path
from typing import Any

import torch
from local import finish, input_card, load
from maskclip import _resized
from torch import Tensor, nn
from torch.nn import functional
from towers import TEMPLATES, export_text, score

from openvocab_occ.errors import ConfigError
from openvocab_occ.segmentation.card import Card, OutputCard, PromptCard
from openvocab_occ.segmentation.export import export_module


class MaskVectors(nn.Module):
    """Masks of a proposer, and CLIP's class token biased by each."""

    def __init__(self, clip: Any, proposer: Any, size: tuple[int, int], layers: int) -> None:
        super().__init__()
        self.vision, self.project, self.proposer, self.last = (
            clip.vision_model,
            clip.visual_projection,
            proposer,
            layers,
        )
        patch = clip.config.patch_size
        self.grid = (size[0] // patch, size[1] // patch)
        self.position = nn.Parameter(_resized(self.vision.embeddings.position_embedding.weight, self.grid))

    def forward(self, pixel_values: Tensor) -> tuple[Tensor, Tensor]:
        """Return mask logits [n, masks, h, w] and vectors [n, masks, channels]."""
        masks = self.proposer(pixel_values=pixel_values).masks_queries_logits
        bias = functional.interpolate(masks, self.grid, mode="bilinear", align_corners=False).flatten(2)
        embeddings = self.vision.embeddings
        patches = embeddings.patch_embedding(pixel_values).flatten(2).transpose(1, 2)
        token = embeddings.class_embedding.expand(patches.shape[0], 1, -1)
        x = self.vision.pre_layrnorm(torch.cat([token, patches], dim=1) + self.position)
        for layer in self.vision.encoder.layers[: -self.last]:
            x = _output(layer(x, attention_mask=None))
        asked = x[:, :1].expand(-1, masks.shape[1], -1)
        for layer in self.vision.encoder.layers[-self.last :]:
            asked = _attend(layer, asked, x[:, 1:], bias)
            x = _output(layer(x, attention_mask=None))
        return masks, self.project(self.vision.post_layernorm(asked))


def _output(found: Any) -> Tensor:
    return found[0] if isinstance(found, tuple) else found


def _attend(layer: Any, asked: Tensor, patches: Tensor, bias: Tensor) -> Tensor:
    """Run a layer of CLIP for tokens that look at the patches only, each through its mask."""
    attention = layer.self_attn
    heads = attention.num_heads

    def split(x: Tensor) -> Tensor:
        return x.unflatten(2, (heads, -1)).transpose(1, 2)

    normed, keys = layer.layer_norm1(asked), layer.layer_norm1(patches)
    q, k, v = split(attention.q_proj(normed)), split(attention.k_proj(keys)), split(attention.v_proj(keys))
    weights = (q @ k.transpose(2, 3) * attention.scale + bias[:, None]).softmax(dim=-1)
    mixed = (weights @ v).transpose(1, 2).flatten(2)
    asked = asked + attention.out_proj(mixed)
    return asked + layer.mlp(layer.layer_norm2(asked))


def main(clip: Path, proposer: Path, out: Path, size: tuple[int, int] = (448, 448), layers: int = 3) -> Path:
    """Write OUT/masks.onnx and OUT/text.onnx; return the card. Both models see images by CLIP's mean and std."""
    import transformers

    out.mkdir(parents=True, exist_ok=True)
    tower = load(transformers.CLIPVisionModelWithProjection, clip)
    if not 1 <= layers <= tower.config.num_hidden_layers:
        raise ConfigError("layers is not usable", expected=f"1 to {tower.config.num_hidden_layers}", got=layers)
    masks = load(transformers.MaskFormerForInstanceSegmentation, proposer)
    module = MaskVectors(tower, masks, size, layers).eval()
    path = out / "masks.onnx"
    export_module(module, path, {"pixel_values": torch.rand(1, 3, *size)}, outputs=["masks", "embeddings"])
    card = Card(
        schema=1, name=f"masks of {proposer.name} with vectors of {clip.name}", contract="masks",
        input=input_card(clip, size=size), output=OutputCard(name="masks", layout="NCHW", kind="masks",
                                                             embeddings="embeddings", mask_activation="sigmoid"),
        text=export_text(clip, out), prompts=PromptCard(templates=TEMPLATES), score=score(clip),
        source=f"{clip.name}, {proposer.name}",
    )  # fmt: skip
    return finish(card, path)


if __name__ == "__main__":
    import tyro

    print(tyro.cli(main))
