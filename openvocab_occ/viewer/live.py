"""Maps that change while they are looked at: one being built, or one that another program writes again and again."""

import logging
import threading
import time
from collections.abc import Callable, Sequence

from openvocab_occ.datasets.frame import Frame
from openvocab_occ.errors import MapError, NotFoundError
from openvocab_occ.io.files import PathLike, existing
from openvocab_occ.objects.ovmap import MANIFEST
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.pipeline.build import MapBuilder
from openvocab_occ.segmentation.encoder import PixelEncoder
from openvocab_occ.viewer.server import Viewer, view

EVERY = 5.0
"""Seconds between two states of a map that is being built, at least; and as long as a snapshot takes, ten times."""
_log = logging.getLogger(__name__)


def view_build(
    sequence: Sequence[Frame],
    encoder: PixelEncoder,
    builder: MapBuilder,
    *,
    port: int = 8080,
    every: float = EVERY,
    started: Callable[[Viewer], object] | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Viewer:
    """Build a map and show it while it grows; return the viewer, which shows the whole map then.

    Args:
        sequence: The frames; they are integrated in this thread.
        encoder: Of the builder.
        builder: An empty map, or one to go on with.
        port: Of the page.
        every: Seconds between two states that are shown, at least.
        started: Told of the viewer when there is something to look at: after the first frame.
        progress: Told how many frames are done, and of how many.
    """
    viewer: Viewer | None = None
    due = 0.0
    try:
        for done, frame in enumerate(sequence, start=1):
            builder.integrate(frame)
            if progress is not None:
                progress(done, len(sequence))
            begun = time.monotonic()
            if begun < due and done < len(sequence):
                continue
            scene = builder.snapshot()
            if viewer is not None:
                viewer.show(scene)
            elif len(scene.voxels):
                viewer = view(scene, encoder, sequence=sequence, port=port, block=False)
                if started is not None:
                    started(viewer)
            taken = time.monotonic() - begun
            due = begun + taken + max(every, 10 * taken)
    except BaseException:
        if viewer is not None:
            viewer.close()
        raise
    if viewer is None:
        raise MapError("the map has no voxels to look at", fix="map frames with an occupancy grid or depth")
    return viewer


class Follower:
    """Shows a saved map anew whenever its folder is written again."""

    def __init__(self, viewer: Viewer, path: PathLike, *, every: float = 1.0) -> None:
        """Begin to look at the folder each `every` seconds, in a thread of its own."""
        self._viewer, self._path = viewer, existing(path, "map")
        self._stamp = self._written()
        self._stop = threading.Event()
        self._every = every
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Follow no more."""
        self._stop.set()
        self._thread.join()

    def __enter__(self) -> "Follower":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        while not self._stop.wait(self._every):
            stamp = self._written()
            if stamp is None or stamp == self._stamp:
                continue
            try:
                self._viewer.show(SceneMap.open(self._path))
            except (MapError, NotFoundError) as error:  # being replaced, or empty; the next look tells
                _log.info("%s cannot be shown: %s", self._path, error)
                continue
            self._stamp = stamp

    def _written(self) -> tuple[int, int] | None:
        try:
            found = (self._path / MANIFEST).stat()
        except FileNotFoundError:
            return None
        return found.st_mtime_ns, found.st_ino
