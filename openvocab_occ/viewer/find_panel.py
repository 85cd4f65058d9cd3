"""The question and its answer: typed words, the line that tells, the ranked list, why, and how to refine."""

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32

from openvocab_occ.errors import OpenVocabOccError
from openvocab_occ.pipeline.combine import crop
from openvocab_occ.query import algebra as q
from openvocab_occ.query.answer import Hit
from openvocab_occ.query.find import Answer, find, parsed_query, score_voxels
from openvocab_occ.viewer.colors import Painted, paint_voxels
from openvocab_occ.viewer.drawing import HIT_COLOR, draw_boxes, draw_caption
from openvocab_occ.viewer.markup import LISTED, answer_line, block, escape, hit_table, preformatted
from openvocab_occ.viewer.work import IsCurrent

if TYPE_CHECKING:
    from openvocab_occ.viewer.session import Session

CAPTIONED = 3
"""Hits with label and score in the scene; those after them have their rank only, since captions overlap from afar."""
BOXED = 50
"""Hits with a box in the scene."""
_REMEMBERED = 20
_WELCOME = block("Type what you look for and press Enter.")
_PAST = "earlier queries"


class FindPanel:
    """The query of one browser and what it found."""

    def __init__(self, session: "Session") -> None:
        self.session = session
        self.answer: Answer | None = None
        self.scores: Float32[np.ndarray, " n"] | None = None
        """Of each voxel; None without an answer."""
        self.text = ""
        """Of the query that was asked last."""
        self._threshold: float | None = None
        self._current = -1  # hit that was gone to last
        self._captions = 0
        self._moving_slider = False
        gui = session.client.gui
        with gui.add_form(None) as form:
            self.query = gui.add_text("Find", "", hint="words, then Enter; empty to clear")
        form.on_submit(lambda _event: self.ask(self.query.value))
        names = examples(session)
        if names:
            self.examples = gui.add_button_group("Try", names)
            self.examples.on_click(lambda event: self._fill(event.target.value))
        self.status = gui.add_html(_WELCOME)
        self.progress = gui.add_progress_bar(100.0, animated=True, visible=False)
        self.list = gui.add_html("", visible=False)
        self.buttons: Any = None
        with gui.add_folder("Refine", expand_by_default=False):
            self.without = gui.add_text("Without", "", hint="what a hit must not be, such as: car | bus")
            self.without.on_update(lambda _event: self.ask(self.text) if self.text else None)
            self.threshold = gui.add_slider("Threshold", 0.0, 1.0, 0.01, 0.5, hint="least score of a hit")
            self.threshold.on_update(lambda _event: self._set_threshold())
            self.reset = gui.add_button("Threshold of the model", disabled=True)
            self.reset.on_click(lambda _event: self._set_threshold(None))
            self.only_region = gui.add_checkbox("Only in the region", False, hint="drag with Ctrl to select one")
            self.only_region.on_update(lambda _event: self.ask(self.text) if self.text else None)
            self.history: Any = gui.add_dropdown("History", (_PAST,))
            self.history.on_update(
                lambda event: self._fill(event.target.value) if event.target.value != _PAST else None
            )
        with gui.add_folder("Why", expand_by_default=False, visible=False) as self.why:
            self.reasons = gui.add_html("")
        self.lane = session.lane("query", self._busy)

    def ask(self, text: str) -> None:
        """Answer a query and show it; an empty one clears the last answer. Returns at once; the latest wins."""
        self.text = text.strip()
        self.lane.put(lambda current: self._ask(text.strip(), current))

    def refresh(self) -> None:
        """Ask again: the map is another."""
        self.answer, self.scores = None, None
        self.ask(self.text)

    def heat(self, *, stretched: bool) -> Painted:
        """Return the colours of the scores."""
        return paint_voxels(self.session.content.scene, "relevance", self.scores, stretched=stretched)

    def step(self, by: int) -> None:
        """Go to the next or previous hit."""
        hits = self.answer.hits if self.answer else ()
        if hits:
            self._current = (self._current + by) % len(hits) if self._current >= 0 else (0 if by > 0 else len(hits) - 1)
            self._visit(hits[self._current])

    def _ask(self, text: str, current: IsCurrent) -> None:
        scene, encoder = self.session.content.scene, self.session.content.encoder
        answer, scores = None, None
        try:
            if text:
                answer, scores = self._answered(text)
        except OpenVocabOccError as error:
            if current():
                self.status.content = block(f"<b>cannot answer:</b> {escape(error)}")
            return
        except Exception as error:
            if current():
                self.status.content = block(f"<b>failed:</b> {escape(f'{type(error).__name__}: {error}')}")
            raise
        if not current() or scene is not self.session.content.scene or encoder is not self.session.content.encoder:
            return
        self.answer, self.scores = answer, scores
        self._remember(text)
        self._show()

    def _answered(self, text: str) -> tuple[Answer, Float32[np.ndarray, " n"] | None]:
        """Return the answer, with hits as objects of the whole map, and the scores of its voxels."""
        content, region = self.session.content, self.session.region
        scene, query = content.scene, self._query(text)
        inside = region if self.only_region.value else None
        place = scene if inside is None else crop(scene, inside)
        answer = find(place, query, content.encoder, threshold=self._threshold)
        if answer.verdict == "unknown words":
            return answer, None
        scores = score_voxels(scene, query, content.encoder)
        if inside is not None:
            held = ((scene.voxels.centers >= inside[0]) & (scene.voxels.centers < inside[1])).all(axis=1)
            scores = np.where(held, scores, np.float32(0))
        return _in_whole(answer, scene.objects), scores

    def _query(self, text: str) -> Any:
        """Return the text, or its query without what is not wanted."""
        without = self.without.value.strip()
        if not without:
            return text
        scene = self.session.content.scene
        asked, unwanted = parsed_query(scene, text).query, parsed_query(scene, without).query
        if asked is None or unwanted is None:
            return text
        parts: Any = (asked, unwanted)
        return q.checked(q.And((parts[0], q.Not(parts[1]))))

    def _show(self) -> None:
        """Bring panel and scene in line with the answer."""
        answer, client = self.answer, self.session.client
        hits = [] if answer is None else list(answer.hits)
        self._current = -1
        with client.atomic():
            self.status.content = _WELCOME if answer is None else block(answer_line(answer))
            self.list.content = hit_table(self.session.content.scene, hits) if hits else ""
            self.list.visible = bool(hits)
            self.why.visible = answer is not None
            self.reasons.content = "" if answer is None else preformatted(answer.explain())
            self._offer(hits)
            self._mark(hits)
            if answer is not None and self._threshold is None:
                self._place_slider(answer.threshold)
        self.session.outline()
        self.session.repaint()

    def _mark(self, hits: list[Hit]) -> None:
        nodes = self.session.client.scene
        margin = 0.75 * self.session.content.scene.voxels.voxel_size  # clear of the squares, which turn to the camera
        draw_boxes(nodes, "/hits/edges", [hit.object for hit in hits[:BOXED]], HIT_COLOR, margin)
        captions = [f"{rank} {h.object.label or 'object'} {h.score:.2f}" for rank, h in enumerate(hits[:CAPTIONED], 1)]
        captions += [str(rank) for rank in range(CAPTIONED + 1, min(len(hits), LISTED) + 1)]
        for rank, (hit, text) in enumerate(zip(hits, captions, strict=False)):
            draw_caption(nodes, f"/hits/caption_{rank}", hit.object, text)
        for rank in range(len(captions), self._captions):
            nodes.remove_by_name(f"/hits/caption_{rank}")
        self._captions = len(captions)

    def _offer(self, hits: list[Hit]) -> None:
        """Make a button for each listed hit."""
        if self.buttons is not None:
            self.buttons.remove()
            self.buttons = None
        if hits:
            names = tuple(str(rank) for rank in range(1, min(len(hits), LISTED) + 1))
            self.buttons = self.session.client.gui.add_button_group("Go to", names, order=self.list.order + 1e-3)
            self.buttons.on_click(lambda event: self._visit(hits[int(event.target.value) - 1]))

    def _visit(self, hit: Hit) -> None:
        self.session.select(hit.object.id)
        self.session.go_to(hit.object)

    def _fill(self, text: str) -> None:
        self.query.value = text
        self.ask(text)

    def _remember(self, text: str) -> None:
        past = [one for one in self.history.options if one not in (text, _PAST)]
        if text:
            self.history.options = (_PAST, text, *past[: _REMEMBERED - 1])
            self.history.value = _PAST

    def _set_threshold(self, *value: float | None) -> None:
        if self._moving_slider:
            return
        self._threshold = value[0] if value else float(self.threshold.value)
        self.reset.disabled = self._threshold is None
        if self.text:
            self.ask(self.text)

    def _place_slider(self, threshold: float) -> None:
        """Move the slider without asking again."""
        self._moving_slider = True
        self.threshold.value = float(np.clip(threshold, 0.0, 1.0))
        self._moving_slider = False

    def _busy(self, busy: bool) -> None:
        self.progress.visible = busy


def examples(session: "Session") -> tuple[str, ...]:
    """Return up to three queries that this map can answer: what stands parked, and the commonest other things."""
    objects = list(session.content.scene.objects)
    parked = Counter(item.label for item in objects if item.state == "parked" and item.label)
    common = [label for label, _ in Counter(item.label for item in objects if item.label).most_common(6)]
    first = [label for label in parked if label == "truck"] or [label for label, _ in parked.most_common(1)]
    found = [f"parked {label}s" for label in first] + [label for label in common if label not in first]
    return tuple(found[:3])


def _in_whole(answer: Answer, objects: Any) -> Answer:
    """Return an answer about a part of a map with hits as objects of the whole."""
    return replace(answer, hits=tuple(replace(hit, object=objects[hit.object.id]) for hit in answer.hits))
