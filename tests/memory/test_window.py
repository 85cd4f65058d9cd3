"""Which voxels a window reads and a write reaches: laws, and kernels against their reference."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ.geometry import GridSpec, pose
from openvocab_occ.memory import TileMap
from openvocab_occ.memory._tiles_kernels import gather, locate
from openvocab_occ.memory._tiles_reference import rows_of_voxels, window
from openvocab_occ.memory.schema import CELLS, LEVELS, TILE, MapSchema, Tile
from openvocab_occ.memory.window import Window
from tests.memory.conftest import NAMES, SPEC, contents, random_logits, random_pose, voxel_centers, write


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


def test_gather_of_nothing():
    table = np.full((1, 1, 1), -1, np.int32)
    values, stamps = np.empty((0, CELLS, 4, 4), np.uint8), np.empty((0, CELLS, 4), np.uint64)
    out, known = np.full((2, 3, 4, 4), 7, np.float32), np.ones((2, 3, 4), bool)
    gather(np.eye(4)[:3], table, values, stamps, LEVELS, (0.0, 0.0), False, 0, 2, out, known)
    assert not out.any()
    assert not known.any()
