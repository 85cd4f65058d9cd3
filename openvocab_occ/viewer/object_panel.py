"""The selected object or voxel: what is known of it, its best pictures, and what stands around it."""

from typing import TYPE_CHECKING, Any

from openvocab_occ.objects.tree import SceneObject
from openvocab_occ.viewer.descriptions import object_facts, object_json, relatives, voxel_facts
from openvocab_occ.viewer.markup import block, escape, facts
from openvocab_occ.viewer.pictures import best_views
from openvocab_occ.viewer.work import IsCurrent

if TYPE_CHECKING:
    from openvocab_occ.viewer.session import Session

_NOTHING = block("Click an object or a voxel of the map.")
_AROUND = "go to what is around it"


class ObjectPanel:
    """Details of what one browser has selected."""

    def __init__(self, session: "Session", tab: Any) -> None:
        self.session = session
        self._tab = tab  # where a picture goes that comes later
        self.item: SceneObject | None = None
        self.voxel: int | None = None
        self._targets: dict[str, int] = {}
        gui = session.client.gui
        self.title = gui.add_html(_NOTHING)
        self.picture: Any = None
        self.note = gui.add_html("", visible=False)
        self.facts = gui.add_html("", visible=False)
        self.around: Any = gui.add_dropdown("Around", (_AROUND,), visible=False)
        self.around.on_update(lambda event: self._visit(event.target.value))
        self.buttons = gui.add_button_group("Object", ("look at", "find similar", "JSON"), visible=False)
        self.buttons.on_click(lambda event: self._press(event.target.value))
        with gui.add_folder("Voxel", visible=False) as self.voxel_folder:
            self.voxel_facts = gui.add_html("")
        self.lane = session.lane("details")

    def show(self, item: SceneObject | None, voxel: int | None = None) -> None:
        """Show an object, the voxel that was clicked, or neither."""
        self.item, self.voxel = item, voxel
        self.lane.put(self._fill)

    def _fill(self, current: IsCurrent) -> None:
        item, voxel, content = self.item, self.voxel, self.session.content
        rows = [] if item is None else object_facts(content, item)
        around = {} if item is None else dict(relatives(content.scene, item))
        inspected = "" if voxel is None else facts(voxel_facts(content, voxel))
        if not current():
            return
        with self.session.client.atomic():
            self.title.content = _NOTHING if item is None and voxel is None else block(_title(item))
            self.facts.content, self.facts.visible = facts(rows), item is not None
            self._targets = around
            self.around.options = (_AROUND, *around)
            self.around.value = _AROUND
            self.around.visible, self.buttons.visible = bool(around), item is not None
            self.voxel_facts.content, self.voxel_folder.visible = inspected, voxel is not None
            self._forget_picture()
        if item is None:
            return
        picture, note = best_views(content, item)
        if current() and picture is not None:
            order = self.title.order + 1e-3
            with self._tab:
                self.picture = self.session.client.gui.add_image(picture, format="jpeg", jpeg_quality=85, order=order)
        if current():
            self.note.content, self.note.visible = block(escape(note), small=True), bool(note)

    def _forget_picture(self) -> None:
        self.note.visible = False
        if self.picture is not None:
            self.picture.remove()
            self.picture = None

    def _visit(self, name: str) -> None:
        if name in self._targets:
            node = self.session.content.scene.objects[self._targets[name]]
            self.session.select(node.id)
            self.session.go_to(node)

    def _press(self, name: str) -> None:
        item = self.item
        if item is None:
            return
        if name == "look at":
            self.session.go_to(item)
        elif name == "find similar":
            self.session.find.query.value = f"anything like #{item.id}"
            self.session.find.ask(f"anything like #{item.id}")
        else:
            self._offer_json(item)

    def _offer_json(self, item: SceneObject) -> None:
        """Open a window with the object as JSON and a button that copies it."""
        gui = self.session.client.gui
        copy = "navigator.clipboard.writeText(this.nextElementSibling.textContent);this.textContent='copied'"
        with gui.add_modal(f"Object {item.id}") as modal:
            gui.add_html(
                f'<button onclick="{copy}" style="padding:2px 10px;margin-bottom:6px">Copy JSON</button>'
                '<pre style="max-height:55vh;overflow:auto;font-size:11px;white-space:pre-wrap">'
                f"{_escape_lines(object_json(item))}</pre>"
            )
            gui.add_button("Close").on_click(lambda _event: modal.close())


def _title(item: SceneObject | None) -> str:
    if item is None:
        return "<b>Voxel in no object</b>"
    return f'<b style="font-size:14px">{escape(item.label or item.level)} #{item.id}</b>'


def _escape_lines(text: str) -> str:
    return "\n".join(line[: len(line) - len(line.lstrip())] + escape(line) for line in text.splitlines())
