"""What was measured, over the images: points, rendered grids, agreement between views; and all from above."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from openvocab_occ.datasets.frame import Frame, View
from openvocab_occ.depth.render import render_depth
from openvocab_occ.geometry import Camera, transform
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.occupancy.fusion import points_of_depth
from openvocab_occ.pipeline.doctor.sample import Sample, world_points

_WIDTH = 640  # pixels of one image in a mosaic
_FAR = 40.0  # metres where the colours of depth end
_GREEN, _RED = (40, 200, 70), (235, 50, 40)
_TOLERANCE = 0.05  # share of the depth


def draw(sample: Sample) -> dict[str, UInt8[np.ndarray, "h w 3"]]:
    """Return the pictures that this drive has data for, by file name."""
    made: dict[str, UInt8[np.ndarray, "h w 3"]] = {}
    frame = next((f for f in sample.frames if f.views), None)
    if frame is not None:
        if frame.points is not None:
            world = transform(frame.T_world_ego, frame.points)
            made["lidar_on_images.png"] = _mosaic([_points_on(view, world) for view in frame.views])
        if frame.occupancy is not None:
            grid = frame.occupancy
            made["grid_on_images.png"] = _mosaic([_grid_on(view, grid) for view in frame.views])
        pair = _depth_pair(sample.frames)
        if pair is not None:
            made["depth_agreement.png"] = _mosaic([_depth_of(pair[0]), _depth_of(pair[1]), _agreement(*pair)])
        if not made:
            made["images.png"] = _mosaic([_small(view)[0] for view in frame.views])
    if sample.frames:
        made["from_above.png"] = _from_above(sample)
    return made


def _small(view: View) -> tuple[UInt8[np.ndarray, "h w 3"], Camera]:
    import cv2

    width = min(_WIDTH, view.camera.width)
    camera = view.camera.resized(width, max(1, round(view.camera.height * width / view.camera.width)))
    image = cv2.resize(view.image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return image, camera  # pyright: ignore[reportReturnType]


def _mosaic(images: Sequence[UInt8[np.ndarray, "h w 3"]]) -> UInt8[np.ndarray, "y x 3"]:
    """Put images side by side, three in a row."""
    height, width = (max(image.shape[i] for image in images) for i in (0, 1))
    columns = min(3, len(images))
    sheet = np.full((height * -(-len(images) // columns), width * columns, 3), 255, dtype=np.uint8)
    for i, image in enumerate(images):
        y, x = height * (i // columns), width * (i % columns)
        sheet[y : y + image.shape[0], x : x + image.shape[1]] = image
    return sheet


def _colors(depth: Float[np.ndarray, "*n"], far: float = _FAR) -> UInt8[np.ndarray, "*n 3"]:
    """Return near as red, far as blue."""
    import cv2

    level = np.clip(255 * (1 - depth / far), 0, 255).astype(np.uint8)
    colors = cv2.applyColorMap(level.reshape(-1, 1), cv2.COLORMAP_TURBO)[:, 0, ::-1]
    return np.ascontiguousarray(colors).reshape(*depth.shape, 3)


def _points_on(view: View, points: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "h w 3"]:
    image, camera = _small(view)
    image = (image * 0.6).astype(np.uint8)
    pixels, depth = camera.project(points)
    inside = camera.inside(pixels)
    _dots(image, pixels[inside], _colors(depth[inside]))
    return _named(image, f"{view.name}: LiDAR, red near, blue from {_FAR:.0f} m")


def _dots(
    image: UInt8[np.ndarray, "h w 3"], pixels: Float[np.ndarray, "n 2"], colors: UInt8[np.ndarray, "n 3"]
) -> None:
    """Paint squares of 2 x 2 pixels."""
    for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
        u = np.clip(np.rint(pixels[:, 0]).astype(int) + dx, 0, image.shape[1] - 1)
        v = np.clip(np.rint(pixels[:, 1]).astype(int) + dy, 0, image.shape[0] - 1)
        image[v, u] = colors


def _grid_on(view: View, grid: OccupancyGrid) -> UInt8[np.ndarray, "h w 3"]:
    image, camera = _small(view)
    seen = render_depth(grid, camera)
    hit = seen.voxel >= 0
    image[hit] = (0.5 * image[hit] + 0.5 * _colors(seen.depth[hit])).astype(np.uint8)
    return _named(image, f"{view.name}: the grid's depth, red near, blue from {_FAR:.0f} m")


def _depth_of(view: View) -> UInt8[np.ndarray, "h w 3"]:
    image, camera = _small(view)
    assert view.depth is not None
    rows = np.linspace(0, view.depth.shape[0] - 1, camera.height).astype(int)
    columns = np.linspace(0, view.depth.shape[1] - 1, camera.width).astype(int)
    depth = view.depth[rows][:, columns]
    far = float(np.percentile(depth[depth > 0], 95)) if (depth > 0).any() else _FAR
    hit = depth > 0
    image[hit] = (0.4 * image[hit] + 0.6 * _colors(depth[hit], far)).astype(np.uint8)
    return _named(image, f"{view.name}: measured depth, blue from {far:.1f} m")


def _depth_pair(frames: Sequence[Frame]) -> tuple[View, View] | None:
    """Return the first and the last view with depth."""
    views = [view for frame in frames for view in frame.views if view.depth is not None]
    return (views[0], views[-1]) if len(views) > 1 else None


def _agreement(a: View, b: View) -> UInt8[np.ndarray, "h w 3"]:
    """Put the depth of one view over the image of the other: green where both measured the same surface."""
    image, camera = _small(b)
    image = (image * 0.6).astype(np.uint8)
    assert a.depth is not None
    assert b.depth is not None
    points = points_of_depth(a.depth, a.camera, stride=3)
    pixels, depth = camera.project(points)
    full, _ = b.camera.project(points)
    inside = camera.inside(pixels) & b.camera.inside(full)
    u, v = np.clip(np.rint(full[inside]).astype(int), 0, [b.camera.width - 1, b.camera.height - 1]).T
    measured = b.depth[v, u]
    valid = measured > 0
    same = np.abs(depth[inside] - measured) < _TOLERANCE * measured
    colors = np.where(same[:, None], _GREEN, _RED).astype(np.uint8)
    _dots(image, pixels[inside][valid], colors[valid])
    return _named(image, "depth of the first in the second: green the same surface, red another or hidden")


def _named(image: UInt8[np.ndarray, "h w 3"], text: str) -> UInt8[np.ndarray, "h w 3"]:
    import cv2

    scale = 0.42
    cv2.rectangle(image, (0, 0), (image.shape[1], 18), (0, 0, 0), -1)
    cv2.putText(image, text, (5, 13), cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), 1, cv2.LINE_AA)
    return image


def _from_above(sample: Sample) -> UInt8[np.ndarray, "h w 3"]:
    """Draw points, way and cameras in the world's x and y."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 7), dpi=100, layout="constrained")
    canvas, axes = FigureCanvasAgg(figure), figure.add_subplot()
    for frame in sample.frames[:4]:
        points = world_points(frame)
        if len(points):
            near = points[np.linalg.norm(points - frame.T_world_ego[:3, 3], axis=1) < 1.5 * _FAR]
            axes.scatter(*near[:, :2].T, s=0.3, c=near[:, 2], cmap="viridis", linewidths=0)
    way = np.array([frame.T_world_ego[:3, 3] for frame in sample.frames])
    axes.plot(*way[:, :2].T, "-o", color="black", markersize=4, linewidth=1, label="ego, x forward")
    size = max(2.0 if sample.has_rig else 0.2, 0.03 * float(np.ptp(way[:, :2], axis=0).max()))
    for frame in sample.frames:
        tip = frame.T_world_ego[:3, 3] + size * frame.T_world_ego[:3, 0]
        axes.plot(*np.array([frame.T_world_ego[:2, 3], tip[:2]]).T, color="black", linewidth=2)
    for view in (view for frame in sample.frames for view in frame.views):
        tip = view.camera.position + size * view.camera.T_world_cam[:3, 2]
        axes.plot(*np.array([view.camera.position[:2], tip[:2]]).T, color="crimson", linewidth=1)
    axes.plot([], [], color="crimson", linewidth=1, label="cameras look along")
    axes.set(aspect="equal", xlabel="world x (m)", ylabel="world y (m)", title="from above; points coloured by height")
    axes.legend(loc="upper right")
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])
