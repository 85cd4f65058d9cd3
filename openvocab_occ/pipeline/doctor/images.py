"""Poses against the images alone: what matches in two of them must lie on epipolar lines."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from openvocab_occ.datasets.frame import View
from openvocab_occ.geometry import Camera, invert
from openvocab_occ.pipeline.doctor.finding import Finding, best_other
from openvocab_occ.pipeline.doctor.poses import GIVEN, POSES, PoseReading
from openvocab_occ.pipeline.doctor.sample import Sample

_WIDTH = 800  # pixels at which images are matched
_TOLERANCE = 3.0  # of those pixels; poses of vehicles are off by a tenth of a degree
_MIN_MATCHES = 40
_MAX_PAIRS = 6
_MOVED = 3.0  # median pixels below which a pair tells nothing
_AGREED = 0.5  # share of the matches that must fit one motion
_RATIO = 0.75  # Lowe's: the best match against the second


def check_images(sample: Sample) -> list[Finding]:
    """Match neighbouring images of a camera and compare with the motion that the poses tell."""
    shares: dict[str, list[float]] = {name: [] for name in POSES}
    for a, b in _pairs(sample):
        matches = match(a, b)
        if len(matches) < _MIN_MATCHES or np.median(np.linalg.norm(matches[:, 0] - matches[:, 1], axis=1)) < _MOVED:
            continue
        for name, reading in POSES.items():
            shares[name].append(epipolar_share(a.camera, b.camera, matches, reading))
    if not shares[GIVEN]:
        return []
    means = {name: float(np.mean(values)) for name, values in shares.items()}
    other = best_other(means, GIVEN, gain=1.5, least=0.2)
    count = len(shares[GIVEN])
    if other is not None:
        return [
            Finding(
                "error",
                "poses",
                f"camera poses look wrong: {other} they agree with the images",
                f"{means[other]:.0%} of what matches in {count} pairs of images fits then, {means[GIVEN]:.0%} as given",
                "poses must take camera (x right, y down, z forward) to world",
            )
        ]
    if means[GIVEN] < 0.3:
        return [
            Finding(
                "warning",
                "poses",
                f"images do not agree: {means[GIVEN]:.0%} of what matches lies on epipolar lines",
                "no usual mistake explains it",
                "check K, distortion, times and poses",
            )
        ]
    return [Finding("ok", "images", f"{means[GIVEN]:.0%} of what matches in {count} pairs of images fits the poses")]


def _pairs(sample: Sample) -> Sequence[tuple[View, View]]:
    pairs = [
        (a, b)
        for first, second in sample.pairs
        for a in first.views
        for b in second.views
        if a.name == b.name
    ]  # fmt: skip
    return pairs[:: max(1, len(pairs) // _MAX_PAIRS)][:_MAX_PAIRS]


def match(a: View, b: View) -> Float[np.ndarray, "n 2 2"]:
    """Return matching pixels of two images (made no wider than 800), without those that fit no motion at all."""
    import cv2

    sift = cv2.SIFT_create(1500)  # pyright: ignore[reportAttributeAccessIssue]
    found = []
    for view in (a, b):
        points, descriptors = sift.detectAndCompute(_small(view.image), None)
        if descriptors is None or len(points) < _MIN_MATCHES:
            return np.empty((0, 2, 2))
        found.append((np.array([p.pt for p in points]), descriptors))
    best = cv2.BFMatcher().knnMatch(found[0][1], found[1][1], k=2)
    kept = [m[0] for m in best if len(m) == 2 and m[0].distance < _RATIO * m[1].distance]
    pixels = np.array([(found[0][0][m.queryIdx], found[1][0][m.trainIdx]) for m in kept]).reshape(-1, 2, 2)
    if len(pixels) < _MIN_MATCHES:
        return np.empty((0, 2, 2))
    cv2.setRNGSeed(0)
    _, agreed = cv2.findFundamentalMat(pixels[:, 0], pixels[:, 1], cv2.FM_RANSAC, _TOLERANCE / 2, 0.99)
    if agreed is None or agreed.mean() < _AGREED:
        return np.empty((0, 2, 2))  # most matches fit no one motion: the two hardly show the same
    return pixels[agreed[:, 0] != 0]


def epipolar_share(a: Camera, b: Camera, matches: Float[np.ndarray, "n 2 2"], reading: PoseReading) -> float:
    """Return the share of matches whose second pixel is near the epipolar line of the first."""
    small = [camera.resized(*_size(camera.width, camera.height)) for camera in (a, b)]
    rays = [small[i].unproject(matches[:, i]) for i in (0, 1)]
    T_b_a = invert(reading(b.T_world_cam)) @ reading(a.T_world_cam)
    t = T_b_a[:3, 3]
    turned = rays[0] @ T_b_a[:3, :3].T
    if np.linalg.norm(t) < 1e-6:  # it only turned: pixels go to pixels
        off = np.linalg.norm(turned[:, :2] / turned[:, 2:] - rays[1][:, :2], axis=1)
    else:
        lines = np.cross(t / np.linalg.norm(t), turned)
        with np.errstate(invalid="ignore", divide="ignore"):
            off = np.abs((lines * rays[1]).sum(axis=1)) / np.linalg.norm(lines[:, :2], axis=1)
    return float((off * small[1].K[0, 0] < _TOLERANCE).mean())


def _size(width: int, height: int) -> tuple[int, int]:
    scale = min(1.0, _WIDTH / width)
    return round(width * scale), round(height * scale)


def _small(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "y x 3"]:
    import cv2

    size = _size(image.shape[1], image.shape[0])
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)  # pyright: ignore[reportReturnType]
