"""The probability that voxels are occupied, as a field whose level 0.5 is a surface."""

import numpy as np
from jaxtyping import Bool, Float32

_LEVEL, _MARGIN = 0.5, 0.1


def probability_from_logits(logits: Float32[np.ndarray, "x y z classes"], free: int) -> Float32[np.ndarray, "x y z"]:
    """Return 1 - softmax(logits)[free]."""
    with np.errstate(over="ignore"):
        odds = np.exp(logits - logits[..., free, None])  # of each class against free, which is 1
    total = odds.sum(axis=-1, dtype=np.float64)
    return (1.0 - 1.0 / total).astype(np.float32)


def probability_from_labels(
    occupied: Bool[np.ndarray, "x y z"], known: Bool[np.ndarray, "x y z"] | None
) -> Float32[np.ndarray, "x y z"]:
    """Smooth labels into a field: binomial weights 1 2 1 along each axis, over known voxels only.

    Every voxel stays on its side of 0.5, by 0.1 at least, so that walls one voxel thick and single voxels remain.
    Outside the grid nothing is known.
    """
    weight = np.ones(occupied.shape, np.float32) if known is None else known.astype(np.float32)
    inside = occupied.astype(np.float32)
    total = _binomial(weight)
    mean = np.divide(_binomial(inside), total, out=np.zeros_like(total), where=total > 0)
    return np.where(
        occupied, np.maximum(mean, np.float32(_LEVEL + _MARGIN)), np.minimum(mean, np.float32(_LEVEL - _MARGIN))
    )


def _binomial(values: Float32[np.ndarray, "x y z"]) -> Float32[np.ndarray, "x y z"]:
    for axis in range(3):
        pad = [(1, 1) if k == axis else (0, 0) for k in range(3)]
        wide = np.moveaxis(np.pad(values, pad), axis, 0)
        values = np.moveaxis((wide[:-2] + 2 * wide[1:-1] + wide[2:]) / np.float32(4), 0, axis)
    return np.ascontiguousarray(values)
