"""Rectangles cover exactly the exposed faces, each once."""

import numpy as np
import pytest

from openvocab_occ._jit import limit_threads
from openvocab_occ.occupancy import read_occ3d
from openvocab_occ.occupancy.faces import exposed_faces


def unit_faces(occupied) -> list[tuple[int, int, int, int]]:
    """Kind, plane and the two other indices of every face between an occupied voxel and a free one or the outside."""
    found, padded = [], np.pad(occupied, 1)
    for axis in range(3):
        for side in (0, 1):
            beyond = np.roll(padded, -1 if side else 1, axis)[1:-1, 1:-1, 1:-1]
            index = np.argwhere(occupied & ~beyond)
            others = np.delete(index, axis, axis=1)
            found += [(2 * axis + side, i[axis] + side, a, b) for i, (a, b) in zip(index, others, strict=True)]
    return sorted((int(k), int(p), int(a), int(b)) for k, p, a, b in found)


def cut_up(faces) -> list[tuple[int, int, int, int]]:
    rows = faces.tolist()
    return sorted((k, p, a, b) for k, p, a0, a1, b0, b1 in rows for a in range(a0, a1) for b in range(b0, b1))


@pytest.mark.parametrize("density", [0.0, 0.1, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 4, 5), (7, 70, 3), (2, 3, 130), (65, 2, 64), (5, 64, 65), (1, 1, 64)])
def test_they_cover_the_surface_once(rng, shape, density):
    occupied = rng.random(shape) < density
    faces = exposed_faces(occupied)
    assert faces.dtype == np.int32
    assert cut_up(faces) == unit_faces(occupied)
    assert (np.diff(faces[:, 0]) >= 0).all()


def test_a_box_has_six_rectangles():
    occupied = np.zeros((10, 12, 9), bool)
    occupied[2:7, 3:11, 1:8] = True
    assert exposed_faces(occupied).tolist() == [
        [0, 2, 3, 11, 1, 8], [1, 7, 3, 11, 1, 8],
        [2, 3, 2, 7, 1, 8], [3, 11, 2, 7, 1, 8],
        [4, 1, 2, 7, 3, 11], [5, 8, 2, 7, 3, 11],
    ]  # fmt: skip


def test_more_rectangles_than_room_was_made_for(rng):
    occupied = np.indices((40, 40, 40)).sum(axis=0) % 2 == 0  # a chequerboard: nothing can be merged
    with limit_threads(1):
        faces = exposed_faces(occupied)
    assert len(faces) == 6 * occupied.sum()
    with limit_threads(4):
        np.testing.assert_array_equal(exposed_faces(occupied), faces)


@pytest.mark.data
def test_on_real_labels_there_are_far_fewer_rectangles_than_faces(data):
    occupied = read_occ3d(data / "occ3d" / "labels.npz").occupied
    faces = exposed_faces(occupied)
    units = unit_faces(occupied)
    assert cut_up(faces) == units
    assert len(faces) < 0.5 * len(units)
