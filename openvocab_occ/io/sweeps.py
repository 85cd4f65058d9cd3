"""LiDAR sweeps as files of bare numbers."""

import numpy as np
from jaxtyping import Float32

from openvocab_occ.errors import DataError
from openvocab_occ.io.files import PathLike, existing


def read_sweep(path: PathLike, columns: int, *, what: str = "LiDAR sweep") -> Float32[np.ndarray, "n 3"]:
    """Read rows of little-endian float32 that begin with x, y, z; returns that are not finite are left out.

    Args:
        path: The file.
        columns: Numbers in a row: 4 for KITTI, 5 for nuScenes.
        what: What error messages call it.
    """
    file = existing(path, what)
    content = file.read_bytes()
    if columns < 3 or len(content) % (4 * columns):
        raise DataError(
            f"{what} {file.name} is cut off or of another kind",
            expected=f"float32 rows of {columns}",
            got=f"{len(content)} bytes",
        )
    local = np.frombuffer(content, dtype="<f4").reshape(-1, columns)[:, :3]
    return np.ascontiguousarray(local[np.isfinite(local).all(axis=1)], dtype=np.float32)
