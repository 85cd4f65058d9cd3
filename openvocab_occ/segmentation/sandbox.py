"""A model in a process of its own, with limited memory, which can write no file and dump no core.

Parent and child speak over pipes in frames of 8 bytes of length and msgpack. Never pickles: the child is not trusted.
"""

import os
import selectors
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import msgspec
import numpy as np
from jaxtyping import Float32, UInt8

import openvocab_occ.errors as errors
from openvocab_occ.errors import ModelError
from openvocab_occ.segmentation.encoder import Contract, FeatureMap, TextEncoder
from openvocab_occ.segmentation.scoring import Scoring

MEMORY_BYTES = 6 << 30
"""Address space of the child; onnxruntime and NumPy alone reserve about 2 GB."""
START_SECONDS = 120.0
REQUEST_SECONDS = 300.0
MAX_FRAME = 4 << 30


class SandboxedEncoder:
    """A PixelEncoder whose model runs in a child process. A child that dies or hangs is a ModelError."""

    def __init__(
        self, model: Path, card: Path | None, *, threads: int | None = None, memory_bytes: int = MEMORY_BYTES
    ) -> None:
        command = [sys.executable, "-m", "openvocab_occ.segmentation.sandbox_child", str(memory_bytes)]
        environment = {key: os.environ[key] for key in ("PATH", "LD_LIBRARY_PATH", "HOME") if key in os.environ}
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
        self._model = model
        self._memory = memory_bytes
        self._child = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment
        )
        facts = self._ask(
            {"do": "load", "model": str(model), "card": None if card is None else str(card), "threads": threads},
            START_SECONDS,
        )
        self.name: str = facts["name"]
        self.contract: Contract = facts["contract"]
        self.dim: int = facts["dim"]
        self.labels: tuple[str, ...] = tuple(facts["labels"])
        self.fingerprint: str = facts["fingerprint"]
        self.text: TextEncoder | None = _SandboxedText(self, self.dim) if facts["text"] else None
        self.scoring: Scoring | None = None
        if facts["scoring"] is not None:
            told = facts["scoring"]
            negatives = None if told["negatives"] is None else unpack_array(told["negatives"])
            self.scoring = Scoring(**{**told, "negatives": negatives})

    def encode(self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> list[FeatureMap]:
        """Run the model on RGB images."""
        found = []
        for image in images:
            one = self._ask({"do": "encode", "image": pack_array(image)}, REQUEST_SECONDS)
            cells = unpack_array(one["cells"])
            if cells.ndim != 3 or cells.dtype != np.float32:
                raise ModelError("the sandboxed model answered nonsense", got=f"{cells.dtype} {cells.shape}")
            found.append(FeatureMap(cells, tuple(one["scale"]), tuple(one["offset"])))
        return found

    def close(self) -> None:
        """End the child."""
        if self._child.poll() is None:
            self._child.kill()
        self._child.wait()
        for pipe in (self._child.stdin, self._child.stdout):
            if pipe is not None:
                pipe.close()

    def __del__(self) -> None:
        if hasattr(self, "_child"):
            self.close()

    def _ask(self, request: dict[str, Any], seconds: float) -> dict[str, Any]:
        stdin, stdout = self._child.stdin, self._child.stdout
        assert stdin is not None, "Popen was asked for pipes"
        assert stdout is not None, "Popen was asked for pipes"
        try:
            write_frame(stdin, request)
            answer = _read_frame(stdout, seconds)
        except (EOFError, OSError, TimeoutError, ValueError) as error:  # ValueError: closed, or no msgpack
            late = isinstance(error, TimeoutError)
            self.close()
            raise ModelError(
                f"model {self._model.name} was stopped in its sandbox",
                expected=f"an answer within {seconds:g} s and {self._memory / (1 << 30):.3g} GB of memory",
                got="no answer" if late else f"the end of the process (code {self._child.returncode})",
            ) from error
        if "error" in answer:
            kind = getattr(errors, str(answer["error"]), ModelError)
            known = isinstance(kind, type) and issubclass(kind, errors.OpenVocabOccError)
            raise (kind if known else ModelError)(str(answer["message"]))
        return answer


class _SandboxedText:
    """The text side, asked in the child."""

    def __init__(self, encoder: SandboxedEncoder, dim: int) -> None:
        self.dim = dim
        self._encoder = encoder

    def encode(self, texts: Sequence[str]) -> Float32[np.ndarray, "n c"]:
        """Return a unit vector for each text."""
        answer = self._encoder._ask({"do": "text", "texts": list(texts)}, REQUEST_SECONDS)
        return unpack_array(answer["vectors"]).astype(np.float32)

    def unknown_words(self, text: str) -> tuple[str, ...]:
        """Return the words that the tokenizer cannot read."""
        return tuple(self._encoder._ask({"do": "unknown", "text": text}, REQUEST_SECONDS)["words"])


def pack_array(array: np.ndarray) -> dict[str, Any]:
    """Return an array as plain values."""
    return {"shape": list(array.shape), "dtype": array.dtype.str, "data": np.ascontiguousarray(array).tobytes()}


def unpack_array(packed: dict[str, Any]) -> np.ndarray:
    """Return the array; ModelError where the values contradict each other."""
    try:
        if packed["dtype"] not in ("<f4", "|u1"):
            raise ValueError(f"dtype {packed['dtype']}")
        return np.frombuffer(packed["data"], dtype=packed["dtype"]).reshape(packed["shape"])
    except (KeyError, TypeError, ValueError) as error:
        raise ModelError("the sandboxed model answered nonsense", got=error) from error


def write_frame(stream: IO[bytes], message: dict[str, Any]) -> None:
    """Send one message."""
    content = msgspec.msgpack.encode(message)
    stream.write(len(content).to_bytes(8, "little") + content)
    stream.flush()


def read_exactly(stream: IO[bytes], count: int, until: float = float("inf")) -> bytes:
    """Read so many bytes; EOFError at the end of the stream, TimeoutError after the time `until`."""
    parts, left = [], count
    with selectors.DefaultSelector() as selector:
        selector.register(stream, selectors.EVENT_READ)
        while left:
            spare = until - time.monotonic()
            if spare != float("inf") and not selector.select(max(spare, 0)):
                raise TimeoutError
            part = os.read(stream.fileno(), min(left, 1 << 20))
            if not part:
                raise EOFError
            parts.append(part)
            left -= len(part)
    return b"".join(parts)


def _read_frame(stream: IO[bytes], seconds: float) -> dict[str, Any]:
    until = time.monotonic() + seconds
    length = int.from_bytes(read_exactly(stream, 8, until), "little")
    if length > MAX_FRAME:
        raise EOFError
    return msgspec.msgpack.decode(read_exactly(stream, length, until), type=dict)
