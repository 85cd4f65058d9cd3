"""Large images in overlapping tiles, and their cells joined without seams."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float32, UInt8

from openvocab_occ.errors import ModelError
from openvocab_occ.segmentation.card import Tile

Run = Callable[[UInt8[np.ndarray, "n h w 3"]], Float32[np.ndarray, "n r s c"]]
"""Cells of a stack of images of one size."""


def run_in_tiles(
    fed: UInt8[np.ndarray, "h w 3"], tile: Tile, run: Run, *, unit: bool
) -> tuple[Float32[np.ndarray, "r s c"], tuple[int, int]]:
    """Run a model on tiles of an image and average the cells where they overlap, with weights that fade to the edges.

    Tiles lie on multiples of the model's stride, so that all cells are of one grid; beyond the image its border is
    repeated. Where `unit`, averages are normalised; zeros stay. The second value is the height and width, in
    pixels of `fed`, that the cells span; it may reach beyond the image by less than a cell.
    """
    height, width = fed.shape[:2]
    rows, columns = tile.size
    first = run(_cut(fed, 0, 0, tile.size)[None])
    stride = (rows / first.shape[1], columns / first.shape[2])
    if any(s != int(s) for s in stride):
        raise ModelError(
            "the model's cells do not fit into tiles",
            expected="tiles of a whole number of cells, each a whole number of pixels",
            got=f"{first.shape[1]} x {first.shape[2]} cells a tile of {rows} x {columns}",
            fix="change input.tile.size",
        )
    down, across = int(stride[0]), int(stride[1])
    tops, lefts = _starts(height, rows, tile.overlap, down), _starts(width, columns, tile.overlap, across)
    size = (-(-height // down), -(-width // across))
    total = np.zeros((*size, first.shape[3]), dtype=np.float32)
    weights = np.zeros((*size, 1), dtype=np.float32)
    fade = _fade(first.shape[1])[:, None, None] * _fade(first.shape[2])[None, :, None]
    for top in tops:
        for left in lefts:
            cells = first[0] if top == left == 0 else run(_cut(fed, top, left, tile.size)[None])[0]
            r, s = top // down, left // across
            here = np.s_[r : r + cells.shape[0], s : s + cells.shape[1]]
            inside = total[here].shape[:2]
            total[here] += (cells * fade)[: inside[0], : inside[1]]
            weights[here] += fade[: inside[0], : inside[1]]
    total /= weights
    if unit:
        lengths = np.linalg.norm(total, axis=2, keepdims=True)
        total /= np.where(lengths > 0, lengths, 1)
    return total, (size[0] * down, size[1] * across)


def _starts(length: int, tile: int, overlap: int, stride: int) -> list[int]:
    """Return where tiles begin: multiples of the stride, the last one reaching the end."""
    last = -(-max(length - tile, 0) // stride) * stride
    step = max((tile - overlap) // stride, 1) * stride
    return [*range(0, last, step), last]


def _fade(count: int) -> Float32[np.ndarray, " n"]:
    at = np.arange(count, dtype=np.float32)
    return np.minimum(at + 1, count - at)


def _cut(fed: UInt8[np.ndarray, "h w 3"], top: int, left: int, size: tuple[int, int]) -> UInt8[np.ndarray, "a b 3"]:
    part = fed[top : top + size[0], left : left + size[1]]
    spare = (size[0] - part.shape[0], size[1] - part.shape[1])
    return np.pad(part, ((0, spare[0]), (0, spare[1]), (0, 0)), mode="edge") if any(spare) else part
