"""Occupancy labels of neighbouring data sets, as grids.

Each format has its own frame: the pose of that frame in the world is passed as `T_world_grid`, by default the identity.
"""

from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Integer, UInt8

from openvocab_occ.arrays import ArrayLike
from openvocab_occ.errors import DataError, GridError, ShapeError
from openvocab_occ.geometry import GridSpec
from openvocab_occ.io.files import PathLike, existing
from openvocab_occ.io.numbers import read_arrays
from openvocab_occ.occupancy.grid import GEOMETRY_CLASSES, OCC3D_CLASSES, OCC3D_FREE, OCC3D_SPEC, OccupancyGrid

SURROUNDOCC_SPEC = GridSpec((-50.0, -50.0, -5.0), 0.5, (200, 200, 16))
"""In the frame of nuScenes' LiDAR (x right, y forward)."""
OPENOCCUPANCY_SPEC = GridSpec((-51.2, -51.2, -5.0), 0.2, (512, 512, 40))
"""In the frame of nuScenes' LiDAR (x right, y forward)."""
SEMANTICKITTI_SPEC = GridSpec((0.0, -25.6, -2.0), 0.2, (256, 256, 32))
"""In the frame of KITTI's Velodyne (x forward, y left)."""
OPENOCC_CLASSES: tuple[str, ...] = (
    "car", "truck", "trailer", "bus", "construction vehicle", "bicycle", "motorcycle", "pedestrian", "traffic cone",
    "barrier", "driveable surface", "other flat", "sidewalk", "terrain", "manmade", "vegetation", "free",
)  # fmt: skip
"""Labels 0..16 of OpenOcc v2, in its own order."""
SEMANTICKITTI_CLASSES: tuple[str, ...] = (
    "free", "car", "bicycle", "motorcycle", "truck", "other-vehicle", "person", "bicyclist", "motorcyclist", "road",
    "parking", "sidewalk", "other-ground", "building", "fence", "vegetation", "trunk", "terrain", "pole",
    "traffic-sign",
)  # fmt: skip
"""Learning classes 1..19 of SemanticKITTI; its class 0 is empty here, and what it leaves unlabelled is unknown."""
SEMANTICKITTI_LEARNING = MappingProxyType({
    0: 0, 1: 0, 10: 1, 11: 2, 13: 5, 15: 3, 16: 5, 18: 4, 20: 5, 30: 6, 31: 7, 32: 8, 40: 9, 44: 10, 48: 11, 49: 12,
    50: 13, 51: 14, 52: 0, 60: 9, 70: 15, 71: 16, 72: 17, 80: 18, 81: 19, 99: 0, 252: 1, 253: 7, 254: 6, 255: 8,
    256: 5, 257: 5, 258: 4, 259: 5,
})  # fmt: skip
"""Raw label to learning class."""
_IGNORED_SURROUNDOCC, _IGNORED_OPENOCCUPANCY = 0, 0


def read_surroundocc(path: PathLike, T_world_grid: ArrayLike | None = None) -> OccupancyGrid:
    """Read SurroundOcc's `.npy` of rows x, y, z, label, in the LiDAR's frame.

    Voxels that are not listed are free; those labelled 0 were left out of its evaluation and are unknown. The classes
    are Occ3D's.
    """
    rows = _rows(path, (4,))
    return _sparse(rows[:, :3], rows[:, 3], SURROUNDOCC_SPEC, _IGNORED_SURROUNDOCC, T_world_grid, path)


def read_openoccupancy(path: PathLike, T_world_grid: ArrayLike | None = None) -> OccupancyGrid:
    """Read OpenOccupancy's `.npy` of rows z, y, x, [three speeds,] label, in the LiDAR's frame.

    It is nuScenes-Occupancy v0.1. Voxels that are not listed are free; those labelled 0 are noise and unknown. The
    classes are Occ3D's.
    """
    rows = _rows(path, (4, 7))
    return _sparse(rows[:, 2::-1], rows[:, -1], OPENOCCUPANCY_SPEC, _IGNORED_OPENOCCUPANCY, T_world_grid, path)


def read_openocc(path: PathLike, T_world_grid: ArrayLike | None = None) -> OccupancyGrid:
    """Read OpenOcc v2's `labels.npz` (OccNet, CVPR 2024 track), in the ego frame, to Occ3D's classes."""
    labels = read_arrays(path, "OpenOcc labels").get("semantics")
    if labels is None or labels.shape != OCC3D_SPEC.shape or labels.dtype.kind not in "iu":
        got = "no such array" if labels is None else f"{labels.dtype} {labels.shape}"
        raise ShapeError(f"{path} is no OpenOcc v2", expected=f"integers semantics {OCC3D_SPEC.shape}", got=got)
    _check_range(labels, len(OPENOCC_CLASSES), path)
    table = np.array([OCC3D_CLASSES.index(name) for name in OPENOCC_CLASSES], dtype=np.uint8)
    return OccupancyGrid(table[labels], OCC3D_SPEC, _pose(T_world_grid))


def read_openocc_v1(
    path: PathLike,
    invalid: PathLike | None = None,
    T_world_grid: ArrayLike | None = None,
    *,
    first_class: int = 0,
) -> OccupancyGrid:
    """Read OpenOcc v1's `NNN_occ.npy`: rows of a flat index into [z, y, x] and a class, in the ego frame.

    Args:
        path: Classes are those of OpenOcc v2 in their order.
        invalid: `NNN_occ_invalid.npy`, flat indices of voxels that are unknown.
        T_world_grid: Ego to world.
        first_class: The number that means car: 0, or 1 in files that count from there.
    """
    rows = _rows(path, (2,))
    shape = OCC3D_SPEC.shape
    flat, classes = rows[:, 0], rows[:, 1] - first_class
    _check_range(classes, len(OPENOCC_CLASSES) - 1, path)
    hidden = np.zeros(0, np.int64)
    if invalid is not None:
        hidden = np.asarray(read_arrays(invalid, "invalid voxels")[""]).reshape(-1).astype(np.int64)
    for name, indices in ((path, flat), (invalid, hidden)):
        if len(indices) and (indices.min() < 0 or indices.max() >= OCC3D_SPEC.num_voxels):
            raise GridError(f"{name} has voxels outside the grid", expected=f"0..{OCC3D_SPEC.num_voxels - 1}")
    table = np.array([OCC3D_CLASSES.index(name) for name in OPENOCC_CLASSES], dtype=np.uint8)
    labels = np.full(OCC3D_SPEC.num_voxels, OCC3D_FREE, dtype=np.uint8)
    labels[flat] = table[classes]
    known = np.ones(OCC3D_SPEC.num_voxels, dtype=np.bool_)
    known[hidden] = False
    swapped = shape[::-1]
    return OccupancyGrid(
        labels.reshape(swapped).transpose(2, 1, 0), OCC3D_SPEC, _pose(T_world_grid),
        known=known.reshape(swapped).transpose(2, 1, 0),
    )  # fmt: skip


def read_semantickitti(
    path: PathLike, invalid: PathLike | None = None, T_world_grid: ArrayLike | None = None
) -> OccupancyGrid:
    """Read SemanticKITTI's voxels, in the Velodyne's frame.

    Args:
        path: `NNNNNN.label` (raw labels), or `NNNNNN.bin` (voxels with returns of one sweep: the rest is unknown).
        invalid: `NNNNNN.invalid`, voxels that no sweep saw; they are unknown.
        T_world_grid: Velodyne to world.
    """
    spec, T = SEMANTICKITTI_SPEC, _pose(T_world_grid)
    file = existing(path, "SemanticKITTI voxels")
    if file.suffix == ".bin":
        hit = read_bits(file)
        return OccupancyGrid((~hit).astype(np.uint8), spec, T, 1, known=hit, class_names=GEOMETRY_CLASSES)
    raw = np.frombuffer(file.read_bytes()[: file.stat().st_size // 2 * 2], dtype="<u2")
    if file.stat().st_size != 2 * spec.num_voxels:
        raise DataError(
            f"{file.name} is cut off or of another kind",
            expected=f"{2 * spec.num_voxels} bytes: uint16 of {spec.shape}",
            got=f"{file.stat().st_size} bytes",
        )
    table = np.full(int(raw.max()) + 1, 255, dtype=np.uint8)
    for label, learned in SEMANTICKITTI_LEARNING.items():
        if label < len(table):
            table[label] = learned
    labels = table[raw].reshape(spec.shape)
    if (labels == 255).any():
        strange = np.unique(raw[labels.reshape(-1) == 255])
        raise GridError(f"{file.name} has labels of no class", expected="SemanticKITTI's", got=strange[:8].tolist())
    known = (labels != 0) | (raw.reshape(spec.shape) == 0)
    if invalid is not None:
        known &= ~read_bits(invalid)
    return OccupancyGrid(labels, spec, T, 0, known=known, class_names=SEMANTICKITTI_CLASSES)


def read_bits(path: PathLike) -> Bool[np.ndarray, "x y z"]:
    """Read a `.bin`, `.invalid` or `.occluded` of SemanticKITTI: one bit a voxel, the highest of a byte first."""
    file = existing(path, "SemanticKITTI voxels")
    packed = np.frombuffer(file.read_bytes(), dtype=np.uint8)
    if 8 * len(packed) != SEMANTICKITTI_SPEC.num_voxels:
        raise DataError(
            f"{file.name} is cut off or of another kind",
            expected=f"{SEMANTICKITTI_SPEC.num_voxels // 8} bytes",
            got=f"{len(packed)} bytes",
        )
    return np.unpackbits(packed).astype(np.bool_).reshape(SEMANTICKITTI_SPEC.shape)


def _rows(path: PathLike, columns: tuple[int, ...]) -> Integer[np.ndarray, "n c"]:
    array = read_arrays(path, "occupancy rows").get("")
    if array is None or array.ndim != 2 or array.shape[1] not in columns:
        got = "several arrays" if array is None else array.shape
        raise ShapeError(f"{path} is of another kind", expected=f"rows of {' or '.join(map(str, columns))}", got=got)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise DataError(f"{path} is not finite", expected="indices and labels")
    return array.astype(np.int64)


def _sparse(
    index: Integer[np.ndarray, "n 3"],
    labels: Integer[np.ndarray, " n"],
    spec: GridSpec,
    ignored: int,
    T_world_grid: ArrayLike | None,
    path: PathLike,
) -> OccupancyGrid:
    """Fill a grid of Occ3D's classes from a list of voxels."""
    _check_range(labels, OCC3D_FREE, path)
    flat = spec.flat(index)
    if (flat < 0).any():
        raise GridError(
            f"{path} has voxels outside the grid",
            expected=f"indices within {spec.shape}",
            got=index[np.argmin(flat)].tolist(),
            fix="is it of another format, or are its columns in another order?",
        )
    dense: UInt8[np.ndarray, " n"] = np.full(spec.num_voxels, OCC3D_FREE, dtype=np.uint8)
    dense[flat] = labels
    known = np.ones(spec.num_voxels, dtype=np.bool_)
    known[flat[labels == ignored]] = False
    return OccupancyGrid(dense.reshape(spec.shape), spec, _pose(T_world_grid), known=known.reshape(spec.shape))


def _check_range(labels: np.ndarray, count: int, path: PathLike) -> None:
    if labels.size and (labels.min() < 0 or labels.max() >= count):
        got = f"{labels.min()}..{labels.max()}"
        raise GridError(f"labels of {path} are out of range", expected=f"0..{count - 1}", got=got)


def _pose(T_world_grid: ArrayLike | None) -> np.ndarray:
    return np.eye(4) if T_world_grid is None else np.asarray(T_world_grid)
