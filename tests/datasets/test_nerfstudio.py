"""A hand-made transforms.json, with poses as OpenGL and Blender write them."""

import json

import cv2
import numpy as np
import pytest

from openvocab_occ.datasets import load_sequence
from openvocab_occ.errors import DataError, NotFoundError
from openvocab_occ.geometry import transform
from openvocab_occ.io.images import write_image

BASE = {"w": 64, "h": 48, "fl_x": 50.0, "fl_y": 52.0, "cx": 33.0, "cy": 24.5, "camera_model": "OPENCV"}
C2W = np.array([[0.0, 0, 1, 4], [1, 0, 0, -2], [0, 1, 0, 1.5], [0, 0, 0, 1]])
"""Right is world y, up is world z, and the camera looks along world -x: the opposite of its own z."""


@pytest.fixture
def write(tmp_path):
    (tmp_path / "images").mkdir()
    write_image(tmp_path / "images" / "a.png", np.zeros((48, 64, 3), np.uint8))

    def write(frame=(), **changes):
        entry = {"file_path": "images/a.png", "transform_matrix": C2W.tolist(), **dict(frame)}
        content = {**BASE, "frames": [{k: v for k, v in entry.items() if v is not None}], **changes}
        (tmp_path / "transforms.json").write_text(json.dumps({k: v for k, v in content.items() if v is not None}))
        return tmp_path

    return write


def test_a_known_point_falls_on_its_pixel(write):
    frame = load_sequence("nerfstudio", write())[0]
    # 5 m along the view, 1 m to the right, 0.5 m up
    point = np.array([[4 - 5.0, -2 + 1.0, 1.5 + 0.5]])
    pixels, depth = frame.views[0].camera.project(point)
    assert depth[0] == pytest.approx(5.0)
    # there, pixel (0, 0) has its centre at (0.5, 0.5): u = fl_x / 5 + cx - 0.5
    np.testing.assert_allclose(pixels, [[50 / 5 + 33.0 - 0.5, -52 * 0.5 / 5 + 24.5 - 0.5]], atol=1e-9)
    np.testing.assert_allclose(frame.T_world_ego[:3, :3], np.diag([-1, -1, 1]), atol=1e-9)
    np.testing.assert_allclose(transform(frame.T_world_ego, np.array([[5.0, -1.0, 0.5]])), point, atol=1e-9)


def test_distortion_is_that_of_opencv(write):
    k = {"k1": 0.1, "k2": -0.02, "p1": 0.003, "p2": -0.001}
    camera = load_sequence("nerfstudio", write(**k))[0].views[0].camera
    local = np.array([[0.4, -0.3, 1.5]])
    told, _ = cv2.projectPoints(local, np.zeros(3), np.zeros(3), camera.K, np.array([0.1, -0.02, 0.003, -0.001]))
    np.testing.assert_allclose(camera.project(transform(camera.T_world_cam, local))[0], told[0], atol=1e-6)
    fish = {"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k2": 0.01, "k3": 0.0, "k4": 0.0}
    camera = load_sequence("nerfstudio", write(fish))[0].views[0].camera  # a frame may have a lens of its own
    told, _ = cv2.fisheye.projectPoints(
        local[:, None], np.zeros(3), np.zeros(3), camera.K, np.array([0.05, 0.01, 0, 0])
    )
    np.testing.assert_allclose(camera.project(transform(camera.T_world_cam, local))[0], told[0], atol=1e-6)


def test_blender_and_depth(write):
    folder = write({"file_path": "./images/a", "depth_file_path": "images/d.png", "time": 0.25},
                   fl_x=None, fl_y=None, cx=None, cy=None, camera_angle_x=2 * np.arctan(32 / 50))  # fmt: skip
    write_image(folder / "images" / "d.png", np.full((48, 64), 2500, np.uint16))
    frame = load_sequence("nerfstudio", folder)[0]
    np.testing.assert_allclose(frame.views[0].camera.K, [[50, 0, 31.5], [0, 50, 23.5], [0, 0, 1]], atol=1e-9)
    assert (frame.views[0].depth == 2.5).all()
    assert frame.timestamp == 0.25


@pytest.mark.parametrize(
    ("frame", "changes", "message"),
    [
        ({}, {"camera_model": "EQUIRECTANGULAR"}, "camera model of frame 0 .* is not supported.*EQUIRECTANGULAR"),
        ({"transform_matrix": None}, {}, "frame 0 of transforms.json lacks transform_matrix"),
        ({"transform_matrix": (C2W @ np.diag([2, 2, 2, 1])).tolist()}, {}, "not a rotation"),
        ({}, {"w": 640}, "another size than its camera: expected 640 x 48, got 64 x 48"),
        ({}, {"fl_x": None}, "lacks its focal length"),
        ({}, {"fl_x": "wide"}, "camera of frame 0 .* cannot be read"),
    ],
)
def test_bad_frames(write, frame, changes, message):
    sequence = load_sequence("nerfstudio", write(frame, **changes))
    with pytest.raises(DataError, match=message):
        sequence[0]


def test_bad_files(write, tmp_path):
    with pytest.raises(NotFoundError, match=r"gone\.png"):
        load_sequence("nerfstudio", write({"file_path": "gone.png"}))[0]
    assert len(load_sequence("nerfstudio", write(frames=[]))) == 0
    with pytest.raises(DataError, match="JSON with the key frames"):
        load_sequence("nerfstudio", write(frames=None))
    with pytest.raises(NotFoundError, match="capture"):
        load_sequence("nerfstudio", tmp_path / "images")
