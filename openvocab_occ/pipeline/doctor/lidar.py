"""The ground that a LiDAR sees: how far below it, which way up, and whether cameras look at what it measures."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from openvocab_occ.datasets.frame import Frame
from openvocab_occ.geometry import transform
from openvocab_occ.pipeline.doctor.finding import Finding
from openvocab_occ.pipeline.doctor.sample import Sample, thinned

_NEAR = 25.0  # metres around the ego where the ground is sought
_PLANE = 0.15  # metres from a plane to its points
_LOWEST, _HIGHEST = 0.3, 5.0  # metres of a LiDAR above the ground: a delivery robot, the roof of a bus
_STEEP = 0.9  # cosine; the ground near a vehicle is level to 25 degrees
_MIN_POINTS = 300


@dataclass(frozen=True)
class Ground:
    """The plane that holds most returns near the ego."""

    normal: Float[np.ndarray, " 3"]
    """Upward in the ego frame."""
    height: float
    """Of the plane at the ego, metres above the ego's origin."""
    share: float
    """Of the returns that lie on it."""
    above: float
    """Share of the other returns that lie above it."""


def find_ground(points: Float[np.ndarray, "n 3"]) -> Ground | None:
    """Find the largest plane among returns in the ego frame, by random triples; None where there are too few."""
    near = thinned(points[np.linalg.norm(points, axis=1) < _NEAR * max(1.0, _spread(points))], 4000)
    if len(near) < _MIN_POINTS:
        return None
    tolerance = _PLANE * max(1.0, _spread(points))
    rng = np.random.default_rng(0)
    triples = near[rng.integers(0, len(near), (300, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    good = lengths > 1e-6
    normals = normals[good] / lengths[good, None]
    offsets = np.einsum("ij,ij->i", normals, triples[good][:, 0])
    counts = np.array([(np.abs(near @ n - d) < tolerance).sum() for n, d in zip(normals, offsets, strict=True)])
    n, d = normals[counts.argmax()], offsets[counts.argmax()]
    n, d = (n, d) if n[2] >= 0 else (-n, -d)
    side = near @ n - d
    other = side[np.abs(side) > 3 * tolerance]
    height = float(d / n[2]) if n[2] > 0.1 else float("nan")
    above = float((other > 0).mean()) if len(other) else 1.0
    return Ground(n, height, float(counts.max() / len(near)), above)


def _spread(points: Float[np.ndarray, "n 3"]) -> float:
    """Return how many times larger a sweep is than those of vehicles, so that a wrong unit hides no ground.

    That is its typical range over 10 m.
    """
    return float(np.median(np.linalg.norm(points, axis=1)) / 10.0) if len(points) else 1.0


def check_lidar(sample: Sample) -> list[Finding]:
    """The LiDAR must stand upright above the ground, and the ground lie about at the ego's feet."""
    frame = next((f for f in sample.frames if f.points is not None), None)
    if frame is None or frame.points is None:
        return []
    if len(frame.points) < _MIN_POINTS:
        return [Finding("warning", "LiDAR", f"a sweep has {len(frame.points)} returns", advice="check the file")]
    ground = find_ground(frame.points.astype(np.float64))
    found: list[Finding] = []
    if ground is None:
        return [Finding("note", "LiDAR", "no ground is seen near the ego")]
    if ground.normal[2] < _STEEP:
        if ground.share > 0.3:
            tilt = np.degrees(np.arccos(ground.normal[2]))
            found.append(
                Finding(
                    "warning",
                    "LiDAR",
                    f"the largest plane that the LiDAR sees is tilted by {tilt:.0f} degrees",
                    "it should be the road, level in the ego frame",
                    "check the axes of the points and of T_ego_lidar",
                )
            )
        return found or [Finding("note", "LiDAR", "no level ground is seen near the ego")]
    sensor = frame.poses.get("lidar")
    stands = None if sensor is None else float((np.linalg.inv(frame.T_world_ego) @ sensor)[2, 3]) - ground.height
    if ground.above < 0.3 and ground.share < 0.95:
        found.append(
            Finding(
                "error",
                "LiDAR",
                "the LiDAR sees the world upside down",
                f"{1 - ground.above:.0%} of what is not on the ground lies below it",
                "z points up in the ego frame",
            )
        )
    if stands is not None and not _LOWEST < stands < _HIGHEST:
        right = next((k for k in (0.001, 0.01, 0.1, 10.0, 100.0, 1000.0) if 0.8 < _rescaled(frame, k) < 4.0), None)
        found.append(
            Finding(
                "error" if right else "warning",
                "LiDAR",
                f"the LiDAR is {stands:.2f} m above the ground",
                f"with points {right:g} times as large it would be {_rescaled(frame, right):.2f} m"
                if right
                else "on vehicles it is 0.3 to 5 m",
                "check the unit of the points" if right else "check T_ego_lidar",
            )
        )
    elif not -3.0 < ground.height < 0.7:
        found.append(
            Finding(
                "warning",
                "LiDAR",
                f"the ground lies at {ground.height:+.1f} m in the ego frame",
                "the ego stands on it, or a little above",
                "check T_ego_lidar; grids around the ego may miss the ground",
            )
        )
    elif not found:
        high = "" if stands is None else f", the LiDAR {stands:.2f} m above it"
        found.append(Finding("ok", "LiDAR", f"the ground lies at {ground.height:+.2f} m in the ego frame{high}"))
    return found + _coverage(sample)


def _rescaled(frame: Frame, factor: float) -> float:
    """Return the sensor's height above the ground if its points were larger by this factor."""
    if frame.points is None or "lidar" not in frame.poses:
        return float("nan")
    sensor = (np.linalg.inv(frame.T_world_ego) @ frame.poses["lidar"])[:3, 3]
    ground = find_ground(sensor + (frame.points - sensor) * factor)
    return float("nan") if ground is None or ground.normal[2] < _STEEP else float(sensor[2]) - ground.height


def _coverage(sample: Sample) -> list[Finding]:
    """Every camera looks at something that the LiDAR measured, or the two do not share a frame."""
    frame = next(f for f in sample.frames if f.points is not None)
    assert frame.points is not None
    points = transform(frame.T_world_ego, thinned(frame.points))
    blind = []
    for view in frame.views:
        pixels, _ = view.camera.project(points)
        if view.camera.inside(pixels).sum() < 20:
            blind.append(view.name)
    if not frame.views or not blind:
        return []
    if len(blind) == len(frame.views):
        return [
            Finding(
                "error",
                "LiDAR",
                "no camera looks at anything that the LiDAR measured",
                "both look at the same street",
                "check the extrinsics of cameras and LiDAR",
            )
        ]
    names = ", ".join(blind)
    return [Finding("note", "LiDAR", f"the LiDAR measures nothing in {names}", "true of LiDARs that look one way only")]
