"""Laws of the lattice: metres and voxels are inverses."""

import numpy as np
import pytest

from openvocab_occ.errors import DataError, GridError, ShapeError
from openvocab_occ.geometry import GridSpec

SPECS = [GridSpec((-40.0, -40.0, -1.0), 0.4, (200, 200, 16)), GridSpec((1.5, -2.0, 0.1), (0.5, 0.3, 0.2), (7, 5, 3))]


@pytest.mark.parametrize("spec", SPECS)
def test_every_centre_lies_in_its_voxel(spec):
    index = np.stack(np.unravel_index(np.arange(spec.num_voxels), spec.shape), axis=-1)
    np.testing.assert_array_equal(spec.index(spec.centers(index)), index)


@pytest.mark.parametrize("spec", SPECS)
def test_flat_and_unflat_are_inverse_and_in_c_order(spec):
    flat = np.arange(spec.num_voxels)
    index = spec.unflat(flat)
    np.testing.assert_array_equal(spec.flat(index), flat)
    values = np.arange(spec.num_voxels).reshape(spec.shape)
    np.testing.assert_array_equal(values[tuple(index.T)], flat)


def test_outside_has_no_flat_index():
    spec = SPECS[1]
    outside = np.array([[-1, 0, 0], [7, 0, 0], [0, 5, 0], [0, 0, 3], [0, 0, -1], [6, 4, 2]])
    assert spec.flat(outside).tolist() == [-1] * 5 + [spec.num_voxels - 1]
    assert spec.contains(outside).tolist() == [False] * 5 + [True]


def test_bounds_hold_exactly_the_voxels(rng):
    spec = SPECS[1]
    lower, upper = spec.bounds
    np.testing.assert_allclose(upper - lower, spec.size * spec.shape)
    points = rng.uniform(lower - 1, upper + 1, (2000, 3))
    np.testing.assert_array_equal(spec.contains(spec.index(points)), ((points >= lower) & (points < upper)).all(axis=1))


def test_lower_faces_belong_to_the_voxel():
    spec = GridSpec((0.0, 0.0, 0.0), 0.5, (4, 4, 4))
    assert spec.index([[0.5, 1.0, 0.0], [0.49, 0.99, -0.01]]).tolist() == [[1, 2, 0], [0, 1, -1]]


@pytest.mark.usefixtures("unchecked")
def test_equal_specs_are_equal():
    assert GridSpec([0, 0, 0], 1, [2, 3, 4]) == GridSpec((0.0, 0.0, 0.0), 1.0, (2, 3, 4))
    assert hash(SPECS[0]) == hash(GridSpec((-40.0, -40.0, -1.0), 0.4, (200, 200, 16)))


@pytest.mark.parametrize(
    ("origin", "size", "shape", "error", "message"),
    [
        (
            (0, 0, 0),
            0.0,
            (2, 2, 2),
            GridError,
            "voxel size is not usable: expected one or three lengths above 0 m, got 0",
        ),
        ((0, 0, 0), (1, -1, 1), (2, 2, 2), GridError, "voxel size is not usable"),
        ((0, 0, 0), np.nan, (2, 2, 2), GridError, "voxel size is not usable"),
        ((0, 0, 0), (1, 1), (2, 2, 2), GridError, "voxel size is not usable"),
        ((0, 0, 0), 1.0, (2, 0, 2), GridError, "grid shape is not usable: expected three positive integers"),
        ((0, 0, 0), 1.0, (2, 2.5, 2), GridError, "grid shape is not usable"),
        (
            (0, 0, 0),
            1.0,
            (2048, 2048, 512),
            GridError,
            "grid is too large: expected at most 2147483647 voxels, .*tiles",
        ),
        ((0, 0, np.inf), 1.0, (2, 2, 2), DataError, "grid origin is not finite"),
        ((0, 0), 1.0, (2, 2, 2), ShapeError, "grid origin has the wrong shape"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_what_is_no_lattice_is_refused(origin, size, shape, error, message):
    with pytest.raises(error, match=message):
        GridSpec(origin, size, shape)
