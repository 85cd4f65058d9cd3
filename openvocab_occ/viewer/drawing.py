"""Boxes, paths, cameras and captions as nodes of a viser scene."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32, UInt8

from openvocab_occ.geometry import Camera
from openvocab_occ.geometry.pose import wxyz_from_matrix
from openvocab_occ.objects.box import Box
from openvocab_occ.objects.tree import SceneObject

if TYPE_CHECKING:
    import viser

HIT_COLOR = (213, 94, 0)
SELECT_COLOR = (0, 114, 178)
MEASURE_COLOR = (204, 121, 167)
MOVING_COLOR = (230, 60, 120)
PATH_COLOR = (0, 128, 128)
_FRUSTUM_SIZE = 1.0  # metres, about
_EDGES = np.array(
    [(i, (i + 1) % 4) for i in range(4)] + [(4 + i, 4 + (i + 1) % 4) for i in range(4)] + [(i, 4 + i) for i in range(4)]
)


def box_edges(box: Box, margin: float = 0.0) -> Float32[np.ndarray, "12 2 3"]:
    """Return the ends of the twelve edges of a box, world, this many metres outside it."""
    return Box(box.center, box.size + 2 * margin, box.yaw).corners[_EDGES].astype(np.float32)


def draw_boxes(
    nodes: "viser.SceneApi", name: str, objects: Sequence[SceneObject], color: tuple[int, int, int], margin: float
) -> None:
    """Show the edges of boxes `margin` metres around objects as one node; without objects the node goes."""
    if not objects:
        nodes.remove_by_name(name)
        return
    edges = np.concatenate([box_edges(item.box, margin) for item in objects])
    nodes.add_line_segments(name, edges, color, thickness=3.0, thickness_units="screen")


def draw_caption(nodes: "viser.SceneApi", name: str, item: SceneObject, text: str) -> None:
    """Write a text above an object."""
    top = item.center + np.array([0.0, 0.0, item.box.size[2] / 2 + 0.5])
    nodes.add_label(name, text, position=top, anchor="bottom-center")


def draw_points(
    nodes: "viser.SceneApi",
    name: str,
    points: Float[np.ndarray, "n 3"],
    colors: UInt8[np.ndarray, "n 3"] | tuple[int, int, int],
    size: float,
) -> None:
    """Show points as flat squares around their own middle; float32, since they may spread far."""
    middle = points.mean(axis=0) if len(points) else np.zeros(3)
    nodes.add_point_cloud(
        name, (points - middle).astype(np.float32), colors, point_size=size, point_shape="square",
        point_shading="flat", precision="float32", position=middle,
    )  # fmt: skip


def draw_line(
    nodes: "viser.SceneApi", name: str, points: Float[np.ndarray, "n 3"], color: tuple[int, int, int]
) -> None:
    """Show a way through points; one point is none."""
    if len(points) > 1:
        segments = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)  # n - 1, 2, 3
        nodes.add_line_segments(name, segments, color, thickness=3.0, thickness_units="screen")


def vertical_fov(camera: Camera) -> float:
    """Return the angle, radians, that a pinhole camera sees from its upper to its lower edge."""
    return float(2 * np.arctan(camera.height / 2 / camera.K[1, 1]))


def draw_frustum(
    nodes: "viser.SceneApi", name: str, camera: Camera, picture: UInt8[np.ndarray, "h w 3"] | None
) -> None:
    """Show a camera as a pyramid, with what it saw at its base."""
    nodes.add_camera_frustum(
        name, fov=vertical_fov(camera), aspect=camera.width / camera.height, scale=_FRUSTUM_SIZE, color=PATH_COLOR,
        thickness=2.0, thickness_units="screen", image=picture, format="jpeg", jpeg_quality=80,
        wxyz=wxyz_from_matrix(camera.T_world_cam[:3, :3]), position=camera.position, cast_shadow=False,
        receive_shadow=False,
    )  # fmt: skip


def draw_plane(
    nodes: "viser.SceneApi", name: str, camera: Camera, picture: UInt8[np.ndarray, "h w 3"], depth: float
) -> None:
    """Show a picture across all that a pinhole camera sees, this z-depth from it, metres."""
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    middle = np.array([((camera.width - 1) / 2 - cx) / fx, ((camera.height - 1) / 2 - cy) / fy, 1.0]) * depth
    nodes.add_image(
        name, picture, render_width=camera.width / fx * depth, render_height=camera.height / fy * depth,
        format="jpeg", jpeg_quality=90, cast_shadow=False, receive_shadow=False,
        wxyz=wxyz_from_matrix(camera.T_world_cam[:3, :3]),
        position=camera.T_world_cam[:3, :3] @ middle + camera.position,
    )  # fmt: skip
