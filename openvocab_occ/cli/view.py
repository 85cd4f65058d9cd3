"""`openvocab-occ view`."""

import contextlib
from pathlib import Path
from typing import Annotated

import tyro

from openvocab_occ.cli.encoder import encoder_for
from openvocab_occ.cli.output import console, print_json


def view(
    map: Annotated[Path, tyro.conf.Positional],
    *,
    encoder: Path | None = None,
    card: Path | None = None,
    images: tuple[str, str] | None = None,
    option: tuple[str, ...] = (),
    earlier: Path | None = None,
    tiles: Path | None = None,
    follow: bool = False,
    host: str = "127.0.0.1",
    port: int = 8080,
    token: str | None = None,
    json: bool = False,
) -> None:
    """Show a map in the web browser; Ctrl-C ends it.

    Args:
        map: A saved map, NAME.ovmap, or a folder of them.
        encoder: The ONNX model that made the map; needed where words become vectors (dense models), except where the
            shipped model made it.
        card: The model's card, if it does not lie beside it.
        images: Kind and path of the drive, as `map` takes them, for the photos; a map holds none.
        option: Options of that kind, each KEY=VALUE.
        earlier: A map of the same place; what differs from it is marked.
        tiles: A global map, NAME.tiles, to be shown around it.
        follow: Show the map anew whenever it is written again.
        host: Address to listen on; others than this machine's own need a token.
        port: Port to listen on; 0 takes any free one.
        token: What visitors must have: 16 or more letters, digits, - and _; or "new".
        json: Print one JSON object with the address, then serve.
    """
    import secrets

    from openvocab_occ.cli.source import Source
    from openvocab_occ.memory import TileMap
    from openvocab_occ.objects.scene_map import SceneMap
    from openvocab_occ.viewer import server
    from openvocab_occ.viewer.layers import ChangesLayer, Layer, TileMapLayer
    from openvocab_occ.viewer.live import Follower

    layers: list[Layer] = []
    shown = SceneMap.open(map) if earlier or tiles else map
    if earlier and isinstance(shown, SceneMap):
        layers.append(ChangesLayer(shown, SceneMap.open(earlier)))
    if tiles and isinstance(shown, SceneMap):
        city = TileMap.open(str(tiles), writable=False)
        layers += [TileMapLayer(city, scene=shown, by="agent"), TileMapLayer(city, scene=shown, by="class")]
    running = server.view(
        shown,
        encoder_for(map, encoder, card),
        sequence=Source(*images, option=list(option)).load() if images else None,
        layers=layers,
        host=host,
        port=port,
        token=secrets.token_urlsafe() if token == "new" else token,
        block=False,
    )
    with contextlib.ExitStack() as stack:
        if follow:
            stack.enter_context(Follower(running, map))
        if json:
            print_json({"url": running.invitation, "map": str(map)})
        else:
            console().print(f"{map} at [bold]{running.invitation}[/bold]  (Ctrl-C ends)", soft_wrap=True)
        running.wait()
