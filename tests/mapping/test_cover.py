import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from openvocab_occ.errors import DataError
from openvocab_occ.geometry import Camera, GridSpec, invert, look_at, transform
from openvocab_occ.mapping import cover_grid, keys_of, rows_from_depth
from openvocab_occ.mapping.cover import cover_moved
from openvocab_occ.mapping.key_table import KeyTable
from openvocab_occ.mapping.keys import pack, unpack
from openvocab_occ.occupancy import OccupancyGrid


def turned(rng, size, yaw_only=False):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, 0, rng.uniform(-4, 4)] if yaw_only else rng.normal(size=3)).as_matrix()
    T[:3, 3] = rng.uniform(-90, 90, 3)
    return OccupancyGrid(np.zeros((9, 8, 6), np.uint8), GridSpec((-1.3, 0.7, -1.0), size, (9, 8, 6)), T)


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.2, 0.4, 0.55]), st.sampled_from([0.1, 0.25, 0.4, 1.0]))
def test_every_voxel_of_the_map_goes_to_the_grid_voxel_that_holds_its_centre(seed, size, voxel_size):
    rng = np.random.default_rng(seed)
    grid = turned(rng, size)
    flat = np.sort(rng.choice(grid.spec.num_voxels, 60, replace=False))
    cover = cover_grid(flat, grid, voxel_size)
    # by brute force, over all voxels of the map near the grid
    corners = transform(grid.T_world_grid, np.stack(grid.spec.bounds)[np.array(list(np.ndindex(2, 2, 2))), [0, 1, 2]])
    low, high = np.floor(corners.min(0) / voxel_size) - 1, np.ceil(corners.max(0) / voxel_size) + 1
    keys = (np.array(list(np.ndindex(*(high - low).astype(int)))) + low).astype(np.int32)
    local = transform(invert(grid.T_world_grid), (keys + 0.5) * voxel_size)
    at = grid.spec.index(local - 1e-6 * size)  # the rule for centres on faces
    holder = grid.spec.flat(at)
    seen = np.isin(holder, flat)
    wanted = set(zip(pack(keys[seen]).tolist(), holder[seen].tolist(), strict=True))
    got = set(zip(pack(cover.keys).tolist(), flat[cover.row].tolist(), strict=True))
    assert wanted <= got  # no holes
    extra = got - wanted  # only of voxels that hold no centre: one each, where their own centre lies
    assert {g for _, g in extra} == set(flat.tolist()) - {g for _, g in wanted}
    own = {g: int(pack(keys_of(grid.centers(np.array([g])), voxel_size))[0]) for _, g in extra}
    assert all(key == own[g] for key, g in extra)
    np.testing.assert_allclose(np.bincount(cover.row, cover.share, minlength=len(flat)), 1, rtol=1e-6)


def test_a_wall_one_voxel_thick_has_no_tunnels_however_it_is_turned():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        grid = turned(rng, 0.4, yaw_only=True)
        index = np.stack(np.meshgrid([4], np.arange(8), np.arange(6), indexing="ij"), -1).reshape(-1, 3)
        keys = cover_grid(np.sort(grid.spec.flat(index)), grid, 0.4).keys
        there = set(map(tuple, keys.tolist()))
        # walk through the middle of the wall from voxel to voxel over faces: no way leads across
        local = [grid.T_world_grid[:3, :3].T @ d for d in np.eye(3)]
        centre = transform(grid.T_world_grid, grid.spec.centers(np.array([[4, 4, 3]])))[0]
        start = tuple((keys_of(centre[None] - grid.T_world_grid[:3, 0] * 0.8, 0.4)[0]).tolist())
        far, reached, todo = 0, {start}, [start]
        while todo:
            key = todo.pop()
            point = transform(invert(grid.T_world_grid), (np.array([key]) + 0.5) * 0.4)[0] - grid.spec.centers(
                np.array([4, 4, 3])
            )
            if np.abs(point[1]) > 0.9 or np.abs(point[2]) > 0.7 or abs(point[0]) > 1.0:
                continue
            far = max(far, point[0])
            for axis in range(3):
                for step in (-1, 1):
                    near = list(key)
                    near[axis] += step
                    if tuple(near) not in there and tuple(near) not in reached:
                        reached.add(tuple(near))
                        todo.append(tuple(near))
        assert far < 0.2, local


def test_the_lattice_of_the_grid_itself_covers_one_to_one():
    grid = OccupancyGrid(np.zeros((5, 6, 7), np.uint8), GridSpec((0.8, -2.0, -1.0), 0.4, (5, 6, 7)))
    cover = cover_grid(np.arange(210), grid, 0.4)
    assert len(cover.row) == 210
    np.testing.assert_array_equal(cover.keys[np.argsort(cover.row)], keys_of(grid.centers(np.arange(210)), 0.4))


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(), (-0.2, 0.05, 0.001, 0.0)]))
def test_rows_of_measured_depth_are_the_voxels_of_the_points(seed, distortion):
    rng = np.random.default_rng(seed)
    pose = look_at(rng.normal(size=3), rng.normal(size=3) + 9)
    camera = Camera(np.array([[30.0, 0.2 * (not distortion), 15], [0, 33, 11], [0, 0, 1]]), 32, 24, pose, distortion)
    depth = rng.uniform(0.0, 9.0, (24, 32)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = rng.choice([0, np.inf, np.nan])
    rows, keys = rows_from_depth(depth, camera, 0.3, max_depth=8.0)
    rays = camera.rays()
    good = np.isfinite(depth) & (depth > 0) & (depth <= 8) & np.isfinite(rays).all(-1)
    np.testing.assert_array_equal(rows >= 0, good)
    wanted = keys_of(transform(camera.T_world_cam, rays[good] * depth[good, None].astype(float)), 0.3)
    assert (keys[rows[good]] == wanted).all(axis=1).mean() > 0.995  # rays are float32: points on faces may differ
    assert len(np.unique(pack(keys))) == len(keys) == len(np.unique(rows[good]))


def test_depth_beyond_the_reach_of_the_map_is_told():
    camera = Camera(np.array([[30.0, 0, 15], [0, 30, 11], [0, 0, 1]]), 32, 24)
    with pytest.raises(DataError, match="outside the reach"):
        rows_from_depth(np.full((24, 32), 1e9, np.float32), camera, 0.1)


@given(st.integers(0, 2**32 - 1))
def test_the_key_table_is_a_dict(seed):
    rng = np.random.default_rng(seed)
    table, known = KeyTable(), {}
    for _ in range(4):
        keys = pack(rng.integers(-9, 9, (int(rng.integers(0, 3000)), 3)).astype(np.int32))
        rows = table.insert(keys)
        for key in keys.tolist():
            known.setdefault(key, len(known))
        assert rows.tolist() == [known[key] for key in keys.tolist()]
    assert table.keys.tolist() == list(known)
    ends = pack(np.array([[-(2**23), -(2**23), -(2**15)], [2**23 - 1, 2**23 - 1, 2**15 - 1]], np.int32))
    assert table.find(ends).tolist() == [-1, -1]
    assert table.insert(ends).tolist() == [len(known), len(known) + 1]


def test_a_moved_map_by_whole_voxels_only_shifts():
    keys = unpack(np.unique(pack(np.random.default_rng(0).integers(-5, 5, (50, 3)).astype(np.int32))))
    T = np.eye(4)
    T[:3, 3] = [0.8, -2.0, 0.4]
    cover = cover_moved(keys, 0.4, T)
    np.testing.assert_array_equal(cover.keys[np.argsort(cover.row)], keys + np.array([2, -5, 1]))
