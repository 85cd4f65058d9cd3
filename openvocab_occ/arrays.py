"""Checks at the border: arrays come in from users and files, and are right from here on."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from openvocab_occ.errors import DataError, ShapeError

ArrayLike = NDArray[Any] | Sequence[Any] | float
"""What a caller may pass for an array. numpy's own alias refuses tuples when it is checked at run time."""


def check_shape(array: NDArray[np.generic], shape: Sequence[int | None], name: str) -> None:
    """Raise ShapeError unless `array` has this shape; None stands for any length."""
    if array.ndim != len(shape) or any(w is not None and w != g for w, g in zip(shape, array.shape, strict=False)):
        wanted = "(" + ", ".join("any" if w is None else str(w) for w in shape) + ")"
        raise ShapeError(f"{name} has the wrong shape", expected=wanted, got=array.shape)


def check_finite(array: NDArray[np.generic], name: str) -> None:
    """Raise DataError when `array` holds a NaN or an infinity, saying how many."""
    bad = int(array.size - np.isfinite(array).sum())
    if bad:
        raise DataError(
            f"{name} is not finite", expected="numbers", got=f"{bad} of {array.size} values NaN or infinite"
        )


def as_floats(
    value: ArrayLike, shape: Sequence[int | None], name: str, dtype: DTypeLike = np.float64
) -> NDArray[np.floating]:
    """Return `value` as a contiguous array of this dtype; finite and of this shape (None = any length), or raise."""
    try:
        array = np.ascontiguousarray(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise ShapeError(f"{name} is not an array of numbers", got=type(value).__name__) from error
    check_shape(array, shape, name)
    check_finite(array, name)
    return array
