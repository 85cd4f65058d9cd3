"""What the exporters share: a folder of local weights as `transformers` saves them, and the card that goes with them.

Nothing is downloaded: the folder must hold config.json, the weights, preprocessor_config.json and, for text,
tokenizer.json. Weights are read from safetensors only, never from pickles.
"""

import json
import os
import shutil
from pathlib import Path
from typing import Any

from openvocab_occ.errors import ConfigError
from openvocab_occ.io.files import existing, sha256
from openvocab_occ.segmentation.card import Card, InputCard, TextCard
from openvocab_occ.segmentation.card_files import write_card
from openvocab_occ.segmentation.onnx import load_encoder
from openvocab_occ.segmentation.selftest import record

os.environ.setdefault("HF_HUB_OFFLINE", "1")
COMMENT = "Made by an exporter of openvocab_occ from local weights. Check `license` and `source`."


def read_json(folder: Path, name: str) -> dict[str, Any]:
    """Return a JSON file of the folder; empty where there is none."""
    file = folder / name
    return json.loads(file.read_text()) if file.is_file() else {}


def load(kind: Any, folder: Path, **options: Any) -> Any:
    """Load a model of a `transformers` class, in eval mode, with the attention that exports well."""
    weights = list(existing(folder, "folder of weights").glob("*.safetensors"))
    if not weights:
        raise ConfigError(f"{folder} has no weights", expected="model.safetensors", fix="save_pretrained makes it")
    model = kind.from_pretrained(
        folder, local_files_only=True, use_safetensors=True, attn_implementation="eager", **options
    )
    return model.eval()


def input_card(folder: Path, *, size: tuple[int, int], name: str = "pixel_values", resize: str = "squash") -> InputCard:
    """Return how images go in, by the preprocessor's mean and std; range is 0..1 before them."""
    told = read_json(folder, "preprocessor_config.json")
    mean, std = told.get("image_mean"), told.get("image_std")
    if mean is None or std is None:
        raise ConfigError(
            f"{folder} does not say how images go in", expected="image_mean and image_std in preprocessor_config.json"
        )
    return InputCard(
        name=name, layout="NCHW", color="RGB", range=(0.0, 1.0), mean=tuple(mean), std=tuple(std), size=size,
        resize=resize, interpolation="bilinear",
    )  # fmt: skip


def copy_tokenizer(folder: Path, out: Path) -> str:
    """Copy tokenizer.json beside the models; return its name."""
    shutil.copyfile(existing(folder / "tokenizer.json", "tokenizer"), out / "tokenizer.json")
    return "tokenizer.json"


def finish(card: Card, model: Path, *, texts: tuple[str, ...] = ("a truck", "two red cars")) -> Path:
    """Write the card beside the model with its hash and with numbers for its self-test; return the card's file."""
    from msgspec import structs

    target = model.with_suffix(".card.yaml")
    card = structs.replace(card, sha256=sha256(model))
    write_card(card, target, comment=COMMENT)
    test = record(load_encoder(model), texts=texts if card.text is not None else ())
    write_card(structs.replace(card, selftest=test), target, comment=COMMENT)
    return target


def check_text(text: TextCard, dim: int, width: int) -> None:
    """Raise ConfigError where words and images are not of one space."""
    if dim != width:
        raise ConfigError(f"text of {text.onnx} does not fit the images", expected=f"{dim} numbers", got=width)
