"""What every tile of a map has in common: classes, cells, and how the bytes of a voxel lie in a chunk.

A chunk holds one tile of one floor: 64 x 64 cells, and of each cell, lowest voxel first, the stamps of its voxels
(8 bytes, little-endian), their writers (4) and their logits. Cells that nobody saw are runs of zeros. That is smaller
than planes of one byte of all cells, in which every plane has the outline of what was seen, and is compressed in half
the time.
"""

from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, UInt8

from openvocab_occ._jit import in_slices
from openvocab_occ.errors import ConfigError, DataError, MapError
from openvocab_occ.memory._codec_kernels import quantise

TILE = 64
"""Cells along a side of a tile."""
CELLS = TILE * TILE
ORIGIN = (512, 2**20, 2**20)
"""Chunk (floor, x, y) of the tile whose lower corner is the world's origin; tiles left of it have smaller numbers."""
SHAPE = (1024, 2**21, 2**21)
"""Chunks along floor, x and y: 53,687 km at 0.4 m, more than the way around the Earth."""
FORMAT = 3
FREE = "free"
_FEW = 8192  # rows that one thread encodes

DType = Literal["uint8", "float16", "float32"]
TOP = 63
"""The uint8 code of the largest class of a voxel; another of its classes has TOP (p / p_max)^(2/3), rounded, and less.

Equal steps of a power of p spend the bits where probabilities are large. Top and power trade bytes for small ones.
On the noise of the simulated streets, bytes, and error of a probability at most and on average:
127, 2/3: 100 %, 0.009, 0.0005; 127, 3/4: 92 %, 0.012, 0.0007; 63, 2/3: 80 %, 0.020, 0.0011; 63, 3/4: 74 %, 0.025,
0.0014; 63, 1: 57 %, 0.078, 0.0037.
"""
POWER = 2 / 3
REACH = 9.0
"""What code 0 stands for: a log-probability this far below the largest. All that is more than 7.2 below gets it."""
LEVELS = np.maximum(np.log(np.arange(256).clip(1e-9, TOP) / TOP) / POWER, -REACH).astype(np.float32)
"""What each code stands for, relative to the largest class."""
_STEPS = 4096  # table entries for each unit of log-probability: codes are off by 0.02 before they are rounded
_CODES = np.minimum(np.rint(TOP * np.exp(-POWER * np.arange(9 * _STEPS) / _STEPS)), TOP - 1).astype(np.uint8)


@dataclass(frozen=True)
class MapSchema:
    """The constants of a map, as they stand in the attributes of its arrays."""

    class_names: tuple[str, ...]
    heights: int = 16
    """Voxels of a floor along z."""
    cell: float = 0.4
    """Edge of a voxel, metres, on all axes."""
    z0: float = -1.0
    """Lower end of floor 0 in the world, metres."""
    dtype: DType = "uint8"
    journal: bool = True
    """Whether every write is also kept as it came, so that the map can be rebuilt without an agent."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "class_names", tuple(self.class_names))
        names = self.class_names
        if len(names) < 2 or len(set(names)) != len(names) or not all(isinstance(n, str) and n for n in names):
            raise ConfigError("class names do not tell classes apart", expected="two or more, no two alike", got=names)
        if not 1 <= self.heights <= 4096:
            raise ConfigError("heights is not usable", expected="1 to 4096 voxels", got=self.heights)
        if not (np.isfinite(self.cell) and self.cell > 0 and np.isfinite(self.z0)):
            raise ConfigError("cell or z0 is not usable", expected="metres, cell above 0", got=(self.cell, self.z0))
        if self.dtype not in ("uint8", "float16", "float32"):
            raise ConfigError("dtype is not known", expected="uint8, float16 or float32", got=self.dtype)

    @property
    def num_classes(self) -> int:
        """Classes of a voxel."""
        return len(self.class_names)

    @property
    def item(self) -> int:
        """Bytes of one logit."""
        return np.dtype(self.dtype).itemsize

    @property
    def payload(self) -> int:
        """Bytes of the logits of one voxel."""
        return self.num_classes * self.item

    @property
    def cell_bytes(self) -> int:
        """Bytes of a cell: of all its voxels, stamps, then writers, then logits; filled up to a multiple of 8."""
        return -(-self.heights * (12 + self.payload) // 8) * 8

    @cached_property
    def free(self) -> int:
        """Position of the class `free`."""
        if FREE not in self.class_names:
            raise ConfigError("the map has no class 'free'", expected="a class of that name", got=self.class_names)
        return self.class_names.index(FREE)

    def attributes(self) -> dict[str, Any]:
        """Return all of it as plain JSON data, with what a foreign reader needs to know."""
        heights, size = self.heights, self.heights * self.payload
        cell = {
            "stamp": f"bytes 0 to {8 * heights - 1}: uint64 of each height, milliseconds since 1970 plus 1, 0: never",
            "writer": f"the next {4 * heights}: uint32 of each height, the agent's name stands in agents/ in hex",
            "logits": f"the next {size}: [height, class] {self.dtype}",
        }
        value = "max(ln(code / top) / power, -reach), less its mean over the classes"
        return {
            "openvocab_occ": {
                "kind": "tile map",
                "format": FORMAT,
                **asdict(self),
                "class_names": list(self.class_names),
                "tile_cells": TILE,
                "origin_chunk": dict(zip(("floor", "x", "y"), ORIGIN, strict=True)),
                "byte_order": "little",
                "cell_bytes": cell,
                "quantiser": {"top": TOP, "power": POWER, "reach": REACH, "value": value}
                if self.dtype == "uint8"
                else None,
            }
        }

    @staticmethod
    def of_attributes(attributes: dict[str, Any], where: str) -> "MapSchema":
        """Read `attributes`; `where` is named in errors."""
        data = attributes.get("openvocab_occ")
        if not isinstance(data, dict) or data.get("kind") != "tile map":
            raise MapError(f"{where} is not a tile map", expected="attributes of openvocab_occ", got=list(attributes))
        if data.get("format") != FORMAT:
            raise MapError(
                f"{where} has a format this version cannot read", expected=FORMAT, got=data.get("format"),
                fix="update openvocab_occ",
            )  # fmt: skip
        try:
            rest = {name: data[name] for name in ("heights", "cell", "z0", "dtype", "journal")}
            return MapSchema(tuple(data["class_names"]), **rest)
        except (KeyError, TypeError, ConfigError) as error:
            raise MapError(f"{where} has damaged attributes", got=error) from error

    def encode(self, logits: Float[np.ndarray, "n c"]) -> UInt8[np.ndarray, "n payload"]:
        """Return the stored bytes of logits of any offset: log-probabilities to the map's precision.

        Raises:
            DataError: A logit is not finite.
        """
        return self.encode_seen(logits, np.ones(len(logits), dtype=np.bool_))[1]

    def encode_seen(
        self, logits: Float[np.ndarray, "m c"], mask: Bool[np.ndarray, " m"]
    ) -> tuple[Int64[np.ndarray, " n"], UInt8[np.ndarray, "n payload"]]:
        """Return the numbers of the rows in `mask`, and their stored bytes; other rows may be anything.

        Raises:
            DataError: A logit is not finite.
        """
        if self.dtype == "uint8":
            return self._codes(np.ascontiguousarray(logits, dtype=np.float32), np.ascontiguousarray(mask))
        flat = np.flatnonzero(mask)
        rows = logits[flat].astype(np.float32)
        _finite(int((~np.isfinite(rows).all(axis=1)).sum()), len(rows))
        with np.errstate(over="ignore"):
            centred = (rows - rows.mean(axis=1, keepdims=True)).astype(self.dtype)
        if not np.isfinite(centred).all():
            raise DataError(f"logits do not fit {self.dtype}", expected="below 65504", got=float(np.abs(rows).max()))
        return flat, centred.view(np.uint8).reshape(len(rows), self.payload)

    def _codes(self, logits: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what `encode_seen` does, quantised."""
        edges = np.linspace(0, len(mask), 65).astype(np.int64)
        rows = np.cumsum([0, *(int(np.count_nonzero(mask[a:b])) for a, b in pairwise(edges))])
        flat, codes = np.empty(rows[-1], np.int64), np.empty((rows[-1], self.num_classes), np.uint8)
        bad = np.zeros(64, dtype=np.int64)

        def work(start: int, stop: int) -> None:
            for n in range(start, stop):
                bad[n] = quantise(
                    logits, mask, _CODES, np.float32(_STEPS), TOP, edges[n], edges[n + 1], rows[n], flat, codes
                )

        in_slices(work, 64, grain=1 if len(mask) > _FEW else 64)
        _finite(int(bad.sum()), len(flat))
        return flat, codes

    def decode(self, payload: UInt8[np.ndarray, "*n payload"]) -> Float32[np.ndarray, "*n c"]:
        """Return class-centred log-probabilities of stored bytes."""
        if self.dtype == "uint8":
            values = LEVELS[payload]
            return values - values.mean(axis=-1, keepdims=True)
        return np.ascontiguousarray(payload).view(self.dtype).astype(np.float32)


class Tile:
    """The voxels of one tile, as bytes with one row a cell; the arrays are views into it."""

    __slots__ = ("record", "schema")

    def __init__(self, schema: MapSchema, record: UInt8[np.ndarray, "cells bytes"] | None = None) -> None:
        self.schema = schema
        self.record = np.zeros((CELLS, schema.cell_bytes), dtype=np.uint8) if record is None else record

    @property
    def stamps(self) -> np.ndarray:
        """uint64[cells, heights]: milliseconds since 1970 plus 1, 0 where never seen."""
        return self.record[:, : 8 * self.schema.heights].view("<u8")

    @property
    def writers(self) -> np.ndarray:
        """uint32[cells, heights]: number of the agent."""
        h = self.schema.heights
        return self.record[:, 8 * h : 12 * h].view("<u4")

    @property
    def payload(self) -> np.ndarray:
        """uint8[cells, heights, bytes]: the stored logits."""
        h, size = self.schema.heights, self.schema.payload
        return self.record[:, 12 * h : 12 * h + h * size].reshape(CELLS, h, size)

    @property
    def logits(self) -> np.ndarray:
        """float32[cells, heights, classes], 0 where never seen."""
        values = self.schema.decode(self.payload)
        values[self.stamps == 0] = 0
        return values

    def copy(self) -> "Tile":
        """Return a tile of its own bytes."""
        return Tile(self.schema, self.record.copy())


def _finite(bad: int, rows: int) -> None:
    if bad:
        raise DataError(
            "logits under the mask are not finite", expected="numbers",
            got=f"NaN or infinity in {bad} of {rows} voxels", fix="clip log(0) to -30, say",
        )  # fmt: skip
