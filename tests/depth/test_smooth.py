"""Smooth surfaces: the first crossing is the one that small steps find, and lies nearer to meshes than voxels do."""

import numpy as np
import pytest

from openvocab_occ.depth import render_depth
from openvocab_occ.depth._smooth_reference import first_crossing
from openvocab_occ.depth.smooth import trace_surface
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import Camera, GridSpec, look_at
from openvocab_occ.occupancy import GEOMETRY_CLASSES, OccupancyGrid

SMOOTH = ("smooth labels", "smooth logits")
K = np.array([[14.0, 0, 7.5], [0, 13.0, 5.0], [0, 0, 1]])


def grid_of(probability, *, known=None) -> OccupancyGrid:
    """A grid whose logits say so, in voxels of 1 m."""
    share = np.clip(probability.astype(np.float64), 1e-6, 1 - 1e-6)
    logits = np.stack([np.log(share), np.log1p(-share)], axis=-1).astype(np.float32)
    spec = GridSpec((0.0, 0.0, 0.0), 1.0, probability.shape)
    return OccupancyGrid.from_logits(logits, spec, free_label=1, known=known, class_names=GEOMETRY_CLASSES)


@pytest.mark.parametrize("shape", [(6, 5, 4), (1, 1, 1), (1, 7, 3)])
@pytest.mark.parametrize("low", [0.0, 0.4])
def test_the_first_crossing_is_the_one_small_steps_find(rng, shape, low):
    grid = grid_of(rng.uniform(low, 1.0 - low * 0.4, shape) ** 2)
    origins = rng.uniform(-3, np.add(shape, 3), (60, 3))
    directions = rng.uniform(0, shape, (60, 3)) - origins
    directions[:10] = np.eye(3)[rng.integers(0, 3, 10)] * rng.choice([-2.0, 1.0], (10, 1))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    step, grazes = 1e-3, 0
    for origin, direction in zip(origins, directions, strict=True):
        t, voxel = trace_surface(grid, origin, direction[None], 20.0)
        wanted = first_crossing(origin, direction, grid.probability, 20.0, step)
        if wanted == 20.0:  # steps may pass over where the ray only grazes the surface
            grazes += voxel[0] >= 0
            continue
        assert t[0] <= wanted + 1e-5
        if t[0] < wanted - step - 1e-5:
            grazes += 1
            continue
        assert grid.probability.flat[voxel[0]] >= 0.5
        assert (
            np.abs(grid.spec.centers(grid.spec.unflat(voxel.astype(np.int64)))[0] - origin - t * direction) < 1
        ).all()
    assert grazes <= 2


def test_a_plane_between_voxels_is_found_where_it_is():
    for level in (0.5, 0.25, 0.8):  # share of the fourth layer that is filled
        filled = np.zeros((8, 8, 8))
        filled[:, :, :3], filled[:, :, 3] = 1.0, level
        camera = Camera(K, 16, 11, look_at([4.0, 4.0, 7.5], [4.0, 4.0, 0.0]))
        depth = render_depth(grid_of(filled), camera, surface="smooth").depth
        height = 3.5 - (0.5 - level) / (1 - level) if level < 0.5 else 3.5 + (level - 0.5) / level
        np.testing.assert_allclose(depth[3:8, 5:11], 7.5 - height, atol=1e-4)


def test_walls_one_voxel_thick_and_single_voxels_remain():
    labels = np.ones((9, 9, 9), np.uint8)
    labels[:, :, 2], labels[4, 4, 6] = 0, 0
    grid = OccupancyGrid(
        labels, GridSpec((0.0, 0.0, 0.0), 1.0, labels.shape), free_label=1, class_names=GEOMETRY_CLASSES
    )
    camera = Camera(K, 16, 11, look_at([4.5, 4.5, 8.9], [4.5, 4.5, 0.0]))
    image = render_depth(grid, camera, surface="smooth")
    assert set(np.unique(image.voxel // 9 // 9 * 0 + image.voxel % 9)) == {2, 6}
    assert grid.probability[labels == 0].min() >= 0.5 > grid.probability[labels == 1].max()


def test_what_is_not_known_is_transparent():
    filled = np.zeros((6, 6, 6))
    filled[:, :, 4], filled[:, :, 0] = 1.0, 1.0
    camera = Camera(K, 16, 11, look_at([3.0, 3.0, 9.0], [3.0, 3.0, 0.0]))
    seen = render_depth(grid_of(filled), camera, surface="smooth")
    assert set(np.unique(seen.voxel[4:7, 6:10] % 6)) == {4}
    known = np.ones(filled.shape, bool)
    known[:, :, 4] = False
    through = render_depth(grid_of(filled, known=known), camera, surface="smooth")
    assert set(np.unique(through.voxel[4:7, 6:10] % 6)) == {0}


def test_a_camera_within_the_surface_and_one_that_sees_nothing():
    full = grid_of(np.ones((4, 4, 4)))
    inside = render_depth(full, Camera(K, 16, 11, look_at([2.1, 2.2, 2.3], [4, 4, 4])), surface="smooth")
    assert (inside.depth == 0).all()
    assert (inside.voxel == (2 * 4 + 2) * 4 + 2).all()
    nothing = render_depth(
        grid_of(np.zeros((4, 4, 4))), Camera(K, 16, 11, look_at([-3, 2, 2], [4, 2, 2])), max_depth=9.0, surface="smooth"
    )
    assert (nothing.depth == 9.0).all()
    assert (nothing.voxel == -1).all()


def test_probability_is_that_of_the_softmax(rng):
    logits = (rng.normal(size=(3, 4, 5, 18)) * 30).astype(np.float32)
    grid = OccupancyGrid.from_logits(logits, GridSpec((0.0, 0.0, 0.0), 1.0, (3, 4, 5)))
    wide = logits.astype(np.float64)
    softmax = np.exp(wide - wide.max(axis=-1, keepdims=True))
    softmax /= softmax.sum(axis=-1, keepdims=True)
    np.testing.assert_allclose(grid.probability, 1 - softmax[..., 17], atol=1e-6)


def test_smooth_surfaces_are_nearer_to_meshes_than_voxels():
    pytest.importorskip("open3d", exc_type=ImportError)
    from openvocab_occ.evaluation.mesh_scenes import surface_errors

    errors = {(e.scene, e.surface): e for e in surface_errors(width=80, height=60)}
    scenes = ("slope", "balls", "pipes")
    median = {s: np.array([errors[scene, s].median_m for scene in scenes]) for s in ("voxel", *SMOOTH)}
    far = {s: np.array([errors[scene, s].p90_m for scene in scenes]) for s in ("voxel", *SMOOTH)}
    assert (median["smooth logits"] < median["voxel"]).all()
    assert median["smooth logits"].mean() < 0.4 * median["voxel"].mean()
    assert far["smooth labels"].mean() < 0.95 * far["voxel"].mean()
    assert (median["smooth labels"] < median["voxel"] + 0.02).all()  # a level floor of labels lies where it lies
    assert all(error.misses < 0.05 for error in errors.values())


def test_smooth_labels_are_nearer_to_the_city_than_voxels():
    from openvocab_occ.evaluation.mesh_scenes import city_errors

    errors = {e.surface: e for e in city_errors(3, keyframes=(20,))}
    assert errors["smooth labels"].median_m < 0.75 * errors["voxel"].median_m
    assert errors["smooth labels"].p90_m < 0.75 * errors["voxel"].p90_m
    assert max(errors[name].misses for name in ("voxel", "smooth labels")) < 0.08


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"surface": "mesh"}, "surface is not known: expected voxel or smooth, got mesh"),
        ({"surface": "smooth", "step": 0.1}, r"a smooth surface is not sampled: expected step=None, got 0\.1"),
    ],
)
def test_what_is_no_surface_is_refused(options, message):
    with pytest.raises(ConfigError, match=message):
        render_depth(grid_of(np.ones((2, 2, 2))), Camera(K, 16, 11), **options)
