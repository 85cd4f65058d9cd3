"""Features of a map as a table in which voxels that look alike share a row."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float16, Float32, Float64, Int32

from openvocab_occ.errors import ConfigError
from openvocab_occ.objects._leaders_kernels import choose_leaders

_CHUNK = 1024  # voxels at once: neighbours along the drive, for voxels are sorted by x
_RECENT = 1024  # rows of the table that a chunk is compared with


@dataclass(frozen=True, eq=False)
class FeatureTable:
    """Vectors and the row of each voxel."""

    vectors: Float16[np.ndarray, "t c"]
    row: Int32[np.ndarray, " n"]
    worst_cosine_error: float
    """Greatest 1 - cosine between a voxel's feature and the vector it points to."""
    mean_cosine_error: float


def feature_table(features: Float32[np.ndarray, "n c"], max_cosine_error: float) -> FeatureTable:
    """Choose some of the features as vectors so that each voxel has one within `max_cosine_error`; 0 keeps all.

    Voxels are taken in order; one that no recent vector is near becomes a vector itself. That is not the fewest vectors
    there could be, but takes time linear in the voxels: about 40 microseconds each at 512 features on one core.
    """
    if not 0 <= max_cosine_error <= 1:
        raise ConfigError("max_cosine_error is not usable", expected="0..1", got=max_cosine_error)
    count = len(features)
    if max_cosine_error == 0:
        leaders, row = np.arange(count), np.arange(count, dtype=np.int32)
    else:
        leaders, row = _leaders(features, 1 - 0.99 * max_cosine_error)  # the rest is for rounding to float16
    vectors = features[leaders].astype(np.float16)
    worst, total = 0.0, 0.0
    for start in range(0, count, 1 << 14):
        error = 1 - cosines(features[start : start + (1 << 14)], vectors[row[start : start + (1 << 14)]])
        worst, total = max(worst, float(error.max())), total + float(error.sum())
    return FeatureTable(vectors, row, worst, total / max(count, 1))


def cosines(a: np.ndarray, b: np.ndarray) -> Float64[np.ndarray, " n"]:
    """Return the cosine of each pair of rows; 1 where both are zero."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    equal = ~a.any(axis=1) & ~b.any(axis=1)
    return np.where(equal, 1.0, np.einsum("nc,nc->n", a, b) / np.where(lengths > 0, lengths, 1))


def _leaders(features: Float32[np.ndarray, "n c"], least: float) -> tuple[np.ndarray, Int32[np.ndarray, " n"]]:
    """Return which voxels become vectors, and the vector of each voxel."""
    row = np.full(len(features), -1, dtype=np.int32)
    leaders: list[int] = []
    recent = np.empty((0, features.shape[1]), dtype=np.float32)
    for start in range(0, len(features), _CHUNK):
        unit = features[start : start + _CHUNK]
        norm = np.linalg.norm(unit, axis=1, keepdims=True)
        unit = np.divide(unit, norm, out=np.zeros_like(unit), where=norm > 0)
        found = row[start : start + _CHUNK]
        if len(recent):
            near = unit @ recent.T
            best = near.argmax(axis=1)
            good = near[np.arange(len(unit)), best] >= least
            found[good] = len(leaders) - len(recent) + best[good]
        left = np.flatnonzero(found < 0)
        if not len(left):
            continue
        number = np.empty(len(left), dtype=np.int32)
        fresh = np.empty(len(left), dtype=np.int64)
        count = choose_leaders(unit[left] @ unit[left].T, least, number, fresh)
        found[left] = len(leaders) + number
        leaders.extend((start + left[fresh[:count]]).tolist())
        recent = np.concatenate([recent, unit[left[fresh[:count]]]])[-_RECENT:]
    return np.array(leaders, dtype=np.int64), row
