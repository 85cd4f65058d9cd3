"""The objects of the map level by level."""

from typing import TYPE_CHECKING, Any

from openvocab_occ.objects.tree import GROUP, OBJECT, PART, REGION, SceneObject
from openvocab_occ.viewer.markup import block, escape

if TYPE_CHECKING:
    from openvocab_occ.viewer.session import Session

_MOST = 500  # names in the list
_PICK = "choose one"
_PLURAL = {REGION: "regions", GROUP: "groups", OBJECT: "objects", PART: "parts"}


class TreePanel:
    """A browser of levels, and the way from the scene down to the selected object."""

    def __init__(self, session: "Session") -> None:
        self.session = session
        self._ids: dict[str, int] = {}
        gui = session.client.gui
        self.level: Any = gui.add_dropdown("Level", (OBJECT,), initial_value=OBJECT)
        self.level.on_update(lambda _event: self._list())
        self.nodes: Any = gui.add_dropdown("Node", (_PICK,))
        self.nodes.on_update(lambda event: self._open(event.target.value))
        self.way = gui.add_html("")
        self.refresh()

    def refresh(self) -> None:
        """Read the levels of the map anew."""
        tree = self.session.content.scene.objects
        levels = tuple(name for name in (REGION, GROUP, OBJECT, PART) if tree.level(name)) or (OBJECT,)
        self.level.options = levels
        self.level.value = OBJECT if OBJECT in levels else levels[0]
        self._list()
        self.follow(None)

    def follow(self, item: SceneObject | None) -> None:
        """Show the way down to an object, and what it holds; without one, the tree's size."""
        tree = self.session.content.scene.objects
        if item is None:
            counts = [f"{len(tree.level(name))} {_PLURAL[name]}" for name in _PLURAL if tree.level(name)]
            self.way.content = block(", ".join(counts) or "no objects")
            return
        above: list[SceneObject] = []
        node = item
        while node.parent is not None:
            node = tree[node.parent]
            above.insert(0, node)
        lines = [_line(depth, node) for depth, node in enumerate(above)]
        lines += [_line(len(above) + depth, node, bold=depth == 0) for depth, node in tree.walk(item.id)][:30]
        self.way.content = block("".join(lines), small=True)

    def _list(self) -> None:
        nodes = self.session.content.scene.objects.level(self.level.value)
        self._ids = {f"{node.label or node.level} #{node.id}": node.id for node in nodes[:_MOST]}
        self.nodes.options = (_PICK, *self._ids)
        self.nodes.value = _PICK

    def _open(self, name: str) -> None:
        if name in self._ids:
            node = self.session.content.scene.objects[self._ids[name]]
            self.session.select(node.id)
            if len(node.points):
                self.session.go_to(node)


def _line(depth: int, node: SceneObject, *, bold: bool = False) -> str:
    name = escape(f"{node.label or node.level} #{node.id}" if node.id else "scene")
    text = f"<b>{name}</b>" if bold else name
    return f'<div style="padding-left:{10 * depth}px">{text} <span style="opacity:.6">{escape(node.level)}</span></div>'
