"""The options that say which drive is read; the same for every command that reads one."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from openvocab_occ.datasets.frame import FrameSequence


@dataclass(frozen=True)
class Source:
    """A drive on disk."""

    kind: Annotated[str, tyro.conf.Positional]
    """How the drive is stored: nuscenes-infos, city, street."""
    path: Annotated[str, tyro.conf.Positional]
    """Its folder or file; for the city and the street, any name."""
    scene: str | None = None
    """One scene of a source that holds several."""
    occupancy: str | None = None
    """Your own grids: files below the source by {token}, {index}, {scene} or {timestamp}, such as pred/{token}.npz."""
    occupancy_frame: str = "lidar_ego"
    """The frame these grids are in: lidar_ego, cam_front_left_ego or lidar."""
    frames: int | None = None
    """Use only the first so many."""

    def load(self) -> FrameSequence:
        """Open the drive."""
        from openvocab_occ.datasets.registry import load_sequence

        root = None if self.kind in ("city", "street") else Path(self.path)
        sequence = load_sequence(
            self.kind, root, scene=self.scene, occupancy=self.occupancy, occupancy_frame=self.occupancy_frame
        )
        return sequence[: self.frames]
