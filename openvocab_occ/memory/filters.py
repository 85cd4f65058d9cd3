"""What to do about things that move, before a write or after a read (LMPOcc Table VI)."""

from collections.abc import Collection, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32

from openvocab_occ.errors import ConfigError
from openvocab_occ.memory.schema import FREE

DYNAMIC = frozenset({
    "others", "barrier", "bicycle", "bus", "car", "construction vehicle", "motorcycle", "pedestrian", "traffic cone",
    "trailer", "truck",
})  # fmt: skip
"""The paper's dynamic classes: 0 to 10 of Occ3D."""


def remove_dynamic(
    logits: Float[np.ndarray, "x y z classes"],
    known: Bool[np.ndarray, "x y z"],
    class_names: Sequence[str],
    *,
    version: Literal[1, 2],
    seed: int = 0,
    dynamic: Collection[str] = DYNAMIC,
) -> Float32[np.ndarray, "x y z classes"]:
    """Return logits without the voxels whose largest class is dynamic; only known voxels are looked at.

    Version 1 sets their logits to 0. Version 2 gives each the logits of a free voxel, drawn at random; where none is
    free it does as version 1. The paper keeps dynamic things: both ways cost it accuracy.
    """
    if FREE not in class_names:
        raise ConfigError("the classes have no 'free'", expected="a class of that name", got=tuple(class_names))
    if version not in (1, 2):
        raise ConfigError("version is not known", expected="1 or 2", got=version)
    out = logits.astype(np.float32)
    label = logits.argmax(axis=-1)
    moving = known & np.isin(label, [n for n, name in enumerate(class_names) if name in dynamic])
    free = np.flatnonzero(known & (label == class_names.index(FREE)))
    out[moving] = 0.0
    if version == 2 and free.size:
        drawn = np.random.default_rng(seed).choice(free, size=int(moving.sum()))
        out[moving] = logits.reshape(-1, logits.shape[-1])[drawn]
    return out
