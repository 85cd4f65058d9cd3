"""Renderings of a map: what they show is what is there, at the depth it is at."""

import dataclasses

import numpy as np
import pytest

from openvocab_occ.depth.render import render_depth
from openvocab_occ.export.render import owners, render_map
from openvocab_occ.geometry import GridSpec, transform
from openvocab_occ.objects import ObjectTree
from openvocab_occ.occupancy import GEOMETRY_CLASSES, OccupancyGrid
from tests.export.conftest import CAMERAS


def whole_grid(scene):
    """The map as one dense grid with nothing left out, and the map's position of each voxel."""
    keys = scene.voxels.keys.astype(np.int64)
    low, shape = keys.min(axis=0), np.ptp(keys, axis=0) + 1
    spec = GridSpec(tuple((low * 0.4).tolist()), 0.4, tuple(shape.tolist()))
    at = np.full(spec.num_voxels, -1)
    at[spec.flat(keys - low)] = np.arange(len(keys))
    labels = np.where(at >= 0, 0, 1).astype(np.uint8).reshape(spec.shape)
    return OccupancyGrid(labels, spec, free_label=1, class_names=GEOMETRY_CLASSES), at


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_the_window_shows_what_the_whole_map_shows(street, camera):
    view = render_map(street, camera, max_depth=60.0)
    grid, at = whole_grid(street)
    truth = render_depth(grid, camera, max_depth=60.0)
    voxel = np.where(truth.voxel >= 0, at[truth.voxel], -1)
    assert (voxel >= 0).any()
    assert (view.voxel == voxel).mean() > 0.999  # rays along faces may fall to either side
    np.testing.assert_allclose(view.depth[view.voxel == voxel], truth.depth[view.voxel == voxel], atol=1e-3)
    assert (view.depth[view.voxel < 0] == 60.0).all()


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_points_at_their_depth_lie_on_their_voxels(street, camera):
    view = render_map(street, camera, max_depth=60.0)
    hit = view.voxel >= 0
    points = transform(camera.T_world_cam, (camera.rays() * view.depth[..., None])[hit])
    off = np.abs(points - street.voxels.centers[view.voxel[hit]]).max(axis=1)
    assert off.max() < 0.2 + 1e-3
    outside = view.depth[hit] > 0
    assert np.abs(off[outside] - 0.2).max() < 1e-3  # on a face, not within


def test_voxels_belong_to_the_smallest_object_that_holds_them(street):
    owner = owners(street)
    for item in street.objects:
        assert (owner[item.voxels] == item.id).all()
    whole = street.objects[1]
    few = {"voxels": whole.voxels[:5], "points": whole.points[:5]}
    inner = dataclasses.replace(whole, id=99, parent=1, label="door", **few)
    nodes = [dataclasses.replace(n, children=(99,)) if n.id == 1 else n for n in street.objects.nodes]
    nested = dataclasses.replace(street, objects=ObjectTree([*nodes, inner]))
    assert (owners(nested)[inner.voxels] == 99).all()
