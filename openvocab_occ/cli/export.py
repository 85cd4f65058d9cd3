"""`openvocab-occ export`."""

from pathlib import Path
from typing import Annotated

import tyro

from openvocab_occ.cli.output import console, print_json


def export(
    map: Annotated[Path, tyro.conf.Positional],
    *,
    out: Path,
    query: str | None = None,
    encoder: Path | None = None,
    card: Path | None = None,
    json: bool = False,
) -> None:
    """Render a semantic view of a map for a person or a vision-language model.

    Args:
        map: A saved map, NAME.ovmap.
        out: Folder to write: pictures, depth, instance ids and view.json.
        query: Put the answer to this into the bundle.
        encoder: The ONNX model that made the map; needed where words become vectors (dense models).
        card: The model's card, if it does not lie beside it.
        json: Print one JSON object.
    """
    from openvocab_occ.export.views import export_views
    from openvocab_occ.objects.scene_map import SceneMap
    from openvocab_occ.query.find import find
    from openvocab_occ.segmentation.onnx import load_encoder

    scene = SceneMap.open(map)
    model = load_encoder(encoder, card) if encoder else None
    answer = find(scene, query, model) if query else None
    export_views(scene, out, query=answer)
    files = sorted(file.name for file in out.iterdir())
    if json:
        print_json({"folder": str(out), "files": files, "answer": answer.to_dict() if answer else None})
    else:
        console().print(f"[bold]{out}[/bold]  " + ", ".join(files))
