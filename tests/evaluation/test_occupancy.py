"""Occupancy metrics: published means, hand-made cases, laws."""

import math

import numpy as np
import pytest

from openvocab_occ.errors import DataError
from openvocab_occ.evaluation.occupancy import DYNAMIC, STATIC, OccupancyScore, RayScore, ray_directions
from openvocab_occ.geometry import GridSpec, pose
from openvocab_occ.occupancy import OccupancyGrid

LMPOCC_S = (10.97, 48.87, 23.66, 43.31, 51.27, 23.61, 23.79, 27.49, 26.28, 36.26, 37.95,
            81.97, 42.06, 52.09, 58.43, 52.96, 45.45)  # fmt: skip
"""Table I of the paper; its means there are 40.38, 32.13 (dynamic) and 55.49 (static)."""


def test_partition_gives_the_published_means():
    rows = np.array(LMPOCC_S)
    assert round(rows.mean(), 2) == 40.38
    assert round(rows[list(DYNAMIC)].mean(), 2) == 32.13
    assert round(rows[list(STATIC)].mean(), 2) == 55.49


def test_iou_is_that_of_sets(rng):
    score = OccupancyScore()
    pairs = [(rng.integers(0, 18, (6, 7, 5), dtype=np.uint8), rng.integers(0, 18, (6, 7, 5), dtype=np.uint8),
              rng.random((6, 7, 5)) < 0.6) for _ in range(3)]  # fmt: skip
    for predicted, truth, mask in pairs:
        score.add(predicted, truth, mask)
    p, t = (np.concatenate([pair[k][pair[2]] for pair in pairs]) for k in (0, 1))
    for c in range(18):
        assert score.iou[c] == pytest.approx(((p == c) & (t == c)).sum() / ((p == c) | (t == c)).sum())
    assert score.mean() == pytest.approx(np.mean(score.iou[:17]))
    assert score.geometric == pytest.approx(((p != 17) & (t != 17)).sum() / ((p != 17) | (t != 17)).sum())


def test_truth_scores_full_and_missing_classes_do_not_count(rng):
    labels = rng.choice(np.array([4, 11, 17], np.uint8), (5, 5, 5))
    score = OccupancyScore()
    score.add(labels, labels)
    assert score.to_dict() == {"mIoU": 100.0, "dynamic": 100.0, "static": 100.0, "geometric": 100.0}
    assert np.isnan(score.iou[0])


def test_labels_out_of_range_are_refused():
    with pytest.raises(DataError, match="out of range"):
        OccupancyScore().add(np.full((1, 1, 1), 18, np.uint8), np.zeros((1, 1, 1), np.uint8))


def test_rays_are_those_of_the_benchmark():
    rays = ray_directions()
    assert rays.shape == (14040, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1)
    pitch = np.rad2deg(np.arcsin(rays[::360, 2]))
    assert len(pitch) == 39
    assert pitch[0] == pytest.approx(-45)
    assert pitch[-1] == pytest.approx(12.548, abs=1e-3)


def wall(at, label=15, T=None):
    labels = np.full((100, 100, 10), 17, np.uint8)
    labels[at] = label
    return OccupancyGrid(labels, GridSpec((-20.0, -20.0, -2.0), 0.4, labels.shape), np.eye(4) if T is None else T)


@pytest.mark.parametrize("T", [np.eye(4), pose((100.0, -50.0, 3.0), (0.9, 0.0, 0.0, 0.4))])
def test_ray_iou_of_a_moved_wall(T):
    """A wall of the same class moved by 1.2 m is right at 2 and 4 m for rays that meet it head on, never at 1 m."""
    origin = T[:3, 3][None]
    truth = wall(80, T=T)
    exact, moved, other = RayScore(), RayScore(), RayScore()
    exact.add(truth, truth, origin)
    moved.add(wall(83, T=T), truth, origin)
    other.add(wall(80, label=16, T=T), truth, origin)
    assert exact.value == 1.0
    assert moved.at(0) < 0.02  # rays along the wall leave both at the border of the grid
    assert 0.5 < moved.at(1) <= moved.at(2) < 1.0
    assert other.value == 0.0


def test_nothing_seen_is_no_score():
    empty = OccupancyGrid(np.full((4, 4, 4), 17, np.uint8), GridSpec((0.0, 0.0, 0.0), 1.0, (4, 4, 4)))
    score = RayScore()
    score.add(empty, empty, np.array([[2.0, 2.0, 2.0]]))
    assert math.isnan(score.at(0))
