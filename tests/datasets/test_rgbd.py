"""Hand-made RGB-D recordings of the three layouts, of one camera whose geometry is known."""

import shutil

import numpy as np
import pytest

from openvocab_occ.datasets import load_sequence
from openvocab_occ.errors import ConfigError, DataError, NotFoundError, PoseError
from openvocab_occ.geometry import look_at, transform, wxyz_from_matrix
from openvocab_occ.io.images import write_image
from openvocab_occ.occupancy.fusion import points_of_depth

FX, CX, CY = 50.0, 31.5, 23.5
SIZE = (64, 48)
POINT = np.array([[3.0, 0.5, 1.0]])


def camera_pose(i):
    return look_at((0.1 * i, -0.05 * i, 1.2), (5.0, 0.0, 1.2))


def depth_image(i, scale, size=SIZE, f=FX, cx=CX, cy=CY):
    """A wall at x = 3 in the world, as z-depth; two pixels that mean there is none."""
    from openvocab_occ.geometry import Camera

    camera = Camera(np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]]), *size, camera_pose(i))
    rays = camera.rays() @ camera.T_world_cam[:3, :3].T
    depth = np.rint((3.0 - camera.position[0]) / rays[..., 0] * scale).astype(np.uint16)
    depth[0, 0], depth[0, 1] = 0, 65535
    return depth


def color(i, size=SIZE):
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return np.stack([u * (256 // size[0]), v * (256 // size[1]), np.full_like(u, i)], axis=-1).astype(np.uint8)


@pytest.fixture
def seven(tmp_path):
    folder = tmp_path / "seq-01"
    folder.mkdir()
    (tmp_path / "camera-intrinsics.txt").write_text(f"{FX} 0 {CX}\n0 {FX} {CY}\n0 0 1\n")
    for i in (1, 0, 2):
        write_image(folder / f"frame-{i:06d}.color.png", color(i))
        write_image(folder / f"frame-{i:06d}.depth.png", depth_image(i, 1000))
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", camera_pose(i))
    return tmp_path


@pytest.fixture
def tum(tmp_path):
    (tmp_path / "rgb").mkdir()
    (tmp_path / "depth").mkdir()
    rgb, depth, truth = ["# color images"], ["# depth"], ["# timestamp tx ty tz qx qy qz qw"]
    for i in (2, 0, 1):  # lists are not in order of time
        write_image(tmp_path / "rgb" / f"{i}.png", color(i))
        write_image(tmp_path / "depth" / f"{i}.png", depth_image(i, 5000))
        rgb.append(f"{10 + i}.000 rgb/{i}.png")
        depth.append(f"{10 + i}.010 depth/{i}.png")
    rgb.append("99.0 rgb/0.png")  # without depth and pose
    for k in range(-1, 6):  # poses of every half second, none of them at the images' times
        T = camera_pose(0.5 * k + 0.25)
        w, x, y, z = wxyz_from_matrix(T[:3, :3])
        truth.append(f"{10.25 + 0.5 * k} {T[0, 3]} {T[1, 3]} {T[2, 3]} {x} {y} {z} {w}")
    for name, lines in (("rgb.txt", rgb), ("depth.txt", depth), ("groundtruth.txt", truth)):
        (tmp_path / name).write_text("\n".join(lines) + "\n")
    return tmp_path


@pytest.fixture
def scannet(tmp_path):
    for name in ("color", "depth", "pose", "intrinsic"):
        (tmp_path / name).mkdir()
    for name, f, cx, cy in (("color", 2 * FX, 2 * CX + 0.5, 2 * CY + 0.5), ("depth", FX, CX, CY)):
        K = np.eye(4)
        K[0, 0] = K[1, 1] = f
        K[:2, 2] = cx, cy
        np.savetxt(tmp_path / "intrinsic" / f"intrinsic_{name}.txt", K)
    for i in (0, 1, 2, 10):
        write_image(tmp_path / "color" / f"{i}.png", color(i, (128, 96)))
        write_image(tmp_path / "depth" / f"{i}.png", depth_image(i, 1000))
        np.savetxt(tmp_path / "pose" / f"{i}.txt", camera_pose(i) if i != 1 else np.full((4, 4), -np.inf))
    return tmp_path


def check(frame, i, tolerance=1e-6):
    """The camera is where it was put, a known point on its pixel, and measured pixels lie on the wall."""
    view = frame.views[0]
    np.testing.assert_allclose(view.camera.T_world_cam, camera_pose(i), atol=tolerance)
    x, y, z = np.linalg.inv(camera_pose(i))[:3] @ [*POINT[0], 1]
    np.testing.assert_allclose(
        view.camera.project(POINT)[0], [[FX * x / z + CX, FX * y / z + CY]], atol=100 * tolerance
    )
    assert view.depth[0, 0] == view.depth[0, 1] == 0
    points = points_of_depth(view.depth, view.camera)
    assert len(points) == view.depth.size - 2
    np.testing.assert_allclose(points[:, 0], 3.0, atol=2e-3)
    # the ego is the camera: x forward, z up
    np.testing.assert_allclose(frame.T_world_ego[:3, 0], camera_pose(i)[:3, 2], atol=tolerance)
    np.testing.assert_allclose(frame.T_world_ego[:3, 2], -camera_pose(i)[:3, 1], atol=tolerance)


def test_seven_scenes(seven):
    sequence = load_sequence("rgbd", seven)
    assert sequence.name == "seq-01"
    assert [frame.token for frame in sequence] == [f"frame-{i:06d}" for i in range(3)]
    for i, frame in enumerate(sequence):
        check(frame, i)
        np.testing.assert_array_equal(frame.views[0].image, color(i))
    assert (
        load_sequence("rgbd", seven, depth_scale=2000)[0].views[0].depth.max() < 0.6 * sequence[0].views[0].depth.max()
    )


def test_tum(tum):
    sequence = load_sequence("rgbd", tum, intrinsics=[FX, FX, CX, CY], tolerance=0.3)
    assert [frame.timestamp for frame in sequence] == [10, 11, 12]  # in order, the one without depth left out
    for i, frame in enumerate(sequence):
        assert frame.views[0].image[0, 0, 2] == i
        check(frame, i, tolerance=2e-3)  # poses are interpolated along a slight bend
    assert len(load_sequence("rgbd", tum, tolerance=0.001)) == 0
    with pytest.raises(ConfigError, match=r"camera is not told.*64 x 48"):
        load_sequence("rgbd", tum, tolerance=0.3)[0]


def test_scannet(scannet):
    sequence = load_sequence("rgbd", scannet)
    assert [frame.token for frame in sequence] == ["0", "2", "10"]  # by number; tracking was lost in 1
    for frame in sequence:
        check(frame, int(frame.token))
        view = frame.views[0]
        assert view.image.shape == (48, 64, 3)  # the colour of twice the size, as the depth camera sees it
        np.testing.assert_allclose(view.image[20, 30, :2], [(2 * 30 + 0.5) * 2, (2 * 20 + 0.5) * 2], atol=1)


def test_up_turns_the_world(seven):
    for axis in ("z", "-z", "y", "-y", "x", "-x"):
        given, turned = (load_sequence("rgbd", seven, up=up)[1] for up in ("z", axis))
        up = np.zeros(3)
        up["xyz".index(axis[-1])] = -1 if axis[0] == "-" else 1
        R = turned.views[0].camera.T_world_cam[:3, :3] @ given.views[0].camera.T_world_cam[:3, :3].T
        np.testing.assert_allclose(R @ up, [0, 0, 1], atol=1e-9)
        np.testing.assert_allclose(
            transform(turned.T_world_ego, POINT), transform(given.T_world_ego, POINT) @ R.T, atol=1e-9
        )
    with pytest.raises(ConfigError, match="up is not an axis"):
        load_sequence("rgbd", seven, up="w")


def test_own_grids_join(seven):
    np.save(seven / "g-1.npy", np.full((200, 200, 16), 17, np.uint8))
    frame = load_sequence("rgbd", seven, occupancy="g-{index}.npy", occupancy_frame="world")[1]
    np.testing.assert_array_equal(frame.occupancy.T_world_grid, np.eye(4))


def test_bad_recordings(seven, tmp_path):
    folder = seven / "seq-01"
    with pytest.raises(ConfigError, match="depth_scale is not usable"):
        load_sequence("rgbd", seven, depth_scale=0)
    (folder / "frame-000000.pose.txt").write_text("1 2 3")
    with pytest.raises(DataError, match=r"frame-000000\.pose\.txt holds no pose.*got 3 numbers"):
        load_sequence("rgbd", seven)[0]
    np.savetxt(folder / "frame-000000.pose.txt", np.full((4, 4), np.nan))
    with pytest.raises(PoseError, match="holds NaN"):
        load_sequence("rgbd", seven)[0]
    image = folder / "frame-000001.depth.png"
    image.write_bytes(image.read_bytes()[:60])
    with pytest.raises(DataError, match=r"000001\.depth\.png is truncated"):
        load_sequence("rgbd", seven)[1]
    (folder / "frame-000002.color.png").unlink()
    with pytest.raises(NotFoundError, match=r"frame-000002\.color\.png"):
        load_sequence("rgbd", seven)[2]
    shutil.copytree(folder, seven / "seq-02")
    with pytest.raises(ConfigError, match="several recordings: expected scene=, got seq-01, seq-02"):
        load_sequence("rgbd", seven)
    (tmp_path / "empty").mkdir()
    with pytest.raises(NotFoundError, match="no RGB-D recording"):
        load_sequence("rgbd", tmp_path / "empty")


def test_ten_thousand_frames_open_without_reading_any(tmp_path):
    for i in range(10_000):
        (tmp_path / f"frame-{i:06d}.depth.png").touch()
    sequence = load_sequence("rgbd", tmp_path)
    assert len(sequence[9_000:]) == 1_000
    with pytest.raises(NotFoundError):
        sequence[9_999]


@pytest.mark.data
def test_real_frames(data):
    frames = list(load_sequence("rgbd", data / "rgbd_3dmatch"))
    assert [frame.token for frame in frames][-1] == "frame-000422"
    assert frames[0].views[0].camera.K[0, 0] == pytest.approx(570.342205)
    assert 1 < np.median(frames[0].views[0].depth) < 5
