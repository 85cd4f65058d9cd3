"""Occ3D labels survive the round trip; what is none is refused."""

import numpy as np
import pytest

from openvocab_occ.errors import DataError, GridError, NotFoundError, ShapeError, UnsafeFileError
from openvocab_occ.geometry import GridSpec, pose
from openvocab_occ.occupancy import OCC3D_CLASSES, OCC3D_SPEC, OccupancyGrid, read_occ3d, read_occ3d_masks, write_occ3d

SHAPE = OCC3D_SPEC.shape


@pytest.fixture
def arrays(rng) -> dict[str, np.ndarray]:
    return {
        "semantics": rng.integers(0, 18, SHAPE, dtype=np.uint8),
        "mask_lidar": rng.integers(0, 2, SHAPE, dtype=np.uint8),
        "mask_camera": rng.integers(0, 2, SHAPE, dtype=np.uint8),
    }


def test_a_grid_survives_the_round_trip(tmp_path, arrays):
    T = pose([1, 2, 3], [0.9, 0.1, 0.2, 0.3])
    grid = OccupancyGrid(arrays["semantics"], OCC3D_SPEC, T, known=arrays["mask_lidar"] != 0)
    write_occ3d(tmp_path / "labels.npz", grid, mask_camera=arrays["mask_camera"] != 0)
    again = read_occ3d(tmp_path / "labels.npz", T)
    np.testing.assert_array_equal(again.labels, grid.labels)
    np.testing.assert_array_equal(again.known, grid.known)
    np.testing.assert_array_equal(again.T_world_grid, T)
    assert (again.spec, again.class_names, again.free_label) == (OCC3D_SPEC, OCC3D_CLASSES, 17)
    masks = read_occ3d_masks(tmp_path / "labels.npz")
    np.testing.assert_array_equal(masks.camera, arrays["mask_camera"])
    np.testing.assert_array_equal(masks.lidar, arrays["mask_lidar"])


def test_the_same_grid_gives_the_same_bytes(tmp_path, arrays):
    grid = OccupancyGrid(arrays["semantics"], OCC3D_SPEC)
    write_occ3d(tmp_path / "a.npz", grid)
    write_occ3d(tmp_path / "b.npz", grid)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    masks = read_occ3d_masks(tmp_path / "a.npz")
    assert masks.lidar.all()
    assert masks.camera.all()


def test_labels_of_another_integer_type_are_read(tmp_path, arrays):
    np.savez(tmp_path / "labels.npz", **{key: array.astype(np.int64) for key, array in arrays.items()})
    grid = read_occ3d(tmp_path / "labels.npz")
    assert grid.labels.dtype == np.uint8
    np.testing.assert_array_equal(grid.labels, arrays["semantics"])


@pytest.mark.data
def test_the_real_file_survives_the_round_trip(data, tmp_path):
    source = data / "occ3d" / "labels.npz"
    grid, masks = read_occ3d(source), read_occ3d_masks(source)
    assert not (masks.camera & ~masks.lidar).any()
    write_occ3d(tmp_path / "labels.npz", grid, mask_camera=masks.camera)
    with np.load(source) as old, np.load(tmp_path / "labels.npz") as new:
        assert sorted(old) == sorted(new)
        for key in old:
            np.testing.assert_array_equal(old[key], new[key])
            assert old[key].dtype == new[key].dtype


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(NotFoundError, match=r"Occ3D labels not found: expected .*labels\.npz"):
        read_occ3d(tmp_path / "labels.npz")


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            {"semantics": None},
            DataError,
            "holds no semantics: expected the keys semantics, .*, got mask_lidar, mask_camera",
        ),
        ({"mask_lidar": None}, DataError, "holds no mask_lidar"),
        ({"semantics": np.zeros((16, 200, 200), np.uint8)}, ShapeError, r"semantics of .* \(200, 200, 16\), got \(16"),
        (
            {"semantics": np.full(SHAPE, 18, np.uint8)},
            GridError,
            r"are out of range: expected labels 0\.\.17, got 18\.\.18",
        ),
        ({"semantics": np.full(SHAPE, -1)}, GridError, r"semantics of .*labels\.npz are out of range"),
        ({"semantics": np.zeros(SHAPE)}, GridError, "are not class numbers: expected integers, got float64"),
        ({"mask_lidar": np.full(SHAPE, 2, np.uint8)}, DataError, "mask_lidar of .* is not a mask: expected 0 and 1"),
        ({"mask_lidar": np.zeros((3, 3), np.uint8)}, ShapeError, "mask_lidar of .* has the wrong shape"),
        ({"mask_lidar": np.full(SHAPE, np.nan)}, DataError, "mask_lidar of .* is not a mask"),
        ({"semantics": np.array([{}], dtype=object)}, UnsafeFileError, "holds pickled objects: expected plain arrays"),
    ],
)
def test_wrong_content_is_refused(tmp_path, arrays, change, error, message):
    file = tmp_path / "labels.npz"
    np.savez_compressed(file, **{key: value for key, value in (arrays | change).items() if value is not None})
    with pytest.raises(error, match=message):
        read_occ3d(file)


def test_missing_camera_mask_is_refused_only_where_asked_for(tmp_path, arrays):
    del arrays["mask_camera"]
    np.savez(tmp_path / "labels.npz", **arrays)
    read_occ3d(tmp_path / "labels.npz")
    with pytest.raises(DataError, match="holds no mask_camera"):
        read_occ3d_masks(tmp_path / "labels.npz")


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "text", "npy", "not an array", "folder"])
def test_a_damaged_file_is_refused(tmp_path, arrays, damage):
    file = tmp_path / "labels.npz"
    np.savez_compressed(file, **arrays)
    content = file.read_bytes()
    file.unlink()
    if damage == "cut":
        file.write_bytes(content[: len(content) // 2])
    elif damage == "flip":
        middle = len(content) // 6
        file.write_bytes(content[:middle] + bytes(64) + content[middle + 64 :])
    elif damage == "empty":
        file.touch()
    elif damage == "text":
        file.write_text("no archive")
    elif damage == "npy":
        with file.open("wb") as stream:
            np.save(stream, arrays["semantics"])
    elif damage == "not an array":
        import zipfile

        with zipfile.ZipFile(file, "w") as archive:
            for key in arrays:
                archive.writestr(f"{key}.npy", "words")
    else:
        file.mkdir()
    with pytest.raises(DataError, match=r"labels\.npz (cannot be read: expected an \.npz archive|is damaged)"):
        read_occ3d(file)


@pytest.mark.parametrize("before", [None, b"old"])
def test_other_grids_are_not_written_and_nothing_is_left(tmp_path, before):
    file = tmp_path / "labels.npz"
    if before:
        file.write_bytes(before)
    small = OccupancyGrid(np.zeros((2, 2, 2), np.uint8), GridSpec((0.0, 0.0, 0.0), 0.4, (2, 2, 2)))
    with pytest.raises(GridError, match="grid is not on the lattice of Occ3D: expected GridSpec"):
        write_occ3d(file, small)
    other = OccupancyGrid(np.zeros(SHAPE, np.uint8), OCC3D_SPEC, free_label=1, class_names=("occupied", "free"))
    with pytest.raises(
        GridError, match="grid has other classes than Occ3D: expected 18 classes from 'others' to 'free'"
    ):
        write_occ3d(file, other)
    assert [p.read_bytes() for p in tmp_path.iterdir()] == ([before] if before else [])


@pytest.mark.usefixtures("unchecked")
def test_a_mask_of_another_shape_is_not_written(tmp_path):
    grid = OccupancyGrid(np.zeros(SHAPE, np.uint8), OCC3D_SPEC)
    with pytest.raises(ShapeError, match=r"mask_camera has the wrong shape: expected \(200, 200, 16\), got \(2, 2\)"):
        write_occ3d(tmp_path / "labels.npz", grid, mask_camera=np.zeros((2, 2), bool))
    assert list(tmp_path.iterdir()) == []
