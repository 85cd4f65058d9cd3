"""The merge: of all records of a voxel the greatest stays."""

from itertools import permutations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ.memory import TileMap
from openvocab_occ.memory._tiles_kernels import merge_rows, merge_tiles
from openvocab_occ.memory._tiles_reference import greatest
from openvocab_occ.memory.schema import CELLS, MapSchema, Tile
from tests.memory.conftest import (
    NAMES,
    SPEC,
    contents,
    random_logits,
    random_pose,
    write,
)


@settings(max_examples=3)
@given(st.integers(0, 10**6))
def test_merge_of_writes_does_not_depend_on_order_or_repeats(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("maps")
    writes = []
    for _ in range(3):  # stamps and agents tie often
        T, stamp, agent = random_pose(rng, reach=2), float(rng.integers(0, 2)), str(rng.choice(["a", "b"]))
        writes.append((random_logits(rng), rng.random(SPEC.shape) < 0.6, T, stamp, agent))
    maps = []
    for n, order in enumerate([*permutations(range(3)), (0, 1, 2, 1, 0), (2, 2, 1, 0)]):
        city = TileMap.create(folder / str(n), NAMES, heights=8, journal=False)
        for i in order:
            logits, mask, T, stamp, agent = writes[i]
            write(city, logits, mask, T, stamp=stamp, agent=agent, log=f"log {i % 2}")
        maps.append(contents(city))
    assert all(m == maps[0] for m in maps[1:])


def test_merge_kernels_keep_the_greatest_record(rng):
    schema = MapSchema(NAMES, heights=2)
    tiles = [Tile(schema) for _ in range(4)]
    for tile in tiles:
        tile.stamps[:] = rng.integers(0, 3, tile.stamps.shape)
        tile.writers[:] = rng.integers(1, 3, tile.writers.shape) * (tile.stamps > 0)
        tile.payload[:] = rng.integers(0, 2, tile.payload.shape) * (tile.stamps > 0)[..., None]
    merged = Tile(schema)
    for tile in tiles:
        merge_tiles(tile.stamps, tile.writers, tile.payload, merged.stamps, merged.writers, merged.payload)
    by_row = Tile(schema)
    rows = np.arange(CELLS * 2, dtype=np.int32).reshape(CELLS, 2)
    for cell in range(0, CELLS, 17):
        for h in range(2):
            records = [(int(t.stamps[cell, h]), int(t.writers[cell, h]), t.payload[cell, h].tobytes()) for t in tiles]
            best = greatest([r for r in records if r[0]])
            assert (merged.stamps[cell, h], merged.writers[cell, h]) == best[:2]
            assert not best[0] or merged.payload[cell, h].tobytes() == best[2]
            for stamp, writer, payload in records:
                if stamp:
                    one = np.where(rows == rows[cell, h], 0, -1).astype(np.int32)
                    code = np.frombuffer(payload, np.uint8)[None]
                    view = (by_row.stamps, by_row.writers, by_row.payload)
                    merge_rows(one, code, np.uint64(stamp), np.uint32(writer), False, *view)
            assert by_row.payload[cell, h].tobytes() == merged.payload[cell, h].tobytes()
