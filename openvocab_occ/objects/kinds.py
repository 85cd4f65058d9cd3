"""What kind of thing a class name speaks of: ground, something fixed, or something that can move.

This is evidence for cutting, tracking and states where an occupancy grid or a labelled model names classes; it is never
a list of what can be found.
"""

import re
from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from jaxtyping import Int8


class Kind(IntEnum):
    """What a class is good for."""

    UNKNOWN = 0
    GROUND = 1
    FIXED = 2
    MOVABLE = 3
    NOTHING = 4
    """Sky: what it names is no thing."""


_WORDS = {
    Kind.GROUND: "road street lane driveable drivable surface asphalt pavement flat sidewalk terrain ground grass "
    "crosswalk parking floor lawn kerb curb path dirt gravel soil sand water",
    Kind.FIXED: "building house wall fence pole tree vegetation trunk bush hedge manmade barrier sign light cone "
    "shed bridge structure others other plant bench lamp rail guardrail hydrant mailbox",
    Kind.MOVABLE: "car van truck bus trailer vehicle motorcycle motorbike bicycle bike pedestrian person people "
    "rider cyclist bicyclist motorcyclist tractor excavator train tram animal dog cat taxi ambulance "
    "lorry pickup scooter stroller",
    Kind.NOTHING: "sky free background void nothing",
}  # fmt: skip
_KIND = {word: kind for kind, words in _WORDS.items() for word in words.split()}
_LENGTH = {
    "pedestrian": (0.4, 1.2), "person": (0.4, 1.2), "bicycle": (1.2, 2.4), "motorcycle": (1.4, 2.8),
    "car": (3.2, 6.0), "van": (4.2, 7.2), "truck": (4.6, 12.0), "bus": (6.0, 19.0), "trailer": (4.0, 16.0),
    "construction vehicle": (3.0, 11.0),
}  # fmt: skip
"""Least and greatest length in metres of what the class names, as built."""


def kind_of(name: str) -> Kind:
    """Return what kind of thing a class name speaks of, by its words; the last known word decides.

    Names of which no word is known are UNKNOWN.
    """
    text = name.lower()
    if text in ("traffic light", "street light", "street lamp", "street sign", "bus stop", "fire hydrant"):
        return Kind.FIXED
    if text in ("car park", "parking lot", "parking space"):
        return Kind.GROUND
    for word in reversed(re.findall(r"[a-z]+", text)):
        kind = _KIND.get(word) or _KIND.get(word.removesuffix("s"))
        if kind is not None:
            return kind
    return Kind.UNKNOWN


def kinds_of(names: Sequence[str]) -> Int8[np.ndarray, "256"]:
    """Return the kind of each class number; UNKNOWN beyond the names."""
    table = np.zeros(256, dtype=np.int8)
    table[: len(names)] = [kind_of(name) for name in names]
    return table


def plausible_length(name: str) -> tuple[float, float] | None:
    """Return the least and greatest length in metres of a thing called so; None where that says nothing."""
    return _LENGTH.get(name.lower())
