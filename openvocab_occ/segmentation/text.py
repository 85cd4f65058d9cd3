"""The text side of a model with features."""

import re
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from openvocab_occ.errors import ModelError, QueryError
from openvocab_occ.io.files import existing
from openvocab_occ.segmentation.card import PromptCard, TextCard
from openvocab_occ.segmentation.session import CPU, Limits, Port, Session

_BATCH = 64  # texts a run


class OnnxTextEncoder:
    """A tokenizer and an ONNX graph; one unit vector a text, averaged over the prompt templates of the card."""

    def __init__(
        self,
        card: TextCard,
        folder: Path,
        *,
        prompts: PromptCard | None = None,
        providers: Sequence[str] = (CPU,),
        threads: int | None = None,
        limits: Limits | None = None,
    ) -> None:
        self.card = card
        self.prompts = prompts or PromptCard()
        self._session = Session(folder / card.onnx, providers=providers, threads=threads, limits=limits)
        tokenizer = existing(folder / card.tokenizer, "tokenizer")
        self.files = (*self._session.files, tokenizer)
        self._tokenizer, self._unknown = _read_tokenizer(tokenizer, card)
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
        mean = np.zeros((len(texts), self.dim), dtype=np.float32)
        for template in self.prompts.templates:
            mean += self._unit([template.replace("{}", text) for text in texts])
        lengths = np.linalg.norm(mean, axis=1, keepdims=True)
        if (lengths == 0).any():
            unknown = texts[int(np.argmin(lengths))]
            raise QueryError(f"the text model knows no word of {unknown!r}", fix="use other words")
        return mean / lengths

    def unknown_words(self, text: str) -> tuple[str, ...]:
        """Return the words that the tokenizer cannot read; models of bytes or letters know them all."""
        if self._unknown is None:
            return ()
        words = dict.fromkeys(re.findall(r"\w+", text))
        read = self._tokenizer.encode_batch([self._normal(w) for w in words], add_special_tokens=False)
        return tuple(w for w, r in zip(words, read, strict=True) if not r.ids or self._unknown in r.ids)

    def _unit(self, texts: Sequence[str]) -> Float32[np.ndarray, "n c"]:
        batch = 1 if self._ids.shape[0] == 1 else _BATCH
        parts = [self._run(texts[at : at + batch]) for at in range(0, len(texts), batch)]
        vectors = np.concatenate(parts)
        lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
        return vectors / np.where(lengths > 0, lengths, 1)

    def _normal(self, text: str) -> str:
        text = text.lower() if self.card.lowercase else text
        if self.card.strip_punctuation:
            text = "".join(c for c in text if not unicodedata.category(c).startswith("P"))
        return " ".join(text.split())

    def _run(self, texts: Sequence[str]) -> Float32[np.ndarray, "n c"]:
        card = self.card
        rows = [self._finished(e.ids) for e in self._tokenizer.encode_batch([self._normal(t) for t in texts])]
        width = card.context_length if card.padding == "max" else max(1, max(map(len, rows)))
        fixed = self._ids.shape[1]
        if fixed is not None and fixed != width:
            raise ModelError(
                f"text model {card.onnx} takes {fixed} tokens, and only so many",
                expected=f"text.context_length {fixed} with text.padding max",
                got=f"{width}, {card.padding}",
            )
        ids = np.full((len(rows), width), card.pad_id, dtype=np.int64)
        mask = np.zeros((len(rows), width), dtype=np.int64)
        for row, tokens in enumerate(rows):
            ids[row, : len(tokens)] = tokens
            mask[row, : len(tokens)] = 1
        feeds = {self._ids.name: _cast(ids, self._ids)}
        if self._mask is not None:
            feeds[self._mask.name] = _cast(mask, self._mask)
        vectors = self._pooled(self._session.run(self._output.name, feeds), ids, mask)
        if card.slice is None:
            return vectors
        if card.slice[1] > vectors.shape[1]:
            raise ModelError(
                f"text model {card.onnx} does not fit its card",
                expected=f"channels {card.slice[0]}..{card.slice[1] - 1}",
                got=f"{vectors.shape[1]} channels",
                fix="check text.slice",
            )
        return vectors[:, slice(*card.slice)]

    def _finished(self, tokens: list[int]) -> list[int]:
        eos = self.card.eos_id
        if eos is None or (tokens and tokens[-1] == eos):
            return tokens
        return [*tokens[: self.card.context_length - 1], eos]

    def _pooled(self, raw: np.ndarray, ids: np.ndarray, mask: np.ndarray) -> Float32[np.ndarray, "n c"]:
        card, count = self.card, len(ids)
        axes = 2 if card.pooling == "none" else 3
        if raw.ndim != axes or len(raw) != count or raw.dtype.kind != "f":
            wanted = f"floats ({count}, {'channels' if axes == 2 else 'tokens, channels'})"
            raise ModelError(
                f"text model {card.onnx} does not put out {'one vector a text' if axes == 2 else 'one vector a token'}",
                expected=wanted,
                got=f"{raw.dtype} {raw.shape}",
                fix="export it with its pooling and name that output in text.output, or set text.pooling",
            )
        raw = raw.astype(np.float32)
        if card.pooling == "none":
            return raw
        if card.pooling == "mean":
            kept = mask.astype(np.float32)
            return (raw * kept[:, :, None]).sum(axis=1) / np.maximum(kept.sum(axis=1), 1)[:, None]
        at = {
            "cls": np.zeros(count, dtype=np.intp),
            "last": np.maximum(mask.sum(axis=1) - 1, 0),
            "eos": (ids == card.eos_id).argmax(axis=1),
        }[card.pooling]
        return raw[np.arange(count), at]


def _cast(array: np.ndarray, port: Port) -> np.ndarray:
    return array.astype(port.numpy or np.int64)


def _read_tokenizer(file: Path, card: TextCard) -> tuple[Any, int | None]:
    """Return the tokenizer, and the id of what it cannot read if it has one."""
    from tokenizers import Tokenizer, models, normalizers, pre_tokenizers

    try:
        if file.suffix == ".txt":
            words = file.read_text(encoding="utf-8").splitlines()
            vocabulary = {word: number for number, word in enumerate(words)}
            tokenizer = Tokenizer(models.WordPiece(vocabulary, unk_token=words[0], max_input_chars_per_word=100))
            tokenizer.normalizer = normalizers.BertNormalizer(lowercase=card.lowercase)  # pyright: ignore
            tokenizer.pre_tokenizer = pre_tokenizers.BertPreTokenizer()  # pyright: ignore[reportAttributeAccessIssue]
        else:
            tokenizer = Tokenizer.from_file(str(file))
    except Exception as error:  # tokenizers raises nothing narrower
        raise ModelError(
            f"tokenizer {file.name} cannot be read",
            expected="a tokenizer.json, or a .txt of words whose first is the unknown one",
            got=error,
        ) from error
    tokenizer.no_padding()  # the file may carry its own; the card's counts
    tokenizer.enable_truncation(card.context_length)
    unknown = getattr(tokenizer.model, "unk_token", None)
    if unknown is None and (number := getattr(tokenizer.model, "unk_id", None)) is not None:
        return tokenizer, int(number)
    return tokenizer, None if unknown is None else tokenizer.token_to_id(unknown)
