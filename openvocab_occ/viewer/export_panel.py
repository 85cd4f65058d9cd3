"""Files to take away, and views to come back to."""

import json
import re
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool

from openvocab_occ.viewer.downloads import FORMATS, converted, view_bundle
from openvocab_occ.viewer.markup import LISTED, block, escape
from openvocab_occ.viewer.stage import staged
from openvocab_occ.viewer.work import IsCurrent

if TYPE_CHECKING:
    from openvocab_occ.viewer.session import Session

_WHOLE, _HITS, _OBJECT, _REGION = "whole map", "hits", "object", "region"
_BUNDLE_SIZE = (1024, 576)
_NONE = "choose one"
_RENDER_SECONDS = 60.0
_MOST_VIEWS = 50


class ExportPanel:
    """Downloads and saved views of one browser."""

    def __init__(self, session: "Session") -> None:
        self.session = session
        self._views: dict[str, dict[str, Any]] = {}
        gui = session.client.gui
        with gui.add_folder("This view"):
            self.view_buttons = [
                gui.add_button(text) for text in ("View bundle", "Picture", "Page (HTML)", "Recording")
            ]
            for button, what in zip(self.view_buttons, ("view bundle", "picture", "page", "recording"), strict=True):
                button.on_click(lambda _event, what=what: self.download(what))
        with gui.add_folder("Map"):
            self.what = gui.add_dropdown("Of", (_WHOLE, _HITS, _OBJECT, _REGION))
            self.format = gui.add_dropdown("As", FORMATS)
            gui.add_button("Download").on_click(lambda _event: self.download("map"))
        self.status = gui.add_html("", visible=False)
        self.progress = gui.add_progress_bar(100.0, animated=True, visible=False)
        with gui.add_folder("Saved views"):
            self.name = gui.add_text("Name", "")
            self.names: Any = gui.add_dropdown("View", (_NONE,))
            self.names.on_update(lambda event: self.restore(event.target.value))
            self.buttons = gui.add_button_group("Views", ("save", "delete"))
            self.buttons.on_click(lambda event: self._press(event.target.value))
        self.lane = session.lane("export", self._busy)
        self._storage_lane = session.lane("saved views")
        self._storage_lane.put(self._read)

    def download(self, what: str) -> None:
        """Make a file and hand it to the browser."""
        self.lane.put(lambda current: self._download(what, current))

    def save(self, name: str) -> None:
        """Remember camera, query, selection, colours and frame under a name, in the browser's own store."""
        session, camera = self.session, self.session.client.camera
        self._views.pop(name, None)
        self._views[name] = {
            "position": np.asarray(camera.position).tolist(),
            "look_at": np.asarray(camera.look_at).tolist(),
            "fov": float(camera.fov),
            "query": session.find.text,
            "selected": session.selected,
            "mode": session.mode,
            "frame": int(session.time.frame.value),
        }
        while len(self._views) > _MOST_VIEWS:
            self._views.pop(next(iter(self._views)))
        self._write()

    def restore(self, name: str) -> None:
        """Go back to a saved view."""
        view = self._views.get(name)
        if view is None:
            return
        session = self.session
        session.go(np.array(view["position"]), np.array(view["look_at"]))
        session.client.camera.fov = view["fov"]
        session.layers.mode.value = view["mode"]
        session.time.frame.value = view["frame"]
        session.find.query.value = view["query"]
        session.find.ask(view["query"])
        session.select(view["selected"])

    def _download(self, what: str, current: IsCurrent) -> None:
        stem = file_stem(self.session.content.scene.provenance.name or "map")
        if what == "map":
            name, content = converted(self.session.content.scene, self._chosen(), self.format.value, stem)
        elif what == "view bundle":
            name, content = view_bundle(
                self.session.content.scene, self.session.answer, self._bundle_camera(), f"{stem}_view"
            )
        elif what == "picture":
            name, content = f"{stem}.png", self._picture()
        else:
            html = what == "page"
            name, content = f"{stem}.{'html' if html else 'viser'}", self._staged(html=html)
        if not current():
            return
        self.session.client.send_file_download(name, content, save_immediately=True)
        self.status.content = block(f"{escape(name)}, {len(content) / 1e6:.2f} MB", small=True)
        self.status.visible = True

    def _chosen(self) -> Bool[np.ndarray, " n"] | None:
        """Return which voxels are to be exported; None for all."""
        session, scene = self.session, self.session.content.scene
        chosen = np.zeros(len(scene.voxels), dtype=bool)
        match self.what.value:
            case "hits":
                for hit in session.answer.hits if session.answer else ():
                    chosen[hit.object.voxels] = True
            case "object":
                if session.selected is not None:
                    chosen[scene.objects[session.selected].voxels] = True
            case "region":
                if session.region is not None:
                    low, high = session.region
                    chosen = ((scene.voxels.centers >= low) & (scene.voxels.centers < high)).all(axis=1)
            case _:
                return None
        return chosen

    def _bundle_camera(self) -> Any:
        through = self.session.time.looked_through
        return self.session.camera(*_BUNDLE_SIZE) if through is None else through

    def _picture(self) -> bytes:
        import cv2

        camera = self.session.client.camera
        image = self.session.client.get_render(
            camera.image_height, camera.image_width, wxyz=camera.wxyz, position=camera.position, fov=camera.fov,
            transport_format="png", timeout=_RENDER_SECONDS,
        )  # fmt: skip
        light = image[..., :3].astype(np.float32)
        if image.shape[2] == 4:  # on white: the page's ground is not part of the scene
            alpha = image[..., 3:].astype(np.float32) / 255
            light = light * alpha + 255 * (1 - alpha)
        return cv2.imencode(".png", np.ascontiguousarray(light.astype(np.uint8)[..., ::-1]))[1].tobytes()

    def _staged(self, *, html: bool) -> bytes:
        session, camera = self.session, self.session.client.camera
        hits = [] if session.answer is None else list(session.answer.hits[:LISTED])
        captions = [f"{rank} {hit.object.label or 'object'} {hit.score:.2f}" for rank, hit in enumerate(hits, 1)]
        return staged(
            session.content, session.colors, list(zip([hit.object for hit in hits], captions, strict=True)),
            (np.asarray(camera.position), np.asarray(camera.look_at), float(camera.fov)), html=html,
            dark=bool(session.layers.dark.value),
        )  # fmt: skip

    def _press(self, name: str) -> None:
        if name == "save":
            self.save(self.name.value.strip() or f"view {len(self._views) + 1}")
        elif self.names.value in self._views:
            self._views.pop(self.names.value)
            self._write()

    def _list(self) -> None:
        self.names.options = (_NONE, *self._views)
        self.names.value = _NONE

    def _write(self) -> None:
        self._list()
        self.session.client.local_storage.set_item(self.session.content.key, json.dumps(self._views))

    def _read(self, current: IsCurrent) -> None:
        """Read what this browser saved before; what cannot be read counts as nothing."""
        try:
            text = self.session.client.local_storage.get_item(self.session.content.key, timeout=10)
        except (RuntimeError, TimeoutError):  # the browser keeps nothing, or is gone
            return
        if text is not None and current():
            self._views = readable_views(text)
            self._list()

    def _busy(self, busy: bool) -> None:
        self.progress.visible = busy


def file_stem(name: str) -> str:
    """Return a name that is safe as that of a file on any system."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._")[:60] or "map"


def readable_views(text: str) -> dict[str, dict[str, Any]]:
    """Return the saved views of a browser; those that are damaged are left out."""
    try:
        found = json.loads(text)
    except ValueError:
        return {}
    views: dict[str, dict[str, Any]] = {}
    for name, view in found.items() if isinstance(found, dict) else ():
        try:
            views[str(name)[:80]] = {
                "position": _vector(view["position"]),
                "look_at": _vector(view["look_at"]),
                "fov": float(np.clip(view["fov"], 0.05, 2.8)),
                "query": str(view["query"])[:2000],
                "selected": None if view["selected"] is None else int(view["selected"]),
                "mode": str(view["mode"]),
                "frame": max(int(view["frame"]), 0),
            }
        except (KeyError, TypeError, ValueError):
            continue
    return views


def _vector(values: Any) -> list[float]:
    vector = [float(value) for value in values]
    if len(vector) != 3 or not np.isfinite(vector).all():
        raise ValueError("no place")
    return vector
