"""An image on its way into a model, and where its pixels land."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

from openvocab_occ.segmentation.card import InputCard


@dataclass(frozen=True, eq=False)
class Placed:
    """An image as the model is fed it, before its colours are changed.

    Pixel (u, v) of the image lies at (scale_u u + offset_u, scale_v v + offset_v) of `fed`; centres are at integers.
    """

    fed: UInt8[np.ndarray, "h w 3"]
    scale: tuple[float, float]
    offset: tuple[float, float]


def place(image: UInt8[np.ndarray, "h w 3"], card: InputCard) -> Placed:
    """Resize and pad an RGB image as the card says."""
    height, width = image.shape[:2]
    grown_h, grown_w = _scaled(height, width, card)
    if card.size is not None and card.resize == "squash":
        return _resized(image, card.size, card)
    if card.size is None and card.resize == "squash":
        return _resized(image, _rounded((grown_h, grown_w), card.multiple_of or 1), card)
    inner = _resized(image, (max(1, round(grown_h)), max(1, round(grown_w))), card)
    rows, columns = card.size or _up(inner.fed.shape[:2], card.multiple_of or 1)
    spare = (rows - inner.fed.shape[0], columns - inner.fed.shape[1])
    top, left = (spare[0] // 2, spare[1] // 2) if card.resize == "letterbox" else (0, 0)
    fed = np.full((rows, columns, 3), card.pad_value, dtype=np.uint8)
    fed[top : top + inner.fed.shape[0], left : left + inner.fed.shape[1]] = inner.fed
    return Placed(fed, inner.scale, (inner.offset[0] + left, inner.offset[1] + top))


def colour(fed: UInt8[np.ndarray, "... 3"], card: InputCard) -> Float32[np.ndarray, "... 3"]:
    """Bring 8-bit RGB to the model's colours: order, range, mean, std."""
    colors = fed[..., ::-1] if card.color == "BGR" else fed
    low, high = card.range
    gain = (high - low) / 255.0 / np.asarray(card.std)
    shift = (low - np.asarray(card.mean)) / np.asarray(card.std)
    return colors.astype(np.float32) * gain.astype(np.float32) + shift.astype(np.float32)


def prepare(image: UInt8[np.ndarray, "h w 3"], card: InputCard) -> Float32[np.ndarray, "h2 w2 3"]:
    """Resize an RGB image and bring its colours to what a model wants."""
    return colour(place(image, card).fed, card)


def _scaled(height: int, width: int, card: InputCard) -> tuple[float, float]:
    """Return height and width after the scaling that the card asks for, not yet whole numbers."""
    factor = 1.0
    if card.size is not None:
        factor = min(card.size[0] / height, card.size[1] / width)
    if card.short_side is not None:
        factor = card.short_side / min(height, width)
    if card.max_side is not None:
        factor = min(factor, card.max_side / max(height, width))
    return height * factor, width * factor


def _resized(image: UInt8[np.ndarray, "h w 3"], size: tuple[int, int], card: InputCard) -> Placed:
    import cv2

    height, width = size
    # the exact ones: OpenCV 5 cuts off fractions of grey levels in INTER_LINEAR; INTER_NEAREST is off by half a pixel
    how = {"bilinear": cv2.INTER_LINEAR_EXACT, "area": cv2.INTER_AREA, "nearest": cv2.INTER_NEAREST_EXACT}
    scale = (width / image.shape[1], height / image.shape[0])
    if image.shape[:2] != (height, width):
        image = cv2.resize(image, (width, height), interpolation=how[card.interpolation])  # pyright: ignore
    return Placed(image, scale, (0.5 * scale[0] - 0.5, 0.5 * scale[1] - 0.5))  # (u + 0.5) scale - 0.5


def _rounded(size: Sequence[float], multiple: int) -> tuple[int, int]:
    height, width = (max(1, round(n / multiple)) * multiple for n in size)
    return height, width


def _up(size: Sequence[int], multiple: int) -> tuple[int, int]:
    height, width = (-(-n // multiple) * multiple for n in size)
    return height, width
