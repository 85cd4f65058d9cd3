"""What is stored: the precision of logits, and chunks that any Zarr reader can open."""

import json

import numpy as np
import tensorstore as ts
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ.memory import TileMap
from openvocab_occ.memory._codec_kernels import CRC_TABLE
from openvocab_occ.memory._codec_kernels import crc32c as crc32c_kernel
from openvocab_occ.memory.schema import CELLS, TILE, MapSchema
from tests.memory.conftest import (
    NAMES,
    SPEC,
    centred,
    probabilities,
    random_logits,
    random_pose,
    write,
)


def test_uint8_keeps_every_label_and_bounds_probabilities(rng):
    schema = MapSchema(tuple(map(str, range(18))))
    logits = np.concatenate([rng.normal(0, scale, (4000, 18)) for scale in (0.01, 0.3, 2, 8)]).astype(np.float32)
    logits[:50] = 0  # all alike
    stored = schema.decode(schema.encode(logits))

    assert (stored.argmax(1) == logits.argmax(1)).all()
    assert np.abs(probabilities(stored) - probabilities(logits)).max() < 0.02
    assert np.abs(stored.mean(1)).max() < 1e-5
    assert (schema.encode(stored) == schema.encode(logits)).all(), "stored values are stored as themselves"


def test_a_chunk_can_be_read_by_the_zarr_specification_alone(tmp_path, rng):
    """Metadata as JSON, chunk by zstd, checksum, shape: nothing of ours is used to read."""
    city = TileMap.create(tmp_path / "m", NAMES, heights=8, dtype="float32")
    logits, mask = random_logits(rng), rng.random(SPEC.shape) < 0.5
    write(city, logits, mask, np.eye(4), stamp=12.345, agent="car-7", log="2026-11-22a")
    assert json.loads((tmp_path / "m/zarr.json").read_text())["node_type"] == "group"
    assert json.loads((tmp_path / "m/logs/zarr.json").read_text())["node_type"] == "group"
    folder = tmp_path / "m/logs/2026-11-22a"
    meta = json.loads((folder / "zarr.json").read_text())
    assert (meta["zarr_format"], meta["node_type"], meta["data_type"], meta["fill_value"]) == (3, "array", "uint8", 0)
    assert [codec["name"] for codec in meta["codecs"]] == ["bytes", "zstd", "crc32c"]
    about = meta["attributes"]["openvocab_occ"]
    assert about["class_names"] == list(NAMES)
    floor, x0, y0 = (about["origin_chunk"][axis] for axis in ("floor", "x", "y"))
    raw = (folder / f"c.{floor}.{x0}.{y0}.0").read_bytes()
    assert crc32c(raw[:-4]) == int.from_bytes(raw[-4:], "little")
    flat = np.frombuffer(zstandard.ZstdDecompressor().decompress(raw[:-4]), np.uint8)
    cells = flat.reshape(meta["chunk_grid"]["configuration"]["chunk_shape"])[0]  # [x, y, byte]
    stamps = np.ascontiguousarray(cells[..., :64]).view("<u8")
    writers = np.ascontiguousarray(cells[..., 64:96]).view("<u4")
    values = np.ascontiguousarray(cells[..., 96 : 96 + 8 * 16]).view("<f4").reshape(64, 64, 8, 4)
    seen = mask[10:, 12:]  # the quarter of the grid with x, y >= 0 begins at the origin
    assert (stamps[:10, :12][seen] == 12346).all()
    assert not stamps[:10, :12][~seen].any()
    assert (values[:10, :12][seen] == centred(logits)[10:, 12:][seen]).all()
    number = f"{writers[:10, :12][seen][0]:08x}"
    assert json.loads((tmp_path / "m/agents" / number).read_text())["agent"] == "car-7"


def test_another_zarr_reader_sees_the_same_cells(tmp_path, rng):
    city = TileMap.create(tmp_path / "m", NAMES, heights=8)
    for n in range(3):
        write(city, random_logits(rng), rng.random(SPEC.shape) < 0.5, random_pose(rng, reach=30), stamp=float(n))
    place = {"driver": "file", "path": str(tmp_path / "m/logs/one")}
    array = ts.open({"driver": "zarr3", "kvstore": place}, read=True).result()
    floor, x0, y0 = (array.spec().to_json()["metadata"]["attributes"]["openvocab_occ"]["origin_chunk"][a]
                     for a in ("floor", "x", "y"))  # fmt: skip
    for key, tile in city.tiles():
        x, y = (x0 + key.x) * TILE, (y0 + key.y) * TILE
        cells = array[floor + key.floor, x : x + TILE, y : y + TILE].read().result()
        assert (cells.reshape(CELLS, -1) == tile.record).all()


@settings(max_examples=50)
@given(st.binary(max_size=300))
def test_crc32c_agrees_with_its_reference(data):
    found = crc32c_kernel(np.frombuffer(data, np.uint8), CRC_TABLE)
    assert found == crc32c(data)
    assert crc32c(b"123456789") == 0xE3069283, "the check value of the standard"


def crc32c(data: bytes) -> int:
    table = []
    for n in range(256):
        for _ in range(8):
            n = (n >> 1) ^ (0x82F63B78 if n & 1 else 0)
        table.append(n)
    crc = 0xFFFFFFFF
    for byte in data:
        crc = table[(crc ^ byte) & 255] ^ (crc >> 8)
    return crc ^ 0xFFFFFFFF
