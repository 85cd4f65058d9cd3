"""What all browsers share: the map, and what is worked out of it once."""

from collections.abc import Sequence
from functools import cached_property
from threading import RLock
from typing import Any

import numpy as np
from jaxtyping import Float64, Int32, Int64

from openvocab_occ.datasets.frame import Frame
from openvocab_occ.export.render import heading, overview, owners
from openvocab_occ.export.semantics import Semantics, name_voxels
from openvocab_occ.mapping.picking import Picker
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.tree import SceneObject
from openvocab_occ.segmentation.encoder import PixelEncoder
from openvocab_occ.viewer.colors import Painted, paint_voxels
from openvocab_occ.viewer.tiles import Tile, tile_bounds, tile_voxels

_FRAMES_KEPT = 8  # images of so many frames stay in memory


class Content:
    """A map and all that the page derives from it; safe to use from several threads."""

    def __init__(
        self,
        scene: SceneMap,
        encoder: PixelEncoder | None = None,
        sequence: Sequence[Frame] | None = None,
    ) -> None:
        self.scene = scene
        self.encoder = encoder
        self.sequence = sequence
        """Frames with their images; not part of a map."""
        self._lock = RLock()
        self._painted: dict[str, Painted] = {}
        self._frames: dict[int, Frame | None] = {}
        self.vectors: dict[tuple[str, ...], np.ndarray] = {}
        """Unit vectors of words that were looked up."""
        self._read = RLock()  # frames are read one at a time: sources need not be thread-safe

    @cached_property
    def tiles(self) -> list[Tile]:
        """The voxels, cube by cube."""
        return tile_voxels(self.scene.voxels)

    @cached_property
    def bounds(self) -> Float64[np.ndarray, "t 2 3"]:
        """Corners of the tiles."""
        return tile_bounds(self.tiles)

    @cached_property
    def counts(self) -> Int64[np.ndarray, "t levels"]:
        """Points of each tile at each level of detail."""
        return np.array([[len(level.points) for level in tile.levels] for tile in self.tiles], np.int64)

    @cached_property
    def owner(self) -> Int32[np.ndarray, " n"]:
        """Object of each voxel, 0 for none."""
        return owners(self.scene)

    @cached_property
    def semantics(self) -> Semantics:
        """What each voxel is called."""
        return name_voxels(self.scene)

    @cached_property
    def picker(self) -> Picker:
        """Finds what a ray meets."""
        return Picker(self.scene.voxels)

    @cached_property
    def path(self) -> Float64[np.ndarray, "n 3"]:
        """Where the ego was, frame by frame."""
        return np.array([frame.T_world_ego[:3, 3] for frame in self.scene.frames]).reshape(-1, 3)

    @property
    def start_mode(self) -> str:
        """The colours to begin with."""
        return "rgb" if self.scene.voxels.colors.any() else "semantic"

    @property
    def key(self) -> str:
        """A name of this map that stays the same from one start to the next, for what browsers remember."""
        made = self.scene.provenance
        return f"openvocab_occ/{made.source}/{made.name}/{self.scene.encoder.fingerprint[:12]}"

    def painted(self, mode: str) -> Painted:
        """Return the colours of a mode that needs no query, made once."""
        with self._lock:
            if mode not in self._painted:
                self._painted[mode] = paint_voxels(self.scene, mode)
            return self._painted[mode]

    def frame(self, index: int) -> Frame | None:
        """Return a frame with its images by its index in the map, None where there is none."""
        if self.sequence is None:
            return None
        with self._read:
            if index not in self._frames:
                while len(self._frames) >= _FRAMES_KEPT:
                    self._frames.pop(next(iter(self._frames)))
                self._frames[index] = _find_frame(self.sequence, index)
            return self._frames[index]

    def viewpoint(self, item: SceneObject) -> tuple[np.ndarray, np.ndarray]:
        """Return a position from which an object is well seen, from the side of the drive, and the target."""
        target = np.asarray(item.center, np.float64)
        away = -heading(self.scene)
        if len(self.path):
            nearest = self.path[np.linalg.norm(self.path - target, axis=1).argmin()] - target
            nearest[2] = 0.0
            length = float(np.linalg.norm(nearest))
            away = nearest / length if length > 1.0 else away
        distance = max(8.0, 2.5 * float(np.max(item.box.size)))
        return target + distance * (0.9 * away + np.array([0.0, 0.0, 0.45])), target

    def overview(self, aspect: float, fov: float) -> tuple[np.ndarray, np.ndarray]:
        """Return a position and a target from which the map is seen as a whole."""
        return overview(self.scene, aspect, fov)

    def above(self, fov: float) -> tuple[np.ndarray, np.ndarray]:
        """Return a position and a target of a view straight down, with the drive going up."""
        low, high = np.percentile(self.scene.voxels.centers, (0.5, 99.5), axis=0)
        target = (low + high) / 2
        height = float(np.max(high - low)) / (2 * np.tan(fov / 2))
        return target + np.array([0.0, 0.0, 1.05 * height]) - 0.01 * height * heading(self.scene), target


def _find_frame(sequence: Sequence[Frame], index: int) -> Frame | None:
    """Return the frame of this index; most sequences have it at that place."""
    if 0 <= index < len(sequence):
        frame = sequence[index]
        if frame.index == index:
            return frame
    found: Any = next((frame for frame in sequence if frame.index == index), None)
    return found
