"""Where a camera sees a set of voxels best, put together from the best view of each voxel."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Int64

from openvocab_occ.mapping import VoxelMap
from openvocab_occ.objects.scene_map import KeyFrame
from openvocab_occ.objects.tracks import BEST_CROPS
from openvocab_occ.objects.tree import ObjectTree, Sighting


def best_sightings(
    voxels: VoxelMap, members: Int64[np.ndarray, " n"], frames: Mapping[int, KeyFrame], *, count: int = BEST_CROPS
) -> tuple[Sighting, ...]:
    """Return the views that see voxels at some positions best, best first.

    Each voxel speaks for the one view in which it weighs most; a view's score is the weight it has so, its box holds
    the pixels of those voxels. Views of frames that are not given are left out.
    """
    frame, view, box, score = voxels.best_views(members)
    known = np.isin(frame, list(frames))
    frame, view, box, score = frame[known], view[known], box[known], score[known]
    if not len(frame):
        return ()
    pairs, inverse = np.unique(np.stack([frame, view], axis=1), axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    total = np.bincount(inverse, score.astype(np.float64))
    low, high = np.full((len(pairs), 2), 2**31 - 1), np.zeros((len(pairs), 2), dtype=int)
    np.minimum.at(low, inverse, box[:, :2])
    np.maximum.at(high, inverse, box[:, 2:])
    best = np.lexsort((pairs[:, 1], pairs[:, 0], -total))[:count]
    found = []
    for i in best.tolist():
        number, camera = pairs[i].tolist()
        left, top, right, bottom = *low[i].tolist(), *high[i].tolist()
        found.append(Sighting(number, frames[number].cameras[camera].name, (left, top, right, bottom), float(total[i])))
    return tuple(found)


def with_sightings(tree: ObjectTree, voxels: VoxelMap, frames: Sequence[KeyFrame]) -> ObjectTree:
    """Return the tree with the best views of the nodes that hold voxels but know none: ground, parts, merged things."""
    known = {frame.index: frame for frame in frames}
    return ObjectTree(
        node if node.views or not len(node.voxels)
        else replace(node, views=best_sightings(voxels, node.voxels, known))
        for node in tree.nodes
    )  # fmt: skip
