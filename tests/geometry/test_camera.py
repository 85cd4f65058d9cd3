"""Laws of cameras: pixels and rays are inverses, and OpenCV agrees."""

import cv2
import numpy as np
import pytest

from openvocab_occ.errors import CameraError, PoseError
from openvocab_occ.geometry import Camera, look_at, pose, transform

K = np.array([[400.0, 0, 310.3], [0, 390.0, 241.7], [0, 0, 1]])
LENSES = {
    "pinhole": ((), "pinhole"),
    "brown4": ((-0.28, 0.07, 1e-3, -5e-4), "brown"),
    "brown5": ((-0.3, 0.1, 1e-3, -5e-4, -0.01), "brown"),
    "brown8": ((0.3, 0.05, 1e-3, 2e-4, 0.01, 0.2, 0.02, 0.003), "brown"),
    "fisheye": ((0.03, -0.01, 0.004, -0.002), "fisheye"),
}


@pytest.fixture(params=LENSES)
def camera(request) -> Camera:
    distortion, lens = LENSES[request.param]
    return Camera(K, 640, 480, look_at([3, 4, 2], [10, -3, 1]), distortion, lens)


def test_points_on_rays_project_back_onto_their_pixels(camera, rng):
    pixels = rng.uniform([0, 0], [639, 479], (500, 2))
    depths = rng.uniform(0.1, 90, 500)
    rays = camera.unproject(pixels)
    assert np.isfinite(rays).all()
    np.testing.assert_array_equal(rays[:, 2], 1)
    again, depth = camera.project(transform(camera.T_world_cam, rays * depths[:, None]))
    np.testing.assert_allclose(again, pixels, atol=1e-5)
    np.testing.assert_allclose(depth, depths, rtol=1e-10)


def test_rays_are_those_of_integer_pixels(camera):
    rays = camera.rays()
    assert rays.shape == (480, 640, 3)
    np.testing.assert_allclose(rays[17, 33], camera.unproject(np.array([33.0, 17.0])), atol=1e-12)


def test_projection_agrees_with_opencv(camera, rng):
    local = rng.uniform([-3, -2, 4], [3, 2, 20], (200, 3))
    project = cv2.fisheye.projectPoints if camera.lens == "fisheye" else cv2.projectPoints
    wanted = project(local[:, None], np.zeros(3), np.zeros(3), K, np.array(camera.distortion or [0.0] * 4))[0]
    got, depth = camera.project(transform(camera.T_world_cam, local))
    np.testing.assert_allclose(got, wanted.reshape(-1, 2), atol=1e-8)
    np.testing.assert_allclose(depth, local[:, 2], atol=1e-10)


def test_points_behind_or_beside_have_no_pixel(camera):
    local = np.array([[0.0, 0, -5], [1, 1, -0.01], [0, 0, 5]])
    pixels, depth = camera.project(transform(camera.T_world_cam, local))
    assert np.isnan(pixels[:2]).all()
    np.testing.assert_allclose(pixels[2], K[:2, 2], atol=1e-8)
    np.testing.assert_allclose(depth, [-5, -0.01, 5], atol=1e-12)


def test_no_pixels_and_no_points_give_none(camera):
    assert camera.unproject(np.empty((0, 2))).shape == (0, 3)
    pixels, depth = camera.project(np.empty((0, 3)))
    assert pixels.shape == (0, 2)
    assert depth.shape == (0,)


def test_a_lens_does_not_fold_far_points_back_into_the_image():
    camera = Camera(K, 640, 480, distortion=(-0.3, 0.0, 0.0, 0.0))
    reach = 1 / np.sqrt(0.9)  # where r - 0.3 r^3 turns back
    inner, beyond = np.array([[0.7, 0, 1]]), np.array([[1.5, 0, 1.0]])
    folded = cv2.projectPoints(beyond[:, None], np.zeros(3), np.zeros(3), K, np.array([-0.3, 0, 0, 0]))[0]
    assert camera.inside(folded).all()  # the polynomial alone would see it
    assert np.isnan(camera.project(beyond)[0]).all()
    assert np.isfinite(camera.project(inner)[0]).all()
    assert np.isfinite(camera.project(np.array([[reach - 1e-6, 0, 1]]))[0]).all()
    assert np.isnan(camera.project(np.array([[0, reach + 1e-6, 1]]))[0]).all()


def test_pixels_beyond_the_lens_have_no_ray():
    strong = Camera(K, 640, 480, distortion=(-0.3, 0.0, 0.0, 0.0))
    edge = K[0, 2] + K[0, 0] * (2 / 3) / np.sqrt(0.9)  # r - 0.3 r^3 at its top
    rays = strong.unproject(np.array([[edge - 2, K[1, 2]], [edge + 2, K[1, 2]]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()
    fisheye = Camera(
        np.array([[200.0, 0, 320], [0, 200, 240], [0, 0, 1]]), 640, 480, distortion=(0.0,) * 4, lens="fisheye"
    )
    rays = fisheye.rays()
    v, u = np.mgrid[:480, :640]
    angle = np.hypot(u - 320, v - 240) / 200  # an ideal fisheye: pixels are angles
    assert np.isfinite(rays[angle < 1.5]).all()
    assert np.isnan(rays[angle > np.pi / 2 + 0.01]).all()
    np.testing.assert_allclose(
        np.arctan(np.hypot(rays[..., 0], rays[..., 1]))[angle < 1.5], angle[angle < 1.5], atol=1e-4
    )


@pytest.mark.parametrize("size", [(320, 240), (1280, 960), (160, 480), (641, 479)])
def test_resizing_keeps_where_a_point_lies_on_the_image(camera, size, rng):
    local = rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (100, 3))
    points = transform(camera.T_world_cam, local)
    small = camera.resized(*size)
    before = (camera.project(points)[0] + 0.5) / [camera.width, camera.height]
    after = (small.project(points)[0] + 0.5) / [small.width, small.height]
    np.testing.assert_allclose(after, before, atol=1e-9)
    np.testing.assert_allclose(small.resized(640, 480).K, camera.K, atol=1e-9)


def test_resizing_moves_the_centre_by_the_half_pixel_law(camera):
    half = camera.resized(320, 240)
    np.testing.assert_allclose(half.K[:2, 2], (K[:2, 2] + 0.5) / 2 - 0.5)


def test_cropping_shifts_pixels(camera, rng):
    points = transform(camera.T_world_cam, rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (50, 3)))
    window = camera.cropped(100, 60, 200, 150)
    assert (window.width, window.height) == (200, 150)
    np.testing.assert_allclose(window.project(points)[0], camera.project(points)[0] - [100, 60], atol=1e-8)


def test_inside_is_half_a_pixel_around_the_centres():
    camera = Camera(K, 640, 480)
    pixels = np.array([[-0.5, 0], [-0.51, 0], [639.49, 479.49], [639.5, 0], [0, 479.5], [np.nan, 3]])
    assert camera.inside(pixels).tolist() == [True, False, True, False, False, False]


def test_a_camera_moved_sees_the_moved_world(camera, rng):
    points = transform(camera.T_world_cam, rng.uniform([-2, -1.5, 4], [2, 1.5, 9], (50, 3)))
    T = pose([5, 6, 7], [0.3, 0.4, -0.5, 0.6])
    moved = camera.at(T @ camera.T_world_cam)
    np.testing.assert_allclose(moved.project(transform(T, points))[0], camera.project(points)[0], atol=1e-7)
    np.testing.assert_allclose(moved.position, transform(T, camera.position[None])[0], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"K": np.diag([0.0, 1, 1])}, CameraError, "camera matrix K cannot be inverted to rays: expected .*fx, fy > 0"),
        ({"K": K.T}, CameraError, "camera matrix K cannot be inverted to rays"),
        ({"K": K * np.nan}, CameraError, "camera matrix K is not finite"),
        ({"K": np.eye(2)}, CameraError, r"camera matrix K has the wrong shape: expected \(3, 3\), got \(2, 2\)"),
        ({"width": 0}, CameraError, r"image has no pixels: expected width and height of at least 1, got \(0, 480\)"),
        ({"T_world_cam": np.full((4, 4), np.nan)}, PoseError, "T_world_cam holds NaN or infinity"),
        ({"lens": "mirror"}, CameraError, "lens model is not known: expected pinhole or brown or fisheye, got mirror"),
        ({"distortion": (0.1, 0.2)}, CameraError, "distortion does not fit the brown lens: expected 4 or 5 or 8"),
        ({"distortion": (0.1,) * 5, "lens": "fisheye"}, CameraError, "distortion does not fit the fisheye lens"),
        ({"distortion": (np.nan,) * 4}, CameraError, "distortion does not fit the brown lens"),
        ({"K": K + np.array([[0, 2.0, 0], [0] * 3, [0] * 3]), "distortion": (0.1,) * 4},
         CameraError, "skew and distortion together are not supported"),
    ],
)  # fmt: skip
@pytest.mark.usefixtures("unchecked")
def test_what_is_no_camera_is_refused(change, error, message):
    with pytest.raises(error, match=message):
        Camera(**{"K": K, "width": 640, "height": 480} | change)
