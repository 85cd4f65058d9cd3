"""From what a graph puts out to unit features or probabilities, checked against the card on the way."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from openvocab_occ.errors import ModelError
from openvocab_occ.segmentation.card import OutputCard

_PROBABILITY_TOLERANCE = 0.02  # quantised models round their softmax
_NORM_TOLERANCE = 0.01


@dataclass(frozen=True, kw_only=True)
class Reader:
    """Reads the output of one model; raises ModelError where it is not what the card says."""

    card: OutputCard
    dim: int
    """Channels wanted: labels, or the length of the text model's vectors."""
    model: str
    """Name of the model's file, for errors."""
    from_text: bool
    """Whether `dim` comes from a text model."""

    def cells(self, raw: np.ndarray, count: int, fed: tuple[int, int]) -> Float32[np.ndarray, "n h w c"]:
        """Return cells of `count` images that were fed with this height and width."""
        if self.card.kind == "classes":
            cells = self._one_hot(raw, count)
        elif self.card.layout == "NTC":
            cells = self.unit(self._tokens(raw, count, fed))
        else:
            cells = self._grid(raw, count)
        self._check_stride(cells.shape[1:3], fed)
        return cells

    def unit(self, vectors: Float[np.ndarray, "... c"]) -> Float32[np.ndarray, "... c"]:
        """Normalise each vector; one without any feature stays zero."""
        vectors = np.ascontiguousarray(vectors, dtype=np.float32)
        if vectors.shape[-1] != self.dim:
            raise self._width(vectors.shape[-1], vectors.shape)
        lengths = np.sqrt(np.einsum("...c,...c->...", vectors, vectors)[..., None])  # norm would copy them
        off = float(np.abs(lengths - 1).max(initial=0))
        if self.card.normalized and off > _NORM_TOLERANCE:
            raise self.misfit("features of length 1", f"lengths off by {off:.3g}", "write normalized: false")
        return vectors / np.where(lengths > 0, lengths, 1)

    def misfit(self, expected: str, got: str, fix: str | None = None) -> ModelError:
        """Return the error that says how model and card differ."""
        return ModelError(f"{self.model} does not fit its card", expected=expected, got=got, fix=fix)

    def channel_source(self) -> str:
        """Say where the number of channels comes from."""
        return "as many as the text model's vectors have" if self.from_text else "one a label"

    def _grid(self, raw: np.ndarray, count: int) -> Float32[np.ndarray, "n h w c"]:
        kind, layout = self.card.kind, self.card.layout
        if raw.ndim != 4 or len(raw) != count or raw.dtype.kind != "f":
            raise self.misfit(f"floats ({count}, ...) of 4 axes in layout {layout}", f"{raw.dtype} {raw.shape}")
        cells = np.ascontiguousarray(raw.transpose(0, 2, 3, 1) if layout == "NCHW" else raw, dtype=np.float32)
        if kind == "features":
            return self.unit(cells)
        if cells.shape[3] != self.dim:
            raise self._width(cells.shape[3], raw.shape)
        if kind == "logits":
            return softmax(cells)
        off = float(np.abs(cells.sum(axis=3) - 1).max())
        if off > _PROBABILITY_TOLERANCE or cells.min() < -_PROBABILITY_TOLERANCE:
            raise self.misfit(
                "probabilities that sum to 1", f"sums off by {off:.3g}, lowest {cells.min():.3g}", "is it kind: logits?"
            )
        return np.clip(cells, 0, 1)

    def _tokens(self, raw: np.ndarray, count: int, fed: tuple[int, int]) -> Float[np.ndarray, "n h w c"]:
        if raw.ndim != 3 or len(raw) != count or raw.dtype.kind != "f":
            raise self.misfit(f"floats ({count}, tokens, channels)", f"{raw.dtype} {raw.shape}")
        patch, prefix = self.card.patch or 1, self.card.prefix_tokens
        rows, columns = fed[0] // patch, fed[1] // patch
        if raw.shape[1] != prefix + rows * columns:
            raise self.misfit(
                f"{prefix} + {rows} x {columns} tokens of {patch} pixels from an image of {fed[1]} x {fed[0]}",
                f"{raw.shape[1]} tokens",
                "check output.patch and output.prefix_tokens",
            )
        if raw.shape[2] != self.dim:
            raise self._width(raw.shape[2], raw.shape)
        return raw[:, prefix:].reshape(count, rows, columns, self.dim)

    def _one_hot(self, raw: np.ndarray, count: int) -> Float32[np.ndarray, "n h w c"]:
        channel = {"NCHW": 1, "NHWC": 3}.get(self.card.layout)
        numbers = raw
        if channel is not None and raw.ndim == 4 and raw.shape[channel] == 1:
            numbers = raw.squeeze(channel)
        if numbers.ndim != 3 or len(numbers) != count or (numbers != np.rint(numbers)).any():
            raise self.misfit(f"class numbers ({count}, height, width)", f"{raw.dtype} {raw.shape}")
        if numbers.min() < 0 or numbers.max() >= self.dim:
            raise self.misfit(f"classes 0..{self.dim - 1}, one a label", f"{numbers.min()}..{numbers.max()}")
        return np.eye(self.dim, dtype=np.float32)[numbers.astype(np.intp)]

    def _check_stride(self, cells: Sequence[int], fed: tuple[int, int]) -> None:
        if self.card.stride is None:
            return
        for axis, has, side in zip(("height", "width"), cells, fed, strict=True):
            if abs(has - side / self.card.stride) >= 1:
                raise self.misfit(
                    f"a cell every {self.card.stride:g} pixels, about {side / self.card.stride:.0f} along the {axis}",
                    f"{has} cells for {side} pixels",
                    "check output.stride",
                )

    def _width(self, channels: int, shape: Sequence[int]) -> ModelError:
        fix = None
        if self.from_text:
            fix = "features of another width are not aligned to these words: is it the output before the projection?"
        return self.misfit(f"{self.dim} channels, {self.channel_source()}", f"{channels} in {tuple(shape)}", fix)


def softmax(logits: Float32[np.ndarray, "... c"]) -> Float32[np.ndarray, "... c"]:
    """Return probabilities along the last axis."""
    powers = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return powers / powers.sum(axis=-1, keepdims=True)


def sigmoid(logits: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Return 1 / (1 + exp(-x)) without overflow."""
    return (0.5 * np.tanh(0.5 * logits) + 0.5).astype(np.float32)
