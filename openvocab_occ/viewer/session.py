"""What one browser sees: its query, its selection, its colours. The map is shared, nothing else is."""

import logging
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float64

from openvocab_occ.errors import OpenVocabOccError
from openvocab_occ.geometry import Camera
from openvocab_occ.geometry.pose import matrix_from_wxyz
from openvocab_occ.objects.tree import SceneObject
from openvocab_occ.query.find import Answer
from openvocab_occ.viewer.colors import grey_but
from openvocab_occ.viewer.content import Content
from openvocab_occ.viewer.drawing import SELECT_COLOR, draw_boxes, draw_caption
from openvocab_occ.viewer.export_panel import ExportPanel
from openvocab_occ.viewer.find_panel import FindPanel
from openvocab_occ.viewer.layer_panel import LayerPanel
from openvocab_occ.viewer.layers import Layer
from openvocab_occ.viewer.markup import block, provenance_line
from openvocab_occ.viewer.object_panel import ObjectPanel
from openvocab_occ.viewer.points import Eye, Points
from openvocab_occ.viewer.shelf import Shelf
from openvocab_occ.viewer.time_panel import TimePanel
from openvocab_occ.viewer.tools import Tools
from openvocab_occ.viewer.tree_panel import TreePanel
from openvocab_occ.viewer.work import IsCurrent, Lane

if TYPE_CHECKING:
    import viser

FOV = 1.0  # radians, vertical
_WIDE = 660  # pixels of the canvas from which there is room for a second column
_COLUMN = 300  # its width, pixels
_EYE_REST = 0.2  # seconds between two looks at the camera
_log = logging.getLogger(__name__)


class Session:
    """The page of one browser. viser's callbacks come on many threads; all work is done on lanes."""

    def __init__(
        self, client: "viser.ClientHandle", shelf: Shelf, layers: Callable[[Content], list[Layer]], budget: int
    ) -> None:
        """Fill the page with the shelf's first map; `layers` tells what can be shown beside a map."""
        content = shelf.first
        self.client = client
        self.shelf = shelf
        self.layers_of = layers
        self.content = content
        self.selected: int | None = None
        """Id of the object that is shown in detail."""
        self.mode = content.start_mode
        self.voxels_shown = True
        self.colors = np.zeros((len(content.scene.voxels), 3), np.uint8)
        """Of the voxels, as they are shown."""
        self.points = Points(client.scene, content, budget)
        self._eye_lane = Lane(self._failed("points"), rest=_EYE_REST)
        self._lanes = [self._eye_lane]
        self._paint_lane = self.lane("colours")
        self._build()
        client.camera.on_update(lambda _camera: self.look())
        self.repaint()

    def lane(self, what: str, busy: Callable[[bool], None] | None = None) -> Lane:
        """Return a lane for work of a panel; it ends with the session."""
        made = Lane(self._failed(what), busy)
        self._lanes.append(made)
        return made

    @property
    def answer(self) -> Answer | None:
        """The answer that is shown, or None."""
        return self.find.answer

    @property
    def region(self) -> Float64[np.ndarray, "2 3"] | None:
        """Corners of the selected region, metres."""
        return self.tools.region

    def camera(self, width: int, height: int) -> Camera:
        """Return a pinhole camera of this size that sees what the browser sees."""
        view = self.client.camera
        focal = height / 2 / np.tan(view.fov / 2)
        K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = matrix_from_wxyz(np.asarray(view.wxyz, np.float64)), view.position
        return Camera(K, width, height, T)

    def go(self, position: np.ndarray, target: np.ndarray) -> None:
        """Move the camera, level."""
        with self.client.atomic():
            self.client.camera.up_direction = (0.0, 0.0, 1.0)
            self.client.camera.position = np.asarray(position, np.float64)
            self.client.camera.look_at = np.asarray(target, np.float64)

    def go_to(self, item: SceneObject) -> None:
        """Look at an object from the side of the drive."""
        self.time.leave_camera()
        self.go(*self.content.viewpoint(item))

    def overview(self) -> None:
        """Look at the whole map."""
        self.time.leave_camera()
        self.go(*self.content.overview(max(self.client.camera.aspect, 0.5), FOV))

    def above(self) -> None:
        """Look straight down."""
        self.time.leave_camera()
        self.go(*self.content.above(FOV))

    def select(self, id: int | None, *, voxel: int | None = None) -> None:
        """Show an object in detail, or the voxel that was clicked, or nothing."""
        self.selected = id if id in self.content.scene.objects and id != 0 else None
        item = None if self.selected is None else self.content.scene.objects[self.selected]
        self.outline()
        self.object.show(item, voxel)
        self.tree.follow(item)

    def outline(self) -> None:
        """Draw a box around the selected object, and a caption where it has none as a hit."""
        item = None if self.selected is None else self.content.scene.objects[self.selected]
        nodes, margin = self.client.scene, 1.25 * self.content.scene.voxels.voxel_size
        draw_boxes(nodes, "/selection/edges", [] if item is None else [item], SELECT_COLOR, margin)
        if item is None:
            nodes.remove_by_name("/selection/caption")
        elif self.answer is None or item.id not in {hit.object.id for hit in self.answer.hits}:
            draw_caption(nodes, "/selection/caption", item, f"{item.label or item.level} #{item.id}")
        else:
            nodes.remove_by_name("/selection/caption")

    def repaint(self) -> None:
        """Bring colours and legend in line with mode and answer."""
        self._paint_lane.put(self._paint)

    def look(self) -> None:
        """Bring the points in line with the camera."""
        self._eye_lane.put(self._see)

    def change(self, content: Content) -> None:
        """Show another state of the map; the query is asked again."""
        self.content = content
        self.points.change(content)
        self.select(None)
        self.find.refresh()
        self.tree.refresh()
        self.time.refresh()
        self.layers.replace()
        self.about.content = block(provenance_line(content.scene), small=True)
        self.repaint()

    def idle(self) -> bool:
        """Tell whether all work is done."""
        return all(lane.idle() for lane in self._lanes)

    def close(self) -> None:
        """Stop all work: the browser is gone."""
        self.time.stop()
        for lane in self._lanes:
            lane.close()

    def _build(self) -> None:
        gui = self.client.gui
        if len(self.shelf.names) > 1:
            self.maps = gui.add_dropdown("Map", self.shelf.names)
            self.maps.on_update(lambda event: self._open(event.target.value))
            self._map_lane = self.lane("map")
        self.find = FindPanel(self)
        self.layers = LayerPanel(self)
        self.about = gui.add_html(block(provenance_line(self.content.scene), small=True))
        panel = gui.add_panel()
        tab = panel.add_tab("Object")
        with tab:
            self.object = ObjectPanel(self, tab)
        with panel.add_tab("Tree"):
            self.tree = TreePanel(self)
        tab = panel.add_tab("Time")
        with tab:
            self.time = TimePanel(self, tab)
        with panel.add_tab("Layers"):
            self.layers.build_list()
        with panel.add_tab("Export"):
            self.export = ExportPanel(self)
        if self.client.camera.image_width >= _WIDE:
            panel.dock_right()
            panel.set_width(_COLUMN)
        else:
            panel.dock_below(gui.main_panel)
        self.tools = Tools(self)

    def _open(self, name: str) -> None:
        def job(current: IsCurrent) -> None:
            content = self.shelf.content(name)
            if current() and content is not self.content:
                self.change(content)
                self.overview()

        self._map_lane.put(job)

    def _paint(self, current: IsCurrent) -> None:
        answer, scores, stretched = self.find.answer, self.find.scores, self.layers.stretched
        mode, voxels = self.mode, self.content.scene.voxels
        if mode == "relevance" and scores is None:
            self.layers.legend.content = block("Relevance needs a query: type one above.")
            mode = self.content.start_mode
        painted = self.content.painted(mode) if mode != "relevance" else self.find.heat(stretched=stretched)
        colors, emphasis = painted.colors, None
        if answer is not None and answer.verdict != "unknown words":
            emphasis = self._members([hit.object for hit in answer.hits])
            if mode != "relevance":
                colors = grey_but(voxels, colors, emphasis)
        if not current():
            return
        if mode == self.mode:
            self.layers.legend.content = block(painted.legend)
        self.colors = colors
        self.points.paint(colors, emphasis)
        self.points.see(self._eye())

    def _members(self, objects: Sequence[SceneObject]) -> Bool[np.ndarray, " n"]:
        held = np.zeros(len(self.content.scene.voxels), dtype=bool)
        for item in objects:
            held[item.voxels] = True
        return held

    def _see(self, _current: IsCurrent) -> None:
        self.points.see(self._eye())

    def _eye(self) -> Eye:
        camera = self.client.camera
        height = max(camera.image_height, 100)
        return Eye(np.asarray(camera.position, np.float64), height / 2 / np.tan(camera.fov / 2))

    def _failed(self, what: str) -> Callable[[Exception], None]:
        def tell(error: Exception) -> None:
            if isinstance(error, OpenVocabOccError):
                text = str(error)
            else:
                _log.error("%s failed", what, exc_info=error)
                text = f"{type(error).__name__}: {error}"
            self.client.add_notification(f"{what} failed", " ".join(text.split())[:400], color="red")

        return tell
