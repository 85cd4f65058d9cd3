"""A hand-made KITTI sequence: calibration, poses in camera axes, sweeps and semantic voxels."""

import numpy as np
import pytest

from openvocab_occ.datasets import load_sequence
from openvocab_occ.errors import ConfigError, DataError, NotFoundError
from openvocab_occ.geometry import GridSpec, transform
from openvocab_occ.io.images import write_image
from openvocab_occ.occupancy.formats import SEMANTICKITTI_CLASSES, SEMANTICKITTI_SPEC

P2 = np.array([[70.0, 0, 60, 70 * 0.06], [0, 70, 20, 0], [0, 0, 1, 0]])  # 6 cm to the left of camera 0
TR = np.array([[0.0, -1, 0, 0.0], [0, 0, -1, -0.08], [1, 0, 0, -0.27]])  # Velodyne to camera 0


def origin_cam0(i):
    """Camera 0 drives along its z axis, and turns right about its y axis."""
    angle = 0.1 * i
    T = np.eye(4)
    T[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    T[:3, 3] = [0.2 * i, 0, 2.0 * i]
    return T


def text(matrix):
    return " ".join(f"{v:.12g}" for v in np.ravel(matrix[:3]))


@pytest.fixture
def drive(tmp_path):
    folder = tmp_path / "sequences" / "08"
    (tmp_path / "poses").mkdir()
    for part in ("image_2", "velodyne", "voxels"):
        (folder / part).mkdir(parents=True)
    (folder / "calib.txt").write_text(f"P0: {text(P2)}\nP2: {text(P2)}\nTr: {text(TR)}\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * i:.3e}\n" for i in range(3)))
    (tmp_path / "poses" / "08.txt").write_text("".join(text(origin_cam0(i)) + "\n" for i in range(3)))
    for i in range(3):
        write_image(folder / "image_2" / f"{i:06d}.png", np.full((40, 120, 3), i, np.uint8))
        np.array([[10.1, 2.1, -1.73, 0.5], [np.inf, 0, 0, 0]], "<f4").tofile(folder / "velodyne" / f"{i:06d}.bin")
    raw = np.zeros(SEMANTICKITTI_SPEC.shape, "<u2")
    raw[50, 138, 1], raw[60, 128, 5], raw[61, 128, 5] = 40, 252, 99
    raw.tofile(folder / "voxels" / "000000.label")
    hidden = np.zeros(SEMANTICKITTI_SPEC.shape, bool)
    hidden[0, 0, 0:3] = True
    np.packbits(hidden).tofile(folder / "voxels" / "000000.invalid")
    return tmp_path


def test_a_known_point_falls_on_its_pixel(drive):
    sequence = load_sequence("kitti", drive, scene="08")
    assert len(sequence) == 3
    for i, frame in enumerate(sequence):
        assert frame.token == f"{i:06d}"
        assert frame.timestamp == pytest.approx(0.1 * i)
        # KITTI's own way: a Velodyne point into camera 0, then by P2 into the image
        velodyne = np.array([10.1, 2.1, -1.73])
        in_cam0 = TR[:, :3] @ velodyne + TR[:, 3]
        u, v, w = P2 @ [*in_cam0, 1]
        world = transform(frame.T_world_ego, frame.points)
        np.testing.assert_allclose(frame.views[0].camera.project(world)[0], [[u / w, v / w]], atol=1e-3)
        np.testing.assert_allclose(transform(frame.poses["lidar"], velodyne[None]), world, atol=1e-4)
    # the world is z up: camera 0 started 1.65 m above its origin, and drove forward along x, turning right
    first, last = sequence[0], sequence[2]
    np.testing.assert_allclose(first.T_world_ego, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(last.T_world_ego[:3, 3], [4.0, -0.4, 0.0], atol=1e-9)
    np.testing.assert_allclose(last.T_world_ego[:3, 0], [np.cos(0.2), -np.sin(0.2), 0], atol=1e-9)
    np.testing.assert_allclose(first.points[0, 2], -1.73 + 0.08 + 1.65, atol=1e-5)  # the road is at the ego's feet


def test_semantic_voxels(drive):
    first, second = load_sequence("kitti", drive)[:2]
    grid = first.occupancy
    assert second.occupancy is None
    assert SEMANTICKITTI_CLASSES[grid.labels[50, 138, 1]] == "road"
    assert SEMANTICKITTI_CLASSES[grid.labels[60, 128, 5]] == "car"  # a moving one
    assert not grid.known[61, 128, 5]  # of no class
    assert not grid.known[0, 0, :3].any()
    assert grid.known[0, 0, 3]
    assert int(grid.occupied.sum()) == 2
    # the sweep's road return lies in the road voxel
    where = grid.spec.index(transform(np.linalg.inv(grid.T_world_grid), transform(first.T_world_ego, first.points)))
    assert where.tolist() == [[50, 138, 1]]


def test_parts_may_be_missing(drive):
    folder = drive / "sequences" / "08"
    for part in ("velodyne", "voxels"):
        for file in (folder / part).iterdir():
            file.unlink()
    frame = load_sequence("kitti", folder)[0]
    assert frame.points is None
    assert frame.occupancy is None
    (drive / "poses" / "08.txt").rename(folder / "poses.txt")  # as SemanticKITTI ships them
    assert len(load_sequence("kitti", folder)) == 3
    with pytest.raises(ConfigError, match="no camera image_3: expected image_2"):
        load_sequence("kitti", folder, cameras=["image_3"])


def test_own_grids_in_the_frame_of_the_velodyne(drive):
    pattern = "pred/{index:06d}.npy"
    (drive / "pred").mkdir()
    np.save(drive / "pred" / "000001.npy", np.ones((4, 4, 4), np.int64))
    spec, classes = GridSpec((0.0, 0.0, 0.0), 0.5, (4, 4, 4)), ("free", "thing")
    sequence = load_sequence(
        "kitti", drive, occupancy=pattern, occupancy_frame="lidar", occupancy_spec=spec, occupancy_classes=classes
    )
    np.testing.assert_allclose(sequence[1].occupancy.T_world_grid, sequence[1].poses["lidar"])
    with pytest.raises(NotFoundError, match=r"000002\.npy"):
        sequence[2]


def test_bad_sequences(drive):
    with pytest.raises(ConfigError, match="has no sequence '09': expected 08"):
        load_sequence("kitti", drive, scene="09")
    folder = drive / "sequences" / "08"
    (drive / "poses" / "08.txt").write_text(text(np.eye(4)) + "\n")
    with pytest.raises(DataError, match="poses of sequence 08 do not reach its last frame: expected 3 rows, got 1"):
        load_sequence("kitti", drive)
    (drive / "poses" / "08.txt").write_text("1 2 three\n")
    with pytest.raises(DataError, match=r"row 0 of 08\.txt holds no numbers"):
        load_sequence("kitti", drive)
    (drive / "poses" / "08.txt").unlink()
    with pytest.raises(NotFoundError, match="KITTI poses"):
        load_sequence("kitti", drive)
    (folder / "calib.txt").unlink()
    with pytest.raises(NotFoundError, match="KITTI calibration"):
        load_sequence("kitti", drive)


@pytest.mark.data
def test_real_poses_drive_forward_on_the_level(data, drive):
    """Sequence 00: the car moves along its own x axis, and climbs little."""
    (drive / "poses" / "08.txt").write_bytes((data / "trajectories" / "kitti_00.txt").read_bytes())
    folder = drive / "sequences" / "08"
    for i in range(0, 4000, 40):
        write_image(folder / "image_2" / f"{i:06d}.png", np.zeros((4, 4, 3), np.uint8))
        np.zeros((1, 4), "<f4").tofile(folder / "velodyne" / f"{i:06d}.bin")
    poses = np.array([frame.T_world_ego for frame in load_sequence("kitti", drive)[3:]])
    assert np.degrees(np.arccos(np.clip(poses[:, 2, 2], -1, 1))).max() < 12
    step = np.diff(poses[:, :3, 3], axis=0)
    forward = (step * poses[:-1, :3, 0]).sum(axis=1) / np.linalg.norm(step, axis=1).clip(1e-3)
    assert np.median(forward) > 0.99
