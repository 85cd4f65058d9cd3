"""The occupancy grid: a label for every voxel of a box, predicted or given."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8

from openvocab_occ.arrays import ArrayLike, check_finite, check_shape
from openvocab_occ.errors import GridError, ShapeError
from openvocab_occ.geometry import GridSpec, as_pose, transform
from openvocab_occ.occupancy._rays_kernels import mark_blocks
from openvocab_occ.occupancy.faces import exposed_faces
from openvocab_occ.occupancy.field import probability_from_labels, probability_from_logits

OCC3D_CLASSES: tuple[str, ...] = (
    "others", "barrier", "bicycle", "bus", "car", "construction vehicle", "motorcycle", "pedestrian", "traffic cone",
    "trailer", "truck", "driveable surface", "other flat", "sidewalk", "terrain", "manmade", "vegetation", "free",
)  # fmt: skip
"""Labels 0..17 of Occ3D-nuScenes."""
OCC3D_FREE = 17
OCC3D_SPEC = GridSpec((-40.0, -40.0, -1.0), 0.4, (200, 200, 16))
"""The grid of Occ3D-nuScenes, in the ego frame at LiDAR time."""
GEOMETRY_CLASSES: tuple[str, ...] = ("occupied", "free")
"""Classes of a grid that knows shapes only; free is 1."""


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """Labels of a box of voxels, and where the box is in the world."""

    labels: UInt8[np.ndarray, "x y z"]
    """Class of each voxel, indexed [x, y, z]."""
    spec: GridSpec
    """The lattice in the grid's own frame."""
    T_world_grid: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """Grid frame to world."""
    free_label: int = OCC3D_FREE
    """The label that means empty."""
    logits: Float32[np.ndarray, "x y z classes"] | None = None
    """Scores of the classes before the softmax, where a network gave them."""
    known: Bool[np.ndarray, "x y z"] | None = None
    """False where nothing was observed: such voxels are transparent to rays, clear nothing, and never count as seen."""
    class_names: tuple[str, ...] = OCC3D_CLASSES
    """Name of each label."""

    def __post_init__(self) -> None:
        labels = np.asarray(self.labels)
        if labels.shape != self.spec.shape:
            raise ShapeError(
                "occupancy labels do not fit the grid",
                expected=self.spec.shape,
                got=labels.shape,
                fix="axes are [x, y, z]; transpose the array or pass its own GridSpec",
            )
        if not np.issubdtype(labels.dtype, np.integer):
            raise GridError(
                "occupancy labels are not class numbers",
                expected="integers",
                got=labels.dtype,
                fix="for class scores use OccupancyGrid.from_logits",
            )
        names = tuple(self.class_names)
        if not 0 <= self.free_label < len(names) <= 256:
            raise GridError(
                "free label is not a class", expected=f"0..{len(names) - 1} of at most 256 classes", got=self.free_label
            )
        low, high = int(labels.min()), int(labels.max())
        if low < 0 or high >= len(names):
            raise GridError(
                "occupancy labels are out of range",
                expected=f"0..{len(names) - 1} ({len(names)} classes)",
                got=f"{low}..{high}",
                fix="pass class_names and free_label of your own classes",
            )
        if self.logits is not None:
            logits = np.asarray(self.logits, dtype=np.float32)
            check_shape(logits, (*self.spec.shape, len(names)), "occupancy logits")
            check_finite(logits, "occupancy logits")
            object.__setattr__(self, "logits", logits)
        if self.known is not None:
            known = np.asarray(self.known)
            check_shape(known, self.spec.shape, "known mask")
            object.__setattr__(self, "known", np.ascontiguousarray(known != 0))
        object.__setattr__(self, "labels", np.ascontiguousarray(labels, dtype=np.uint8))
        object.__setattr__(self, "T_world_grid", as_pose(self.T_world_grid, "T_world_grid"))
        object.__setattr__(self, "class_names", names)

    @classmethod
    def from_logits(
        cls,
        logits: Float[np.ndarray, "x y z classes"],
        spec: GridSpec,
        T_world_grid: ArrayLike | None = None,
        *,
        free_label: int = OCC3D_FREE,
        known: Bool[np.ndarray, "x y z"] | None = None,
        class_names: tuple[str, ...] = OCC3D_CLASSES,
    ) -> "OccupancyGrid":
        """Label each voxel with its best class, and keep the logits."""
        check_shape(np.asarray(logits), (*spec.shape, len(class_names)), "occupancy logits")
        labels = np.argmax(logits, axis=-1).astype(np.uint8)
        T = np.eye(4) if T_world_grid is None else np.asarray(T_world_grid)
        return cls(labels, spec, T, free_label, np.asarray(logits, dtype=np.float32), known, class_names)

    @cached_property
    def occupied(self) -> Bool[np.ndarray, "x y z"]:
        """True where a ray stops: known and not free."""
        occupied = self.labels != self.free_label
        return occupied if self.known is None else occupied & self.known

    @cached_property
    def faces(self) -> Int32[np.ndarray, "n 6"]:
        """The surface of what is occupied, as rectangles; see `exposed_faces`. Made once, on first use."""
        return exposed_faces(self.occupied)

    @cached_property
    def blocks(self) -> UInt8[np.ndarray, "bx by bz"]:
        """1 where a block of 8 x 8 x 8 voxels holds an occupied one: what rays through large grids leap by."""
        x, y, z = self.spec.shape
        blocks = np.zeros(((x + 7) // 8, (y + 7) // 8, (z + 7) // 8), np.uint8)
        mark_blocks(self.occupied, blocks)
        return blocks

    @cached_property
    def probability(self) -> Float32[np.ndarray, "x y z"]:
        """Probability at the centre of each voxel that it is occupied: of the logits, or of smoothed labels.

        0 where nothing is known. Smoothed labels are no probabilities, but their level 0.5 is a surface all the same.
        """
        if self.logits is None:
            return probability_from_labels(self.occupied, self.known)
        field = probability_from_logits(self.logits, self.free_label)
        return field if self.known is None else np.where(self.known, field, np.float32(0.0))

    def centers(self, flat: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Return the centres of voxels given by flat index, metres in the world, float64."""
        return transform(self.T_world_grid, self.spec.centers(self.spec.unflat(flat)))
