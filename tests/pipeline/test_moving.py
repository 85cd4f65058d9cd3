"""On the synthetic street, whose truth is known: what moves leaves no trail, what is parked stays."""

import numpy as np
import pytest

from openvocab_occ.datasets.street import CAR, TRUCK, load_street, street
from openvocab_occ.mapping import NO_LABEL, VoxelMap
from openvocab_occ.pipeline import MapBuilder
from openvocab_occ.segmentation.encoder import FeatureMap


class ByPlace:
    """An encoder that says nothing but takes part."""

    name, contract, dim, labels, fingerprint, text = "mean", "dense", 3, (), "d" * 64, None

    def encode(self, images):
        small = [image[2::4, 2::4].astype(np.float32) + 1 for image in images]
        return [FeatureMap(s / np.linalg.norm(s, axis=2, keepdims=True), (0.25, 0.25), (-0.375, -0.375)) for s in small]


@pytest.fixture(scope="module")
def drive():
    frames = list(load_street(frames=12))
    builder = MapBuilder(ByPlace())
    for frame in frames:
        builder.integrate(frame)
    return frames, builder.snapshot()


def inside(points, thing, time, pad=0.0):
    low, high = thing.bounds(time)
    return ((points > low - pad) & (points < high + pad)).all(axis=1)


def test_a_moving_car_leaves_no_trail_and_is_in_the_layers(drive):
    frames, scene = drive
    car = next(thing for thing in street(0).objects if thing.moving)
    trail = np.zeros(len(scene.voxels), bool)
    for frame in frames:
        trail |= inside(scene.voxels.centers, car, frame.timestamp, pad=0.2) & (scene.voxels.centers[:, 2] > 0.3)
    assert trail.sum() <= 3
    found = 0
    for layer in scene.dynamic:
        at = inside((layer.keys + 0.5) * 0.4, car, layer.time, pad=0.3)
        found += at.sum()
    assert found > 100


def test_parked_trucks_and_cars_stay(drive):
    _, scene = drive
    seen = 0
    for thing in street(0).objects:
        if thing.label in (CAR, TRUCK) and not thing.moving:
            at = inside(scene.voxels.centers, thing, 0.0)
            seen += at.sum() > 30
            assert (scene.voxels.labels[at] != thing.label).sum() <= 0.1 * at.sum()
    assert seen >= 5
    trucks = [thing for thing in street(0).objects if thing.label == TRUCK]
    assert all(inside(scene.voxels.centers, truck, 0.0).sum() > 80 for truck in trucks)


def test_classes_are_counted_and_normals_face_where_surfaces_do(drive):
    frames, scene = drive
    voxels = scene.voxels
    assert voxels.label_counts.shape == (len(voxels), 18)
    named = voxels.labels != NO_LABEL
    assert (voxels.label_counts.sum(axis=1)[named] <= voxels.count[named]).all()
    road = voxels.label_counts.argmax(axis=1) == frames[0].occupancy.class_names.index("driveable surface")
    assert (voxels.normals[road, 2] > 0.9).mean() > 0.8
    assert set(voxels.columns()["view_frame"].tolist()) <= set(range(12))


def test_frames_in_any_order_give_the_same_map(drive):
    frames, scene = drive
    builder = MapBuilder(ByPlace())
    for frame in frames[::-1]:
        builder.integrate(frame)
    other = builder.snapshot()
    np.testing.assert_array_equal(other.voxels.keys, scene.voxels.keys)
    np.testing.assert_allclose(other.voxels.features, scene.voxels.features, atol=1e-4)
    np.testing.assert_array_equal(other.voxels.labels, scene.voxels.labels)
    for name, column in scene.voxels.columns().items():
        if name in ("view_frame", "view", "view_box", "count", "label_counts"):
            np.testing.assert_array_equal(other.voxels.columns()[name], column)


def test_a_run_split_in_two_merges_to_the_whole(drive):
    frames, _ = drive
    parts = [MapBuilder(ByPlace()) for _ in range(3)]
    for i, frame in enumerate(frames[:6]):
        parts[0].integrate(frame)
        parts[1 + (i >= 3)].integrate(frame)
    whole, *halves = (part._voxels for part in parts)
    merged = VoxelMap(0.4, 3, num_classes=18)
    for half in halves:
        merged.merge(half)
    np.testing.assert_array_equal(merged.keys, whole.keys)
    np.testing.assert_allclose(merged.features, whole.features, atol=1e-5)
    np.testing.assert_array_equal(merged.free_count, whole.free_count)
    np.testing.assert_array_equal(merged.label_counts, whole.label_counts)
    np.testing.assert_array_equal(merged.count, whole.count)
