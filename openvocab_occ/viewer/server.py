"""The viewer: a page on this machine that shows a map and answers words."""

import contextlib
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from openvocab_occ.datasets.frame import Frame
from openvocab_occ.errors import OpenVocabOccError
from openvocab_occ.io.files import PathLike
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.query.find import find, score_voxels
from openvocab_occ.segmentation.encoder import PixelEncoder
from openvocab_occ.viewer.content import Content
from openvocab_occ.viewer.guard import Door, guarded_server, stop
from openvocab_occ.viewer.layer_panel import theme
from openvocab_occ.viewer.layers import GridLayer, Layer, PathLayer, SliceLayer
from openvocab_occ.viewer.session import FOV, Session
from openvocab_occ.viewer.shelf import Shelf
from openvocab_occ.viewer.tiles import BUDGET

if TYPE_CHECKING:
    import viser

_PANEL_WIDTH = 300  # pixels


class Viewer:
    """A map being served; close it, or use it as a context."""

    def __init__(
        self,
        server: "viser.ViserServer",
        shelf: Shelf,
        layers: Sequence[Layer] = (),
        *,
        token: str | None = None,
        budget: int = BUDGET,
    ) -> None:
        """Begin to serve; `budget` is how many points a browser is sent at most, what is far being coarser."""
        self.server = server
        self.sessions: dict[int, Session] = {}
        """Page of each browser that is connected, by viser's client id."""
        self.shelf = shelf
        self._extra = list(layers)
        self._token = token
        self._budget = budget
        self._closed = threading.Event()
        self._changing = threading.Lock()
        theme(server.gui)
        server.gui.main_panel.dock_left()
        server.gui.main_panel.set_width(_PANEL_WIDTH)
        server.scene.configure_environment_map(hdri=None)
        server.scene.world_axes.visible = False
        position, target = shelf.first.overview(1.0, FOV)
        server.initial_camera.position = position
        server.initial_camera.look_at = target
        server.initial_camera.fov = FOV
        server.on_client_connect(self._enter)
        server.on_client_disconnect(self._leave)
        threading.Thread(target=_warm_up, args=(shelf.first,), daemon=True).start()

    @property
    def scene(self) -> SceneMap:
        """The map that is shown."""
        return self.shelf.first.scene

    @property
    def port(self) -> int:
        """The port that is listened on."""
        return self.server.get_port()

    @property
    def url(self) -> str:
        """Address of the page."""
        host = self.server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}"

    @property
    def invitation(self) -> str:
        """Address of the page for a visitor: with the token, where one is asked for."""
        return f"{self.url}/?token={self._token}" if self._token else self.url

    def show(self, scene: SceneMap) -> None:
        """Show another state of the map in every browser that shows it; cameras stay, queries are asked again.

        Raises MapError for an empty map; the one before stays.
        """
        with self._changing:
            old = self.shelf.first
            content = self.shelf.replace(old, scene)
            sessions = [session for session in self.sessions.values() if session.content is old]
        for session in sessions:
            session.change(content)

    def add_layer(self, layer: Layer) -> None:
        """Offer one more layer; browsers that are connected see it too."""
        with self._changing:
            self._extra.append(layer)
            sessions = list(self.sessions.values())
        for session in sessions:
            session.layers.replace()

    def wait(self) -> None:
        """Serve until `close` or Ctrl-C."""
        try:
            while not self._closed.wait(0.5):  # a wait without end would not hear Ctrl-C everywhere
                pass
        except KeyboardInterrupt:
            pass
        finally:
            self.close()

    def close(self) -> None:
        """Stop serving; a second call does nothing."""
        if not self._closed.is_set():
            self._closed.set()
            for session in list(self.sessions.values()):
                session.close()
            stop(self.server)

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _enter(self, client: "viser.ClientHandle") -> None:
        with self._changing:
            self.sessions[client.client_id] = Session(client, self.shelf, self.layers, self._budget)

    def _leave(self, client: "viser.ClientHandle") -> None:
        session = self.sessions.pop(client.client_id, None)
        if session is not None:
            session.close()

    def layers(self, content: Content) -> list[Layer]:
        """Return what can be shown beside the voxels of a map."""
        layers: list[Layer] = [PathLayer(content.path), GridLayer(content.scene), SliceLayer(content.scene)]
        return [*layers, *self._extra]


def _warm_up(content: Content) -> None:
    """Load what the first query needs, seconds of imports, before a person asks it."""
    with contextlib.suppress(OpenVocabOccError):  # the query itself will say so
        find(content.scene, "parked car near the road", content.encoder)
        score_voxels(content.scene, "car", content.encoder)
    ray = np.array([0.0, 0.0, -1.0])
    content.picker.pick(content.scene.voxels.centers[0] + [0.0, 0.0, 100.0], ray)


def view(
    scene: SceneMap | PathLike,
    encoder: PixelEncoder | None = None,
    *,
    sequence: Sequence[Frame] | None = None,
    layers: Sequence[Layer] = (),
    host: str = "127.0.0.1",
    port: int = 8080,
    token: str | None = None,
    block: bool = True,
) -> Viewer:
    """Serve a page that shows the map, takes queries and marks what answers them.

    Args:
        scene: A map, the path of a saved one, or a folder of them to choose from on the page.
        encoder: Turns queries into vectors; a map made by a model with labels needs none.
        sequence: The frames the map was built from, for their images; a map has none.
        layers: More to show, such as `layers.ChangesLayer` or `layers.TileMapLayer`.
        host: An address of this machine. Others than its own need a token.
        port: 0 takes any free one.
        token: A word that visitors must have: it is in the page's address. Without one only this machine is served.
        block: Serve until Ctrl-C; else return at once, and the viewer lives until `close` or the end of the program.

    Raises:
        ConfigError: The port is taken, or the host is not this machine and there is no token.
        MapError: The map is empty.
    """
    shelf = Shelf(scene, encoder, sequence)  # what is wrong with a map is told before a port is opened
    server = guarded_server(host, port, "openvocab_occ", Door(token))
    try:
        viewer = Viewer(server, shelf, layers, token=token)
    except BaseException:
        stop(server)
        raise
    if block:
        viewer.wait()
    return viewer
