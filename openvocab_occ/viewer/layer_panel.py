"""Colours with their legend, and the list of layers."""

from typing import TYPE_CHECKING, Any

from openvocab_occ.viewer.colors import COLOR_MODES
from openvocab_occ.viewer.layers import ChangesLayer, Layer
from openvocab_occ.viewer.markup import block, escape
from openvocab_occ.viewer.work import IsCurrent

if TYPE_CHECKING:
    from openvocab_occ.viewer.session import Session

_NONE = "no other map"


class LayerPanel:
    """What is drawn, and how it is coloured, in one browser."""

    def __init__(self, session: "Session") -> None:
        self.session = session
        self._layers: list[Layer] = []
        self._boxes: list[Any] = []
        self._legends: list[Any] = []
        self._lanes: list[Any] = []
        self._changes: list[Layer] = []
        self._compare_lane = session.lane("comparison")
        self._folder: Any = None
        self._before_heat = session.mode
        gui = session.client.gui
        with gui.add_folder("Colour"):
            self.mode = gui.add_dropdown("Show", COLOR_MODES, initial_value=session.mode)
            self.mode.on_update(lambda _event: self._set_mode(self.mode.value))
            self._stretched = gui.add_checkbox(
                "Stretch", False, hint="relevance from the least to the greatest score, not from 0 to 1",
                visible=session.mode == "relevance",
            )  # fmt: skip
            self._stretched.on_update(lambda _event: session.repaint())
            self.legend = gui.add_html(block(""))

    @property
    def stretched(self) -> bool:
        """Whether heat runs from the least to the greatest score."""
        return bool(self._stretched.value)

    @property
    def switches(self) -> list[Any]:
        """The checkbox of each layer."""
        return list(self._boxes)

    def build_list(self) -> None:
        """Make the tab: a switch for each layer, and the look of the page."""
        gui = self.session.client.gui
        self._holder = gui.add_folder("Layers")
        self._fill()
        others = self.session.shelf.names if len(self.session.shelf.names) > 1 else ()
        self.compare: Any = gui.add_dropdown("Compare with", (_NONE, *others), visible=bool(others))
        self.compare.on_update(lambda _event: self._compare())
        with gui.add_folder("Page"):
            self.voxels = gui.add_checkbox("Voxels of the map", True)
            self.voxels.on_update(lambda _event: self._show_voxels())
            self.dark = gui.add_checkbox("Dark", False)
            self.dark.on_update(lambda _event: theme(gui, dark=self.dark.value))
        keys = "N P next, previous hit · H heat map · O overview · B from above · C through the camera · J K frame · "
        gui.add_html(block(escape(keys + "E export the view · Ctrl+K all commands") + "<br>click: object or voxel · "
                           "Shift-click twice: distance · Ctrl-drag: region", small=True))  # fmt: skip

    def replace(self) -> None:
        """Show the layers of the session's map anew; those of a name that was on stay on."""
        on = {layer.name: bool(box.value) for layer, box in zip(self._layers, self._boxes, strict=True)}
        for number in range(len(self._layers)):
            self.session.client.scene.remove_by_name(f"/layers/{number}")
        for handle in (*self._boxes, *self._legends):
            handle.remove()
        self._fill(on)

    def _show_voxels(self) -> None:
        self.session.voxels_shown = bool(self.voxels.value)
        self.session.points.show(self.session.voxels_shown)

    def toggle_heat(self) -> None:
        """Change between relevance and the colours before."""
        self.mode.value = self._before_heat if self.session.mode == "relevance" else "relevance"

    def _compare(self) -> None:
        """Offer what differs from the map that was chosen."""

        def job(current: IsCurrent) -> None:
            name = self.compare.value
            earlier = None if name == _NONE else self.session.shelf.content(name).scene
            if current():
                self._changes = [] if earlier is None else [ChangesLayer(self.session.content.scene, earlier)]
                self.replace()

        self._compare_lane.put(job)

    def _fill(self, on: dict[str, bool] | None = None) -> None:
        layers = [*self._changes, *self.session.layers_of(self.session.content)]
        self._layers, self._boxes, self._legends = layers, [], []
        gui = self.session.client.gui
        with self._holder:
            for number, layer in enumerate(layers):
                shown = (on or {}).get(layer.name, layer.shown)
                box = gui.add_checkbox(layer.name, shown)
                self._boxes.append(box)
                self._legends.append(gui.add_html("", visible=False))
                if number == len(self._lanes):
                    self._lanes.append(self.session.lane(f"layer {number + 1}"))
                box.on_update(lambda event, number=number: self._switch(number, event.target.value))
                if shown:
                    self._switch(number, True)

    def _switch(self, number: int, on: bool) -> None:
        layer, legend, nodes = self._layers[number], self._legends[number], self.session.client.scene
        folder = f"/layers/{number}"

        def job(current: IsCurrent) -> None:
            nodes.remove_by_name(folder)
            text = ""
            if on:
                nodes.add_frame(folder, show_axes=False)
                text = layer.draw(nodes, folder)
                if not current():
                    nodes.remove_by_name(folder)
                    return
            legend.content, legend.visible = block(text, small=True), bool(text)

        self._lanes[number].put(job)

    def _set_mode(self, mode: str) -> None:
        if mode == "relevance" and self.session.mode != "relevance":
            self._before_heat = self.session.mode
        self.session.mode = mode
        self._stretched.visible = mode == "relevance"
        self.session.repaint()


def theme(gui: Any, *, dark: bool = False) -> None:
    """Set the look of the page, for the server's gui or one browser's."""
    gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(0, 114, 178), dark_mode=dark)
