"""Bridges: where two things that touch became one, and where to cut them."""

import numpy as np
from jaxtyping import Int64

from openvocab_occ.mapping.keys import unpack
from openvocab_occ.objects.box import principal_yaw
from openvocab_occ.objects.kinds import plausible_length

VALLEY = 0.55
"""A cross section of what is too long for one thing counts as a neck when it holds at most this share of the voxels of
the fullest on either side."""
GAP = 0.15
"""The same of what may be one thing, for a truck has a neck of its own behind the cab."""
TOO_LONG = 1.25
"""Times its greatest plausible length from which a thing is surely more than one."""
_SLACK = 0.8  # metres by which voxels make a thing look longer


def cut_bridge(packed: Int64[np.ndarray, " n"], name: str, voxel_size: float) -> list[Int64[np.ndarray, " _"]]:
    """Return the voxels of each thing that a segment of things called `name` is made of, along its length.

    A segment is cut at the emptiest cross section that leaves a plausible length of such a thing on both sides and is a
    neck, or, where the whole is far too long for one, at the emptiest whatever it holds; where the whole is no longer
    than one can be, only where hardly anything is left. Names without a plausible length are never cut. The pieces are
    cut again.
    """
    lengths = plausible_length(name)
    if lengths is None or len(packed) < 8:
        return [packed]
    least, greatest = lengths
    xy = (unpack(packed)[:, :2] + 0.5) * voxel_size
    if np.linalg.norm(np.ptp(xy, axis=0)) < 2 * least - _SLACK:
        return [packed]
    yaw = principal_yaw(xy)
    along = xy @ np.array([np.cos(yaw), np.sin(yaw)])
    along -= along.min()
    slices = np.floor(along / voxel_size).astype(int)
    filled = np.bincount(slices).astype(np.float64)
    edge = max(round((least - _SLACK) / voxel_size), 1)
    if len(filled) < 2 * edge + 1:
        return [packed]
    length = len(filled) * voxel_size
    # slices of a turned lattice hold now more, now fewer voxels, so necks are those of their mean; gaps are clear
    smooth = np.convolve(np.pad(filled, 1, mode="edge"), np.ones(3) / 3, mode="valid")
    profile, valley = (smooth, VALLEY) if length > greatest + _SLACK else (filled, GAP)
    at = edge + int(profile[edge : len(profile) - edge].argmin())
    peak = min(smooth[:at].max(), smooth[at:].max())
    if profile[at] > valley * peak and length <= greatest * TOO_LONG + _SLACK:
        return [packed]
    left = slices < at if profile[at] > valley * peak else slices <= at
    return [
        piece
        for side in (packed[left], packed[~left])
        if len(side)
        for piece in (cut_bridge(side, name, voxel_size) if 0 < left.sum() < len(packed) else [side])
    ]
