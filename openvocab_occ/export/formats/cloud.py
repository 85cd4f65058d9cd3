"""A point cloud: what a map becomes in the formats of others, and what they become here."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, Shaped, UInt8

from openvocab_occ.arrays import check_shape
from openvocab_occ.objects import SceneMap


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points with colours and named numbers."""

    points: Float64[np.ndarray, "n 3"]
    """Metres, world."""
    colors: UInt8[np.ndarray, "n 3"] | None = None
    """RGB."""
    columns: Mapping[str, Shaped[np.ndarray, " n"]] = field(default_factory=dict[str, np.ndarray])
    """Further numbers of each point by name."""

    def __post_init__(self) -> None:
        if self.colors is not None:
            check_shape(self.colors, (len(self.points), 3), "colours of a cloud")
        for name, column in self.columns.items():
            check_shape(column, (len(self.points),), f"column {name} of a cloud")

    @classmethod
    def of(cls, scene: SceneMap) -> "Cloud":
        """Return the centres of a map's voxels; `object` is the id of the smallest object that holds each, 0 for none.

        `label` is the occupancy class, 255 for none; `confidence` how far the views agree.
        """
        voxels = scene.voxels
        owner = np.zeros(len(voxels), dtype=np.int32)
        for node in sorted(scene.objects.nodes, key=lambda node: -len(node.voxels)):
            owner[node.voxels] = node.id
        columns = {
            "label": voxels.labels,
            "object": owner,
            "confidence": np.clip(voxels.agreement, 0, 1).astype(np.float32),
            "count": voxels.count,
            "last_seen": voxels.last_seen,
        }
        return cls(voxels.centers, voxels.colors, columns)
