"""The map as nodes: tiles and their levels, colours, picking, layers."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openvocab_occ.errors import ConfigError
from openvocab_occ.export.palette import NOTHING, UNLABELLED, label_colors, paint_labels, paint_numbers
from openvocab_occ.mapping import Lifted, VoxelMap
from openvocab_occ.mapping.picking import Picker
from openvocab_occ.objects.box import Box
from openvocab_occ.pipeline.combine import only
from openvocab_occ.pipeline.compare import diff
from openvocab_occ.viewer.colors import COLOR_MODES, grey_but, object_colors, paint_voxels, uncertainty
from openvocab_occ.viewer.content import Content
from openvocab_occ.viewer.drawing import box_edges
from openvocab_occ.viewer.layers import ChangesLayer, GridLayer, Layer, PathLayer, SliceLayer, TileMapLayer
from openvocab_occ.viewer.points import Eye, Points
from openvocab_occ.viewer.tiles import LEVELS, choose_levels, distances, tile_bounds, tile_voxels


def voxels_of(keys, size=0.4):
    keys = np.unique(np.asarray(keys, np.int32).reshape(-1, 3), axis=0)
    ones = np.ones(len(keys), np.float32)
    voxels = VoxelMap(size, 1, contract="logits")
    if len(keys):
        voxels.integrate(keys, Lifted(ones[:, None], ones, ones.astype(np.int32)), time=0.0)
    return voxels


def some_voxels(seed, count, reach=400, size=0.4):
    return voxels_of(np.random.default_rng(seed).integers(-reach, reach, (count, 3)), size)


@settings(max_examples=16)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0, 1, 120]), st.sampled_from([0.1, 0.37, 0.4, 50.0]))
def test_tiles_hold_each_voxel_once_and_near(seed, count, size):
    voxels = some_voxels(seed, count, reach=150, size=size)
    tiles = tile_voxels(voxels)
    held = np.concatenate([tile.voxels for tile in tiles]) if tiles else np.empty(0, np.int64)
    assert sorted(held.tolist()) == list(range(len(voxels)))
    assert len({tile.name for tile in tiles}) == len(tiles)
    for tile in tiles:
        fine = tile.levels[0].points
        np.testing.assert_allclose(fine + tile.center, voxels.centers[tile.voxels], atol=1e-4 * max(size, 1))
        if size < 1:
            sent = fine.astype(np.float16).astype(np.float64)  # what viser puts on the wire
            assert np.abs(sent + tile.center - voxels.centers[tile.voxels]).max() < 0.009


@settings(max_examples=16)
@given(st.integers(0, 2**32 - 1))
def test_each_level_covers_the_one_before_by_voxels_of_twice_the_size(seed):
    voxels = voxels_of(np.random.default_rng(seed).integers(-40, 40, (400, 3)))
    for tile in tile_voxels(voxels):
        for number, level in enumerate(tile.levels):
            assert level.size == pytest.approx(0.4 * 2**number)
            offset = voxels.centers[tile.voxels] - (level.points + tile.center)[level.cell]
            assert np.abs(offset).max() <= level.size / 2 + 1e-4  # a voxel lies in the point it became
            assert len(np.unique(level.points, axis=0)) == len(level.points)
            top = np.full(len(level.points), -(2**31))
            np.maximum.at(top, level.cell, voxels.keys[tile.voxels][:, 2])
            assert (voxels.keys[level.member][:, 2] == top).all()  # the highest lends its colour
        assert (np.diff([len(level.points) for level in tile.levels]) <= 0).all()


@settings(max_examples=16)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.0))
def test_a_hit_is_shown_at_every_level(seed, share):
    rng = np.random.default_rng(seed)
    voxels = voxels_of(rng.integers(-30, 30, (300, 3)))
    hit = rng.random(len(voxels)) < share
    for tile in tile_voxels(voxels):
        for level in tile.levels:
            shown = level.representatives(tile.voxels, hit)
            any_hit = np.zeros(len(level.points), bool)
            np.logical_or.at(any_hit, level.cell, hit[tile.voxels])
            assert (hit[shown] == any_hit).all()
            assert (level.representatives(tile.voxels, None) == level.member).all()


@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(0, 40_000))
def test_levels_fit_the_budget_and_nearer_is_never_coarser(seed, count, budget):
    rng = np.random.default_rng(seed)
    fine = rng.integers(1, 4000, count)
    counts = np.maximum(fine[:, None] >> (2 * np.arange(LEVELS)), 1)
    away = np.round(rng.uniform(0, 2000, count), 2)
    levels = choose_levels(away, counts, voxel_size=0.4, focal_px=600.0, budget=budget)
    kept = levels >= 0
    assert counts[np.flatnonzero(kept), levels[kept]].sum() <= budget
    order = np.argsort(away, kind="stable")
    if kept.all():
        assert (np.diff(levels[order]) >= 0).all()
    else:  # what is left out lies beyond what is shown, which is as coarse as can be
        assert away[kept].max(initial=0.0) <= away[~kept].min()
        assert (levels[kept] == LEVELS - 1).all()


def test_near_voxels_are_fine_and_far_ones_a_pixel_wide():
    counts = np.tile([64, 16, 4, 1], (4, 1))
    away = np.array([0.0, 200.0, 500.0, 1e9])  # a voxel of 0.4 m measures 1.2 px at 200 m and 0.48 at 500 m
    levels = choose_levels(away, counts, voxel_size=0.4, focal_px=600.0)
    assert levels.tolist() == [0, 0, 2, 3]


def test_distance_to_a_tile_is_that_to_its_nearest_voxel():
    voxels = some_voxels(3, 200, reach=100)
    tiles = tile_voxels(voxels)
    eye = np.array([70.0, -3.0, 12.0])
    for tile, away in zip(tiles, distances(tile_bounds(tiles), eye), strict=True):
        low = voxels.centers[tile.voxels].min(axis=0) - 0.2
        high = voxels.centers[tile.voxels].max(axis=0) + 0.2
        assert away == pytest.approx(np.linalg.norm(eye - np.clip(eye, low, high)), abs=1e-9)
    assert (distances(tile_bounds(tiles), voxels.centers[0]) == 0).any()


class Nodes:
    """Counts what a viser scene would be sent."""

    def __init__(self):
        self.sent = []

    def add_point_cloud(self, name, points, colors, **more):
        node = SimpleNamespace(name=name, points=points, colors=colors, visible=more["visible"])
        node.remove = lambda: self.sent.append((name, "removed"))
        self.sent.append((name, len(points)))
        return node


def test_points_follow_the_camera_and_send_only_what_changes(street):
    content, nodes = Content(street), Nodes()
    points = Points(nodes, content)
    assert points.see(Eye(np.zeros(3), 600.0)) == 0  # no colours yet
    points.paint(street.voxels.colors)
    near = Eye(np.zeros(3), 600.0)
    assert points.see(near) == len(content.tiles)
    assert points.sent == len(street.voxels)
    away = distances(content.bounds, np.zeros(3))
    order = [next(i for i, tile in enumerate(content.tiles) if tile.name == name) for name, _ in nodes.sent]
    assert (np.diff(away[order]) >= 0).all()  # nearest first
    assert points.see(near) == 0
    assert points.see(Eye(np.array([0.0, 0.0, 5000.0]), 600.0)) == len(content.tiles)
    assert 0 < points.sent < len(street.voxels) / 10
    points.change(content)
    assert points.sent == 0


def test_points_of_a_small_budget_keep_to_it(street):
    points = Points(Nodes(), Content(street), budget=900)
    points.paint(street.voxels.colors)
    points.see(Eye(np.zeros(3), 600.0))
    assert 0 < points.sent <= 900


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_a_ray_picks_the_first_voxel_that_it_passes_through(seed):
    rng = np.random.default_rng(seed)
    voxels = some_voxels(seed, 2000, reach=90)
    picker = Picker(voxels)
    origin = rng.uniform(-60, 60, 3)
    target = voxels.centers[rng.integers(len(voxels))]
    direction = (target - origin) * rng.uniform(0.1, 10)
    pick = picker.pick(origin, direction)
    low, high = voxels.centers - 0.2, voxels.centers + 0.2  # by slabs, over all voxels
    with np.errstate(divide="ignore"):
        a, b = (low - origin) / direction, (high - origin) / direction
    start, stop = np.minimum(a, b).max(axis=1).clip(0), np.maximum(a, b).min(axis=1)
    met = np.flatnonzero(start < stop)
    first = met[start[met].argmin()]
    assert pick is not None
    assert start[pick.voxel] == pytest.approx(start[first], abs=1e-6)
    assert np.abs(pick.point - voxels.centers[pick.voxel]).max() <= 0.2 + 1e-4
    assert pick.distance == pytest.approx(np.linalg.norm(pick.point - origin), abs=1e-3)


def test_a_ray_beside_the_map_picks_nothing(street):
    picker = Content(street).picker
    assert picker.pick(np.array([0.0, 0, 50]), np.array([0.0, 0, 1])) is None
    assert picker.pick(np.array([0.0, 0, 50]), np.array([0.0, 0, -1])) is not None
    assert Picker(voxels_of([])).pick(np.zeros(3), np.array([1.0, 0, 0])) is None


@given(st.lists(st.sampled_from(["car", "Car", "road", "", "truck", "gnu", "a|b"]) | st.text(max_size=4), max_size=90))
def test_no_two_labels_look_alike(names):
    colors = {tuple(color) for color in label_colors(names).tolist()}
    assert len(colors) == len(names)
    assert not colors & {NOTHING, UNLABELLED}


def test_labels_keep_their_colours_whatever_else_there_is():
    assert (label_colors(["road", "car"])[1] == label_colors(["car", "x", "road"])[0]).all()


def test_images_of_labels_are_painted_pixel_by_pixel():
    names = ["road", "car"]
    painted = paint_labels(np.array([[1, 0, -1]], np.int32), names)
    assert painted.tolist() == [[*label_colors(names)[::-1].tolist(), list(UNLABELLED)]]


def test_numbers_are_clamped_and_the_scale_has_two_ends():
    colors = paint_numbers(np.array([-5.0, 0.0, 1.0, 9.0, np.nan]), 0.0, 1.0, "viridis")
    assert (colors[0] == colors[1]).all()
    assert (colors[2] == colors[3]).all()
    assert (colors[4] == colors[0]).all()
    assert colors[1].tolist() == [68, 1, 84]  # viridis begins violet


@pytest.mark.parametrize("mode", COLOR_MODES)
def test_every_mode_colours_every_voxel_and_has_a_legend(street, mode):
    painted = paint_voxels(street, mode, street.voxels.features[:, 4])
    assert painted.colors.shape == (len(street.voxels), 3)
    assert painted.legend
    if mode not in ("age", "occupancy"):  # one frame saw all of this street
        assert len(np.unique(painted.colors, axis=0)) > 3


def test_modes_that_cannot_be_shown_are_refused(street):
    with pytest.raises(ConfigError, match="needs a query"):
        paint_voxels(street, "relevance")
    with pytest.raises(ConfigError, match="rgb or semantic or .*, got sepia"):
        paint_voxels(street, "sepia")


def test_a_fixed_scale_shows_weak_scores_weakly_and_a_stretched_one_in_full(street):
    scores = np.linspace(0, 0.2, len(street.voxels), dtype=np.float32)
    fixed, stretched = (paint_voxels(street, "relevance", scores, stretched=s) for s in (False, True))
    best = scores.argmax()
    assert stretched.colors[best].tolist() == paint_numbers(np.ones(1), 0.0, 1.0, "plasma")[0].tolist()
    assert fixed.colors[best].tolist() != stretched.colors[best].tolist()
    assert "1.00" in fixed.legend
    assert "0.20" in stretched.legend


def test_instances_have_the_colour_of_their_number(street):
    painted = paint_voxels(street, "instance").colors.astype(int)
    truck = next(item for item in street.objects if item.label == "truck")
    own = object_colors(np.array([truck.id], np.int32))[0].astype(int)
    assert (np.abs(painted[truck.voxels] - own).sum(axis=1) <= 0.2 * own.sum() + 3).all()
    assert object_colors(np.zeros(1, np.int32))[0].tolist() == list(UNLABELLED)


def test_uncertainty_is_what_the_best_label_leaves(street):
    np.testing.assert_allclose(uncertainty(street.voxels), 1 - street.voxels.features.max(axis=1), atol=1e-6)


def test_all_but_hits_lose_their_hue(street):
    kept = np.zeros(len(street.voxels), bool)
    kept[np.concatenate([item.voxels for item in street.objects if item.label == "car"])] = True
    shown = grey_but(street.voxels, street.voxels.colors, kept)
    assert (shown[kept] == street.voxels.colors[kept]).all()
    assert (np.ptp(shown[~kept].astype(int), axis=1) == 0).all()


def test_edges_are_those_of_the_turned_box():
    box = Box(np.array([5.0, -3.0, 1.0]), np.array([4.0, 2.0, 1.5]), 0.6)
    edges = box_edges(box).astype(np.float64)
    lengths = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    np.testing.assert_allclose(np.sort(lengths), np.repeat([1.5, 2.0, 4.0], 4), atol=1e-5)
    along = edges[np.isclose(lengths, 4.0, atol=1e-4)]
    yaw = np.arctan2(*(along[:, 1] - along[:, 0]).T[1::-1]) % np.pi
    np.testing.assert_allclose(yaw, 0.6, atol=1e-5)
    np.testing.assert_allclose(edges.reshape(-1, 3).mean(axis=0), box.center, atol=1e-5)
    assert Box(box.center, box.size + 0.2, box.yaw).contains(box_edges(box, 0.1).reshape(-1, 3), 1e-4).all()


def test_a_slice_tells_free_from_unknown(street):
    import copy
    import dataclasses

    voxels = street.voxels.copy()
    blocks = np.array([[0, 0, 0]], np.int32)
    counts = np.zeros((1, 512), np.uint8)
    counts.reshape(8, 8, 8)[:, :, :] = 3
    voxels.free._add(blocks, counts)
    layer = SliceLayer(dataclasses.replace(street, voxels=copy.copy(voxels)), above=1.0)
    free, unknown, cell = layer.cells()
    edge = 8 * voxels.free.cell
    assert len(free) > 0
    assert ((free[:, :2] > 0) & (free[:, :2] < edge)).all()
    inside = ((unknown[:, :2] > 0) & (unknown[:, :2] < edge)).all(axis=1)
    assert not inside.any()
    both = np.concatenate([free, unknown])[:, :2]
    assert len(np.unique(np.round(both / cell, 3), axis=0)) == len(both)


def test_layers_are_layers(street):
    content = Content(street)
    made = [PathLayer(content.path), GridLayer(street), SliceLayer(street), ChangesLayer(street, street)]
    assert all(isinstance(layer, Layer) for layer in made)
    assert len({layer.name for layer in made}) == len(made)


@pytest.fixture
def page():
    """A page to draw on, with no browser there."""
    import viser

    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server.scene
    server.stop()


def drawn(page, name):
    return page._handle_from_node_name[name]


def test_the_global_map_is_drawn_by_agent_and_by_class(street, page, tmp_path):
    from openvocab_occ.geometry import GridSpec
    from openvocab_occ.memory import TileMap

    city = TileMap.create(tmp_path / "city.tiles", ("wall", "tree", "free"), heights=8)
    spec = GridSpec((0.0, 0.0, -1.0), 0.4, (8, 8, 8))
    logits = np.full((8, 8, 8, 3), -9.0, np.float32)
    logits[..., 2], logits[:, :, 0, 0], logits[:, :, 1, 1] = 0.0, 9.0, 9.0
    for agent, half in (("car-1", np.s_[:4]), ("car-<2>", np.s_[4:])):
        mask = np.zeros((8, 8, 8), bool)
        mask[half] = True
        city.write(logits, mask, np.eye(4), spec, stamp=1.0, agent=agent, log=agent)
    for by, names in (("agent", ("car-1", "car-<2>")), ("class", ("wall", "tree"))):
        layer = TileMapLayer(city, by=by)
        assert isinstance(layer, Layer)
        legend = layer.draw(page, f"/{by}")
        points, numbers, _ = layer.surface()
        assert len(points) == 128
        assert np.bincount(numbers).tolist()[:2] == [64, 64]
        assert len(drawn(page, f"/{by}/surface").points) == 128
        assert all(name.replace("<", "&lt;").replace(">", "&gt;") in legend for name in names)
    far = TileMapLayer(city, around=5.0, scene=replace(street, voxels=voxels_of([[500, 500, 0]])))
    assert len(far.surface()[0]) == 0


def test_changes_are_drawn_where_both_looked(street, page):
    """A thing taken out of the second map has vanished, and the other way round it has appeared."""
    truck = next(item for item in street.objects if item.label == "truck" and item.level == "object")
    keep = ~np.isin(np.arange(len(street.voxels)), truck.voxels)
    without = only(street, keep)
    blocks = np.unique(np.floor(street.voxels.centers[truck.voxels] / (8 * without.voxels.free.cell)), axis=0)
    without.voxels.free._add(blocks.astype(np.int32), np.full((len(blocks), 512), 9, np.uint8))  # looked through there
    legend = ChangesLayer(without, street).draw(page, "/gone")
    assert "vanished: 1 object<" in legend
    gone = diff(street, without).vanished
    assert len(gone) > 0.7 * len(truck.voxels)
    assert len(drawn(page, "/gone/vanished").points) == len(gone)
    legend = ChangesLayer(street, without).draw(page, "/came")
    assert "appeared: 1 object<" in legend
    assert ChangesLayer(street, street).draw(page, "/same").count("0 objects") == 3
