"""Show a saved map in the browser: `python webviewer/app.py street.ovmap --encoder segmenter.onnx`.

Words typed on the page are answered by the encoder that made the map; a map of a model with fixed labels needs none.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

import openvocab_occ as ovo


@dataclass(frozen=True)
class App:
    """Show a saved map in the browser."""

    map: Annotated[Path, tyro.conf.Positional]
    """Folder of the map, such as street.ovmap."""
    encoder: Path | None = None
    """The ONNX file that made the map, with its card beside it."""
    port: int = 8080
    """Port on this machine; 0 takes any free one."""


def main() -> None:
    """Serve until Ctrl-C."""
    app = tyro.cli(App)
    scene = ovo.SceneMap.open(app.map)
    encoder = ovo.load_encoder(app.encoder) if app.encoder else None
    viewer = ovo.view(scene, encoder, port=app.port, block=False)
    print(f"{app.map} is at {viewer.url} (Ctrl-C stops)")
    viewer.wait()


if __name__ == "__main__":
    main()
