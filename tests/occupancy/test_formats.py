"""Neighbouring formats: files made here after their makers' layouts, and what damaged ones say."""

import numpy as np
import pytest

from openvocab_occ.errors import DataError, GridError, ShapeError, UnsafeFileError
from openvocab_occ.geometry import pose
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_FREE
from openvocab_occ.occupancy.formats import (
    OPENOCC_CLASSES,
    OPENOCCUPANCY_SPEC,
    SEMANTICKITTI_CLASSES,
    SEMANTICKITTI_SPEC,
    SURROUNDOCC_SPEC,
    read_bits,
    read_openocc,
    read_openocc_v1,
    read_openoccupancy,
    read_semantickitti,
    read_surroundocc,
)  # fmt: skip

CAR, TRUCK = OCC3D_CLASSES.index("car"), OCC3D_CLASSES.index("truck")


def test_surroundocc(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[120, 90, 5, CAR], [3, 4, 15, 11], [9, 9, 9, 0]]))
    T = pose((1, 2, 3))
    grid = read_surroundocc(tmp_path / "a.npy", T)
    assert grid.spec == SURROUNDOCC_SPEC
    assert grid.labels[120, 90, 5] == CAR
    assert not grid.known[9, 9, 9]
    assert int(grid.occupied.sum()) == 2
    assert int(grid.known.sum()) == grid.spec.num_voxels - 1
    flat = np.ravel_multi_index((120, 90, 5), grid.spec.shape)
    np.testing.assert_allclose(grid.centers(np.array([flat])), [[10.25 + 1, -4.75 + 2, -2.25 + 3]])


@pytest.mark.parametrize("columns", [4, 7])
def test_openoccupancy_lists_z_first(tmp_path, columns):
    rows = np.zeros((2, columns))
    rows[:, :3] = [[39, 7, 500], [0, 1, 2]]
    rows[:, -1] = [CAR, 0]
    np.save(tmp_path / "a.npy", rows)
    grid = read_openoccupancy(tmp_path / "a.npy")
    assert grid.spec == OPENOCCUPANCY_SPEC
    assert np.argwhere(grid.occupied).tolist() == [[500, 7, 39]]
    assert not grid.known[2, 1, 0]


def test_openocc_in_its_own_order(tmp_path):
    labels = np.full((200, 200, 16), 16, np.uint8)
    for i in range(16):
        labels[i, 2, 3] = i
    np.savez(tmp_path / "labels.npz", semantics=labels, flow=np.zeros((1, 2)))
    grid = read_openocc(tmp_path / "labels.npz")
    assert [OCC3D_CLASSES[c] for c in grid.labels[:16, 2, 3]] == list(OPENOCC_CLASSES[:16])
    assert int(grid.occupied.sum()) == 16


@pytest.mark.parametrize("first", [0, 1])
def test_openocc_v1_counts_z_y_x(tmp_path, first):
    where = np.ravel_multi_index(([5, 0], [6, 199], [7, 3]), (16, 200, 200))  # z, y, x
    np.save(tmp_path / "o.npy", np.stack([where, [0 + first, 1 + first]], axis=1))
    np.save(tmp_path / "i.npy", where[1:])
    grid = read_openocc_v1(tmp_path / "o.npy", tmp_path / "i.npy", first_class=first)
    assert grid.labels[7, 6, 5] == CAR
    assert grid.labels[3, 199, 0] == TRUCK
    assert not grid.known[3, 199, 0]
    assert int(grid.occupied.sum()) == 1
    assert (grid.labels != OCC3D_FREE).sum() == 2


def test_semantickitti(tmp_path):
    raw = np.zeros(SEMANTICKITTI_SPEC.shape, "<u2")
    raw[1, 2, 3], raw[4, 5, 6], raw[7, 8, 9] = 259, 70, 1
    raw.tofile(tmp_path / "0.label")
    hidden = np.zeros(SEMANTICKITTI_SPEC.shape, bool)
    hidden[4, 5, 6] = hidden[200, 0, 31] = True
    np.packbits(hidden).tofile(tmp_path / "0.invalid")  # most significant bit first
    grid = read_semantickitti(tmp_path / "0.label", tmp_path / "0.invalid")
    assert SEMANTICKITTI_CLASSES[grid.labels[1, 2, 3]] == "other-vehicle"
    assert SEMANTICKITTI_CLASSES[grid.labels[4, 5, 6]] == "vegetation"
    assert np.argwhere(~grid.known).tolist() == [[4, 5, 6], [7, 8, 9], [200, 0, 31]]
    np.testing.assert_array_equal(read_bits(tmp_path / "0.invalid"), hidden)
    np.packbits(raw != 0).tofile(tmp_path / "0.bin")
    shape = read_semantickitti(tmp_path / "0.bin")
    np.testing.assert_array_equal(shape.occupied, raw != 0)
    np.testing.assert_array_equal(shape.known, raw != 0)


def test_damaged_files_say_so(tmp_path):
    file = tmp_path / "a.npy"
    np.save(file, np.array([[0, 0, 16, 4]]))
    with pytest.raises(GridError, match=r"outside the grid: .*got \[0, 0, 16\].*columns in another order"):
        read_surroundocc(file)
    np.save(file, np.array([[0, 0, 0, 17]]))
    with pytest.raises(GridError, match=r"out of range: expected 0\.\.16, got 17\.\.17"):
        read_surroundocc(file)
    np.save(file, np.zeros((4, 5)))
    for read in (read_surroundocc, read_openoccupancy, read_openocc_v1):
        with pytest.raises(ShapeError, match="another kind: expected rows of"):
            read(file)
    np.save(file, np.array([[0.0, 0, np.nan, 4]]))
    with pytest.raises(DataError, match="not finite"):
        read_surroundocc(file)
    np.save(file, np.array([{}]), allow_pickle=True)
    with pytest.raises(UnsafeFileError, match="pickled objects"):
        read_surroundocc(file)
    file.write_bytes(b"\x93NUMPY\x01\x00v\x00{")
    with pytest.raises(DataError, match="cannot be read"):
        read_openoccupancy(file)
    np.save(file, np.array([[640000, 0]]))
    with pytest.raises(GridError, match="outside the grid"):
        read_openocc_v1(file)
    with pytest.raises(ShapeError, match="no OpenOcc v2"):
        read_openocc(file)
    (tmp_path / "a.label").write_bytes(b"\0" * 77)
    with pytest.raises(DataError, match="cut off or of another kind"):
        read_semantickitti(tmp_path / "a.label")
    with pytest.raises(DataError, match="cut off or of another kind"):
        read_bits(tmp_path / "a.label")
    np.full(SEMANTICKITTI_SPEC.shape, 300, "<u2").tofile(tmp_path / "b.label")
    with pytest.raises(GridError, match=r"labels of no class: .*got \[300\]"):
        read_semantickitti(tmp_path / "b.label")
