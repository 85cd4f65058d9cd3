"""`openvocab-occ find`."""

from pathlib import Path
from typing import Annotated

import tyro

from openvocab_occ.cli.encoder import encoder_for
from openvocab_occ.cli.output import console, print_json
from openvocab_occ.query import find as find_module


def find(
    map: Annotated[Path, tyro.conf.Positional],
    text: Annotated[str, tyro.conf.Positional],
    *,
    encoder: Path | None = None,
    card: Path | None = None,
    threshold: float | None = None,
    limit: int = 20,
    json: bool = False,
) -> None:
    """Ask a map for things in words.

    Args:
        map: A saved map, NAME.ovmap.
        text: What to look for, such as "trucks".
        encoder: The ONNX model that made the map; needed where words become vectors (dense models), except where the
            shipped model made it.
        card: The model's card, if it does not lie beside it.
        threshold: Least score of a hit; the model's own by default.
        limit: How many hits at most.
        json: Print one JSON object.
    """
    from openvocab_occ.objects.scene_map import SceneMap

    scene = SceneMap.open(map)
    model = encoder_for(map, encoder, card)
    answer = find_module.find(scene, text, model, threshold=threshold, limit=limit)
    if json:
        print_json(answer.to_dict())
    else:
        console().print(answer.explain(), markup=False)
