"""Pose convention and direction, and the scale of depth: which way of reading the numbers makes views agree.

Every check compares the data as read with the mistakes that people make (poses inverted, camera axes of OpenGL, depth
in other units). What explains the measurements clearly better than the data as read is what is wrong.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float

from openvocab_occ.datasets.frame import Frame, View
from openvocab_occ.geometry import T_OPENGL_OPENCV, invert, transform
from openvocab_occ.occupancy.fusion import points_of_depth
from openvocab_occ.pipeline.doctor.finding import Finding, best_other
from openvocab_occ.pipeline.doctor.sample import Sample, thinned

GIVEN = "as given"
_GAIN, _LEAST = 1.4, 0.1
"""Another reading must agree this much more often, as a factor and as a share, before it is believed."""
_DEPTH_TOLERANCE = 0.05  # share of the depth: noise of depth cameras is 1 to 3 %
_LIDAR_TOLERANCE = 0.3  # metres between returns of the same surface from two sweeps
_MIN_SHARE = 0.15  # of points that agree, below which no reading explains the views
_MIN_POINTS = 200
_MOVED = 0.3  # metres; below, and below 2 degrees, two frames tell nothing of their poses
_TURNED = 0.035  # radians
_NEAR, _FAR = 0.2, 15.0  # metres; median depth of cameras that measure it

PoseReading = Callable[[Float[np.ndarray, "4 4"]], Float[np.ndarray, "4 4"]]
POSES: Mapping[str, PoseReading] = {
    GIVEN: lambda T: T,
    "inverted": invert,
    "with camera axes of OpenGL (y up, z backward)": lambda T: T @ T_OPENGL_OPENCV,
    "inverted, with camera axes of OpenGL": lambda T: T_OPENGL_OPENCV @ invert(T),
}
"""What T_world_cam may really be, by what must be done to it."""
SCALES: Mapping[str, float] = {
    GIVEN: 1.0, **{f"{k:g} times as large": k for k in (0.001, 0.01, 0.1, 0.2, 5.0, 10.0, 100.0, 1000.0)},
}  # fmt: skip


def check_depth(sample: Sample) -> list[Finding]:
    """Measured depth of one view must fit that of others, and be of a size that cameras can measure."""
    views = [view for frame in sample.frames for view in frame.views if view.depth is not None]
    if not views:
        return []
    found = _depth_size(views, two_sided=not sample.has_rig)
    pairs = _informative(views)
    if not pairs:
        return [*found, Finding("note", "depth", "no two views differ enough to test poses with depth")]
    by_pose = {name: _depth_share(pairs, reading, 1.0) for name, reading in POSES.items()}
    by_scale = {name: _depth_share(pairs, POSES[GIVEN], scale) for name, scale in SCALES.items()}
    given = by_pose[GIVEN]
    pose, scale = (best_other(shares, GIVEN, gain=_GAIN, least=_LEAST) for shares in (by_pose, by_scale))
    if pose is not None and (scale is None or by_pose[pose] >= by_scale[scale]):
        found.append(
            Finding(
                "error",
                "poses",
                f"camera poses look wrong: {pose} they agree with depth",
                f"{by_pose[pose]:.0%} of the points of one view lie on what another measured, {given:.0%} as given",
                "poses must take camera (x right, y down, z forward) to world",
            )
        )
    elif scale is not None:
        found.append(
            Finding(
                "error",
                "depth scale",
                f"depth looks wrong: {scale} it agrees with the poses",
                f"{by_scale[scale]:.0%} of the points of one view lie on what another measured, {given:.0%} as given",
                f"pass the option depth_scale={1 / SCALES[scale]:g} times what it is now (or scale the poses)",
            )
        )
    elif given < _MIN_SHARE:
        found.append(
            Finding(
                "warning",
                "poses",
                f"views do not agree: {given:.0%} of depth points lie on what other views measured",
                "no usual mistake explains it",
                "check poses, K, depth scale, and that colour and depth have the same time",
            )
        )
    else:
        found.append(Finding("ok", "poses", f"views agree: {given:.0%} of depth points lie on what others measured"))
    return found


def _depth_size(views: Sequence[View], *, two_sided: bool) -> list[Finding]:
    medians = [float(np.median(v.depth[v.depth > 0])) for v in views if v.depth is not None and (v.depth > 0).any()]
    if not medians:
        return [Finding("error", "depth", "depth images hold no depth", advice="check depth_scale and the files")]
    median = float(np.median(medians))
    if median < _NEAR or (two_sided and median > _FAR):
        return [
            Finding(
                "warning",
                "depth scale",
                f"the median depth is {median:.3g} m",
                f"cameras that measure depth see {_NEAR:g} to {_FAR:g} m",
                "check the option depth_scale",
            )
        ]
    return [Finding("ok", "depth scale", f"the median depth is {median:.2g} m")]


def _informative(views: Sequence[View]) -> list[tuple[View, View]]:
    """Return pairs of views that saw the scene from different places or directions, those far apart first."""
    pairs = []
    for a, b in combinations(views, 2):
        T = invert(a.camera.T_world_cam) @ b.camera.T_world_cam
        turn = float(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
        move = float(np.linalg.norm(T[:3, 3]))
        depth = 1.0 if a.depth is None or not (a.depth > 0).any() else float(np.median(a.depth[a.depth > 0]))
        if move > 0.005 * depth or move > _MOVED or turn > _TURNED:
            pairs.append((move + turn, a, b))
    pairs.sort(key=lambda pair: -pair[0])
    return [(a, b) for _, a, b in pairs[:: max(1, len(pairs) // 12)]]


def _depth_share(pairs: Sequence[tuple[View, View]], reading: PoseReading, scale: float) -> float:
    """Return the share of depth points that lie on what another view measured, of those that it could have measured."""
    agree = total = 0
    for pair in pairs:
        for a, b in (pair, pair[::-1]):
            assert a.depth is not None
            assert b.depth is not None
            camera = b.camera.at(reading(b.camera.T_world_cam))
            local = points_of_depth(a.depth, a.camera.at(np.eye(4)), stride=8) * scale
            pixels, depth = camera.project(transform(reading(a.camera.T_world_cam), local))
            inside = camera.inside(pixels)
            u, v = np.rint(pixels[inside]).astype(int).T
            u, v = np.clip(u, 0, camera.width - 1), np.clip(v, 0, camera.height - 1)
            measured = b.depth[v, u] * scale
            valid = measured > 0
            agree += int((np.abs(depth[inside] - measured)[valid] < _DEPTH_TOLERANCE * measured[valid]).sum())
            total += int(valid.sum())
    return agree / total if total >= _MIN_POINTS else 0.0


def check_sweeps(sample: Sample) -> list[Finding]:
    """LiDAR sweeps of neighbouring frames must lie on each other in the world."""
    pairs = [(a, b) for a, b in sample.pairs if a.points is not None and b.points is not None and _moves(a, b)]
    if not pairs:
        return []
    readings: dict[str, PoseReading] = {GIVEN: POSES[GIVEN], "inverted": invert}
    shares = {name: float(np.mean([_sweep_share(a, b, r) for a, b in pairs])) for name, r in readings.items()}
    if best_other(shares, GIVEN, gain=_GAIN, least=_LEAST):
        return [
            Finding(
                "error",
                "poses",
                "ego poses look inverted: the other way round, sweeps lie on each other",
                f"{shares['inverted']:.0%} of the returns meet those of the next sweep, {shares[GIVEN]:.0%} as given",
                "T_world_ego takes ego to world",
            )
        ]
    if shares[GIVEN] < _MIN_SHARE:
        return [
            Finding(
                "warning",
                "poses",
                f"sweeps do not meet: {shares[GIVEN]:.0%} of returns lie on those of the next",
                "standing things must stay where they are",
                "check poses, and that they have the sweeps' times",
            )
        ]
    return [Finding("ok", "poses", f"sweeps meet: {shares[GIVEN]:.0%} of returns lie on those of the next")]


def _moves(a: Frame, b: Frame) -> bool:
    T = invert(a.T_world_ego) @ b.T_world_ego
    inverted = a.T_world_ego @ invert(b.T_world_ego)
    return max(float(np.linalg.norm(M[:3, 3])) for M in (T, inverted)) > _MOVED


def _sweep_share(a: Frame, b: Frame, reading: PoseReading) -> float:
    """Return the share of standing returns near one of the other sweep; the ground would slide on itself."""
    from scipy.spatial import KDTree

    assert a.points is not None
    assert b.points is not None
    raised = []
    for frame in (a, b):
        assert frame.points is not None
        points = frame.points[np.linalg.norm(frame.points[:, :2], axis=1) < 40]
        low = np.percentile(points[:, 2], 20) if len(points) else 0.0
        raised.append(transform(reading(frame.T_world_ego), points[points[:, 2] > low + 0.7]))
    first, second = thinned(raised[0], 3000), raised[1]
    if len(first) < _MIN_POINTS or len(second) < _MIN_POINTS:
        return 0.0
    return float((KDTree(second).query(first, distance_upper_bound=_LIDAR_TOLERANCE)[0] < np.inf).mean())


def check_motion(sample: Sample, source: str) -> list[Finding]:
    """A vehicle drives where it heads, on about level ground, and does not jump."""
    found: list[Finding] = []
    poses = np.array([frame.T_world_ego for frame in sample.frames])
    if not len(poses):
        return []
    heights, inverted_heights = poses[:, 2, 3], invert(poses)[:, 2, 3]
    if source.startswith("nuscenes") and np.abs(inverted_heights).max() < 1e-2 < 1 < np.abs(heights).max():
        found.append(
            Finding(
                "error",
                "poses",
                f"ego poses look inverted: z is {heights[0]:.1f} m, and exactly 0 the other way round",
                "nuScenes writes ego poses with z = 0",
                "ego2global takes ego to world",
            )
        )
    if sample.has_rig and (poses[:, 2, 2] < 0.7).any():
        tilt = np.degrees(np.arccos(np.clip(poses[:, 2, 2].min(), -1, 1)))
        found.append(
            Finding(
                "warning",
                "poses",
                f"the ego's z axis is {tilt:.0f} degrees off the world's",
                "roads are not that steep",
                "is the world z up, and the ego x forward, y left, z up?",
            )
        )
    if len(poses) > 1 and (np.abs(poses - poses[0]) < 1e-9).all():
        return [*found, Finding("warning", "poses", "all poses are the same", advice="was the trajectory read?")]
    steps = [
        (b.T_world_ego[:3, 3] - a.T_world_ego[:3, 3], b.timestamp - a.timestamp, a.T_world_ego[:3, 0])
        for a, b in sample.pairs
    ]
    fast = [np.linalg.norm(d) / dt for d, dt, _ in steps if dt > 0]
    if sample.has_rig and fast and np.median(fast) > 70:
        found.append(
            Finding(
                "warning",
                "poses",
                f"the vehicle drives {np.median(fast):.0f} m/s",
                "that is more than 250 km/h",
                "check the poses' direction and unit, and the times",
            )
        )
    moved = [(d, x) for d, _, x in steps if np.linalg.norm(d) > 0.5]
    if sample.has_rig and moved:
        along = float(np.median([d @ x / np.linalg.norm(d) for d, x in moved]))
        if abs(along) < 0.7:
            found.append(
                Finding(
                    "warning",
                    "poses",
                    "the vehicle drives sideways",
                    f"its motion and its x axis are {np.degrees(np.arccos(np.clip(along, -1, 1))):.0f} degrees apart",
                    "the ego is x forward; poses may be inverted, or of a sensor",
                )
            )
        elif along < 0:
            found.append(Finding("note", "poses", "the vehicle drives backward", "or its x axis points back"))
    return found
