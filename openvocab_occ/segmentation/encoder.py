"""What the rest of the toolkit knows of a 2D model: images become cells, and words become vectors of the same space."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int32, UInt8

Contract = Literal["dense", "logits"]
"""What reaches the map: unit features aligned to words, or probabilities of labels. Cards know more ways there."""


@dataclass(frozen=True, eq=False)
class FeatureMap:
    """The output of a model for one image, at the model's own resolution, and where its cells lie on the image.

    Pixel (u, v) falls at cell coordinates (scale_u u + offset_u, scale_v v + offset_v); cell centres are at integers.
    """

    cells: Float32[np.ndarray, "h w c"]
    """Unit features of a `dense` model, zero where it says nothing; class probabilities of a `logits` model."""
    scale: tuple[float, float]
    """Cells a pixel, along u and v."""
    offset: tuple[float, float]
    """Cell coordinate of pixel (0, 0)."""


@dataclass(frozen=True, eq=False)
class MaskMap:
    """What a mask model says about one image: which mask each cell belongs to, and one vector a mask.

    Far smaller than features a cell: a mapper can keep the numbers of masks and look vectors up once.
    """

    ids: Int32[np.ndarray, "h w"]
    """Row of `embeddings`; -1 where no mask is."""
    embeddings: Float32[np.ndarray, "q c"]
    """Unit vectors."""
    scores: Float32[np.ndarray, " q"]
    """How sure the model is of each mask, 0 to 1."""
    scale: tuple[float, float]
    """Cells a pixel, as in FeatureMap."""
    offset: tuple[float, float]

    def densify(self) -> FeatureMap:
        """Return each cell's own vector, zero where no mask is, as any mapper understands it."""
        table = np.concatenate([self.embeddings, np.zeros((1, self.embeddings.shape[1]), np.float32)])
        return FeatureMap(table[self.ids], self.scale, self.offset)  # -1 is the last row


@runtime_checkable
class TextEncoder(Protocol):
    """Words to vectors."""

    dim: int

    def encode(self, texts: Sequence[str]) -> Float32[np.ndarray, "n c"]:
        """Return a unit vector for each text."""
        ...


@runtime_checkable
class PixelEncoder(Protocol):
    """Images to cells.

    Three attributes are optional: `scoring`, a segmentation.scoring.Scoring that turns cosines into scores; and of
    models that put out masks `has_masks`, which is then true, and `encode_masks(images) -> list[MaskMap]`, which a map
    then asks for in place of cells.
    """

    name: str
    contract: Contract
    dim: int
    """Channels of a cell: feature length, or number of labels."""
    labels: tuple[str, ...]
    """Names of the channels of a `logits` model; empty otherwise."""
    fingerprint: str
    """sha256 that changes when the model's output would: of the model file and its card."""

    @property
    def text(self) -> TextEncoder | None:
        """The text side of a `dense` model."""
        ...

    def encode(self, images: Sequence[UInt8[np.ndarray, "h w 3"]]) -> list[FeatureMap]:
        """Run the model on RGB images."""
        ...
