"""Put the shipped demo models into the wheel; an editable install finds them in the checkout instead."""

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ShipDemoModels(BuildHookInterface):  # noqa: D101 - hatchling finds it by its base class
    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: D102
        if version == "standard":
            build_data["force_include"]["models/demo"] = "openvocab_occ/segmentation/demo"
