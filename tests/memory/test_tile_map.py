"""Reading and writing the map: laws of the window, of the merge, and of the file."""

import json
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

import openvocab_occ as ovo
from openvocab_occ.errors import AlreadyExistsError, ConfigError, DataError, NotFoundError, PoseError, ShapeError
from openvocab_occ.geometry import GridSpec, pose
from openvocab_occ.memory import TileMap
from openvocab_occ.memory._codec_kernels import CRC_TABLE
from openvocab_occ.memory._codec_kernels import crc32c as crc32c_kernel
from openvocab_occ.memory._tiles_kernels import gather, locate, merge_rows, merge_tiles
from openvocab_occ.memory._tiles_reference import greatest, rows_of_voxels, window
from openvocab_occ.memory.layer import TileKey
from openvocab_occ.memory.schema import CELLS, LEVELS, TILE, MapSchema, Tile
from openvocab_occ.memory.window import Window
from tests.memory.conftest import NAMES, SPEC, centred, probabilities, random_logits, random_pose


def write(city, logits, mask, T, *, spec=SPEC, stamp=100.0, agent="a", log="one", **more):
    return city.write(logits, mask, T, spec, stamp=stamp, agent=agent, log=log, **more)


def contents(city: TileMap) -> dict[TileKey, bytes]:
    return {key: tile.record.tobytes() for key, tile in city.tiles() if tile.stamps.any()}


def voxel_centers(city: TileMap, key: TileKey) -> np.ndarray:
    """World coordinates [cells, heights, 3] of the voxels of a tile."""
    h, cell = city.schema.heights, city.schema.cell
    x, y, z = np.meshgrid(np.arange(TILE), np.arange(TILE), np.arange(h), indexing="ij")
    index = np.stack([x, y, z], -1) + np.array([key.x * TILE, key.y * TILE, key.floor * h]) + 0.5
    return (index * cell + [0, 0, city.schema.z0]).reshape(CELLS, h, 3)


def test_public_names():
    assert ovo.TileMap is TileMap
    assert ovo.Prior.__name__ == "Prior"


@pytest.mark.parametrize("dtype", ["uint8", "float16", "float32"])
@pytest.mark.parametrize("shift", [(0, 0, 0), (12.0, -20.4, 0.4), (-1000.0, 800.0, -9.6)])
def test_aligned_write_reads_back_bit_for_bit(tmp_path, rng, dtype, shift):
    city = TileMap.create(tmp_path / "m", NAMES, heights=8, dtype=dtype)
    logits, mask, T = random_logits(rng), rng.random(SPEC.shape) < 0.4, pose(shift)
    report = write(city, logits, mask, T)
    prior = city.read(T, SPEC)
    assert report.voxels == report.changed == mask.sum()
    assert (prior.known == mask).all()
    assert not prior.logits[~mask].any()
    stored = city.schema.decode(city.schema.encode(logits[mask]))
    np.testing.assert_allclose(prior.logits[mask], stored, atol=2e-6 if dtype == "uint8" else 0)
    if dtype == "uint8":
        np.testing.assert_allclose(probabilities(stored), probabilities(logits[mask]), atol=0.02)
    else:
        np.testing.assert_allclose(stored, centred(logits[mask]), atol={"float16": 4e-3, "float32": 0}[dtype])


def test_uint8_keeps_every_label_and_bounds_probabilities(rng):
    schema = MapSchema(tuple(map(str, range(18))))
    logits = np.concatenate([rng.normal(0, scale, (4000, 18)) for scale in (0.01, 0.3, 2, 8)]).astype(np.float32)
    logits[:50] = 0  # all alike
    stored = schema.decode(schema.encode(logits))

    assert (stored.argmax(1) == logits.argmax(1)).all()
    assert np.abs(probabilities(stored) - probabilities(logits)).max() < 0.02
    assert np.abs(stored.mean(1)).max() < 1e-5
    assert (schema.encode(stored) == schema.encode(logits)).all(), "stored values are stored as themselves"


@settings(max_examples=12)
@given(st.integers(0, 10**6))
def test_every_map_voxel_centred_in_a_visible_voxel_is_written(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    city = TileMap.create(tmp_path_factory.mktemp("maps") / "m", NAMES, heights=8, journal=False)
    spec = GridSpec((-4.0, -4.8, -1.0), float(rng.choice([0.3, 0.4, 0.55])), (20, 24, 8))
    logits, mask, T = random_logits(rng, spec), rng.random(spec.shape) < 0.5, random_pose(rng, tilt=0.3)
    write(city, logits, mask, T, spec=spec)
    rows = np.where(mask, np.arange(mask.size).reshape(mask.shape), -1)
    codes = city.schema.encode(logits.reshape(-1, len(NAMES)))
    total = 0
    for key in Window(T, spec, city.schema).tiles():
        tile = dict(city.tiles(keys=[key])).get(key) or Tile(city.schema)
        wanted = rows_of_voxels(voxel_centers(city, key), T, spec, rows)
        assert ((tile.stamps > 0) == (wanted >= 0)).all()
        assert (tile.payload[wanted >= 0] == codes[wanted[wanted >= 0]]).all()
        total += (wanted >= 0).sum()
    assert total == sum((tile.stamps > 0).sum() for _, tile in city.tiles())


@settings(max_examples=6)
@given(st.integers(0, 10**6), st.sampled_from(["uint8", "float32"]))
def test_read_takes_the_voxel_that_holds_each_centre(tmp_path_factory, seed, dtype):
    rng = np.random.default_rng(seed)
    city = TileMap.create(tmp_path_factory.mktemp("maps") / "m", NAMES, heights=4, z0=-0.7, dtype=dtype, journal=False)
    for _ in range(2):
        write(city, random_logits(rng), rng.random(SPEC.shape) < 0.7, random_pose(rng, reach=5))
    T = random_pose(rng, reach=5)
    tiles = dict(city.tiles())
    low = np.array([min(key[axis] for key in tiles) for axis in (1, 2, 0)]) * [TILE, TILE, 4]
    size = np.array([max(key[axis] for key in tiles) + 1 for axis in (1, 2, 0)]) * [TILE, TILE, 4] - low
    logits, known = np.zeros((*size, len(NAMES)), np.float32), np.zeros(size, bool)
    for key, tile in tiles.items():
        x, y, z = np.array([key.x * TILE, key.y * TILE, key.floor * 4]) - low
        logits[x : x + TILE, y : y + TILE, z : z + 4] = tile.logits.reshape(TILE, TILE, 4, -1)
        known[x : x + TILE, y : y + TILE, z : z + 4] = (tile.stamps > 0).reshape(TILE, TILE, 4)
    wanted, seen = window(logits, known, low, T, SPEC, -0.7)
    prior = city.read(T, SPEC)
    assert (prior.known == seen).all()
    np.testing.assert_allclose(prior.logits, wanted, atol=3e-6)


def test_rotated_write_and_read_agree_with_the_world(city, rng):
    """A world that is a function of place comes back as that function, whatever the poses it was seen from."""

    def world(points):
        wave = np.sin(points[..., :1] / 3) + np.cos(points[..., 1:2] / 4) + points[..., 2:]
        return (wave * [1.0, -1.0, 0.5, -0.5]).astype(np.float32)

    index = np.stack(np.meshgrid(*map(np.arange, SPEC.shape), indexing="ij"), -1)
    mask = np.ones(SPEC.shape, bool)
    for n in range(6):
        T = random_pose(rng, tilt=0.0, reach=3)
        T[2, 3] = 0
        points = SPEC.centers(index) @ T[:3, :3].T + T[:3, 3]
        write(city, world(points), mask, T, stamp=float(n))
    T = random_pose(rng, tilt=0.0, reach=1)
    T[2, 3] = 0
    wanted = world(SPEC.centers(index) @ T[:3, :3].T + T[:3, 3])
    errors = {}
    for how in ("nearest", "bilinear"):
        prior = city.read(T, SPEC, interpolation=how)
        assert prior.known.mean() > 0.8
        errors[how] = np.abs(prior.logits - wanted)[prior.known].mean()
    assert errors["nearest"] < 0.15  # a third of a cell on a slope of 1/3
    assert errors["bilinear"] < errors["nearest"]


def test_bilinear_at_voxel_centres_is_nearest(city, rng):
    write(city, random_logits(rng), rng.random(SPEC.shape) < 0.5, np.eye(4))
    near, mixed = city.read(np.eye(4), SPEC), city.read(np.eye(4), SPEC, interpolation="bilinear")
    assert (near.known == mixed.known).all()
    np.testing.assert_allclose(mixed.logits, near.logits, atol=1e-4)


def test_unseen_places_and_hidden_voxels_are_unknown(city, rng):
    write(city, random_logits(rng), np.zeros(SPEC.shape, bool), np.eye(4))
    assert contents(city) == {}
    write(city, random_logits(rng), np.ones(SPEC.shape, bool), np.eye(4))
    far = city.read(pose((500.0, 0, 0)), SPEC)
    assert not far.known.any()
    assert not far.logits.any()


def test_hills_are_floors(city, rng):
    """Floors above each other hold what does not fit into one."""
    logits, mask = random_logits(rng), np.ones(SPEC.shape, bool)
    for height in (0.0, 31.2, -62.0):
        write(city, logits, mask, pose((0, 0, height)))
        assert city.read(pose((0, 0, height)), SPEC).known.all()
    assert {key.floor for key, _ in city.tiles()} == {0, 9, 10, -20, -19}


# --- the merge ---


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


def test_older_writes_change_nothing_and_replace_does(city, rng):
    T, mask = np.eye(4), np.ones(SPEC.shape, bool)
    new, old = random_logits(rng), random_logits(rng)
    write(city, new, mask, T, stamp=200.0)
    before = contents(city)
    assert write(city, old, mask, T, stamp=100.0).changed == 0
    assert contents(city) == before
    assert write(city, old, mask, T, stamp=100.0, policy="replace").changed == mask.sum()
    np.testing.assert_allclose(probabilities(city.read(T, SPEC).logits), probabilities(old), atol=0.02)


def test_logs_can_be_left_out_until_they_are_merged(city, rng):
    T, mask = np.eye(4), np.ones(SPEC.shape, bool)
    first, second = random_logits(rng), random_logits(rng)
    write(city, first, mask, T, stamp=1.0, log="one")
    write(city, second, mask, T, stamp=2.0, log="two")
    full = city.read(T, SPEC)
    np.testing.assert_allclose(
        probabilities(city.read(T, SPEC, exclude_logs=["two"]).logits), probabilities(first), atol=0.02
    )
    assert not city.read(T, SPEC, exclude_logs=("one", "two", "never driven")).known.any()
    assert city.consolidate("one") > 0
    assert (city.read(T, SPEC).logits == full.logits).all()
    assert city.logs() == {"one": True, "two": False}
    np.testing.assert_allclose(
        probabilities(city.read(T, SPEC, exclude_logs=["two"]).logits), probabilities(first), atol=0.02
    )
    with pytest.raises(ConfigError, match="log 'one' cannot be left out: it is merged into the base"):
        city.read(T, SPEC, exclude_logs=["one"])
    write(city, second, mask, T, stamp=3.0, log="one")
    assert city.read(T, SPEC, exclude_logs=["two"]).known.all()


def test_readers_see_what_others_write(city, rng):
    other = TileMap.open(city.store.name)
    T, mask = random_pose(rng), np.ones(SPEC.shape, bool)
    assert not other.read(T, SPEC).known.any()
    for stamp in (1.0, 2.0):
        write(city, random_logits(rng), mask, T, stamp=stamp)
        assert (other.read(T, SPEC).logits == city.read(T, SPEC).logits).all()
    assert other.read(T, SPEC).known.any()


def test_a_small_cache_reads_the_same(city, rng):
    tiny = TileMap.open(city.store.name, cache_bytes=1)
    for n in range(5):
        write(city, random_logits(rng), np.ones(SPEC.shape, bool), random_pose(rng, reach=30), log=str(n))
    poses = [random_pose(rng, reach=30) for _ in range(6)]
    wanted = [city.read(T, SPEC) for T in poses]
    for prior, other in zip(wanted, tiny.read_route(poses, SPEC), strict=True):
        assert (prior.logits == other.logits).all()
        assert (prior.known == other.known).all()


def test_memories_fade_with_age(city, rng):
    T, mask = np.eye(4), np.ones(SPEC.shape, bool)
    write(city, random_logits(rng), mask, T, stamp=1000.0)
    fresh = city.read(T, SPEC)
    faded = city.read(T, SPEC, half_life=60.0, now=1120.0)
    assert (faded.known == fresh.known).all()
    np.testing.assert_allclose(faded.logits, fresh.logits / 4, rtol=1e-4)
    assert (city.read(T, SPEC, half_life=60.0, now=900.0).logits == fresh.logits).all(), "the future does not amplify"


# --- the file ---


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


# --- kernels against their reference ---


@settings(max_examples=15)
@given(st.integers(0, 10**6))
def test_locate_agrees_with_its_reference(seed):
    rng = np.random.default_rng(seed)
    schema = MapSchema(NAMES, heights=8)
    spec = GridSpec((-4.0, -4.8, -1.0), (0.4, 0.7, 0.9), (20, 24, 8))
    T = random_pose(rng, tilt=0.5, reach=20)
    frame = Window(T, spec, schema)
    rows = rng.integers(-1, 50, spec.shape).astype(np.int32)
    city = type("City", (), {"schema": schema})
    for key in frame.tiles():
        out = np.empty((CELLS, 8), np.int32)
        found = locate(frame.to_grid(key), rows, out)
        assert found == (out >= 0).sum()
        assert (out == rows_of_voxels(voxel_centers(city, key), T, spec, rows)).all()


@settings(max_examples=50)
@given(st.binary(max_size=300))
def test_crc32c_agrees_with_its_reference(data):
    found = crc32c_kernel(np.frombuffer(data, np.uint8), CRC_TABLE)
    assert found == crc32c(data)
    assert crc32c(b"123456789") == 0xE3069283, "the check value of the standard"


def test_gather_of_nothing():
    table = np.full((1, 1, 1), -1, np.int32)
    values, stamps = np.empty((0, CELLS, 4, 4), np.uint8), np.empty((0, CELLS, 4), np.uint64)
    out, known = np.full((2, 3, 4, 4), 7, np.float32), np.ones((2, 3, 4), bool)
    gather(np.eye(4)[:3], table, values, stamps, LEVELS, (0.0, 0.0), False, 0, 2, out, known)
    assert not out.any()
    assert not known.any()


# --- what is refused ---


def test_refused(tmp_path, city, rng, unchecked):
    logits, mask, T = random_logits(rng), np.ones(SPEC.shape, bool), np.eye(4)
    with pytest.raises(AlreadyExistsError, match="is not empty"):
        TileMap.create(city.store.name, NAMES)
    with pytest.raises(NotFoundError, match="no tile map there"):
        TileMap.open(tmp_path / "none")
    with pytest.raises(ConfigError, match="class names do not tell classes apart"):
        TileMap.create(tmp_path / "x", ["a", "a"])
    with pytest.raises(ConfigError, match="dtype is not known: expected uint8, float16 or float32"):
        MapSchema(NAMES, dtype="int4")  # type: ignore
    with pytest.raises(ConfigError, match="cell or z0 is not usable"):
        TileMap.create(tmp_path / "x", NAMES, cell=0.0)
    with pytest.raises(ShapeError, match=r"logits has the wrong shape: expected \(20, 24, 8, 4\)"):
        write(city, logits[..., :3], mask, T)
    with pytest.raises(ShapeError, match="mask has the wrong shape"):
        write(city, logits, mask[1:], T)
    broken = logits.copy()
    broken[3, 3, 3, 1] = np.nan
    with pytest.raises(DataError, match=r"logits under the mask are not finite: .*1 of 3840 voxels"):
        write(city, broken, mask, T)
    with pytest.raises(ConfigError, match="stamp is not a time"):
        write(city, logits, mask, T, stamp=1e12)
    with pytest.raises(ConfigError, match="stamp is not a time"):
        write(city, logits, mask, T, stamp=float("nan"))
    with pytest.raises(ConfigError, match=r"policy is not known: .*bayes and ema are folded from the journal"):
        city.write(logits, mask, T, SPEC, stamp=1.0, agent="a", log="l", policy="bayes")
    with pytest.raises(ConfigError, match="agent is not a name"):
        write(city, logits, mask, T, agent=" ")
    with pytest.raises(ConfigError, match="log is not a name"):
        write(city, logits, mask, T, log="")
    with pytest.raises(PoseError, match="lies outside what a map can hold"):
        write(city, logits, mask, pose((3e7, 0, 0)))
    with pytest.raises(ConfigError, match="interpolation is not known"):
        city.read(T, SPEC, interpolation="cubic")
    with pytest.raises(ConfigError, match="half_life is not usable"):
        city.read(T, SPEC, half_life=0.0)
    with pytest.raises(ConfigError, match="exclude_logs is one name"):
        city.read(T, SPEC, exclude_logs="one")
    assert contents(city) == {}
    assert city.agents() == {}
    assert city.store.list("journal/") == []
    broken[3, 3, 3, 1] = np.nan
    mask[3, 3, 3] = False
    assert write(city, broken, mask, T).changed == mask.sum(), "what is hidden may be anything"


def test_names_of_any_letters_and_no_way_out_of_the_folder(city, rng):
    for log in ("../../etc", "ä/ö:ü", "a b", "."):
        write(city, random_logits(rng), np.ones(SPEC.shape, bool), np.eye(4), log=log, agent=log)
    assert set(city.logs()) == {"../../etc", "ä/ö:ü", "a b", "."}
    assert {p.name for p in Path(city.store.name).iterdir()} == {
        "zarr.json", "base", "logs", "journal", "agents", "registry", ".locks",
    }  # fmt: skip
    assert sorted(p.name for p in (Path(city.store.name) / "journal").iterdir()) == sorted(
        ["%2E%2E%2F%2E%2E%2Fetc", "%C3%A4%2F%C3%B6%3A%C3%BC", "a%20b", "%2E"]
    )
