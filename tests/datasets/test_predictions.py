"""A user's own occupancy files, joined to any drive."""

import io

import numpy as np
import pytest

from openvocab_occ.datasets import Frame, FrameSequence, load_sequence
from openvocab_occ.datasets.predictions import GridFormat, join_occupancy
from openvocab_occ.errors import ConfigError, DataError, GridError, NotFoundError, ShapeError, UnsafeFileError
from openvocab_occ.geometry import GridSpec, pose
from openvocab_occ.occupancy import OCC3D_SPEC, OccupancyGrid

SPEC = GridSpec((0.0, 0.0, 0.0), 1.0, (4, 3, 2))
SMALL = GridFormat(spec=SPEC, class_names=("car", "road", "free"))


def drive(length=2):
    def read(index):
        T = pose((index, 0, 0))
        return Frame(index, index / 2, T, token=f"t{index}", poses={"lidar": T @ pose((0, 0, 2))})

    return FrameSequence("drive", range(length), read)


@pytest.fixture
def labels(rng):
    return rng.integers(0, 3, SPEC.shape).astype(np.uint8)


@pytest.fixture
def logits(rng):
    return rng.standard_normal((*SPEC.shape, 3)).astype(np.float32)


@pytest.mark.parametrize("key", ["semantics", "pred", "arr_0"])
@pytest.mark.parametrize("dtype", ["u1", "i8", ">i4"])
def test_labels_by_every_key(tmp_path, labels, key, dtype):
    np.savez_compressed(tmp_path / "t1.npz", **{key: labels.astype(dtype)})
    frame = join_occupancy(drive(), "{token}.npz", root=tmp_path, grid=SMALL)[1]
    np.testing.assert_array_equal(frame.occupancy.labels, labels)
    assert frame.occupancy.free_label == 2
    np.testing.assert_array_equal(frame.occupancy.T_world_grid, frame.T_world_ego)
    assert frame.occupancy.known is None


@pytest.mark.parametrize("key", ["logits", "scores", "pred", "arr_0", None])
def test_logits_by_every_key(tmp_path, logits, key):
    if key is None:
        np.save(tmp_path / "x", logits)
    else:
        np.savez(tmp_path / "x.npz", **{key: logits})
    frame = join_occupancy(drive(1), f"x.np{'y' if key is None else 'z'}", root=tmp_path, grid=SMALL)[0]
    np.testing.assert_array_equal(frame.occupancy.logits, logits)
    np.testing.assert_array_equal(frame.occupancy.labels, logits.argmax(-1))


def test_mask_lidar_is_what_is_known(tmp_path, labels, rng):
    known = rng.integers(0, 2, SPEC.shape).astype(np.uint8)
    np.savez(tmp_path / "x.npz", semantics=labels, mask_lidar=known, mask_camera=1 - known)
    frame = join_occupancy(drive(1), "x.npz", root=tmp_path, grid=SMALL)[0]
    np.testing.assert_array_equal(frame.occupancy.known, known == 1)


@pytest.mark.data
def test_real_occ3d_file(data):
    sequence = load_sequence("nuscenes-infos", data / "nuscenes_keyframe", occupancy="../occ3d/labels.npz")
    grid = sequence[0].occupancy
    told = np.load(data / "occ3d" / "labels.npz")
    np.testing.assert_array_equal(grid.labels, told["semantics"])
    np.testing.assert_array_equal(grid.known, told["mask_lidar"] == 1)
    assert grid.spec == OCC3D_SPEC
    assert load_sequence("nuscenes-infos", data / "nuscenes_keyframe")[0].occupancy is None


@pytest.mark.data
def test_frames_of_the_grid(data):
    name = "../occ3d/labels.npz"
    for kind in ("lidar_ego", "lidar", "cam_front_left_ego"):
        frame = load_sequence("nuscenes-infos", data / "nuscenes_keyframe", occupancy=name, occupancy_frame=kind)[0]
        np.testing.assert_array_equal(frame.occupancy.T_world_grid, frame.poses[kind])


def test_pattern_and_folder(tmp_path, labels):
    (tmp_path / "drive").mkdir()
    np.save(tmp_path / "drive" / "000001_0.50", labels)
    pattern = "{scene}/{index:06d}_{timestamp:.2f}.npy"
    assert join_occupancy(drive(), pattern, root=tmp_path, grid=SMALL)[1].occupancy is not None
    absolute = str(tmp_path / "drive" / "000001_0.50.npy")
    assert join_occupancy(drive(), absolute + "{token:.0}", root="/", grid=SMALL)[1].occupancy is not None


def test_callable_gives_grid_array_path_or_nothing(tmp_path, labels):
    np.save(tmp_path / "a.npy", labels)
    grid = OccupancyGrid(labels, SPEC, free_label=2, class_names=SMALL.class_names)
    answers = [grid, labels, tmp_path / "a.npy", "a.npy", None]
    frames = list(join_occupancy(drive(5), lambda frame: answers[frame.index], root=tmp_path, grid=SMALL))
    assert frames[0].occupancy is grid
    assert frames[4].occupancy is None
    for frame in frames[1:4]:
        np.testing.assert_array_equal(frame.occupancy.labels, labels)


def test_slices_keep_the_join(tmp_path, labels):
    sequence = join_occupancy(drive(5), lambda frame: labels, grid=SMALL)
    assert [frame.index for frame in sequence[1:4:2]] == [1, 3]
    assert sequence[3:][0].occupancy is not None


@pytest.mark.parametrize(
    ("arrays", "error", "message"),
    [
        ({"labels": np.zeros(SPEC.shape, np.uint8)}, DataError, r"no array of labels or.*semantics.*labels uint8"),
        ({"a": np.zeros((4, 3, 2, 3), "f4"), "b": np.zeros((4, 3, 2, 3), "f4")}, DataError, "no array of labels"),
        ({"semantics": np.zeros((2, 3, 4), np.uint8)}, ShapeError, r"integers \(4, 3, 2\).*\(2, 3, 4\).*transposed"),
        ({"semantics": np.zeros((1, 4, 3, 2), np.uint8)}, ShapeError, r"array\.squeeze"),
        ({"logits": np.zeros((3, 4, 3, 2), "f4")}, ShapeError, "classes come last"),
        ({"logits": np.zeros((4, 3, 2, 18), "f4")}, ShapeError, "occupancy_classes"),
        ({"pred": np.zeros(SPEC.shape, "f4")}, ShapeError, "class numbers as uint8"),
        ({"pred": np.full(SPEC.shape, 3)}, GridError, r"t0\.npz has labels out of range.*0\.\.2.*3\.\.3"),
        ({"pred": np.full(SPEC.shape, -1)}, GridError, "out of range"),
        ({"pred": np.full(SPEC.shape, 257)}, GridError, "out of range"),
        ({"logits": np.full((*SPEC.shape, 3), np.nan, "f4")}, DataError, r"logits of t0\.npz is not finite"),
        ({"pred": np.zeros(SPEC.shape, int), "mask_lidar": np.zeros(3)}, ShapeError, r"mask_lidar of t0\.npz has"),
        ({"semantics": np.array([{}], dtype=object)}, UnsafeFileError, "holds pickled objects"),
    ],
)  # fmt: skip
def test_bad_content(tmp_path, arrays, error, message):
    np.savez(tmp_path / "t0.npz", **arrays)
    with pytest.raises(error, match=message):
        join_occupancy(drive(), "{token}.npz", root=tmp_path, grid=SMALL)[0]


def test_occ3d_transposed():
    with pytest.raises(ShapeError, match=r"\(16, 200, 200\); the array is likely transposed"):
        join_occupancy(drive(), lambda frame: np.zeros((16, 200, 200), np.uint8))[0]


def test_damaged_and_missing_files(tmp_path, labels):
    buffer = io.BytesIO()
    np.savez(buffer, semantics=labels)
    for name, content in (("a", b""), ("b", b"text"), ("c", buffer.getvalue()[:100])):
        (tmp_path / f"{name}.npz").write_bytes(content)
        with pytest.raises(DataError, match=rf"{name}\.npz (cannot be read|holds pickled objects)"):
            join_occupancy(drive(1), f"{name}.npz", root=tmp_path, grid=SMALL)[0]
    with pytest.raises(NotFoundError, match=r"occupancy of frame 1 file not found.*t1\.npz"):
        join_occupancy(drive(), "{token}.npz", root=tmp_path)[1]


def test_bad_options():
    with pytest.raises(ConfigError, match=r"unknown placeholder: expected \{token\} .*got \{name\}"):
        join_occupancy(drive(), "{name}.npz")
    with pytest.raises(ConfigError, match="unknown placeholder"):
        join_occupancy(drive(), "{token.__class__}.npz")
    with pytest.raises(ConfigError, match="cannot be read"):
        join_occupancy(drive(), "{token.npz")
    with pytest.raises(ConfigError, match="names one file for 2 frames"):
        join_occupancy(drive(), "a.npz")
    with pytest.raises(ConfigError, match=r"occupancy_frame is not known: expected lidar_ego or .*got 'ego'"):
        load_sequence("street", occupancy="{token}.npz", occupancy_frame="ego")
    with pytest.raises(
        ConfigError, match="has no pose of the grid frame 'cam_front_left_ego': expected lidar_ego or world or lidar"
    ):
        join_occupancy(drive(), lambda f: np.zeros(1), grid=GridFormat(frame="cam_front_left_ego"))[0]
    with pytest.raises(ConfigError, match="which class is free"):
        load_sequence("street", occupancy_classes=("a", "b"))
