"""The keyframe's own LiDAR as judge."""

from dataclasses import replace

import numpy as np
import pytest

from openvocab_occ.datasets.registry import load_sequence
from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.evaluation.keyframe import held_out_depth, judge_keyframe, mirror_cameras
from openvocab_occ.segmentation.onnx import load_encoder


@pytest.fixture(scope="module")
def frame(data):
    return load_sequence("nuscenes-infos", data / "nuscenes_keyframe")[0]


@pytest.fixture(scope="module")
def road_model(data):
    return load_encoder(data / "onnx" / "road_adas" / "road-segmentation-adas-0001.onnx")


@pytest.mark.data
def test_right_cameras_beat_mirrored_ones(frame, road_model):
    """Geometry, not luck: with mirrored cameras more returns miss their word, and more get one they should not."""
    report = judge_keyframe(frame, road_model, "roads")
    assert report.words.points_under == report.control.points_under > 1000
    assert report.words.share_under > report.control.share_under + 0.05
    assert report.words.share_elsewhere < report.control.share_elsewhere
    assert report.depth.hit > 0.9
    assert report.depth.median_m < 1.0


@pytest.mark.data
def test_more_returns_make_no_worse_depth(frame):
    """Holding back more of the returns leaves fewer voxels to hit."""
    some, few = held_out_depth(frame, held_out=0.2), held_out_depth(frame, held_out=0.9)
    assert few.hit < some.hit
    assert few.points > some.points


@pytest.mark.data
def test_mirroring_twice_changes_nothing(frame):
    twice = mirror_cameras(mirror_cameras(frame))
    for a, b in zip(frame.views, twice.views, strict=True):
        np.testing.assert_allclose(a.camera.T_world_cam, b.camera.T_world_cam, atol=1e-6)


@pytest.mark.data
def test_refusals(frame, road_model):
    with pytest.raises(DataError, match="cannot be judged"):
        judge_keyframe(replace(frame, points=None), road_model, "road")
    with pytest.raises(ConfigError, match="no label for the word"):
        judge_keyframe(frame, road_model, "zebra")
