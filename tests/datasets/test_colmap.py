"""Hand-made COLMAP models, text and binary, of every camera model that the reader knows."""

import struct

import cv2
import numpy as np
import pytest

from openvocab_occ.datasets import load_sequence
from openvocab_occ.errors import ConfigError, DataError, NotFoundError
from openvocab_occ.geometry import look_at, transform, wxyz_from_matrix
from openvocab_occ.io.images import write_image

MODELS = {  # id, parameters, and what OpenCV calls them: fx, fy, cx, cy, coefficients, fisheye
    "SIMPLE_PINHOLE": (0, [50, 32, 24], (50, 50, 32, 24, [], False)),
    "PINHOLE": (1, [50, 52, 32, 24], (50, 52, 32, 24, [], False)),
    "SIMPLE_RADIAL": (2, [50, 32, 24, 0.1], (50, 50, 32, 24, [0.1, 0, 0, 0], False)),
    "RADIAL": (3, [50, 32, 24, 0.1, 0.01], (50, 50, 32, 24, [0.1, 0.01, 0, 0], False)),
    "OPENCV": (4, [50, 52, 32, 24, 0.1, 0.01, 0.002, -0.003], (50, 52, 32, 24, [0.1, 0.01, 0.002, -0.003], False)),
    "OPENCV_FISHEYE": (5, [50, 52, 32, 24, 0.1, 0.01, 0, 0], (50, 52, 32, 24, [0.1, 0.01, 0, 0], True)),
    "FULL_OPENCV": (6, [50, 52, 32, 24, 0.1, 0.01, 0.002, -0.003, 0.001, 0.02, 0.0, 0.0],
                    (50, 52, 32, 24, [0.1, 0.01, 0.002, -0.003, 0.001, 0.02, 0, 0], False)),
    "SIMPLE_RADIAL_FISHEYE": (8, [50, 32, 24, 0.1], (50, 50, 32, 24, [0.1, 0, 0, 0], True)),
    "RADIAL_FISHEYE": (9, [50, 32, 24, 0.1, 0.01], (50, 50, 32, 24, [0.1, 0.01, 0, 0], True)),
}  # fmt: skip
T_WORLD_CAM = {"b.png": look_at((0, 0, 1), (5, 1, 1)), "a.png": look_at((1, 0, 1), (5, 2, 1))}
LOCAL = np.array([[0.4, -0.3, 1.5]])


def write_model(root, model, binary, folder="sparse/0"):
    number, values, _ = MODELS.get(model, (10, [50.0] * 12, None))
    (root / folder).mkdir(parents=True)
    (root / "images").mkdir()
    poses = []
    for i, (name, T) in enumerate(T_WORLD_CAM.items(), start=1):
        write_image(root / "images" / name, np.full((48, 64, 3), 9 * i, np.uint8))
        T_cam_world = np.linalg.inv(T)
        poses.append((i, wxyz_from_matrix(T_cam_world[:3, :3]), T_cam_world[:3, 3], 7, name))
    if binary:
        cameras = struct.pack("<QiiQQ", 1, 7, number, 64, 48) + struct.pack(f"<{len(values)}d", *values)
        images = struct.pack("<Q", len(poses))
        for i, q, t, camera, name in poses:
            points = struct.pack("<Qddqddq", 2, 1, 2, 5, 3, 4, -1)
            images += struct.pack("<i7di", i, *q, *t, camera) + name.encode() + b"\0" + points
        (root / folder / "cameras.bin").write_bytes(cameras)
        (root / folder / "images.bin").write_bytes(images)
    else:
        line = " ".join(map(str, values))
        (root / folder / "cameras.txt").write_text(f"# Camera list\n#\n7 {model} 64 48 {line}\n")
        lines = ["# Image list", "#"]
        for k, (i, q, t, camera, name) in enumerate(poses):
            lines.append(f"{i} {' '.join(map(str, q))} {' '.join(map(str, t))} {camera} {name}")
            lines.append("1 2 5 3 4 -1" if k else "")  # an image without points has an empty line
        (root / folder / "images.txt").write_text("\n".join(lines) + "\n")
    return root


@pytest.mark.parametrize("binary", [True, False], ids=["bin", "txt"])
@pytest.mark.parametrize("model", MODELS)
def test_a_known_point_falls_on_its_pixel(tmp_path, model, binary):
    sequence = load_sequence("colmap", write_model(tmp_path, model, binary))
    assert [frame.token for frame in sequence] == ["a", "b"]  # in order of names
    fx, fy, cx, cy, coefficients, fisheye = MODELS[model][2]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    told, _ = project(LOCAL[:, None], np.zeros(3), np.zeros(3), K, np.array(coefficients, float))
    for frame, name in zip(sequence, ("a.png", "b.png"), strict=True):
        np.testing.assert_allclose(frame.views[0].camera.T_world_cam, T_WORLD_CAM[name], atol=1e-9)
        pixels, _ = frame.views[0].camera.project(transform(T_WORLD_CAM[name], LOCAL))
        np.testing.assert_allclose(pixels, told.reshape(1, 2) - 0.5, atol=1e-6)  # COLMAP counts from the corner
        assert frame.views[0].image.max() == (18 if name == "a.png" else 9)


def test_smaller_copies_scale_and_up(tmp_path):
    root = write_model(tmp_path, "PINHOLE", binary=True)
    for file in (root / "images").iterdir():
        write_image(file, np.zeros((24, 32, 3), np.uint8))
    frame = load_sequence("colmap", root, scale=2, up="y")[0]
    assert frame.views[0].camera.K[0, 0] == 25
    assert frame.views[0].camera.K[0, 2] == pytest.approx((31.5 + 0.5) / 2 - 0.5)
    np.testing.assert_allclose(frame.views[0].camera.position, [2, -2, 0], atol=1e-9)
    write_image(root / "images" / "a.png", np.zeros((24, 48, 3), np.uint8))
    with pytest.raises(DataError, match=r"a\.png does not fit its camera"):
        load_sequence("colmap", root)[0]


def test_bad_models(tmp_path):
    with pytest.raises(DataError, match=r"THIN_PRISM_FISHEYE.*image_undistorter"):
        load_sequence("colmap", write_model(tmp_path / "thin", "THIN_PRISM_FISHEYE", binary=False))
    root = write_model(tmp_path / "cut", "PINHOLE", binary=True)
    images = root / "sparse/0/images.bin"
    whole = images.read_bytes()
    for length in (4, 60, 90, len(whole) - 5):
        images.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"damaged|cut off"):
            load_sequence("colmap", root)
    images.write_bytes(whole)
    (root / "images" / "a.png").unlink()
    sequence = load_sequence("colmap", root)
    with pytest.raises(NotFoundError, match=r"a\.png"):
        sequence[0]
    assert sequence[1].token == "b"
    (root / "sparse/0/cameras.bin").unlink()
    with pytest.raises(NotFoundError, match="no COLMAP model"):
        load_sequence("colmap", root)
    with pytest.raises(ConfigError, match="scale is not usable"):
        load_sequence("colmap", root, scale=-1)
