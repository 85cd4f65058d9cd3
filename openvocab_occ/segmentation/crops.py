"""Models that embed whole images, such as a CLIP or SigLIP image tower, made to say something of each place."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float32, UInt8

from openvocab_occ.segmentation.card import CropCard
from openvocab_occ.segmentation.encoder import FeatureMap, MaskMap
from openvocab_occ.segmentation.masks import box_of

Embed = Callable[[Sequence[UInt8[np.ndarray, "_ _ 3"]]], Float32[np.ndarray, "n c"]]
"""Unit vectors of images of any sizes."""


@dataclass(frozen=True)
class Window:
    """A square of an image, pixels."""

    top: int
    left: int
    edge: int


def windows(height: int, width: int, card: CropCard) -> Iterator[Window]:
    """Yield the windows of every level; each level covers the image, evenly spread."""
    short = min(height, width)
    for part in card.windows:
        edge = max(1, round(part * short))
        step = max(1.0, edge * (1 - card.overlap))
        tops, lefts = (
            np.unique(np.rint(np.linspace(0, side - edge, int(np.ceil((side - edge) / step)) + 1)).astype(int))
            for side in (height, width)
        )
        for top, left in product(tops.tolist(), lefts.tolist()):
            yield Window(top, left, edge)


def encode_windows(image: UInt8[np.ndarray, "h w 3"], card: CropCard, embed: Embed) -> FeatureMap:
    """Return features on a grid as fine as the smallest step of the windows.

    A cell's vector is the sum of those of the windows over it, weighed by a Gaussian around each window's centre (a
    quarter of its edge wide) and by 1 / edge, so that the small windows decide where they see enough, made unit.
    """
    height, width = image.shape[:2]
    chosen = list(windows(height, width, card))
    vectors = embed([image[w.top : w.top + w.edge, w.left : w.left + w.edge] for w in chosen])
    step = max(1.0, min(card.windows) * min(height, width) * (1 - card.overlap))
    rows, columns = max(1, round(height / step)), max(1, round(width / step))
    v, u = ((np.arange(n) + 0.5) * side / n for n, side in ((rows, height), (columns, width)))
    total = np.zeros((rows, columns, vectors.shape[1]), dtype=np.float32)
    for window, vector in zip(chosen, vectors, strict=True):
        half = window.edge / 2
        y, x = (v - window.top - half) / half, (u - window.left - half) / half
        weight = np.outer(np.exp(-2 * y**2) * (np.abs(y) <= 1), np.exp(-2 * x**2) * (np.abs(x) <= 1)) / window.edge
        total += weight.astype(np.float32)[:, :, None] * vector
    lengths = np.linalg.norm(total, axis=2, keepdims=True)
    scale = (columns / width, rows / height)
    cells = total / np.where(lengths > 0, lengths, 1)
    return FeatureMap(cells, scale, (0.5 * scale[0] - 0.5, 0.5 * scale[1] - 0.5))


def encode_masks(image: UInt8[np.ndarray, "h w 3"], proposals: MaskMap, card: CropCard, embed: Embed) -> MaskMap:
    """Return the masks of `proposals`, whose vectors do not matter, with those of the crops around them."""
    height, width = image.shape[:2]
    crops, kept = [], []
    for number in range(len(proposals.scores)):
        mask = (proposals.ids == number).astype(np.float32)
        box = box_of(mask)
        if box is None:
            continue
        top, left, bottom, right = _pixels(box, proposals, (height, width), card.margin)
        crop = image[top:bottom, left:right]
        if card.blank:
            inside = _inside(mask, proposals, (top, left, bottom, right))
            crop = np.where(inside[:, :, None], crop, np.uint8(127))
        crops.append(crop)
        kept.append(number)
    renamed = np.full(len(proposals.scores) + 1, -1, dtype=np.int32)  # the last is for -1
    renamed[kept] = np.arange(len(kept))
    vectors = embed(crops)
    return replace(proposals, ids=renamed[proposals.ids], embeddings=vectors, scores=proposals.scores[kept])


def _pixels(
    box: tuple[int, int, int, int], proposals: MaskMap, size: tuple[int, int], margin: float
) -> tuple[int, int, int, int]:
    """Return the box of cells in pixels of the image, with its margin, at least one pixel large."""
    limits = []
    for axis, (low, high) in enumerate(((box[0], box[2]), (box[1], box[3]))):
        scale, offset = proposals.scale[1 - axis], proposals.offset[1 - axis]
        start, end = (low - 0.5 - offset) / scale + 0.5, (high - 0.5 - offset) / scale + 0.5
        more = margin * (end - start)
        first = int(np.clip(np.floor(start - more), 0, size[axis] - 1))
        limits.append((first, int(np.clip(np.ceil(end + more), first + 1, size[axis]))))
    return limits[0][0], limits[1][0], limits[0][1], limits[1][1]


def _inside(mask: Float32[np.ndarray, "h w"], proposals: MaskMap, box: tuple[int, int, int, int]) -> np.ndarray:
    """Return which pixels of a box the mask holds, by the nearest cell."""
    top, left, bottom, right = box
    rows = np.rint(np.arange(top, bottom) * proposals.scale[1] + proposals.offset[1]).astype(int)
    columns = np.rint(np.arange(left, right) * proposals.scale[0] + proposals.offset[0]).astype(int)
    return mask[np.clip(rows, 0, mask.shape[0] - 1)][:, np.clip(columns, 0, mask.shape[1] - 1)] > 0
