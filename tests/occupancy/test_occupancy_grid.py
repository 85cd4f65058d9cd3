"""What contradicts itself is no grid."""

import numpy as np
import pytest

from openvocab_occ.errors import DataError, GridError, PoseError, ShapeError
from openvocab_occ.geometry import GridSpec, pose
from openvocab_occ.occupancy import OccupancyGrid

SPEC = GridSpec((0.0, 0.0, 0.0), 0.5, (4, 3, 2))
LABELS = np.full(SPEC.shape, 17, np.uint8)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"labels": LABELS + np.uint8(1)}, GridError, r"out of range: expected 0\.\.17 \(18 classes\), got 18\.\.18"),
        ({"labels": LABELS.astype(int) - 18}, GridError, "labels are out of range"),
        ({"labels": LABELS.astype(np.float32)}, GridError, "not class numbers: .* got float32; for class scores"),
        ({"labels": LABELS.T}, ShapeError, r"do not fit the grid: .* got \(2, 3, 4\); axes are \[x, y, z\]"),
        ({"logits": np.zeros((4, 3, 2, 17), np.float32)}, ShapeError, r"logits has the wrong shape: .*3, 2, 18\)"),
        ({"logits": np.full((4, 3, 2, 18), np.nan, np.float32)}, DataError, "occupancy logits is not finite"),
        ({"known": np.zeros((4, 3), bool)}, ShapeError, "known mask has the wrong shape"),
        ({"free_label": 18}, GridError, r"free label is not a class: expected 0\.\.17"),
        ({"T_world_grid": np.full((4, 4), np.nan)}, PoseError, "T_world_grid holds NaN or infinity"),
        ({"T_world_grid": np.diag([2.0, 2, 2, 1])}, PoseError, "T_world_grid is not a rotation"),
    ],
)  # fmt: skip
def test_what_contradicts_itself_is_refused(change, error, message):
    with pytest.raises(error, match=message):
        OccupancyGrid(**{"labels": LABELS, "spec": SPEC} | change)


def test_from_logits_labels_each_voxel_with_its_best_class(rng):
    logits = rng.normal(size=(*SPEC.shape, 18)).astype(np.float32)
    grid = OccupancyGrid.from_logits(logits, SPEC)
    np.testing.assert_array_equal(grid.labels, logits.argmax(axis=-1))
    np.testing.assert_array_equal(grid.logits, logits)


@pytest.mark.usefixtures("unchecked")
def test_logits_of_another_grid_are_refused():
    with pytest.raises(
        ShapeError, match=r"occupancy logits has the wrong shape: expected \(4, 3, 2, 18\), got \(4, 3, 2\)"
    ):
        OccupancyGrid.from_logits(np.zeros((4, 3, 2), np.float32), SPEC)


def test_occupied_is_known_and_not_free():
    labels = LABELS.copy()
    labels[0], labels[1] = 4, 4
    known = np.ones(SPEC.shape, bool)
    known[1] = False
    assert np.flatnonzero(OccupancyGrid(labels, SPEC).occupied).tolist() == list(range(12))
    assert np.flatnonzero(OccupancyGrid(labels, SPEC, known=known).occupied).tolist() == list(range(6))


def test_centres_are_in_the_world():
    grid = OccupancyGrid(LABELS, SPEC, pose([10, 20, 30], [0, 0, 0, 1]))  # half a turn about z
    np.testing.assert_allclose(grid.centers(np.array([0, 23])), [[9.75, 19.75, 30.25], [8.25, 18.75, 30.75]])
