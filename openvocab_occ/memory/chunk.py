"""Chunks of a Zarr array: the bytes of a tile, compressed by zstd, then their checksum."""

from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import UInt8

from openvocab_occ.errors import MapError
from openvocab_occ.memory._codec_kernels import CRC_TABLE, crc32c
from openvocab_occ.memory.schema import CELLS, SHAPE, TILE, MapSchema, Tile

LEVEL = 1
"""Of zstd. On noisy logits 2 and 3 give larger chunks than 1, in twice and thrice its time."""
_ZSTD = pa.Codec("zstd", compression_level=LEVEL)


def chunk_of(tile: Tile) -> bytes:
    """Return what is stored of a tile."""
    packed = _ZSTD.compress(tile.record.reshape(-1), asbytes=True)
    return packed + _checksum(packed)


def record_of(chunk: bytes, schema: MapSchema, where: str) -> UInt8[np.ndarray, "cells bytes"]:
    """Return the bytes of a tile, not to be altered; `where` is named in errors.

    Raises:
        MapError: It is not what was stored.
    """
    size = CELLS * schema.cell_bytes
    try:
        if len(chunk) < 4 or chunk[-4:] != _checksum(memoryview(chunk)[:-4]):
            raise ValueError("its checksum is wrong")
        raw = _ZSTD.decompress(memoryview(chunk)[:-4], decompressed_size=size)
        return np.frombuffer(raw, dtype=np.uint8).reshape(CELLS, schema.cell_bytes)
    except (ValueError, OSError, pa.ArrowException) as error:
        fix = "openvocab-occ memory verify lists what is damaged, memory verify --repair makes it anew"
        raise MapError(f"{where} is damaged", expected="a whole chunk", got=error, fix=fix) from error


def array_metadata(schema: MapSchema) -> dict[str, Any]:
    """Return the Zarr v3 metadata of a layer."""
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": [SHAPE[0], SHAPE[1] * TILE, SHAPE[2] * TILE, schema.cell_bytes],
        "data_type": "uint8",
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [1, TILE, TILE, schema.cell_bytes]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "."}},
        "fill_value": 0,
        "codecs": [
            {"name": "bytes"},
            {"name": "zstd", "configuration": {"level": LEVEL, "checksum": False}},
            {"name": "crc32c"},
        ],
        "dimension_names": ["floor", "x", "y", "byte"],
        "attributes": schema.attributes(),
    }


def _checksum(data: bytes | memoryview) -> bytes:
    return int(crc32c(np.frombuffer(data, dtype=np.uint8), CRC_TABLE)).to_bytes(4, "little")
