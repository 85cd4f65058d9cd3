"""Which voxels of the map a write reaches."""

from collections.abc import Collection

import numpy as np

from openvocab_occ._jit import in_slices
from openvocab_occ.memory._tiles_kernels import locate
from openvocab_occ.memory.journal import Entry
from openvocab_occ.memory.layer import TileKey
from openvocab_occ.memory.schema import CELLS, MapSchema
from openvocab_occ.memory.window import Window


def tile_rows(entry: Entry, schema: MapSchema, only: Collection[TileKey] | None = None) -> dict[TileKey, np.ndarray]:
    """Return for each tile that a write touches int32[cells, heights]: the row of its codes for a voxel, else -1."""
    if not len(entry.flat):
        return {}
    window = Window(entry.T_world_ego, entry.spec, schema)
    rows = entry.rows()
    keys = [key for key in window.tiles() if only is None or key in only]
    found: dict[TileKey, np.ndarray] = {}

    def work(start: int, stop: int) -> None:
        for key in keys[start:stop]:
            out = np.empty((CELLS, schema.heights), dtype=np.int32)
            if locate(window.to_grid(key), rows, out):
                found[key] = out

    in_slices(work, len(keys))
    return {key: found[key] for key in keys if key in found}
