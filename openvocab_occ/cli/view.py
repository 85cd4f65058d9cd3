"""`openvocab-occ view`."""

from pathlib import Path
from typing import Annotated

import tyro

from openvocab_occ.cli.output import console, print_json


def view(
    map: Annotated[Path, tyro.conf.Positional],
    *,
    encoder: Path | None = None,
    card: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    json: bool = False,
) -> None:
    """Show a map in the web browser; Ctrl-C ends it.

    Args:
        map: A saved map, NAME.ovmap.
        encoder: The ONNX model that made the map; needed where words become vectors (dense models).
        card: The model's card, if it does not lie beside it.
        host: Address to listen on; only this machine by default.
        port: Port to listen on.
        json: Print one JSON object with the address, then serve.
    """
    from openvocab_occ.objects.scene_map import SceneMap
    from openvocab_occ.segmentation.onnx import load_encoder
    from openvocab_occ.viewer import server

    model = load_encoder(encoder, card) if encoder else None
    running = server.view(SceneMap.open(map), model, host=host, port=port, block=False)
    if json:
        print_json({"url": running.url, "map": str(map)})
    else:
        console().print(f"{map} at [bold]{running.url}[/bold]  (Ctrl-C ends)")
    running.wait()
