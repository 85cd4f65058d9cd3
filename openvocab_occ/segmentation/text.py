"""The text side of a dense model."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from openvocab_occ.errors import ModelError, QueryError
from openvocab_occ.io.files import existing
from openvocab_occ.segmentation.card import TextCard
from openvocab_occ.segmentation.session import Port, Session


class OnnxTextEncoder:
    """A tokenizer.json and an ONNX graph that puts out one vector a text."""

    def __init__(
        self,
        card: TextCard,
        folder: Path,
        *,
        providers: Sequence[str] = ("CPUExecutionProvider",),
        threads: int | None = None,
    ) -> None:
        self.card = card
        self._session = Session(folder / card.onnx, providers=providers, threads=threads)
        tokenizer = existing(folder / card.tokenizer, "tokenizer")
        self.files = (*self._session.files, tokenizer)
        self._tokenizer = _read_tokenizer(tokenizer, card.context_length)
        self._ids = self._session.input(card.inputs.ids)
        self._mask = None if card.inputs.mask is None else self._session.input(card.inputs.mask)
        self._output = self._session.output(card.output)
        fed = {card.inputs.ids, card.inputs.mask}
        if unfed := [str(port) for port in self._session.inputs if port.name not in fed]:
            raise ModelError(
                f"text model {card.onnx} has inputs that its card does not name",
                expected="text.inputs with ids and mask",
                got="; ".join(unfed),
            )
        for port in filter(None, (self._ids, self._mask)):
            if port.numpy not in (np.int64, np.int32) or len(port.shape) != 2:
                raise ModelError(
                    f"text model {card.onnx} takes no token ids", expected="int32 or int64 [texts, tokens]", got=port
                )
        self.dim: int = self._run(["a"]).shape[1]

    def encode(self, texts: Sequence[str]) -> Float32[np.ndarray, "n c"]:
        """Return a unit vector for each text.

        Raises:
            QueryError: The model has no direction for a text: it knows none of its words.
        """
        if not texts:
            return np.zeros((0, self.dim), dtype=np.float32)
        one_by_one = self._ids.shape[0] == 1
        vectors = np.concatenate([self._run([t]) for t in texts]) if one_by_one else self._run(texts)
        lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
        if (lengths == 0).any():
            unknown = texts[int(np.argmin(lengths))]
            raise QueryError(f"the text model knows no word of {unknown!r}", fix="use other words")
        return vectors / lengths

    def _run(self, texts: Sequence[str]) -> Float32[np.ndarray, "n c"]:
        card = self.card
        rows = [e.ids for e in self._tokenizer.encode_batch([t.lower() if card.lowercase else t for t in texts])]
        width = card.context_length if card.padding == "max" else max(1, max(map(len, rows)))
        ids = np.full((len(rows), width), card.pad_id, dtype=np.int64)
        mask = np.zeros((len(rows), width), dtype=np.int64)
        for row, tokens in enumerate(rows):
            ids[row, : len(tokens)] = tokens
            mask[row, : len(tokens)] = 1
        feeds = {self._ids.name: _cast(ids, self._ids)}
        if self._mask is not None:
            feeds[self._mask.name] = _cast(mask, self._mask)
        vectors = self._session.run(self._output.name, feeds)
        if vectors.ndim != 2 or len(vectors) != len(texts) or vectors.dtype.kind != "f":
            raise ModelError(
                f"text model {card.onnx} does not put out one vector a text",
                expected=f"floats ({len(texts)}, channels)",
                got=f"{vectors.dtype} {vectors.shape}",
                fix="export it with its pooling, and name that output in text.output",
            )
        return vectors.astype(np.float32)


def _cast(array: np.ndarray, port: Port) -> np.ndarray:
    return array.astype(port.numpy or np.int64)


def _read_tokenizer(file: Path, context_length: int) -> Any:
    from tokenizers import Tokenizer

    try:
        tokenizer = Tokenizer.from_file(str(file))
    except Exception as error:  # tokenizers raises nothing narrower
        raise ModelError(f"tokenizer {file.name} cannot be read", expected="a tokenizer.json", got=error) from error
    tokenizer.no_padding()  # the file may carry its own; the card's counts
    tokenizer.enable_truncation(context_length)
    return tokenizer
