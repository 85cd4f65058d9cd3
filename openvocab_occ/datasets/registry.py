"""Kinds of drives by name."""

import inspect
from importlib import import_module
from pathlib import Path
from typing import Any

from openvocab_occ.datasets.frame import FrameSequence
from openvocab_occ.datasets.predictions import GridFormat, OccupancySource, join_occupancy
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import GridSpec
from openvocab_occ.io.files import PathLike
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_SPEC

READERS = {
    "city": "openvocab_occ.datasets.city.sequence:load_city",
    "colmap": "openvocab_occ.datasets.colmap:load_colmap",
    "kitti": "openvocab_occ.datasets.kitti:load_kitti",
    "nerfstudio": "openvocab_occ.datasets.nerfstudio:load_nerfstudio",
    "nuscenes": "openvocab_occ.datasets.nuscenes:load_nuscenes",
    "nuscenes-infos": "openvocab_occ.datasets.nuscenes_infos:load_infos",
    "recording": "openvocab_occ.datasets.recording:load_recording",
    "rgbd": "openvocab_occ.datasets.rgbd:load_rgbd",
    "rosbag": "openvocab_occ.datasets.rosbag:load_rosbag",
    "street": "openvocab_occ.datasets.street:load_street",
}
"""What reads each kind: `module:function`, called as function(root, scene=..., **options)."""


def load_sequence(
    kind: str,
    root: PathLike | None = None,
    *,
    scene: str | None = None,
    occupancy: OccupancySource | None = None,
    occupancy_frame: str = "lidar_ego",
    occupancy_spec: GridSpec = OCC3D_SPEC,
    occupancy_classes: tuple[str, ...] = OCC3D_CLASSES,
    occupancy_free: int | None = None,
    **options: Any,
) -> FrameSequence:
    """Open a drive; its frames are read when they are asked for.

        load_sequence("nuscenes-infos", "keyframe/", occupancy="preds/{token}.npz")
        load_sequence("city", seed=7, route=0, traversal=1, condition="rain", frames=8)

    Args:
        kind: One of
            `nuscenes` (the official tables, Occ3D's `gts/` beside them), `nuscenes-infos` (mmdetection3d v1.1 info
            files), `kitti` (odometry and SemanticKITTI), `rgbd` (7-Scenes, 3DMatch, TUM, ScanNet exports), `nerfstudio`
            (transforms.json), `colmap`, `rosbag` (ROS 1, ROS 2, MCAP), `recording` (our own folder, docs/recording.md),
            `city` (a made-up town, docs/city.md) or `street` (a small made-up street; options `seed`, `frames`). The
            readers' own docs tell their options.
        root: File or folder of the drive.
        scene: Which drive, where the root holds several.
        occupancy: Your own predictions: a file name with {token}, {index}, {scene} or {timestamp}, relative to the
            root, or a function of the frame that returns a grid, an array or a file. They replace the source's own.
        occupancy_frame: Frame of those grids: `lidar_ego` (Occ3D), `cam_front_left_ego`, `lidar` or `world`.
        occupancy_spec: Their lattice.
        occupancy_classes: Their classes.
        occupancy_free: The class that means empty; by default the one named `free`.
        options: Options of the kind.

    Raises:
        ConfigError: The kind, an option, a placeholder or the frame of the grids is not known.
        NotFoundError: A file is not there (also later, when a frame is read).
    """
    if kind not in READERS:
        raise ConfigError("kind of sequence is not known", expected=" or ".join(sorted(READERS)), got=repr(kind))
    module, name = READERS[kind].split(":")
    reader = getattr(import_module(module), name)
    known = [p for p in inspect.signature(reader).parameters if p not in ("root", "scene")]
    for option in options:
        if option not in known:
            raise ConfigError(f"{kind} has no option {option!r}", expected=" or ".join(known))
    grid = GridFormat(
        spec=occupancy_spec, class_names=tuple(occupancy_classes), free_label=occupancy_free, frame=occupancy_frame
    )
    sequence: FrameSequence = reader(root, scene=scene, **options)
    if occupancy is None:
        return sequence
    folder = None if root is None else Path(root).expanduser()
    if folder is not None and folder.is_file():
        folder = folder.parent
    return join_occupancy(sequence, occupancy, root=folder, grid=grid)
