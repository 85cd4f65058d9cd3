"""From one format to another, by the ends of the names."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from openvocab_occ.errors import ConfigError
from openvocab_occ.export.formats.cloud import Cloud
from openvocab_occ.export.formats.las import read_las, write_las
from openvocab_occ.export.formats.octomap import read_bt, write_bt
from openvocab_occ.export.formats.openlex3d import read_openlex3d, write_openlex3d
from openvocab_occ.export.formats.pcd import read_pcd, write_pcd
from openvocab_occ.export.formats.ply import read_ply, write_ply
from openvocab_occ.export.formats.rerun_log import read_rrd, write_rrd
from openvocab_occ.io.files import PathLike, existing
from openvocab_occ.objects import SceneMap


def _tree_points(path: PathLike) -> Cloud:
    tree = read_bt(path)
    corner, size = tree.corner[tree.occupied], tree.size[tree.occupied]
    parts = [  # large leaves become the cells they stand for
        (corner[size == edge][:, None] + np.array(list(np.ndindex(edge, edge, edge)))).reshape(-1, 3)
        for edge in np.unique(size)
    ]
    cells = np.concatenate(parts or [np.empty((0, 3), dtype=np.int64)])
    return Cloud((cells + 0.5) * tree.resolution)


_READERS: dict[str, Callable[[PathLike], Cloud]] = {
    ".ply": read_ply, ".pcd": read_pcd, ".las": read_las, ".laz": read_las, ".bt": _tree_points,
    ".openlex3d": lambda path: read_openlex3d(path)[0], ".rrd": read_rrd,
}  # fmt: skip
_POINT_WRITERS: dict[str, Callable[[Cloud, PathLike], Path]] = {
    ".ply": write_ply, ".pcd": write_pcd, ".las": write_las, ".laz": write_las,
}  # fmt: skip
_MAP_WRITERS: dict[str, Callable[[SceneMap, PathLike], Path]] = {
    ".bt": lambda scene, path: write_bt(scene.voxels, path), ".rrd": write_rrd, ".openlex3d": write_openlex3d,
}  # fmt: skip


def read_cloud(path: PathLike) -> Cloud:
    """Read the points of a map or of a PLY, PCD, LAS, LAZ, OctoMap .bt (occupied cells), .openlex3d or .rrd."""
    end = Path(path).suffix.lower()
    if end == ".ovmap":
        return Cloud.of(SceneMap.open(path))
    if end not in _READERS:
        raise ConfigError("format is not read", expected=", ".join([".ovmap", *_READERS]), got=end or "no ending")
    return _READERS[end](existing(path, "file"))


def convert(source: PathLike, target: PathLike) -> Path:
    """Write the points or the map `source` in the format that the ending of `target` names.

    PLY, PCD, LAS and LAZ hold points; `.bt` (OctoMap), `.rrd` (Rerun) and `.openlex3d` folders are made of maps only.
    """
    end = Path(target).suffix.lower()
    if end in _POINT_WRITERS:
        return _POINT_WRITERS[end](read_cloud(source), target)
    if end not in _MAP_WRITERS:
        known = ", ".join([*_POINT_WRITERS, *_MAP_WRITERS])
        raise ConfigError("format is not written", expected=known, got=end or "no ending")
    if Path(source).suffix.lower() != ".ovmap":
        raise ConfigError(f"{end} needs a map to start from", expected=".ovmap", got=str(source))
    return _MAP_WRITERS[end](SceneMap.open(source), target)
