"""Show saved maps in the browser: `python webviewer/app.py street.ovmap --encoder segmenter.onnx`.

Given a folder of maps, the page lets you choose among them, and compare two. Words typed on the page are answered by
the encoder that made the map; a map of a model with fixed labels needs none. `openvocab-occ view` can do more.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

import openvocab_occ as ovo


@dataclass(frozen=True)
class App:
    """Show saved maps in the browser."""

    map: Annotated[Path, tyro.conf.Positional]
    """A map, such as street.ovmap, or a folder of them."""
    encoder: Path | None = None
    """The ONNX file that made the maps, with its card beside it."""
    port: int = 8080
    """Port on this machine; 0 takes any free one."""


def main() -> None:
    """Serve until Ctrl-C."""
    app = tyro.cli(App)
    encoder = ovo.load_encoder(app.encoder) if app.encoder else None
    viewer = ovo.view(app.map, encoder, port=app.port, block=False)
    print(f"{app.map} is at {viewer.url} (Ctrl-C stops)")
    viewer.wait()


if __name__ == "__main__":
    main()
