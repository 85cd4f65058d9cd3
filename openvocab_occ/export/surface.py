"""What a picture of a map shows: its still voxels, and what moves where it was last seen."""

from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt8

from openvocab_occ.export.palette import UNLABELLED, label_colors
from openvocab_occ.export.semantics import name_voxels
from openvocab_occ.objects.scene_map import SceneMap
from openvocab_occ.objects.tree import SceneObject


@dataclass(frozen=True, eq=False)
class Surface:
    """Voxels that can be drawn. Those of the map come first, in its order; then those of what moves."""

    voxel_size: float
    keys: Int32[np.ndarray, "n 3"]
    """Lattice indices; they differ."""
    item: Int32[np.ndarray, " n"]
    """Id of the object, 0 where none; of several the one with the fewest voxels."""
    label: Int32[np.ndarray, " n"]
    """Position in `names`, -1 where nothing names the voxel."""
    names: tuple[str, ...]
    colors: UInt8[np.ndarray, "n 3"]
    """Mean RGB of images; the colour of the label where no image gave one."""

    def __len__(self) -> int:
        return len(self.item)

    @cached_property
    def centers(self) -> Float64[np.ndarray, "n 3"]:
        """Centres in the world, metres."""
        return (self.keys + 0.5) * self.voxel_size

    @cached_property
    def centers32(self) -> Float32[np.ndarray, "n 3"]:
        """The same, rounded for drawing: by up to 0.03 mm at 1 km."""
        return self.centers.astype(np.float32)

    @cached_property
    def palette(self) -> UInt8[np.ndarray, "n 3"]:
        """Colour of each voxel's label."""
        table = np.vstack([label_colors(self.names), np.array([UNLABELLED], np.uint8)])  # -1 reads the last row
        return table[self.label]

    @cached_property
    def rows_by_item(self) -> dict[int, Int64[np.ndarray, " _"]]:
        """Rows of each object, as far as they are its own."""
        order = np.argsort(self.item, kind="stable")
        ids, starts = np.unique(self.item[order], return_index=True)
        groups = np.split(order, starts[1:])
        return {int(id): rows for id, rows in zip(ids, groups, strict=True) if id > 0}


def owners(scene: SceneMap) -> Int32[np.ndarray, " n"]:
    """Return for each voxel the id of its object, 0 where none; of several the one with the fewest voxels."""
    owner = np.zeros(len(scene.voxels), np.int32)
    for item in sorted(scene.objects, key=lambda item: -len(item.voxels)):
        owner[item.voxels] = item.id
    return owner


def surface_of(scene: SceneMap) -> Surface:
    """Return what can be drawn of a map, made at the first call.

    The map holds no voxels of what moves; its objects keep the points of their latest sighting, and are drawn there.
    """
    found = _KEPT.get(scene)
    if found is None:
        found = _KEPT[scene] = _made(scene)
    return found


_KEPT: "WeakKeyDictionary[SceneMap, Surface]" = WeakKeyDictionary()


def _made(scene: SceneMap) -> Surface:
    voxels, semantics = scene.voxels, name_voxels(scene)
    names = list(semantics.names)
    keys, item, label = [voxels.keys], [owners(scene)], [semantics.labels]
    taken = {tuple(key) for moving in _moving(scene) for key in _keys(moving, voxels.voxel_size).tolist()}
    if taken:
        inside = voxels.index(np.array(sorted(taken), np.int32)) >= 0
        taken = {key for key, there in zip(sorted(taken), inside, strict=True) if not there}
    for moving in _moving(scene):
        own = [tuple(key) for key in np.unique(_keys(moving, voxels.voxel_size), axis=0).tolist()]
        own = [key for key in own if key in taken]
        taken.difference_update(own)
        if not own:
            continue
        if moving.label and moving.label not in names:
            names.append(moving.label)
        keys.append(np.array(own, np.int32))
        item.append(np.full(len(own), moving.id, np.int32))
        label.append(np.full(len(own), names.index(moving.label) if moving.label else -1, np.int32))
    labels = np.concatenate(label).astype(np.int32)
    table = np.vstack([label_colors(names), np.array([UNLABELLED], np.uint8)])
    colors = table[labels]
    seen = voxels.colors.any(axis=1)
    colors[: len(voxels)][seen] = voxels.colors[seen]
    return Surface(voxels.voxel_size, np.concatenate(keys), np.concatenate(item), labels, tuple(names), colors)


def _moving(scene: SceneMap) -> list[SceneObject]:
    return [item for item in scene.objects if not len(item.voxels) and len(item.points)]


def _keys(item: SceneObject, voxel_size: float) -> Int32[np.ndarray, "n 3"]:
    return np.floor(item.points.astype(np.float64) / voxel_size + 1e-4).astype(np.int32)
