"""The maps that a viewer can show: one, or a folder of them, each opened when it is asked for."""

from collections.abc import Sequence
from pathlib import Path
from threading import RLock

from openvocab_occ.datasets.frame import Frame
from openvocab_occ.errors import NotFoundError
from openvocab_occ.export.render import overview
from openvocab_occ.io.files import PathLike
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.segmentation.encoder import PixelEncoder
from openvocab_occ.viewer.content import Content

_KEPT = 3  # maps that stay open


class Shelf:
    """Maps by name. The encoder and the images go to those maps that they belong to."""

    def __init__(
        self,
        maps: SceneMap | PathLike,
        encoder: PixelEncoder | None = None,
        sequence: Sequence[Frame] | None = None,
    ) -> None:
        """Take a map, the path of one, or a folder with several, `NAME.ovmap` each.

        Raises:
            NotFoundError: There is no map at the path.
            MapError: The first map is damaged or empty.
        """
        self._encoder, self._sequence = encoder, sequence
        self._lock = RLock()
        self._open: dict[str, Content] = {}
        self._paths: dict[str, Path] = {}
        if isinstance(maps, SceneMap):
            name = maps.provenance.name or "map"
            self.names = (name,)
            self._open[name] = self._content(maps)
        else:
            folder = Path(maps).expanduser()
            found = sorted(folder.glob("*.ovmap")) if folder.is_dir() and folder.suffix != ".ovmap" else [folder]
            if not found:
                raise NotFoundError(f"no map in {folder}", expected="folders NAME.ovmap", got="none")
            self._paths = {path.stem: path for path in found}
            self.names = tuple(self._paths)
        self.first = self.content(self.names[0])
        """What is shown first."""

    def content(self, name: str) -> Content:
        """Return a map, opened now where it is not open."""
        with self._lock:
            if name not in self._open:
                opened = self._content(SceneMap.open(self._paths[name]))
                while len(self._open) >= _KEPT:
                    self._open.pop(next(iter(self._open)))
                self._open[name] = opened
            return self._open[name]

    def replace(self, old: Content, scene: SceneMap) -> Content:
        """Put another state of a map in the place of `old`; return it."""
        with self._lock:
            name = next((name for name, content in self._open.items() if content is old), self.names[0])
            new = self._content(scene)
            self._open[name] = new
            if old is self.first:
                self.first = new
            return new

    def _content(self, scene: SceneMap) -> Content:
        overview(scene)  # an empty map is refused
        encoder = self._encoder
        if len(getattr(self, "names", ())) > 1 and encoder is not None:
            encoder = encoder if encoder.fingerprint == scene.encoder.fingerprint else None
        return Content(scene, encoder, self._sequence)
