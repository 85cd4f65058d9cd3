"""The drive in time: keyframes, what their cameras saw, and what moved."""

import threading
from typing import TYPE_CHECKING, Any

import numpy as np

from openvocab_occ.export.palette import paint_numbers
from openvocab_occ.objects.box import Box
from openvocab_occ.objects.scene_map import KeyFrame, NamedCamera
from openvocab_occ.viewer.drawing import (
    MOVING_COLOR,
    PATH_COLOR,
    box_edges,
    draw_frustum,
    draw_plane,
    draw_points,
)
from openvocab_occ.viewer.markup import block, escape, ramp
from openvocab_occ.viewer.pictures import MAX_DEPTH, MAX_ERROR, PICTURE_KINDS, camera_picture
from openvocab_occ.viewer.work import IsCurrent

if TYPE_CHECKING:
    from openvocab_occ.viewer.session import Session

_THUMB_PX = 192  # width of the pictures in the frustums
_PICTURE_PX = 560
_PLANE_DEPTH = 40.0  # metres before the camera at which the photo stands, when looked through
_STEP = 0.5  # seconds that a frame is shown, playing
_EGO_ARROW = 4.0  # metres
_EGO_RISE = 1.5  # metres above the ground, clear of its voxels


class TimePanel:
    """Keyframes, cameras and moving things in one browser."""

    def __init__(self, session: "Session", tab: Any) -> None:
        self.session = session
        self._tab = tab  # where a picture goes that comes later
        self._playing = threading.Event()
        self._through: NamedCamera | None = None
        gui = session.client.gui
        self.note = gui.add_html("")
        self.frame = gui.add_slider("Frame", 0, 1, 1, 0)
        self.frame.on_update(lambda _event: self.update())
        self.play = gui.add_button_group("Play", ("◀", "play", "▶"))
        self.play.on_click(lambda event: self._press(event.target.value))
        self.kind = gui.add_dropdown("Cameras", ("none", "outlines", *PICTURE_KINDS), initial_value="none")
        self.kind.on_update(lambda _event: self.update())
        self.camera: Any = gui.add_dropdown("Camera", ("-",))
        self.camera.on_update(lambda _event: self.update())
        self.through = gui.add_button_group("View", ("look through", "photo", "leave"))
        self.through.on_click(lambda event: self._look(event.target.value))
        self.picture: Any = None
        self.legend = gui.add_html("", visible=False)
        self.lane = session.lane("time")
        self.refresh()

    @property
    def keyframe(self) -> KeyFrame | None:
        """The frame that is shown."""
        frames = self.session.content.scene.frames
        return frames[min(int(self.frame.value), len(frames) - 1)] if frames else None

    @property
    def looked_through(self) -> NamedCamera | None:
        """The camera that the eye is at; None where it is free."""
        return self._through

    @property
    def chosen(self) -> NamedCamera | None:
        """The camera that is chosen, at its pose in the frame that is shown."""
        cameras = () if self.keyframe is None else self.keyframe.cameras
        return next((camera for camera in cameras if camera.name == self.camera.value), cameras[0] if cameras else None)

    def refresh(self) -> None:
        """Read the frames of the map anew."""
        frames = self.session.content.scene.frames
        self.frame.max = max(len(frames) - 1, 1)
        self.frame.disabled = len(frames) < 2
        names = tuple(dict.fromkeys(camera.name for frame in frames for camera in frame.cameras)) or ("-",)
        before = self.camera.value
        self.camera.options = names
        self.camera.value = before if before in names else ("CAM_FRONT" if "CAM_FRONT" in names else names[0])
        self.update()

    def step(self, by: int) -> None:
        """Go to another frame, round and round."""
        count = len(self.session.content.scene.frames)
        if count:
            self.frame.value = (int(self.frame.value) + by) % count

    def update(self) -> None:
        """Bring the scene in line with frame and cameras."""
        self.lane.put(self._show)

    def look_through(self) -> None:
        """Put the eye where the chosen camera was."""
        camera = self.chosen
        if camera is None:
            return
        self._through = camera
        view, T = self.session.client.camera, camera.T_world_cam
        with self.session.client.atomic():
            view.up_direction = -T[:3, 1]
            view.position = camera.position
            view.look_at = camera.position + 10.0 * T[:3, 2]
            tall, wide = np.array([camera.height, camera.width]) / 2 / camera.K[1, 1]
            view.fov = float(2 * np.arctan(max(tall, wide / max(view.aspect, 0.1))))  # all of the picture is seen
        self.update()

    def leave_camera(self) -> None:
        """Look freely again."""
        if self._through is not None:
            self._through = None
            self.session.client.scene.remove_by_name("/photo")
            self.session.points.show(self.session.voxels_shown)
            self.session.client.camera.fov = 1.0
            self.update()

    def stop(self) -> None:
        """Play no more."""
        self._playing.clear()

    def _press(self, name: str) -> None:
        if name == "play":
            if self._playing.is_set():
                self._playing.clear()
            else:
                self._playing.set()
                threading.Thread(target=self._play, daemon=True).start()
        else:
            self._playing.clear()
            self.step(1 if name == "▶" else -1)

    def _play(self) -> None:
        wait = threading.Event()
        while self._playing.is_set():
            self.step(1)
            wait.wait(_STEP)
            while self._playing.is_set() and not self.lane.idle():  # no frame is skipped
                wait.wait(0.02)

    def _look(self, name: str) -> None:
        if name == "leave":
            self.leave_camera()
            self.session.overview()
            return
        self.look_through()
        if name == "photo":
            self.lane.put(self._photo)

    def _photo(self, current: IsCurrent) -> None:
        """Show the photo behind the boxes, in place of the voxels."""
        frame, camera = self.keyframe, self._through
        self._show(current)
        if frame is None or camera is None:
            return
        picture = camera_picture(self.session.content, frame.index, camera, "image", min(camera.width, 1280))
        if picture is None:
            self.session.client.add_notification("no photo", "the map was opened without its images", color="yellow")
        elif current():
            self.session.points.show(False)
            draw_plane(self.session.client.scene, "/photo", camera, picture, _PLANE_DEPTH)

    def _show(self, current: IsCurrent) -> None:
        frame, nodes = self.keyframe, self.session.client.scene
        if frame is None:
            self.note.content = block("This map keeps no frames.")
            return
        self._describe(frame)
        nodes.remove_by_name("/photo")
        self.session.points.show(self.session.voxels_shown)
        self._draw_ego(frame)
        self._draw_moving(frame)
        nodes.remove_by_name("/cameras")
        if self.kind.value == "none":
            self._show_picture(None)
            return
        for number, camera in enumerate(frame.cameras):
            through = self._through is not None and camera.name == self._through.name
            if camera.lens != "pinhole" or through:
                continue
            picture = None
            if self.kind.value != "outlines":
                picture = camera_picture(self.session.content, frame.index, camera, self.kind.value, _THUMB_PX)
            if not current():
                return
            draw_frustum(nodes, f"/cameras/{number}", camera, picture)
        self._enlarge(frame, current)

    def _enlarge(self, frame: KeyFrame, current: IsCurrent) -> None:
        camera, kind = self.chosen, self.kind.value
        if camera is None or kind == "outlines":
            self._show_picture(None)
            return
        picture = camera_picture(self.session.content, frame.index, camera, kind, min(_PICTURE_PX, camera.width))
        if not current():
            return
        if picture is None:
            self._show_picture(
                None, block("The map was opened without its images; depth and semantics come from the map.")
            )
        else:
            self._show_picture(picture, block(_legend(kind), small=True))

    def _show_picture(self, picture: np.ndarray | None, legend: str = "") -> None:
        if self.picture is not None:
            self.picture.remove()
            self.picture = None
        if picture is not None:
            order = self.legend.order - 1e-3
            with self._tab:
                self.picture = self.session.client.gui.add_image(picture, format="jpeg", jpeg_quality=85, order=order)
        self.legend.content, self.legend.visible = legend, bool(legend)

    def _describe(self, frame: KeyFrame) -> None:
        frames = self.session.content.scene.frames
        since = frame.timestamp - frames[0].timestamp
        moving = sum(len(layer.features) for layer in self._layers(frame))
        text = f"frame {frame.index} of {len(frames)}, {since:.1f} s, time {frame.timestamp:.2f}"
        self.note.content = block(escape(text) + (f"<br>{moving} things on the move" if moving else ""))

    def _draw_ego(self, frame: KeyFrame) -> None:
        T = frame.T_world_ego
        start = T[:3, 3] + np.array([0.0, 0.0, _EGO_RISE])
        tip, side = start + _EGO_ARROW * T[:3, 0], 0.25 * _EGO_ARROW * T[:3, 1]
        back = start + 0.6 * _EGO_ARROW * T[:3, 0]
        lines = np.array([[start, tip], [tip, back + side], [tip, back - side]], np.float32)
        nodes = self.session.client.scene
        if self._through is not None:  # it would stand before the eye
            nodes.remove_by_name("/ego")
            return
        nodes.add_line_segments("/ego", lines, PATH_COLOR, thickness=5.0, thickness_units="screen")

    def _draw_moving(self, frame: KeyFrame) -> None:
        nodes, size = self.session.client.scene, self.session.content.scene.voxels.voxel_size
        nodes.remove_by_name("/moving")
        for layer in self._layers(frame):
            draw_points(nodes, "/moving/points", (layer.keys + 0.5) * size, MOVING_COLOR, size)
            boxes = [Box.around(layer.keys[layer.thing == thing], size) for thing in range(len(layer.features))]
            edges = np.concatenate([box_edges(box, 0.5 * size) for box in boxes])
            nodes.add_line_segments("/moving/edges", edges, MOVING_COLOR, thickness=2.0, thickness_units="screen")

    def _layers(self, frame: KeyFrame) -> list[Any]:
        return [layer for layer in self.session.content.scene.dynamic if layer.frame == frame.index]


def _legend(kind: str) -> str:
    if kind == "depth":
        return ramp(
            paint_numbers(np.linspace(0.0, 1.0, 9), 0.0, 1.0, "viridis"), ("0", "30", f"{MAX_DEPTH:.0f}"), "depth, m"
        )
    if kind == "depth error":
        bar = paint_numbers(np.linspace(0.0, 1.0, 9), 0.0, 1.0, "plasma")
        return ramp(bar, ("0", "1.0", f"{MAX_ERROR:.1f}+"), "off from depth measured, LiDAR or the frame's own grid, m")
    return {"semantics": "labels, in the colours of Show: semantic", "image": "what the camera saw"}[kind]
