"""The scene map: voxels, objects, and how they came to be."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from openvocab_occ.geometry import Camera, as_pose
from openvocab_occ.io.files import PathLike
from openvocab_occ.mapping import DynamicLayer, VoxelMap
from openvocab_occ.objects.tree import ObjectTree
from openvocab_occ.segmentation.encoder import Contract, PixelEncoder


@dataclass(frozen=True, kw_only=True)
class EncoderInfo:
    """Which encoder made a map's features."""

    name: str
    contract: Contract
    dim: int
    labels: tuple[str, ...] = ()
    """Names of the channels of a `logits` map."""
    fingerprint: str
    """Two encoders with the same fingerprint give the same features."""

    @classmethod
    def of(cls, encoder: PixelEncoder) -> "EncoderInfo":
        """Describe an encoder."""
        return cls(
            name=encoder.name,
            contract=encoder.contract,
            dim=encoder.dim,
            labels=tuple(encoder.labels),
            fingerprint=encoder.fingerprint,
        )


@dataclass(frozen=True, eq=False)
class NamedCamera(Camera):
    """A camera at the pose it had in a keyframe."""

    name: str = ""
    """Channel, such as CAM_FRONT."""

    @classmethod
    def of(cls, camera: Camera, name: str) -> "NamedCamera":
        """Give a camera a name."""
        return cls(camera.K, camera.width, camera.height, camera.T_world_cam, camera.distortion, camera.lens, name)


@dataclass(frozen=True, eq=False)
class KeyFrame:
    """One frame that a map was built from; the images stay where they are."""

    index: int
    timestamp: float
    """Seconds, of the source's own clock."""
    T_world_ego: Float[np.ndarray, "4 4"]
    cameras: tuple[NamedCamera, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_ego", as_pose(self.T_world_ego, f"T_world_ego of keyframe {self.index}"))


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Where a map comes from."""

    source: str = ""
    """Kind of the sequence, such as nuscenes-infos."""
    name: str = ""
    """Name of the sequence."""
    synthetic: bool = False
    """True when the images were rendered; every number of such a map says so."""
    options: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Options of the builder: plain JSON values."""
    command: str = ""
    """Command line that built the map; empty when a program did."""
    date: str = ""
    """ISO 8601, UTC."""
    version: str = ""
    """Of this package."""


@dataclass(frozen=True, eq=False)
class SceneMap:
    """A map that answers words; does not change once made."""

    voxels: VoxelMap
    objects: ObjectTree
    encoder: EncoderInfo
    frames: tuple[KeyFrame, ...] = ()
    provenance: Provenance = field(default_factory=Provenance)
    class_names: tuple[str, ...] = ()
    """Names of the occupancy classes in `voxels.labels`."""
    dynamic: tuple[DynamicLayer, ...] = ()
    """What moved, frame by frame; none of it is in `voxels`."""

    def save(self, path: PathLike, *, max_cosine_error: float | None = None) -> Path:
        """Write a `.ovmap` folder, whole or not at all; an older map at `path` is replaced, any other folder is not.

        Voxels whose features differ by at most `max_cosine_error` (1 - cosine; None for the usual bound) may share one
        vector; 0 stores every voxel's own. The manifest states the worst error made. Raises StorageError when the
        disk is full.
        """
        from openvocab_occ.objects.ovmap import MAX_COSINE_ERROR, write_map

        bound = MAX_COSINE_ERROR if max_cosine_error is None else max_cosine_error
        return write_map(self, path, max_cosine_error=bound)

    @classmethod
    def open(cls, path: PathLike, *, region: Float[np.ndarray, "2 3"] | None = None) -> "SceneMap":
        """Read a `.ovmap` folder; columns and features of the voxels when they are first asked for.

        With a `region` (lower and upper corner, metres) only the voxels whose centres it holds; objects of which it
        holds none are left out. Every file is checked against the manifest's sha256; those above 16 MB page by page
        as they are read.

        Raises NotFoundError where there is no folder, MapError where it is damaged, from the future, or no map.
        """
        from openvocab_occ.objects.ovmap import read_map

        return read_map(path, region=region)

    def __repr__(self) -> str:
        made = "synthetic " if self.provenance.synthetic else ""
        return f"SceneMap({made}{len(self.voxels)} voxels, {len(self.objects)} objects, encoder {self.encoder.name})"
