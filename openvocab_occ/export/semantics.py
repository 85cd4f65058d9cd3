"""What each voxel is called, as pictures and legends show it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int32

from openvocab_occ.objects.scene_map import SceneMap


@dataclass(frozen=True, eq=False)
class Semantics:
    """A name for each voxel."""

    labels: Int32[np.ndarray, " n"]
    """Position in `names`, -1 where nothing names the voxel."""
    names: tuple[str, ...]


def name_voxels(scene: SceneMap) -> Semantics:
    """Name each voxel by the best label of a `logits` model, else by its occupancy class."""
    voxels = scene.voxels
    if scene.encoder.contract == "logits":
        best = voxels.features.argmax(axis=1).astype(np.int32)
        best[~voxels.features.any(axis=1)] = -1
        return Semantics(best, scene.encoder.labels)
    labels = voxels.labels.astype(np.int32)
    labels[labels >= len(scene.class_names)] = -1
    return Semantics(labels, scene.class_names)
