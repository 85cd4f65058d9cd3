"""The map's points in one browser: which tiles at which level of detail were sent, and in what colours."""

from threading import RLock
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, UInt8

from openvocab_occ.viewer.content import Content
from openvocab_occ.viewer.tiles import BUDGET, choose_levels, distances

if TYPE_CHECKING:
    import viser


class Eye(NamedTuple):
    """Where a browser looks from."""

    position: np.ndarray
    focal_px: float
    """Focal length, pixels."""


class Points:
    """Keeps the points of one browser in line with its camera and colours."""

    def __init__(self, nodes: "viser.SceneApi", content: Content, budget: int = BUDGET) -> None:
        self._nodes = nodes
        self._content = content
        self._budget = budget
        self._lock = RLock()
        self._shown: dict[int, tuple[int, Any]] = {}  # tile: its level and node
        self._colors: np.ndarray | None = None
        self._emphasis: np.ndarray | None = None
        self._visible = True

    @property
    def sent(self) -> int:
        """Points that the browser shows."""
        with self._lock:
            return sum(int(self._content.counts[tile, level]) for tile, (level, _) in self._shown.items())

    @property
    def levels(self) -> dict[int, int]:
        """Level of detail of each tile that is shown."""
        with self._lock:
            return {tile: level for tile, (level, _) in self._shown.items()}

    def paint(self, colors: UInt8[np.ndarray, "n 3"], emphasis: Bool[np.ndarray, " n"] | None = None) -> None:
        """Give the voxels other colours; where several share a point, those of `emphasis` are shown."""
        with self._lock:
            self._colors, self._emphasis = colors, emphasis
            for tile, (level, node) in self._shown.items():
                node.colors = colors[self._members(tile, level)]

    def see(self, eye: Eye) -> int:
        """Send what this view needs, nearest first, and take away what it does not; return how many tiles changed."""
        content = self._content
        if not content.tiles:
            return 0
        away = distances(content.bounds, eye.position)
        levels = choose_levels(
            away, content.counts, voxel_size=content.scene.voxels.voxel_size, focal_px=eye.focal_px,
            budget=self._budget,
        )  # fmt: skip
        changed = 0
        for tile in np.argsort(away, kind="stable").tolist():
            level = int(levels[tile])
            with self._lock:
                if self._content is not content:  # another map came meanwhile
                    return changed
                if self._colors is None or self._shown.get(tile, (-1, None))[0] == level:
                    continue
                changed += 1
                if level < 0:
                    self._shown.pop(tile)[1].remove()
                else:
                    self._shown[tile] = (level, self._send(tile, level))
        return changed

    def show(self, visible: bool) -> None:
        """Hide all points, or show them again."""
        with self._lock:
            self._visible = visible
            for _, node in self._shown.values():
                node.visible = visible

    def change(self, content: Content) -> None:
        """Take away all points: another map comes."""
        with self._lock:
            for _, node in self._shown.values():
                node.remove()
            self._shown, self._colors, self._emphasis, self._content = {}, None, None, content

    def _members(self, tile: int, level: int) -> np.ndarray:
        chosen = self._content.tiles[tile]
        return chosen.levels[level].representatives(chosen.voxels, self._emphasis)

    def _send(self, tile: int, level: int) -> Any:
        assert self._colors is not None, "colours come before tiles"
        chosen = self._content.tiles[tile]
        detail = chosen.levels[level]
        return self._nodes.add_point_cloud(
            chosen.name,
            detail.points,
            self._colors[self._members(tile, level)],
            point_size=detail.size,
            point_shape="square",
            point_shading="flat",
            position=chosen.center,
            visible=self._visible,
        )
