"""A view of a map as files that need no server: a page that opens offline, and a viser recording."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from openvocab_occ.objects.tree import SceneObject
from openvocab_occ.viewer.content import Content
from openvocab_occ.viewer.drawing import HIT_COLOR, PATH_COLOR, draw_boxes, draw_caption, draw_line
from openvocab_occ.viewer.guard import guarded_server, stop
from openvocab_occ.viewer.points import Eye, Points
from openvocab_occ.viewer.tiles import BUDGET


def staged(
    content: Content,
    colors: UInt8[np.ndarray, "n 3"],
    hits: Sequence[tuple[SceneObject, str]],
    camera: tuple[np.ndarray, np.ndarray, float],
    *,
    html: bool,
    dark: bool = False,
) -> bytes:
    """Return the map in some colours, with boxes and captions of hits, as HTML or as a `.viser` recording.

    `camera` is position, target and vertical field of view. The scene is staged on a server that nobody is told of,
    behind the same guard, and is gone again at once: viser can only record a server's own scene.
    """
    server = guarded_server("127.0.0.1", 0, "openvocab_occ")
    try:
        server.scene.configure_environment_map(hdri=None)
        server.scene.world_axes.visible = False
        server.initial_camera.position, server.initial_camera.look_at, server.initial_camera.fov = camera
        points = Points(server.scene, content, BUDGET)
        points.paint(colors)
        points.see(Eye(camera[0], 720 / 2 / np.tan(camera[2] / 2)))
        draw_line(server.scene, "/path", content.path, PATH_COLOR)
        draw_boxes(
            server.scene, "/hits/edges", [item for item, _ in hits], HIT_COLOR, 0.75 * content.scene.voxels.voxel_size
        )
        for number, (item, text) in enumerate(hits):
            if text:
                draw_caption(server.scene, f"/hits/caption_{number}", item, text)
        return server.scene.as_html(dark).encode() if html else server.get_scene_serializer().serialize()
    finally:
        stop(server)
