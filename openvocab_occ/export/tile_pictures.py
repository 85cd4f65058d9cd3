"""Pictures of a tile map: from above and from the front, by class or by agent; its growth over time."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from openvocab_occ.errors import MapError
from openvocab_occ.export.palette import label_colors
from openvocab_occ.io.files import PathLike, written_file
from openvocab_occ.memory.merge import Coverage, Surface

_AGENTS = ((214, 69, 80), (46, 134, 222), (38, 166, 91), (240, 160, 30), (142, 68, 173), (22, 160, 163))
_MOST = 4000  # pixels along a side


def agent_colors(count: int) -> UInt8[np.ndarray, "n 3"]:
    """Return a colour for each agent; the first six differ clearly."""
    return np.array([_AGENTS[n % len(_AGENTS)] for n in range(count)], dtype=np.uint8).reshape(-1, 3)


def view(
    points: Float64[np.ndarray, "n 3"],
    colors: UInt8[np.ndarray, "n 3"],
    cell: float,
    *,
    axes: tuple[int, int, int],
    bounds: Float64[np.ndarray, "2 3"],
) -> UInt8[np.ndarray, "h w 3"]:
    """Return voxels seen along an axis, orthographically, shaded by how near they are; white where there is none.

    Args:
        points: Centres, metres.
        colors: Their colours.
        cell: Edge of a voxel, metres.
        axes: To the right, up, and towards the viewer: of several voxels in a pixel the last of this axis is seen.
        bounds: Lower and upper corner that is shown, metres.
    """
    right, up, near = axes
    low, high = bounds
    size = np.maximum(np.round((high - low) / cell).astype(int), 1)
    scale = max(1, int(np.ceil(max(size[right], size[up]) / _MOST)))
    image = np.full((-(-size[up] // scale), -(-size[right] // scale), 3), 255, dtype=np.uint8)
    order = np.argsort(points[:, near], kind="stable")
    at = np.floor((points[order] - low) / cell).astype(int)
    inside = ((at >= 0) & (at < size)).all(axis=1)
    at, order = at[inside], order[inside]
    depth = (points[order, near] - low[near]) / max(high[near] - low[near], cell)
    shaded = colors[order] * (0.62 + 0.38 * depth[:, None])
    image[image.shape[0] - 1 - at[:, up] // scale, at[:, right] // scale] = shaded.astype(np.uint8)
    return image


def draw_map(path: PathLike, shown: Surface, class_names: Sequence[str], cell: float, *, by: str = "class") -> None:
    """Write a PNG of the top view above the front view, coloured by `class` or by `agent`."""
    draw_stages(path, [("", shown)], class_names, cell, by=by)


def draw_stages(
    path: PathLike, stages: Sequence[tuple[str, Surface]], class_names: Sequence[str], cell: float, *, by: str
) -> None:
    """Write a PNG with the top and front view of each stage side by side, all in the bounds of the last."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    last = stages[-1][1]
    if not len(last.points):
        raise MapError("there is nothing to draw", expected="occupied voxels", got="none")
    bounds = np.stack([last.points.min(axis=0), last.points.max(axis=0)]) + np.array([[-cell / 2], [cell / 2]])
    table = label_colors(class_names) if by == "class" else agent_colors(len(last.agent_names))
    names = class_names if by == "class" else last.agent_names
    span = bounds[1] - bounds[0]
    aspect = span[1] / span[0]
    front = max(3 * span[2] / span[0], 0.12)  # heights three times as large: streets are flat
    width = 12.0 / len(stages) if len(stages) > 1 else 9.0
    figure = Figure(figsize=(width * len(stages), width * (aspect + front) * 0.95 + 1.4), dpi=150, layout="constrained")
    grid = figure.subplots(2, len(stages), squeeze=False, height_ratios=[aspect, front])
    shown: set[int] = set()
    for column, (title, stage) in enumerate(stages):
        ids = stage.labels if by == "class" else np.array(
            [last.agent_names.index(stage.agent_names[a]) for a in stage.agents], dtype=np.int64
        )  # fmt: skip
        shown |= set(np.unique(ids).tolist())
        for row, (axes, name) in enumerate((((0, 1, 2), "top"), ((0, 2, 1), "front, heights x3"))):
            image = view(stage.points * _flip(row), table[ids], cell, axes=axes, bounds=_flipped(bounds, row))
            right, up = axes[0], axes[1]
            extent = (*bounds[:, right].tolist(), *bounds[:, up].tolist())
            axis = grid[row, column]
            axis.imshow(image, extent=extent, interpolation="nearest", aspect=3 if row else 1)
            axis.set_title(" · ".join(filter(None, (title, name))), fontsize=9, pad=4)
            axis.set_xlabel("x, m", fontsize=8)
            axis.set_ylabel("yz"[row] + ", m", fontsize=8)
            axis.tick_params(labelsize=7)
    handles = [Patch(color=table[n] / 255, label=names[n]) for n in sorted(shown)]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 6), fontsize=8, frameon=False)
    _save(figure, path)


def draw_coverage(path: PathLike, grown: Coverage) -> None:
    """Write a PNG of the known ground over time, stacked by the agent that saw it first."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), dpi=150, layout="constrained")
    axis = figure.subplots()
    seconds = grown.times - grown.times.min(initial=grown.times[0] if len(grown.times) else 0.0)
    axis.stackplot(seconds, grown.area.T, labels=grown.agent_names,
                   colors=[tuple(c / 255) for c in agent_colors(len(grown.agent_names))], step="post")  # fmt: skip
    axis.set_xlabel("seconds since the first write")
    axis.set_ylabel("known ground, m² (by who saw it first)")
    axis.margins(x=0)
    axis.legend(loc="upper left", frameon=False)
    _save(figure, path)


def _flip(row: int) -> Float64[np.ndarray, " 3"]:
    """The front view looks along +y: nearer is smaller y."""
    return np.array([1.0, -1.0 if row else 1.0, 1.0])


def _flipped(bounds: Float64[np.ndarray, "2 3"], row: int) -> Float64[np.ndarray, "2 3"]:
    moved = bounds * _flip(row)
    return np.stack([moved.min(axis=0), moved.max(axis=0)])


def _save(figure: object, path: PathLike) -> None:
    with written_file(Path(path)) as scratch:
        figure.savefig(scratch, format="png")  # pyright: ignore[reportAttributeAccessIssue]
