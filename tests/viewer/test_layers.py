"""The map as nodes: tiles, colours, boxes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openvocab_occ.errors import ConfigError
from openvocab_occ.export.palette import NOTHING, UNLABELLED, label_colors, paint_labels, paint_numbers
from openvocab_occ.objects.box import Box
from openvocab_occ.viewer.layers import COLOR_MODES, box_edges, grey_but, tile_voxels, voxel_colors


@given(st.integers(0, 2**32 - 1), st.sampled_from([0, 1, 200]))
def test_tiles_hold_each_voxel_once_and_near(seed, count):
    centers = np.random.default_rng(seed).uniform(-3000, 3000, (count, 3))
    tiles = tile_voxels(centers, edge=32.0)
    held = np.concatenate([tile.voxels for tile in tiles]) if tiles else np.empty(0, np.int64)
    assert sorted(held.tolist()) == list(range(count))
    assert len({tile.name for tile in tiles}) == len(tiles)
    for tile in tiles:
        assert np.abs(tile.points).max() <= 16.001
        np.testing.assert_allclose(tile.points + tile.center, centers[tile.voxels], atol=1e-5)
        sent = tile.points.astype(np.float16).astype(np.float64)  # what viser puts on the wire
        assert np.abs(sent + tile.center - centers[tile.voxels]).max() < 0.008


@given(st.lists(st.sampled_from(["car", "Car", "road", "", "truck", "gnu", "a|b"]) | st.text(max_size=4), max_size=90))
def test_no_two_labels_look_alike(names):
    colors = {tuple(color) for color in label_colors(names).tolist()}
    assert len(colors) == len(names)
    assert not colors & {NOTHING, UNLABELLED}


def test_labels_are_painted_by_position_and_minus_one_is_unlabelled():
    names = ("car", "tree")
    painted = paint_labels(np.array([[1, 0, -1]], np.int32), names)
    assert painted.tolist() == [[*label_colors(names)[::-1].tolist(), list(UNLABELLED)]]


def test_numbers_are_clamped_and_the_scale_has_two_ends():
    colors = paint_numbers(np.array([-5.0, 0.0, 1.0, 9.0, np.nan]), 0.0, 1.0, "viridis")
    assert (colors[0] == colors[1]).all()
    assert (colors[2] == colors[3]).all()
    assert (colors[4] == colors[0]).all()
    assert colors[1].tolist() == [68, 1, 84]  # viridis begins violet


@pytest.mark.parametrize("mode", COLOR_MODES)
def test_every_mode_colours_every_voxel(street, mode):
    colors = voxel_colors(street, mode, street.voxels.features[:, 4])
    assert colors.shape == (len(street.voxels), 3)
    assert len(np.unique(colors, axis=0)) > 3


def test_modes_that_cannot_be_shown_are_refused(street):
    with pytest.raises(ConfigError, match="needs a query"):
        voxel_colors(street, "relevance")
    with pytest.raises(ConfigError, match="image or semantic or height or relevance, got sepia"):
        voxel_colors(street, "sepia")


def test_all_but_hits_lose_their_hue(street):
    hits = [item for item in street.objects if item.label == "car"]
    colors = street.voxels.colors
    shown = grey_but(colors, hits)
    kept = np.zeros(len(colors), bool)
    kept[np.concatenate([item.voxels for item in hits])] = True
    assert (shown[kept] == colors[kept]).all()
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
