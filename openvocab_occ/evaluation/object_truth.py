"""What is true of the things of a synthetic drive, frame by frame."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int32

from openvocab_occ.datasets.city import Traversal, keyframes
from openvocab_occ.datasets.frame import Frame
from openvocab_occ.datasets.street import Street
from openvocab_occ.objects.box import Box
from openvocab_occ.objects.kinds import Kind, kind_of
from openvocab_occ.occupancy import OCC3D_CLASSES


@dataclass(frozen=True, kw_only=True)
class TrueThing:
    """A thing at one moment."""

    id: int
    """Above 0; the same in all frames."""
    label: str
    """Occupancy class."""
    box: Box | None = None
    """Of things with a box; its yaw points forward for things that have a front."""


@runtime_checkable
class Truth(Protocol):
    """The truth of one drive."""

    def instances(self, frame: Frame) -> Int32[np.ndarray, "x y z"]:
        """Return the id of the thing in each voxel of the frame's grid; 0 for ground and air."""
        ...

    def things(self, frame: Frame) -> Mapping[int, TrueThing]:
        """Return the things there are in a frame, by id."""
        ...


class StreetTruth:
    """The truth of the small synthetic street."""

    def __init__(self, street: Street) -> None:
        self._things = {
            number: thing
            for number, thing in enumerate(street.objects, start=1)
            if kind_of(OCC3D_CLASSES[thing.label]) != Kind.GROUND
        }

    def instances(self, frame: Frame) -> Int32[np.ndarray, "x y z"]:
        """Return the id of the thing whose box holds each voxel's centre, or is within a voxel of it."""
        grid = frame.occupancy
        assert grid is not None, "frames of the street have grids"
        flat = np.flatnonzero(grid.occupied)
        labels, centers = grid.labels.reshape(-1)[flat], grid.centers(flat)
        nearest, found = np.full(len(flat), np.inf), np.zeros(len(flat), np.int32)
        for id, thing in self._things.items():
            low, high = thing.bounds(frame.timestamp)
            mine = np.flatnonzero(labels == thing.label)
            off = np.linalg.norm(np.maximum(np.maximum(low - centers[mine], centers[mine] - high), 0), axis=1)
            closer = (off < nearest[mine]) & (off <= grid.spec.size.max())
            nearest[mine[closer]], found[mine[closer]] = off[closer], id
        result = np.zeros(grid.spec.num_voxels, np.int32)
        result[flat] = found
        return result.reshape(grid.spec.shape)

    def things(self, frame: Frame) -> Mapping[int, TrueThing]:
        """Return all things, where they are at the frame's time."""
        found = {}
        for id, thing in self._things.items():
            low, high = thing.bounds(frame.timestamp)
            box = Box((low + high) / 2, high - low, 0.0)
            found[id] = TrueThing(id=id, label=OCC3D_CLASSES[thing.label], box=box)
        return found


class CityTruth:
    """The truth of a drive through the demo city."""

    def __init__(self, drive: Traversal) -> None:
        self._drive = drive
        names = {id: about.name for id, about in drive.attributes().items()}
        self._labels = {id: name for id, name in names.items() if kind_of(name) != Kind.GROUND}
        self._solid = np.array(sorted(self._labels), dtype=np.int32)

    def instances(self, frame: Frame) -> Int32[np.ndarray, "x y z"]:
        """Return the id of the thing that most of each voxel is; 0 for ground and air."""
        ids = keyframes.labels(self._drive, frame.index, masks=False).instances
        return np.where(np.isin(ids, self._solid), ids, 0).astype(np.int32)

    def things(self, frame: Frame) -> Mapping[int, TrueThing]:
        """Return the things within reach, where they are at the frame's time."""
        found = {id: TrueThing(id=id, label=label) for id, label in self._labels.items()}
        for box in keyframes.boxes(self._drive, frame.index):
            upright = Box(np.array(box.center), np.array(box.size), box.yaw)
            found[box.id] = TrueThing(id=box.id, label=OCC3D_CLASSES[box.label], box=upright)
        return found
