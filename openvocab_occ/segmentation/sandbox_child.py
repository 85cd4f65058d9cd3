"""The child side of sandbox.py: limits itself, then answers requests until the parent goes away."""

import os
import sys
from pathlib import Path
from typing import Any

import msgspec

from openvocab_occ.errors import OpenVocabOccError
from openvocab_occ.segmentation.encoder import PixelEncoder
from openvocab_occ.segmentation.sandbox import pack_array, read_exactly, unpack_array, write_frame


def limit(memory_bytes: int) -> None:
    """Bound memory; forbid files to grow and core dumps."""
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def answer(request: dict[str, Any], encoder: PixelEncoder | None) -> tuple[dict[str, Any], PixelEncoder | None]:
    """Do what is asked; return the answer and the encoder."""
    if request["do"] == "load":
        from openvocab_occ.segmentation.onnx import load_encoder

        card = None if request["card"] is None else Path(request["card"])
        encoder = load_encoder(request["model"], card, threads=request["threads"])
        scoring = getattr(encoder, "scoring", None)
        told = None
        if scoring is not None:
            names = ("kind", "threshold", "scale", "bias")
            negatives = None if scoring.negatives is None else pack_array(scoring.negatives)
            told = {name: getattr(scoring, name) for name in names} | {"negatives": negatives}
        names = ("name", "contract", "dim", "labels", "fingerprint")
        facts = {name: getattr(encoder, name) for name in names}
        return {**facts, "text": encoder.text is not None, "scoring": told}, encoder
    assert encoder is not None, "the parent loads first"
    if request["do"] == "encode":
        found = encoder.encode([unpack_array(request["image"])])[0]
        return {"cells": pack_array(found.cells), "scale": found.scale, "offset": found.offset}, encoder
    assert encoder.text is not None, "the parent knows of no text side"
    if request["do"] == "unknown":
        tell = getattr(encoder.text, "unknown_words", None)
        return {"words": [] if tell is None else list(tell(request["text"]))}, encoder
    return {"vectors": pack_array(encoder.text.encode(request["texts"]))}, encoder


def main() -> None:
    """Serve requests."""
    channel = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print does not reach the parent
    import onnxruntime  # noqa: F401 - its libraries are read before the limits

    limit(int(sys.argv[1]))
    encoder: PixelEncoder | None = None
    while True:
        try:
            length = int.from_bytes(read_exactly(sys.stdin.buffer, 8), "little")
            request = msgspec.msgpack.decode(read_exactly(sys.stdin.buffer, length), type=dict)
        except EOFError:
            return
        try:
            result, encoder = answer(request, encoder)
        except OpenVocabOccError as error:
            result = {"error": type(error).__name__, "message": str(error)}
        except MemoryError:
            result = {"error": "ModelError", "message": "the model needs more memory than its sandbox has"}
        write_frame(channel, result)


if __name__ == "__main__":
    main()
