"""What can move is kept apart: a layer a frame of the voxels of movable classes, and which of them stood still."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64

from openvocab_occ.mapping.cover import Cover
from openvocab_occ.mapping.free_space import FreeSpace
from openvocab_occ.mapping.keys import pack, unpack
from openvocab_occ.mapping.lift import Lifted
from openvocab_occ.mapping.voxel_map import VoxelMap

MOVABLE = (
    "bicycle", "bus", "car", "construction vehicle", "motorcycle", "pedestrian", "trailer", "truck",
)  # fmt: skip
"""Classes of Occ3D, and of grids that use its names, whose voxels may be elsewhere in the next frame."""
MIN_LEFT = 0.5
"""Share of a thing's voxels that must be seen through at another time before it counts as moving. The rim of a thing
that stands jitters with the lattice and the pose; one that moves by half its length leaves half of its voxels."""
_FORWARD = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)])[14:]


@dataclass(frozen=True, eq=False)
class DynamicLayer:
    """The voxels of movable classes that one frame saw."""

    frame: int
    """Index of the frame."""
    time: float
    """Seconds."""
    keys: Int32[np.ndarray, "n 3"]
    """Voxels, sorted."""
    thing: Int32[np.ndarray, " n"]
    """Which thing of this layer each voxel belongs to, from 0: connected voxels (26 neighbours)."""
    features: Float32[np.ndarray, "t c"]
    """Mean feature of each thing's pixels."""

    def only(self, things: Bool[np.ndarray, " t"]) -> "DynamicLayer":
        """Return the layer of some of its things."""
        chosen = things[self.thing]
        number = (np.cumsum(things) - 1).astype(np.int32)
        return DynamicLayer(self.frame, self.time, self.keys[chosen], number[self.thing[chosen]], self.features[things])


def layer_of(cover: Cover, lifted: Lifted, *, frame: int, time: float) -> DynamicLayer:
    """Return the layer of the voxels that a cover names."""
    packed, inverse = np.unique(pack(cover.keys), return_inverse=True)
    keys = unpack(packed)
    thing = things_of(keys)
    count = int(thing.max(initial=-1)) + 1
    features = np.zeros((count, lifted.sums.shape[1]), dtype=np.float32)
    weight = np.zeros(count, dtype=np.float32)
    np.add.at(features, thing[inverse], lifted.sums[cover.row] * cover.share[:, None])
    np.add.at(weight, thing[inverse], lifted.weight[cover.row] * cover.share)
    return DynamicLayer(frame, time, keys, thing, features / np.maximum(weight, 1e-9)[:, None])


def things_of(keys: Int32[np.ndarray, "n 3"]) -> Int32[np.ndarray, " n"]:
    """Number the connected groups of sorted voxels (26 neighbours)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if not len(keys):
        return np.empty(0, dtype=np.int32)
    packed = pack(keys)
    here, there = [], []
    for offset in _FORWARD:
        wanted = pack((keys + offset).astype(np.int32))
        at = np.minimum(np.searchsorted(packed, wanted), len(packed) - 1)
        touch = np.flatnonzero(packed[at] == wanted)
        here.append(touch)
        there.append(at[touch])
    pairs = np.concatenate(here), np.concatenate(there)
    graph = coo_matrix((np.ones(len(pairs[0]), dtype=bool), pairs), shape=(len(keys), len(keys)))
    return connected_components(graph, directed=False)[1].astype(np.int32)


def moving(layers: Sequence[DynamicLayer], movable: VoxelMap, free: FreeSpace) -> list[np.ndarray]:
    """Tell which things of each layer moved, bool[things]: frames looked through a good part of where they were.

    A voxel was left when at least half as many frames saw through it as saw something of `movable` in it. A thing
    that was seen in one place only, and never looked through, stays: nothing shows that it moved.
    """
    told = []
    for layer in layers:
        hits = movable.count[movable.index(layer.keys)]
        left = 2 * free.count(layer.keys).astype(np.int64) >= hits
        count = len(layer.features)
        share = np.bincount(layer.thing, left, minlength=count) / np.maximum(
            np.bincount(layer.thing, minlength=count), 1
        )
        told.append(share >= MIN_LEFT)
    return told


def standing(layers: Sequence[DynamicLayer], moved: Sequence[np.ndarray]) -> Int64[np.ndarray, " n"]:
    """Return the packed keys, sorted, of voxels that belong to things that did not move."""
    kept = [pack(layer.keys[~m[layer.thing]]) for layer, m in zip(layers, moved, strict=True)]
    return np.unique(np.concatenate(kept)) if kept else np.empty(0, dtype=np.int64)
