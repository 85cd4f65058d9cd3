"""The viewer: a page on this machine that shows a map and answers words."""

import contextlib
import threading
from typing import TYPE_CHECKING

import numpy as np

from openvocab_occ.errors import OpenVocabOccError
from openvocab_occ.export.render import overview
from openvocab_occ.io.files import PathLike
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.query.find import find
from openvocab_occ.segmentation.encoder import PixelEncoder
from openvocab_occ.viewer.guard import guarded_server, stop
from openvocab_occ.viewer.layers import draw_map, draw_path, tile_voxels, voxel_colors
from openvocab_occ.viewer.panels import Panel

if TYPE_CHECKING:
    import viser

_FOV = 1.0  # radians, vertical
_PANEL_WIDTH = 370


class Viewer:
    """A map being served; close it, or use it as a context."""

    def __init__(self, server: "viser.ViserServer", scene: SceneMap, encoder: PixelEncoder | None) -> None:
        self.server = server
        self.scene = scene
        self.panels: dict[int, Panel] = {}
        """Panel of each browser that is connected, by viser's client id."""
        self._closed = threading.Event()
        self._tiles = tile_voxels(scene.voxels.centers)
        self._mode = "image" if len(scene.voxels) and scene.voxels.colors.any() else "semantic"
        self._draw()

        def enter(client: "viser.ClientHandle") -> None:
            self.panels[client.client_id] = Panel(client, scene, self._tiles, encoder, self._mode)

        def leave(client: "viser.ClientHandle") -> None:
            self.panels.pop(client.client_id, None)

        server.on_client_connect(enter)
        threading.Thread(target=_warm_up, args=(scene, encoder), daemon=True).start()
        server.on_client_disconnect(leave)

    @property
    def port(self) -> int:
        """The port that is listened on."""
        return self.server.get_port()

    @property
    def url(self) -> str:
        """Address of the page."""
        host = self.server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}"

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
            stop(self.server)

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _draw(self) -> None:
        server, scene = self.server, self.scene
        server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(20, 110, 160))
        server.gui.main_panel.dock_left()
        server.gui.main_panel.set_width(_PANEL_WIDTH)
        server.scene.configure_environment_map(hdri=None)
        server.scene.world_axes.visible = False
        position, target = overview(scene, fov=_FOV)
        server.initial_camera.position = position
        server.initial_camera.look_at = target
        server.initial_camera.fov = _FOV
        with server.atomic():
            colors = voxel_colors(scene, self._mode)
            draw_map(server.scene, self._tiles, colors, scene.voxels.voxel_size)
            draw_path(server.scene, np.array([frame.T_world_ego[:3, 3] for frame in scene.frames]).reshape(-1, 3))


def _warm_up(scene: SceneMap, encoder: PixelEncoder | None) -> None:
    """Load what the first query needs, seconds of imports, before a person asks it."""
    with contextlib.suppress(OpenVocabOccError):  # the query itself will say so
        find(scene, "object", encoder)


def view(
    scene: SceneMap | PathLike,
    encoder: PixelEncoder | None = None,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
    block: bool = True,
) -> Viewer:
    """Serve a page that shows the map, takes queries and marks what answers them.

    Args:
        scene: A map, or the path of a saved one.
        encoder: Turns queries into vectors; a map made by a model with labels needs none.
        host: This machine by any of its own names. The page has no password, so other hosts are refused.
        port: 0 takes any free one.
        block: Serve until Ctrl-C; else return at once, and the viewer lives until `close` or the end of the program.

    Raises:
        ConfigError: The port is taken, or the host is not this machine.
        MapError: The map is empty.
    """
    opened = scene if isinstance(scene, SceneMap) else SceneMap.open(scene)
    overview(opened)  # an empty map is told before a port is opened
    server = guarded_server(host, port, "openvocab_occ")
    try:
        viewer = Viewer(server, opened, encoder)
    except BaseException:
        stop(server)
        raise
    if block:
        viewer.wait()
    return viewer
