"""What one browser shows beside the map: the query box, the answer, the legend. Each browser has its own."""

import logging
import re
import threading
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32

from openvocab_occ.errors import OpenVocabOccError
from openvocab_occ.export.palette import label_colors
from openvocab_occ.export.render import heading
from openvocab_occ.export.semantics import name_voxels
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.tree import SceneObject
from openvocab_occ.query.find import Answer, Hit, find, score_voxels
from openvocab_occ.segmentation.encoder import PixelEncoder
from openvocab_occ.viewer.layers import (
    COLOR_MODES,
    Tile,
    draw_hits,
    draw_map,
    grey_but,
    height_range,
    score_range,
    voxel_colors,
)

if TYPE_CHECKING:
    import viser

CAPTIONED = 3
"""Hits with label and score in the scene; those after them have their rank only, since captions overlap from afar."""
LISTED = 8
"""Hits in the list."""
BOXED = 50
"""Hits with a box in the scene."""
_KNOWN_SHOWN = 20
_WELCOME = "Type what you look for and press Enter."
_log = logging.getLogger(__name__)


def escape(text: str) -> str:
    """Return text as markdown that shows exactly these letters: no markup, no HTML, one line.

    viser puts raw HTML of markdown into the page, so every letter that could begin some is written by its number.
    """
    line = " ".join(str(text).split())
    return re.sub(r"[^\w\s]|_", lambda found: f"&#{ord(found[0])};", line)


def answer_line(answer: Answer) -> str:
    """Say in one line of markdown how many objects answer, how surely, and what was not understood."""
    took = f"{1000 * answer.seconds:.0f} ms"
    unknown = ", ".join(escape(word) for word in answer.unknown)
    if answer.hits:
        count = len(answer.hits)
        line = f"**{count} object{'s' * (count != 1)}**, {took}, threshold {answer.threshold:.2f}"
        undecided = sum(hit.undecided for hit in answer.hits)
        line += f"  \n{undecided} undecided: not all that was asked was observed" if undecided else ""
        return line + (f"  \nnot understood: {unknown}" if unknown else "")
    if answer.verdict == "unknown words":
        known = ", ".join(escape(word) for word in answer.known[:_KNOWN_SHOWN])
        return f"**not understood:** {unknown}" + (f"  \nthis map knows: {known}" if known else "")
    best = "no objects in this map" if answer.best is None else f"best {answer.best:.2f} below {answer.threshold:.2f}"
    return f"**{escape(answer.verdict)}:** {best}, {took}" + (f"  \nnot understood: {unknown}" if unknown else "")


def hit_table(scene: SceneMap, hits: list[Hit]) -> str:
    """Return the first hits as a table of markdown: rank, object, score, size, distance from the drive."""
    rows = ["| | object | score | size, m | range |", "|-:|:-|-:|-:|-:|"]
    for rank, hit in enumerate(hits[:LISTED], start=1):
        size = "×".join(f"{edge:.1f}" for edge in hit.object.box.size)
        away = distance_to_path(scene, hit.object)
        rows.append(
            f"| {rank} | {escape(hit.object.label)}&nbsp;#{hit.object.id} | {hit.score:.2f} | {size} |"
            f" {'' if away is None else f'{away:.0f}&nbsp;m'} |"
        )
    rest = len(hits) - LISTED
    return "\n".join(rows) + (f"\n\nand {rest} more" if rest > 0 else "")


def distance_to_path(scene: SceneMap, item: SceneObject) -> float | None:
    """Return the metres from an object's centre to the nearest pose of the ego; None where the map has no frames."""
    path = np.array([frame.T_world_ego[:3, 3] for frame in scene.frames])
    return float(np.linalg.norm(path - np.asarray(item.center), axis=1).min()) if len(path) else None


def provenance_line(scene: SceneMap) -> str:
    """Say what the map was made from; synthetic input is named as such."""
    facts = [
        f"{len(scene.voxels):,} voxels of {scene.voxels.voxel_size:g} m",
        f"{len(scene.objects)} objects",
        f"{len(scene.frames)} frame{'s' * (len(scene.frames) != 1)}",
        f"encoder {escape(scene.encoder.name)}",
    ]
    made = scene.provenance
    facts = [escape(word) for word in (made.source, made.name) if word] + facts
    return ("**Synthetic input.** " if made.synthetic else "") + ", ".join(facts)


class Panel:
    """The controls of one browser and what it alone sees.

    viser runs callbacks on many threads at once. Work is done under a lock, and a query that was overtaken by a newer
    one while it waited or ran shows nothing.
    """

    def __init__(
        self,
        client: "viser.ClientHandle",
        scene: SceneMap,
        tiles: list[Tile],
        encoder: PixelEncoder | None,
        mode: str,
    ) -> None:
        self.client = client
        self.scene = scene
        self.tiles = tiles
        self.encoder = encoder
        self.answer: Answer | None = None
        """Of the query that is shown."""
        self._scores: Float32[np.ndarray, " n"] | None = None
        self._work = threading.Lock()
        self._ticket = 0
        self._clouds: list[Any] = []
        self._drawn: list[Any] = []
        self._build(mode)

    def ask(self, text: str) -> None:
        """Answer a query and show it; an empty one clears the last answer."""
        self._ticket += 1
        ticket = self._ticket
        with self._work:
            if ticket != self._ticket:
                return
            try:
                answer = find(self.scene, text, self.encoder) if text.strip() else None
                scores = (
                    score_voxels(self.scene, text, self.encoder)
                    if answer is not None and answer.verdict != "unknown words"
                    else None
                )
            except OpenVocabOccError as error:
                self.status.content = f"**cannot answer:** {escape(str(error))}"
                return
            except Exception as error:  # a viewer outlives any query; the log has the rest
                _log.exception("query %r failed", text)
                self.status.content = f"**failed:** {escape(f'{type(error).__name__}: {error}')}"
                return
            if ticket == self._ticket:
                self.answer, self._scores = answer, scores
                self._show()

    def recolor(self, mode: str) -> None:
        """Show the map in other colours."""
        with self._work:
            self._paint(mode)

    def go_to(self, item: SceneObject) -> None:
        """Move this browser's camera so that it looks at an object from the side of the drive."""
        target = np.asarray(item.center, np.float64)
        path = np.array([frame.T_world_ego[:3, 3] for frame in self.scene.frames])
        away = -heading(self.scene)
        if len(path):
            nearest = path[np.linalg.norm(path - target, axis=1).argmin()] - target
            nearest[2] = 0.0
            length = float(np.linalg.norm(nearest))
            away = nearest / length if length > 1.0 else away
        distance = max(8.0, 2.5 * float(np.max(item.box.size)))
        with self.client.atomic():
            self.client.camera.position = target + distance * (0.9 * away + np.array([0.0, 0.0, 0.45]))
            self.client.camera.look_at = target

    def _build(self, mode: str) -> None:
        gui = self.client.gui
        with gui.add_form(None) as form:
            self.query = gui.add_text("Find", "", hint="words, then Enter; empty to clear")
        form.on_submit(lambda _event: self.ask(self.query.value))
        self.status = gui.add_markdown(_WELCOME)
        self.hits = gui.add_markdown("", visible=False)
        self.buttons: Any = None
        self.mode = gui.add_dropdown("Colour", COLOR_MODES, initial_value=mode)
        self.mode.on_update(lambda _event: self.recolor(self.mode.value))
        with gui.add_folder("Legend"):
            self.legend = gui.add_markdown(self._legend(mode))
        gui.add_markdown(provenance_line(self.scene))

    def _show(self) -> None:
        """Bring panel and scene in line with the answer."""
        hits = [] if self.answer is None else list(self.answer.hits)
        with self.client.atomic():
            self.status.content = _WELCOME if self.answer is None else answer_line(self.answer)
            self.hits.content = hit_table(self.scene, hits) if hits else ""
            self.hits.visible = bool(hits)
            self._offer(hits)
            for node in self._drawn:
                node.remove()
            captions = [
                f"{rank} {hit.object.label} {hit.score:.2f}" for rank, hit in enumerate(hits[:CAPTIONED], start=1)
            ]
            captions += [str(rank) for rank in range(CAPTIONED + 1, min(len(hits), LISTED) + 1)]
            margin = 0.75 * self.scene.voxels.voxel_size  # clear of the squares, which turn to the camera
            self._drawn = draw_hits(self.client.scene, [hit.object for hit in hits[:BOXED]], captions, margin)
            self._paint(self.mode.value)

    def _offer(self, hits: list[Hit]) -> None:
        """Make a button for each listed hit."""
        if self.buttons is not None:
            self.buttons.remove()
            self.buttons = None
        if hits:
            names = tuple(str(rank) for rank in range(1, min(len(hits), LISTED) + 1))
            self.buttons = self.client.gui.add_button_group("Go to", names, order=self.hits.order + 1e-3)
            self.buttons.on_click(lambda event: self.go_to(hits[int(event.target.value) - 1].object))

    def _paint(self, mode: str) -> None:
        if mode == "relevance" and self._scores is None:
            self.legend.content = "Relevance needs a query: type one above."
            return
        colors = voxel_colors(self.scene, mode, self._scores)
        if mode != "relevance" and self.answer is not None and self.answer.verdict != "unknown words":
            colors = grey_but(colors, [hit.object for hit in self.answer.hits])
        with self.client.atomic():
            self.legend.content = self._legend(mode)
            if self._clouds:
                for tile, cloud in zip(self.tiles, self._clouds, strict=True):
                    cloud.colors = colors[tile.voxels]
            else:
                self._clouds = draw_map(self.client.scene, self.tiles, colors, self.scene.voxels.voxel_size)

    def _legend(self, mode: str) -> str:
        if mode == "image":
            return "The mean colour that the cameras saw; black where none did."
        if mode == "height":
            low, high = height_range(self.scene)
            return f"Height from {low:.1f} m (violet) to {high:.1f} m (yellow)."
        if mode == "relevance" and self._scores is not None:
            low, high = score_range(self._scores)
            return f"Score from {low:.2f} (grey) to {high:.2f} (yellow)."
        semantics = name_voxels(self.scene)
        counts = np.bincount(semantics.labels[semantics.labels >= 0], minlength=len(semantics.names))
        colors = label_colors(semantics.names)
        return "  \n".join(
            f'<span style="color:#{bytes(colors[label]).hex()}">&#9632;</span> {escape(semantics.names[label])}'
            for label in np.argsort(-counts, kind="stable")
            if counts[label]
        )
