"""Put the shipped demo models into the wheel; an editable install finds them in the checkout instead."""

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SHIPPED = (".onnx", ".yaml", ".txt")
"""Models, cards, the lexicon and the words; not the scripts that make them, nor their cache."""


class ShipDemoModels(BuildHookInterface):  # noqa: D101 - hatchling finds it by its base class
    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: D102
        if version == "standard":
            for folder in ("demo", "street"):
                for file in sorted(Path("models", folder).iterdir()):
                    if file.suffix in SHIPPED or file.name == "NOTICE":
                        build_data["force_include"][str(file)] = f"openvocab_occ/segmentation/{folder}/{file.name}"
