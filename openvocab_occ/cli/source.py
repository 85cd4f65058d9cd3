"""The options that say which drive is read; the same for every command that reads one."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from openvocab_occ.datasets.frame import FrameSequence
from openvocab_occ.errors import ConfigError


@dataclass(frozen=True)
class Source:
    """A drive on disk."""

    kind: Annotated[str, tyro.conf.Positional]
    """The source: nuscenes, nuscenes-infos, kitti, rgbd, nerfstudio, colmap, rosbag, recording, city, street."""
    path: Annotated[str, tyro.conf.Positional]
    """Its folder or file; for the city and the street, any name."""
    scene: str | None = None
    """One scene of a source that holds several."""
    occupancy: str | None = None
    """Your own grids: files below the source by {token}, {index}, {scene} or {timestamp}, such as pred/{token}.npz."""
    occupancy_frame: str = "lidar_ego"
    """The frame these grids are in: lidar_ego, cam_front_left_ego, lidar or world."""
    fuse: int | None = None
    """Carve a grid for each frame from the LiDAR or depth of it and of so many frames before and after it."""
    frames: int | None = None
    """Use only the first so many."""
    option: Annotated[list[str], tyro.conf.UseAppendAction] = field(default_factory=list[str])
    """An option of the kind as KEY=VALUE, the value in JSON or plain text, such as depth_scale=5000 or up=y."""

    def load(self) -> FrameSequence:
        """Open the drive."""
        from openvocab_occ.datasets.fused import join_fused
        from openvocab_occ.datasets.registry import load_sequence

        root = None if self.kind in ("city", "street") else Path(self.path)
        sequence = load_sequence(
            self.kind,
            root,
            scene=self.scene,
            occupancy=self.occupancy,
            occupancy_frame=self.occupancy_frame,
            **self.options(),
        )
        if self.fuse is not None:
            if self.occupancy is not None:
                raise ConfigError("a grid is either read or carved", expected="--occupancy or --fuse", got="both")
            sequence = join_fused(sequence, before=self.fuse, after=self.fuse)
        return sequence[: self.frames]

    def options(self) -> dict[str, Any]:
        """Return the options of the kind."""
        found: dict[str, Any] = {}
        for text in self.option:
            key, equals, value = text.partition("=")
            if not equals or not key:
                raise ConfigError("option cannot be read", expected="KEY=VALUE", got=text)
            try:
                found[key.replace("-", "_")] = json.loads(value)
            except ValueError:
                found[key.replace("-", "_")] = value
        return found
