"""A stand-in for a perception network: logits from the truth, wrong where and as a camera network would be.

The model, so that claims about maps and memory can be tested without a network:

- Each voxel is seen (`mask_camera`) or not, at a distance r from the ego.
- The chance that it is right is `reach` x (0.97 if seen else 0.45) x exp(-(r / far)^2), with `far` 60 m in clear
  weather; rain, night and fog lower reach and far (`NOISE`). Errors are drawn in blobs of about two
  voxels, because networks err in pieces, not in grains of salt.
- A wrong occupied voxel becomes free (60 %), or takes a class that is easily taken for its own (`CONFUSED`). A wrong
  free voxel next to something, on one side drawn for the frame, becomes that something; others stay free.
- The winner's logit exceeds the others by a margin that falls with distance and by condition, next to noise of 0.5, so
  that confidence says something about being right.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float32

from openvocab_occ.datasets.city.labels import Labels
from openvocab_occ.datasets.city.things import LABELS
from openvocab_occ.errors import ConfigError
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_FREE, OccupancyGrid


@dataclass(frozen=True)
class Noise:
    """How much a condition costs."""

    reach: float
    """Factor on the chance to be right."""
    far: float
    """Metres after which that has fallen to 1/e."""
    sharpness: float
    """Logit of the winner next to the ego."""


NOISE: Mapping[str, Noise] = MappingProxyType({
    "clear": Noise(1.0, 60.0, 6.0),
    "heavy traffic": Noise(1.0, 60.0, 6.0),
    "rain": Noise(0.9, 42.0, 4.5),
    "night": Noise(0.85, 34.0, 4.0),
    "fog": Noise(0.92, 26.0, 4.0),
})  # fmt: skip
_PAIRS = (
    ("car", "truck"), ("truck", "bus"), ("truck", "trailer"), ("truck", "construction vehicle"), ("bus", "trailer"),
    ("bicycle", "motorcycle"), ("pedestrian", "bicycle"), ("traffic cone", "barrier"), ("barrier", "manmade"),
    ("driveable surface", "other flat"), ("sidewalk", "driveable surface"), ("sidewalk", "terrain"),
    ("terrain", "vegetation"), ("manmade", "vegetation"), ("others", "manmade"),
)  # fmt: skip


def _confused() -> np.ndarray:
    """Return for each class the one it is most easily taken for."""
    other = np.full(len(OCC3D_CLASSES), LABELS["manmade"], dtype=np.uint8)
    for a, b in reversed(_PAIRS):
        other[LABELS[a]] = LABELS[b]
    for a, b in reversed(_PAIRS):
        if other[LABELS[b]] == LABELS["manmade"]:
            other[LABELS[b]] = LABELS[a]
    other[LABELS["manmade"]] = LABELS["vegetation"]
    return other


CONFUSED = _confused()


def perceive(truth: Labels, condition: str = "clear", *, seed: int = 0) -> OccupancyGrid:
    """Return what a network might have predicted from a keyframe; the same seed errs in the same way."""
    if condition not in NOISE:
        raise ConfigError("condition is not known", expected=" or ".join(NOISE), got=repr(condition))
    noise = NOISE[condition]
    labels, spec = truth.grid.labels, truth.grid.spec
    rng = np.random.default_rng(seed)
    index = [np.arange(n) for n in spec.shape[:2]]
    middle = [np.asarray(spec.origin)[d] + (index[d] + 0.5) * spec.size[d] for d in (0, 1)]
    distance = np.hypot(middle[0][:, None], middle[1][None])[..., None].astype(np.float32)
    fall = np.exp(-((distance / noise.far) ** 2))
    right = noise.reach * np.where(truth.mask_camera, np.float32(0.97), np.float32(0.45)) * fall
    wrong = _blobs(spec.shape, rng) > right
    occupied = labels != OCC3D_FREE
    dice = rng.random(spec.shape, dtype=np.float32)
    seen = labels.copy()
    seen[wrong & occupied & (dice < 0.6)] = OCC3D_FREE
    swapped = wrong & occupied & (dice >= 0.6)
    seen[swapped] = CONFUSED[labels[swapped]]
    grown = _neighbour(labels, rng)
    spread = wrong & ~occupied & (grown != OCC3D_FREE)
    seen[spread] = grown[spread]
    return _with_logits(seen, truth, noise.sharpness * (0.4 + 0.6 * fall), rng)


def _blobs(shape: tuple[int, int, int], rng: np.random.Generator) -> Float32[np.ndarray, "x y z"]:
    """Return numbers uniform in [0, 1] that are alike in neighbouring voxels."""
    coarse = rng.random(tuple((n + 1) // 2 for n in shape), dtype=np.float32)
    wide = coarse.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)[: shape[0], : shape[1], : shape[2]]
    return np.where(rng.random(shape, dtype=np.float32) < 0.6, wide, rng.random(shape, dtype=np.float32))


def _neighbour(labels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return for each voxel the label of a neighbour that is not free, if it has one on the side drawn."""
    axis, step = int(rng.integers(3)), int(rng.choice([-1, 1]))
    moved = np.roll(labels, step, axis=axis)
    edge = [slice(None)] * 3
    edge[axis] = slice(0, 1) if step > 0 else slice(-1, None)
    moved[tuple(edge)] = OCC3D_FREE
    return moved


def _with_logits(
    seen: np.ndarray, truth: Labels, sharpness: Float32[np.ndarray, "x y 1"], rng: np.random.Generator
) -> OccupancyGrid:
    logits = rng.standard_normal((*seen.shape, len(OCC3D_CLASSES)), dtype=np.float32) * np.float32(0.5)
    flat, best = logits.reshape(-1, len(OCC3D_CLASSES)), seen.reshape(-1).astype(np.int64)
    rows, sharp = np.arange(len(flat)), np.broadcast_to(sharpness, seen.shape).reshape(-1).astype(np.float32)
    second = np.where(best == OCC3D_FREE, LABELS["manmade"], CONFUSED[best])
    flat[rows, second] += 0.35 * sharp
    flat[rows, OCC3D_FREE] += 0.3 * sharp
    flat[rows, best] = flat.max(axis=1) + 0.25 * sharp + np.float32(0.1)
    return OccupancyGrid.from_logits(logits, truth.grid.spec, truth.grid.T_world_grid)
