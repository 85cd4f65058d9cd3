"""How long a model takes, with the preparation of images and the reading of its output."""

import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from openvocab_occ.errors import ConfigError
from openvocab_occ.segmentation.card import SelfTest
from openvocab_occ.segmentation.onnx import load_encoder
from openvocab_occ.segmentation.selftest import picture

_WARM = 3  # calls before the timed ones


def bench(
    model: Path,
    card: Path | None = None,
    *,
    size: tuple[int, int] = (256, 704),
    batch: int = 1,
    runs: int = 20,
    threads: int | None = None,
    providers: Sequence[str] = ("cpu",),
) -> dict[str, Any]:
    """Return medians in milliseconds, and what they were measured on."""
    if min(*size, batch, runs) < 1:
        raise ConfigError("size, batch and runs are not usable", expected="at least 1", got=(*size, batch, runs))
    started = time.perf_counter()
    encoder = load_encoder(model, card, threads=threads, providers=providers)
    loaded = time.perf_counter() - started
    images = [picture(SelfTest(size=size, seed=seed)) for seed in range(batch)]
    cells = encoder.encode(images)[0].cells.shape
    seconds = _times(lambda: encoder.encode(images), runs)
    text = encoder.text
    words = None if text is None else _times(lambda: text.encode(["a parked truck"]), runs)
    session = getattr(encoder, "session", None)
    return {
        "model": str(model),
        "size": list(size),
        "batch": batch,
        "threads": threads,
        "provider": "none" if session is None else session.providers[0],
        "machine": f"{platform.machine()} {platform.system()}",
        "load_ms": 1e3 * loaded,
        "ms_median": 1e3 * float(np.median(seconds)) / batch,
        "ms_best": 1e3 * float(np.min(seconds)) / batch,
        "text_ms_median": None if words is None else 1e3 * float(np.median(words)),
        "cells": list(cells),
    }


def _times(call: Callable[[], object], runs: int) -> list[float]:
    for _ in range(_WARM):
        call()
    found = []
    for _ in range(runs):
        started = time.perf_counter()
        call()
        found.append(time.perf_counter() - started)
    return found
