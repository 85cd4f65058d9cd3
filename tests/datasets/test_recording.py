"""Our own folder: what is written comes back, and what is wrong is named."""

import json
import shutil

import numpy as np
import pytest

from openvocab_occ.datasets import load_sequence, write_recording
from openvocab_occ.datasets.frame import Frame, FrameSequence, View
from openvocab_occ.errors import AlreadyExistsError, ConfigError, DataError, NotFoundError, ShapeError, UnsafeFileError
from openvocab_occ.geometry import Camera, GridSpec, look_at, pose
from openvocab_occ.occupancy import OccupancyGrid

SPEC = GridSpec((-2.0, -2.0, 0.0), 0.5, (8, 8, 4))
CLASSES = ("car", "road", "free")


def frame(i, rng):
    T = pose((float(i), 2.0, 0.0), (0.9, 0.1, 0, 0.2))
    camera = Camera(np.array([[30.0, 0, 15.5], [0, 30, 11.5], [0, 0, 1]]), 32, 24, look_at((i, 0, 1), (i + 1, 0, 1)),
                    (0.1, 0.01, 0.0, 0.0) if i else ())  # fmt: skip
    depth = np.round(rng.uniform(0.5, 60, (24, 32)), 3).astype(np.float32)
    depth[0, 0], depth[0, 1] = 0, 70.0
    view = View(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8), camera, depth, f"CAM/{i}")
    logits = rng.normal(size=(*SPEC.shape, 3)).astype(np.float32)
    known = rng.random(SPEC.shape) < 0.5
    grid = OccupancyGrid.from_logits(logits, SPEC, pose((1, 2, 3)), free_label=2, known=known, class_names=CLASSES)
    if i:
        grid = OccupancyGrid(grid.labels, SPEC, T, 2, known=None, class_names=CLASSES)
    points = rng.normal(size=(20, 3)).astype(np.float32)
    return Frame(i, 5.0 + i, T, (view,), grid, points, f"tok{i}", {"lidar_ego": T, "lidar": pose((0, 0, 1.8))})


@pytest.fixture
def frames(rng):
    return [frame(i, rng) for i in range(3)]


def test_what_is_written_comes_back(frames, tmp_path):
    source = FrameSequence("drive", range(3), frames.__getitem__, synthetic=True)
    write_recording(tmp_path / "r", source, image_ending=".png")
    back = load_sequence("recording", tmp_path / "r")
    assert (back.name, back.synthetic, len(back)) == ("drive", True, 3)
    for old, new in zip(frames, back, strict=True):
        assert (new.timestamp, new.token) == (old.timestamp, old.token)
        np.testing.assert_allclose(new.T_world_ego, old.T_world_ego, atol=1e-12)
        np.testing.assert_array_equal(new.points, old.points)
        np.testing.assert_allclose(new.poses["lidar"], old.poses["lidar"])
        a, b = old.views[0], new.views[0]
        np.testing.assert_array_equal(a.image, b.image)
        assert (a.camera.distortion, a.camera.lens, a.name) == (b.camera.distortion, b.camera.lens, b.name)
        np.testing.assert_allclose(b.camera.T_world_cam, a.camera.T_world_cam, atol=1e-12)
        beyond = a.depth > 65.535
        np.testing.assert_allclose(b.depth[~beyond], a.depth[~beyond], atol=1e-3)
        assert (b.depth[beyond] == 0).all()
        for key in ("labels", "known", "logits", "T_world_grid"):
            x, y = getattr(old.occupancy, key), getattr(new.occupancy, key)
            assert (x is None) == (y is None)
            if x is not None:
                np.testing.assert_allclose(y, x, atol=1e-12)
        assert (new.occupancy.spec, new.occupancy.class_names, new.occupancy.free_label) == (SPEC, CLASSES, 2)
    write_recording(tmp_path / "again", back, image_ending=".png")
    assert (tmp_path / "again" / "frames.jsonl").read_text() == (tmp_path / "r" / "frames.jsonl").read_text()


def test_a_failure_leaves_nothing(frames, tmp_path):
    def broken():
        yield frames[0]
        raise DataError("the source broke off")

    with pytest.raises(DataError, match="broke off"):
        write_recording(tmp_path / "r", broken())
    assert not list(tmp_path.iterdir())
    (tmp_path / "photos").mkdir()
    with pytest.raises(AlreadyExistsError):
        write_recording(tmp_path / "photos", frames)
    with pytest.raises(ConfigError, match=r"expected \.jpg or \.png"):
        write_recording(tmp_path / "r", frames, image_ending=".bmp")


@pytest.fixture
def folder(frames, tmp_path):
    write_recording(tmp_path / "r", frames[:1], image_ending=".png")
    (tmp_path / "r" / "recording.json").unlink()
    return tmp_path / "r"


def edit(folder, **changes):
    entry = json.loads((folder / "frames.jsonl").read_text().splitlines()[0])
    entry = {k: v for k, v in {**entry, **changes}.items() if v is not None}
    (folder / "frames.jsonl").write_text(json.dumps(entry) + "\n")
    return load_sequence("recording", folder)


def test_a_folder_made_by_hand(folder):
    """As docs/recording.md shows it: cameras in the header, extrinsics to the ego, no grid."""
    mount = [[0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1]]
    header = {"cameras": {"front": {"K": [[30, 0, 15.5], [0, 30, 11.5], [0, 0, 1]], "T_ego_cam": mount}}}
    (folder / "recording.json").write_text(json.dumps(header))
    lines = [{"timestamp": t, "T_world_ego": pose((t, 0, 0)).tolist(),
              "views": [{"name": "front", "image": "images/CAM_0/000000.png"}]} for t in (3, 1, 2)]  # fmt: skip
    (folder / "frames.jsonl").write_text("\n\n".join(json.dumps(line) for line in lines))
    sequence = load_sequence("recording", folder)
    assert [f.timestamp for f in sequence] == [1, 2, 3]  # in order of time
    # a point 3 m before the camera of the second frame, 1 m to its left: ego (1.5 + 3, 1, 1.6)
    pixels, depth = sequence[1].views[0].camera.project(np.array([[2 + 4.5, 1.0, 1.6]]))
    np.testing.assert_allclose(pixels, [[15.5 - 10, 11.5]], atol=1e-9)
    assert depth[0] == pytest.approx(3)


def test_own_predictions_join(folder):
    np.savez(folder / "tok0.npz", semantics=np.full((200, 200, 16), 17, np.uint8))
    edit(folder, occupancy=None)
    (frame,) = load_sequence("recording", folder, occupancy="{token}.npz", occupancy_frame="lidar")
    np.testing.assert_array_equal(frame.occupancy.T_world_grid, frame.poses["lidar"])


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"T_world_ego": None}, DataError, "lacks T_world_ego"),
        ({"T_world_ego": [[1, 2], [3]]}, ShapeError, "T_world_ego of frame 0 .* is no matrix"),
        ({"points": "../../etc/passwd"}, UnsafeFileError, "outside its folder"),
        ({"points": "gone.npy"}, NotFoundError, r"gone\.npy"),
        ({"points": "occupancy/000000.npz"}, ShapeError, "points of frame 0 .* several arrays"),
        ({"views": [{"name": "x"}]}, DataError, "view x of frame 0 .* is incomplete"),
        ({"grid": {"origin": [0, 0, 0]}}, DataError, "grid of frame 0 .* is not told"),
        ({}, ShapeError, "neither labels nor logits"),  # without a header, grids are Occ3D's
    ],
)
def test_bad_frames(folder, changes, error, message):
    with pytest.raises(error, match=message):
        edit(folder, **changes)[0]


def test_bad_files(folder, tmp_path):
    (folder / "recording.json").write_text(json.dumps({"format": "openvocab_occ recording", "version": 9}))
    with pytest.raises(DataError, match="from the future"):
        load_sequence("recording", folder)
    (folder / "recording.json").unlink()
    (folder / "frames.jsonl").write_text('{"timestamp": 1}\n{"time": 2}\n')
    with pytest.raises(DataError, match=r"line 2 of frames\.jsonl cannot be read"):
        load_sequence("recording", folder)
    (folder / "frames.jsonl").write_text("")
    assert len(load_sequence("recording", folder)) == 0
    shutil.rmtree(folder)
    with pytest.raises(NotFoundError, match="recording not found"):
        load_sequence("recording", folder)


def test_ten_thousand_frames_open_without_reading_any(tmp_path):
    line = {"T_world_ego": np.eye(4).tolist(), "views": [{"image": "gone.jpg", "K": np.eye(3).tolist()}]}
    text = "\n".join(json.dumps({"timestamp": -i, **line}) for i in range(10_000))
    (tmp_path / "frames.jsonl").write_text(text)
    sequence = load_sequence("recording", tmp_path)
    assert len(sequence) == 10_000
    assert sequence.files(5)[0].name == "gone.jpg"
    with pytest.raises(NotFoundError, match=r"gone\.jpg"):
        sequence[9_999]
