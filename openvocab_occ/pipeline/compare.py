"""What is different between two maps of one place, where both looked."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Int64

from openvocab_occ.errors import ConfigError, EncoderMismatchError
from openvocab_occ.mapping import NO_LABEL, VoxelMap
from openvocab_occ.objects import SceneMap

MIN_SHARE = 0.5
"""Share of an object's voxels that must have appeared, or vanished, for the object to."""


@dataclass(frozen=True, eq=False)
class MapDiff:
    """Positions of voxels in the two maps. Every voxel of a is same, changed, vanished, not observed or shifted."""

    same: int
    """Voxels in both that agree."""
    changed: Int64[np.ndarray, " c"]
    """Positions in b of voxels in both that look different or are of another class."""
    appeared: Int64[np.ndarray, " p"]
    """Positions in b where a had looked through."""
    vanished: Int64[np.ndarray, " v"]
    """Positions in a that b looked through."""
    not_observed_in_a: Int64[np.ndarray, " q"]
    """Positions in b of which a knows nothing: they may have been there all along."""
    not_observed_in_b: Int64[np.ndarray, " r"]
    """Positions in a of which b knows nothing: they may still be there."""
    shifted: int
    """Voxels of either that the other has a voxel or two beside: the same surface on another side of a face."""
    objects_appeared: tuple[int, ...]
    """Ids in b."""
    objects_vanished: tuple[int, ...]
    """Ids in a."""

    def to_dict(self) -> dict[str, Any]:
        """Return the counts and the objects."""
        counts = {
            name: len(getattr(self, name))
            for name in ("changed", "appeared", "vanished", "not_observed_in_a", "not_observed_in_b")
        }
        objects = {"objects_appeared": self.objects_appeared, "objects_vanished": self.objects_vanished}
        return {"same": self.same, "shifted": self.shifted, **counts, **objects}


def diff(a: SceneMap, b: SceneMap, *, min_cosine: float = 0.8, tolerance: int = 1) -> MapDiff:
    """Compare two maps of one frame and voxel size.

    Args:
        a: Usually the earlier one.
        b: The later one.
        min_cosine: Features below it have changed.
        tolerance: Voxels within which a voxel of the other map counts as the same surface. Two drives put a wall on
            one or the other side of a face of the lattice.
    """
    if a.voxels.voxel_size != b.voxels.voxel_size:
        raise ConfigError("maps have different voxel sizes", expected=a.voxels.voxel_size, got=b.voxels.voxel_size)
    if a.encoder.fingerprint != b.encoder.fingerprint:
        raise EncoderMismatchError(
            "features of different encoders cannot be compared", expected=a.encoder.name, got=b.encoder.name
        )
    if not 0 <= tolerance <= 3 or not -1 <= min_cosine <= 1:
        raise ConfigError("diff options are not usable", expected="tolerance 0..3, min_cosine -1..1")
    at = b.voxels.index(a.voxels.keys)
    both = np.flatnonzero(at >= 0)
    differs = _differs(a, b, both, at[both], min_cosine)
    vanished, unknown_b, shifted_b = _missing(a.voxels, b.voxels, tolerance)
    appeared, unknown_a, shifted_a = _missing(b.voxels, a.voxels, tolerance)
    return MapDiff(
        same=int((~differs).sum()),
        changed=np.sort(at[both[differs]]),
        appeared=np.flatnonzero(appeared),
        vanished=np.flatnonzero(vanished),
        not_observed_in_a=np.flatnonzero(unknown_a),
        not_observed_in_b=np.flatnonzero(unknown_b),
        shifted=int(shifted_a.sum() + shifted_b.sum()),
        objects_appeared=_mostly(b, appeared),
        objects_vanished=_mostly(a, vanished),
    )


def _differs(
    a: SceneMap, b: SceneMap, in_a: Int64[np.ndarray, " n"], in_b: Int64[np.ndarray, " n"], min_cosine: float
) -> Bool[np.ndarray, " n"]:
    """Tell which pairs of voxels look different, or are named differently by occupancies of the same classes."""
    one, other = a.voxels.features[in_a], b.voxels.features[in_b]
    lengths = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
    differs = np.einsum("nc,nc->n", one, other) < min_cosine * lengths
    if a.class_names == b.class_names:
        labels = a.voxels.labels[in_a], b.voxels.labels[in_b]
        differs |= (labels[0] != labels[1]) & (labels[0] != NO_LABEL) & (labels[1] != NO_LABEL)
    return differs


def _missing(
    here: VoxelMap, there: VoxelMap, tolerance: int
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Of voxels `here` that are not `there`, tell which were looked through, not observed, and shifted."""
    missing = there.index(here.keys) < 0
    shifted = np.zeros(len(here), dtype=bool)
    span = range(-tolerance, tolerance + 1)
    for offset in ((x, y, z) for x in span for y in span for z in span):
        rest = np.flatnonzero(missing & ~shifted)
        near = there.index((here.keys[rest] + np.array(offset)).astype(np.int32)) >= 0
        shifted[rest[near]] = True
    through = there.free.count(here.keys) > 0
    open = missing & ~shifted
    return open & through, open & ~through, missing & shifted


def _mostly(scene: SceneMap, chosen: Bool[np.ndarray, " n"]) -> tuple[int, ...]:
    """Return the ids of the objects of whose voxels most are chosen."""
    return tuple(node.id for node in scene.objects if len(node.voxels) and chosen[node.voxels].mean() >= MIN_SHARE)
