"""Self-tests: numbers that the maker of a card got, compared with what the model gives here."""

from dataclasses import dataclass

import msgspec
import numpy as np
from jaxtyping import UInt8

from openvocab_occ.errors import ConfigError, ModelError
from openvocab_occ.segmentation.card import SelfTest, TextTest
from openvocab_occ.segmentation.encoder import PixelEncoder

NUMBERS = 8  # of each vector; enough that no wrong setting keeps them all
_BLOCK = 16  # pixels of one colour, so that the way of resizing matters little


@dataclass(frozen=True)
class Check:
    """One comparison."""

    what: str
    off: float
    """Largest absolute difference."""
    passed: bool


def picture(test: SelfTest) -> UInt8[np.ndarray, "h w 3"]:
    """Return the test image: blocks of random colours on a slope of grey, so that order, mean and range all matter."""
    height, width = test.size
    random = np.random.default_rng(test.seed)
    blocks = random.integers(0, 256, (-(-height // _BLOCK), -(-width // _BLOCK), 3))
    large = np.kron(blocks, np.ones((_BLOCK, _BLOCK, 1)))[:height, :width]
    slope = np.linspace(-40, 40, width)[None, :, None]
    return np.clip(large + slope, 0, 255).astype(np.uint8)


def record(encoder: PixelEncoder, *, texts: tuple[str, ...] = (), size: tuple[int, int] = (256, 256)) -> SelfTest:
    """Run the model and return the test that it passes here; for exporters that compared it with its original."""
    test = SelfTest(size=size)
    vectors = encoder.text.encode(texts) if encoder.text is not None and texts else ()
    told = (TextTest(text=t, vector=_short(v)) for t, v in zip(texts, vectors, strict=False))
    return msgspec.structs.replace(test, cell=_short(_middle(encoder, test)), texts=tuple(told))


def check(encoder: PixelEncoder, test: SelfTest | None) -> list[Check]:
    """Compare the model with its test.

    Raises:
        ConfigError: The card has no test.
        ModelError: A vector has fewer numbers than the test.
    """
    if test is None or not (test.cell or test.texts):
        raise ConfigError(
            f"the card of {encoder.name} has no self-test",
            expected="a section `selftest` with numbers of the model's makers",
            fix="export with models/export, or write one from the original model",
        )
    found = []
    if test.cell:
        found.append(_compare("image", test.cell, _middle(encoder, test), test.tolerance))
    for one in test.texts:
        if encoder.text is None:
            raise ModelError(f"{encoder.name} has no text side for its self-test", expected="a section `text`")
        vector = encoder.text.encode([one.text])[0]
        found.append(_compare(f"text {one.text!r}", one.vector, vector, test.tolerance))
    return found


def _middle(encoder: PixelEncoder, test: SelfTest) -> np.ndarray:
    cells = encoder.encode([picture(test)])[0].cells
    return cells[cells.shape[0] // 2, cells.shape[1] // 2]


def _compare(what: str, wanted: tuple[float, ...], vector: np.ndarray, tolerance: float) -> Check:
    if len(vector) < len(wanted):
        raise ModelError(f"self-test of the {what} does not fit", expected=f"{len(wanted)} numbers", got=len(vector))
    off = float(np.abs(vector[: len(wanted)] - np.asarray(wanted)).max())
    return Check(what, off, off <= tolerance)


def _short(vector: np.ndarray) -> tuple[float, ...]:
    return tuple(round(float(x), 5) for x in vector[:NUMBERS])
