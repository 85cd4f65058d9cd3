"""Labels of Occ3D-nuScenes: one `labels.npz` a frame, with semantics and two visibility masks."""

import zipfile
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from openvocab_occ.arrays import ArrayLike, check_shape
from openvocab_occ.errors import DataError, GridError, UnsafeFileError
from openvocab_occ.io.files import PathLike, existing, written_file
from openvocab_occ.occupancy.grid import OCC3D_CLASSES, OCC3D_FREE, OCC3D_SPEC, OccupancyGrid


class Occ3DMasks(NamedTuple):
    """What was observed, from all LiDAR sweeps of the scene and from the cameras of this frame."""

    lidar: Bool[np.ndarray, "x y z"]
    camera: Bool[np.ndarray, "x y z"]


def read_occ3d(path: PathLike, T_world_grid: ArrayLike | None = None) -> OccupancyGrid:
    """Read a `labels.npz`; known is its `mask_lidar`.

    The file does not say where it was taken: `T_world_grid` is the ego pose at LiDAR time, by default the identity.

    Raises:
        NotFoundError: There is no such file.
        DataError: It is damaged, or lacks `semantics` or `mask_lidar`; as ShapeError, one is not (200, 200, 16); as
            GridError, a label is not 0..17; as UnsafeFileError, it holds pickled objects.
    """
    file = existing(path, "Occ3D labels")
    semantics, mask_lidar = _read_arrays(file, ("semantics", "mask_lidar"))
    if not np.issubdtype(semantics.dtype, np.integer):
        raise GridError(f"semantics of {file} are not class numbers", expected="integers", got=semantics.dtype)
    low, high = int(semantics.min()), int(semantics.max())
    if low < 0 or high >= len(OCC3D_CLASSES):
        raise GridError(
            f"semantics of {file} are out of range", expected=f"labels 0..{OCC3D_FREE}", got=f"{low}..{high}"
        )
    T = np.eye(4) if T_world_grid is None else np.asarray(T_world_grid)
    known = _as_mask(mask_lidar, "mask_lidar", file)
    return OccupancyGrid(semantics.astype(np.uint8), OCC3D_SPEC, T, OCC3D_FREE, known=known)


def read_occ3d_masks(path: PathLike) -> Occ3DMasks:
    """Read the two masks of a `labels.npz`; errors as of `read_occ3d`."""
    file = existing(path, "Occ3D labels")
    lidar, camera = _read_arrays(file, ("mask_lidar", "mask_camera"))
    return Occ3DMasks(_as_mask(lidar, "mask_lidar", file), _as_mask(camera, "mask_camera", file))


def write_occ3d(path: PathLike, grid: OccupancyGrid, *, mask_camera: Bool[np.ndarray, "x y z"] | None = None) -> None:
    """Write a `labels.npz`, whole or not at all; `mask_lidar` is what the grid knows.

    Without `mask_camera` everything known counts as seen by a camera, because readers of the format expect the key.
    The pose of the grid is not part of the format.

    Raises:
        GridError: The grid has another lattice or other classes than Occ3D.
    """
    if grid.spec != OCC3D_SPEC:
        raise GridError("grid is not on the lattice of Occ3D", expected=OCC3D_SPEC, got=grid.spec)
    if grid.class_names != OCC3D_CLASSES or grid.free_label != OCC3D_FREE:
        raise GridError(
            "grid has other classes than Occ3D",
            expected=f"{len(OCC3D_CLASSES)} classes from {OCC3D_CLASSES[0]!r} to {OCC3D_CLASSES[-1]!r}",
            got=grid.class_names,
            fix="map the labels to Occ3D's first",
        )
    known = np.ones(grid.spec.shape, dtype=np.bool_) if grid.known is None else grid.known
    camera = known if mask_camera is None else np.asarray(mask_camera) != 0
    check_shape(camera, grid.spec.shape, "mask_camera")
    arrays = {
        "semantics": grid.labels,
        "mask_lidar": known.astype(np.uint8),
        "mask_camera": camera.astype(np.uint8),
    }
    with written_file(path) as scratch, scratch.open("wb") as stream:
        np.savez_compressed(stream, **arrays)


def _read_arrays(file: Path, keys: tuple[str, ...]) -> list[np.ndarray]:
    """Read arrays of the shape of Occ3D from an npz that may hold anything."""
    try:
        with zipfile.ZipFile(file) as archive:  # np.load takes any file that is no zip for a pickle
            found = [name.removesuffix(".npy") for name in archive.namelist()]
        missing = [key for key in keys if key not in found]
        if missing:
            raise DataError(
                f"{file} holds no {' and no '.join(missing)}",
                expected="the keys semantics, mask_lidar, mask_camera of Occ3D",
                got=", ".join(found) or "no keys",
            )
        with np.load(file, allow_pickle=False) as archive:
            arrays = [archive[key] for key in keys]
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError) as error:
        raise _damaged(file, error) from error
    except ValueError as error:
        if isinstance(error, DataError):
            raise
        if "allow_pickle" in str(error):
            raise UnsafeFileError(
                f"{file} holds pickled objects", expected="plain arrays", fix="save it again from numbers alone"
            ) from error
        raise _damaged(file, error) from error
    for key, array in zip(keys, arrays, strict=True):
        if not isinstance(array, np.ndarray):  # numpy hands out a member that is no array as bytes
            raise DataError(f"{file} is damaged", expected=f"an array {key}", got=f"{len(array)} bytes of something")
        check_shape(array, OCC3D_SPEC.shape, f"{key} of {file}")
    return arrays


def _as_mask(mask: np.ndarray, name: str, file: Path) -> Bool[np.ndarray, "x y z"]:
    if not (mask.dtype == np.bool_ or np.issubdtype(mask.dtype, np.integer)) or not np.isin(mask, (0, 1)).all():
        raise DataError(
            f"{name} of {file} is not a mask", expected="0 and 1", got=f"{mask.dtype} {mask.min()}..{mask.max()}"
        )
    return mask != 0


def _damaged(file: Path, error: Exception) -> DataError:
    return DataError(f"{file} cannot be read", expected="an .npz archive", got=str(error), fix="copy it again")
