"""What the pointer does in the scene: pick, measure, select a region; and the keys."""

from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from openvocab_occ.export.render import render_map
from openvocab_occ.mapping.picking import Pick
from openvocab_occ.objects.box import Box
from openvocab_occ.viewer.drawing import MEASURE_COLOR, SELECT_COLOR, box_edges
from openvocab_occ.viewer.work import IsCurrent

if TYPE_CHECKING:
    from openvocab_occ.viewer.session import Session

_RECT_PX = 320  # width of the picture in which a rectangle is looked up
_REACH = 300.0  # metres


class Tools:
    """Pointer and keys of one browser."""

    def __init__(self, session: "Session") -> None:
        self.session = session
        self.region: Float64[np.ndarray, "2 3"] | None = None
        """Corners of the selected region, metres; its voxels lie inside."""
        self.measured: float | None = None
        """Metres between the last two points."""
        self._first: Pick | None = None
        self._measuring = Lock()
        self.lane = session.lane("selection")
        scene = session.client.scene
        scene.on_click()(self._click)
        scene.on_click(modifier="shift")(self._measure)
        scene.on_rect_select(modifier="cmd/ctrl")(self._rectangle)
        self._keys()

    def clear_region(self) -> None:
        """Select no region."""
        self.region = None
        self.session.client.scene.remove_by_name("/region")
        self.session.find.only_region.value = False

    def select_region(self, low: np.ndarray, high: np.ndarray) -> None:
        """Select the voxels in a box; its sides stand along the world's axes."""
        self.region = np.array([low, high], np.float64)
        box = Box((self.region[0] + self.region[1]) / 2, self.region[1] - self.region[0], 0.0)
        nodes = self.session.client.scene
        nodes.add_line_segments("/region/edges", box_edges(box), SELECT_COLOR, thickness=2.0, thickness_units="screen")
        inside = [o for o in self.session.content.scene.objects if bool(box.contains(o.center[None])[0])]
        size = " × ".join(f"{edge:.1f}" for edge in box.size)
        text = f"region {size} m, {len(inside)} object{'s' * (len(inside) != 1)}"
        top = box.center + np.array([0, 0, box.size[2] / 2 + 0.5])
        nodes.add_label("/region/caption", text, position=top, anchor="bottom-center")
        self.session.find.only_region.value = True

    def _click(self, event: Any) -> None:
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)

        def job(current: IsCurrent) -> None:
            pick = self.session.content.picker.pick(origin, direction)
            if pick is not None and current():
                self.session.select(int(self.session.content.owner[pick.voxel]), voxel=pick.voxel)
            elif current():
                self._reset()

        self.lane.put(job)

    def _reset(self) -> None:
        """A click beside the map lets go of everything."""
        self.session.select(None)
        self._first = self.measured = None
        self.session.client.scene.remove_by_name("/measure")
        if self.region is not None:
            self.clear_region()

    def _measure(self, event: Any) -> None:
        pick = self.session.content.picker.pick(np.array(event.ray_origin), np.array(event.ray_direction))
        if pick is None:
            return
        nodes = self.session.client.scene
        with self._measuring:  # not on the lane, which would drop the first of two quick clicks
            first, self._first = self._first, None if self._first else pick
            if first is None:
                nodes.remove_by_name("/measure")
                nodes.add_label("/measure/start", "from here: Shift-click again", position=pick.point)
                return
            a, b = first.point, pick.point
            self.measured = float(np.linalg.norm(b - a))
            text = f"{self.measured:.2f} m  (level {np.linalg.norm((b - a)[:2]):.2f}, up {b[2] - a[2]:+.2f})"
            nodes.remove_by_name("/measure/start")
            line = np.array([[a, b]], np.float32)
            nodes.add_line_segments("/measure/line", line, MEASURE_COLOR, thickness=4.0, thickness_units="screen")
            nodes.add_label("/measure/text", text, position=(a + b) / 2, anchor="bottom-center")

    def _rectangle(self, event: Any) -> None:
        low, high = np.array(event.screen_min), np.array(event.screen_max)

        def job(current: IsCurrent) -> None:
            aspect = max(self.session.client.camera.aspect, 0.2)
            height = max(int(_RECT_PX / aspect), 16)
            view = render_map(self.session.content.scene, self.session.camera(_RECT_PX, height), _REACH)
            size = np.array([_RECT_PX, height])
            (left, top), (right, bottom) = (np.clip(np.round(np.array([low, high]) * size), 0, size)).astype(int)
            seen = view.voxel[top : max(bottom, top + 1), left : max(right, left + 1)]
            voxels = np.unique(seen[seen >= 0])
            if not current():
                return
            if not len(voxels):
                self.clear_region()
                return
            centers = self.session.content.scene.voxels.centers[voxels]
            half = self.session.content.scene.voxels.voxel_size / 2
            self.select_region(centers.min(axis=0) - half, centers.max(axis=0) + half)

        self.lane.put(job)

    def _keys(self) -> None:
        session = self.session
        moves: list[tuple[str, Any, Any]] = [
            ("Next hit", "N", lambda: session.find.step(1)),
            ("Previous hit", "P", lambda: session.find.step(-1)),
            ("Heat map on or off", "H", session.layers.toggle_heat),
            ("Overview", "O", session.overview),
            ("From above", "B", session.above),
            ("Look through the camera", "C", session.time.look_through),
            ("Next frame", "K", lambda: session.time.step(1)),
            ("Previous frame", "J", lambda: session.time.step(-1)),
            ("Export the view", "E", lambda: session.export.download("view bundle")),
            ("Clear query", "X", lambda: session.find.ask("")),
        ]
        for label, key, act in moves:
            command = session.client.gui.add_command(label, hotkey=key)
            command.on_trigger(lambda _event, act=act: act())
