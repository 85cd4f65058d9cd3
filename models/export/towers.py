"""Text and image towers of CLIP and SigLIP 2: one vector a text, one vector an image.

The image tower embeds whole images; the card feeds it with sliding windows (contract `crops`). For features of each
patch see maskclip.py.

    python models/export/towers.py WEIGHTS OUT          # OUT/text.onnx, OUT/image.onnx, cards, tokenizer.json
"""

from pathlib import Path
from typing import Any

import torch
from local import copy_tokenizer, finish, input_card, load, read_json
from torch import Tensor, nn

from openvocab_occ.errors import ConfigError
from openvocab_occ.segmentation.card import Card, CropCard, OutputCard, PromptCard, ScoreCard, TextCard, TextInputs
from openvocab_occ.segmentation.export import export_module

TEMPLATES = ("a photo of a {}.", "a photo of the {}.", "a {} on a street.")


class _Text(nn.Module):
    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, input_ids: Tensor) -> Tensor:
        found = self.model(input_ids=input_ids)
        return found.text_embeds if hasattr(found, "text_embeds") else found.pooler_output


class _Image(nn.Module):
    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, pixel_values: Tensor) -> Tensor:
        found = self.model(pixel_values=pixel_values)
        return found.image_embeds if hasattr(found, "image_embeds") else found.pooler_output


def family(folder: Path) -> str:
    """Return `clip` or `siglip`; SigLIP 2 of fixed size has SigLIP's architecture."""
    kind = str(read_json(folder, "config.json").get("model_type", ""))
    if kind in ("clip", "siglip"):
        return kind
    raise ConfigError("this exporter does not know the model", expected="model_type clip or siglip", got=repr(kind))


def export_text(folder: Path, out: Path) -> TextCard:
    """Write OUT/text.onnx and return how words go into it."""
    import transformers

    name = family(folder)
    kind = transformers.CLIPTextModelWithProjection if name == "clip" else transformers.SiglipTextModel
    model = load(kind, folder)
    length, vocabulary = model.config.max_position_embeddings, model.config.vocab_size
    ids = torch.randint(1, vocabulary - 1, (2, length))
    end = int(model.config.eos_token_id)
    ids[:, length // 2] = min(end, vocabulary - 1)
    axes = {"input_ids": {0: torch.export.Dim("texts")}}
    export_module(_Text(model), out / "text.onnx", {"input_ids": ids}, outputs=["text_embeds"], dynamic=axes)
    pad = read_json(folder, "tokenizer_config.json").get("pad_token_id", model.config.pad_token_id)
    siglip = name == "siglip"
    return TextCard(
        onnx="text.onnx", tokenizer=copy_tokenizer(folder, out), context_length=length, pad_id=int(pad or 0),
        padding="max", lowercase=True, strip_punctuation=siglip, eos_id=end, inputs=TextInputs(ids="input_ids"),
        output="text_embeds",
    )  # fmt: skip


def score(folder: Path) -> ScoreCard:
    """Return how cosines become scores: CLIP's against negatives, SigLIP's by its learned scale and bias."""
    import transformers

    if family(folder) == "clip":
        negatives = ("object", "things", "stuff", "texture")
        return ScoreCard(kind="relevancy", scale=10.0, negatives=negatives)
    model = load(transformers.SiglipModel, folder)
    return ScoreCard(kind="sigmoid", scale=model.logit_scale.exp().item(), bias=model.logit_bias.item())


def main(folder: Path, out: Path) -> Path:
    """Write both towers; return the card of the image side."""
    import transformers

    out.mkdir(parents=True, exist_ok=True)
    name = family(folder)
    text = export_text(folder, out)
    kind = transformers.CLIPVisionModelWithProjection if name == "clip" else transformers.SiglipVisionModel
    model = load(kind, folder)
    side = model.config.image_size
    axes = {"pixel_values": {0: torch.export.Dim("images")}}
    path = out / "image.onnx"
    example = {"pixel_values": torch.rand(2, 3, side, side)}
    export_module(_Image(model), path, example, outputs=["image_embeds"], dynamic=axes)
    card = Card(
        schema=1, name=f"{folder.name} image tower", contract="crops", input=input_card(folder, size=(side, side)),
        output=OutputCard(name="image_embeds", layout="NC", kind="embedding"), crops=CropCard(), text=text,
        prompts=PromptCard(templates=TEMPLATES), score=score(folder), source=str(folder.name),
    )  # fmt: skip
    return finish(card, path)


if __name__ == "__main__":
    import tyro

    print(tyro.cli(main))
