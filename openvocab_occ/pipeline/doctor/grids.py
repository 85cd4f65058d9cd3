"""Occupancy grids: axis order, handedness, frame, free label and ground, judged by measured points and cameras."""

from collections.abc import Iterator, Sequence
from itertools import permutations, product

import numpy as np
from jaxtyping import Bool, Float

from openvocab_occ.datasets.frame import Frame
from openvocab_occ.datasets.fused import MIN_LIDAR_RANGE
from openvocab_occ.depth.render import render_depth
from openvocab_occ.geometry import invert, transform
from openvocab_occ.occupancy import OccupancyGrid
from openvocab_occ.pipeline.doctor.finding import Finding, best_other
from openvocab_occ.pipeline.doctor.lidar import find_ground
from openvocab_occ.pipeline.doctor.sample import Sample, world_points

GIVEN = "as given"
_GAIN, _LEAST = 1.3, 0.05
"""Another reading must hold this much more of the points, as a factor and as a share, before it is believed."""
_MIN_POINTS = 200
_MIN_HEIGHT = 0.5  # metres above the ground of points that tell axes; the ground looks the same from every side
_MIN_SHARE = 0.1  # of points in occupied voxels; below it the grid is elsewhere
_FULL = 0.6  # share of known voxels that are occupied; streets and rooms are mostly air
_MAX_FRAMES = 3
_CLOSE = 0.3  # metres


def check_grids(sample: Sample) -> list[Finding]:
    """Judge the grids of up to three frames."""
    frames = [frame for frame in sample.frames if frame.occupancy is not None]
    if not frames:
        return []
    frames = frames[:: max(1, len(frames) // _MAX_FRAMES)][:_MAX_FRAMES]
    without = len(sample.frames) - sum(frame.occupancy is not None for frame in sample.frames)
    found = [Finding("note", "grid", f"{without} of {len(sample.frames)} frames have no grid")] if without else []
    full = [finding for frame in frames if (finding := _content(frame)) is not None]
    if full:
        return [*found, full[0]]
    found += _readings(frames)
    for check in (_ground_layer, _cameras, _path):
        found += check(frames, sample)
    return found


def _content(frame: Frame) -> Finding | None:
    """A grid must know something, and be mostly free."""
    grid = frame.occupancy
    assert grid is not None
    known = grid.spec.num_voxels if grid.known is None else int(grid.known.sum())
    if not known:
        return Finding("error", "grid", f"the grid of frame {frame.index} knows no voxel", advice="check its mask")
    share = float(grid.occupied.sum()) / known
    if share == 0.0:
        return Finding(
            "error", "grid", f"the grid of frame {frame.index} is all free", "nothing can be seen in it",
            f"is {grid.free_label} the free label?",
        )  # fmt: skip
    if share > _FULL and known > 0.2 * grid.spec.num_voxels:
        values, counts = np.unique(grid.labels, return_counts=True)
        most = int(values[counts.argmax()])
        return Finding(
            "error", "grid", f"{share:.0%} of what the grid of frame {frame.index} knows is occupied",
            "streets and rooms are mostly air",
            f"the free label is {grid.free_label}; label {most} is the most frequent",
        )  # fmt: skip
    return None


def symmetries(shape: tuple[int, int, int]) -> Iterator[tuple[str, tuple[int, ...], tuple[bool, ...]]]:
    """Yield every way of permuting and flipping the axes of an array that keeps its shape: words, axes, flips."""
    for axes in permutations(range(3)):
        if tuple(shape[a] for a in axes) != shape:
            continue
        for flips in product((False, True), repeat=3):
            words = [] if axes == (0, 1, 2) else [f"axes in the order {''.join('xyz'[a] for a in axes)}"]
            words += [f"{'xyz'[i]} flipped" for i in range(3) if flips[i]]
            yield ", ".join(words) or GIVEN, axes, flips


def turned(
    occupied: Bool[np.ndarray, "x y z"], axes: Sequence[int], flips: Sequence[bool]
) -> Bool[np.ndarray, "x y z"]:
    """Return the array with its axes permuted, then flipped."""
    return np.flip(occupied.transpose(*axes), tuple(i for i in range(3) if flips[i]))


def _standing(frame: Frame) -> Float[np.ndarray, "n 3"]:
    """Return the measured world points that lie neither on the ground nor on the own vehicle."""
    points = world_points(frame)
    if frame.points is not None:
        sensor = frame.poses.get("lidar", frame.T_world_ego)[:3, 3]
        points = points[np.linalg.norm(points - sensor, axis=1) > MIN_LIDAR_RANGE]
    ground = None
    if frame.points is not None:
        ground = find_ground(frame.points.astype(np.float64))
    if ground is not None and ground.normal[2] > 0.9:
        local = transform(invert(frame.T_world_ego), points)
        return points[local @ ground.normal > ground.height * ground.normal[2] + _MIN_HEIGHT]
    return points


def _share(
    points: Float[np.ndarray, "n 3"],
    grid: OccupancyGrid,
    occupied: Bool[np.ndarray, "x y z"],
    T_world_grid: Float[np.ndarray, "4 4"],
) -> float:
    """Return the share of the points that lie in occupied voxels, of those near enough to lie in the grid anyhow."""
    flat = grid.spec.flat(grid.spec.index(transform(invert(T_world_grid), points)))
    inside = flat >= 0
    if inside.sum() < _MIN_POINTS:
        return 0.0
    return float(occupied.reshape(-1)[flat[inside]].mean())


def _readings(frames: Sequence[Frame]) -> list[Finding]:
    """Compare the grid as given with permuted and flipped axes, and with the other frames that it may be given in."""
    totals: dict[str, list[float]] = {}
    for frame in frames:
        grid = frame.occupancy
        assert grid is not None
        points = _standing(frame)
        if len(points) < _MIN_POINTS:
            continue
        for words, axes, flips in symmetries(grid.spec.shape):
            occupied = np.ascontiguousarray(turned(grid.occupied, axes, flips))
            totals.setdefault(words, []).append(_share(points, grid, occupied, grid.T_world_grid))
        for name, T in {"lidar_ego": frame.T_world_ego, **frame.poses, "world": np.eye(4)}.items():
            if not np.allclose(T, grid.T_world_grid, atol=1e-3):
                totals.setdefault(f"in the frame {name!r}", []).append(_share(points, grid, grid.occupied, T))
    if GIVEN not in totals:
        return [Finding("note", "grid axes", "nothing was measured that could tell the axes of the grids")]
    shares = {name: float(np.mean(values)) for name, values in totals.items()}
    other = best_other(shares, GIVEN, gain=_GAIN, least=_LEAST)
    given = shares[GIVEN]
    if other is None and given < _MIN_SHARE:
        return [
            Finding(
                "warning",
                "grid axes",
                f"grids and measurements do not meet: {given:.0%} of points lie in occupied voxels",
                "no order of axes and no known frame explains it",
                "check occupancy_frame, the lattice, and which file is whose",
            )
        ]
    if other is None:
        best = max((v for k, v in shares.items() if k != GIVEN), default=0.0)
        return [
            Finding(
                "ok",
                "grid axes",
                f"{given:.0%} of the points above the ground lie in occupied voxels, {best:.0%} at best otherwise",
            )
        ]
    framed = other.startswith("in the frame")
    advice = (
        f"pass occupancy_frame={other.split(chr(39))[1]!r}" if framed
        else "axes are [x, y, z]: x forward, y left, z up; turn the array with np.transpose and np.flip before saving"
    )  # fmt: skip
    return [
        Finding(
            "error",
            "grid frame" if framed else "grid axes",
            f"grids look wrong: read {other} they fit",
            f"{shares[other]:.0%} of the points above the ground lie in occupied voxels then, {given:.0%} as given",
            advice,
        )
    ]


def _ground_layer(frames: Sequence[Frame], sample: Sample) -> list[Finding]:
    """The layer that most columns begin with is the ground: below the ego, in the lower half of the grid."""
    frame = frames[0]
    grid = frame.occupancy
    assert grid is not None
    if not sample.has_rig or abs(grid.T_world_grid[2, 2]) < 0.9:
        return []
    columns = grid.occupied.any(axis=2)
    if not columns.any():
        return []
    lowest = grid.occupied.argmax(axis=2)[columns]
    layer = int(np.bincount(lowest).argmax())
    bottom = grid.spec.origin[2] + layer * grid.spec.size[2]
    T_ego_grid = invert(frame.T_world_ego) @ grid.T_world_grid
    height = float(transform(T_ego_grid, np.array([[0.0, 0.0, bottom + grid.spec.size[2] / 2]]))[0, 2])
    what = f"most columns begin in layer {layer} of {grid.spec.shape[2]}, {height:+.1f} m in the ego frame"
    if not -3.0 < height < 1.0 + grid.spec.size[2]:
        return [
            Finding(
                "warning",
                "grid ground",
                what,
                "that should be the ground below the ego",
                "is z flipped, is the lattice's origin right, is the grid in the LiDAR's frame?",
            )
        ]
    return [Finding("ok", "grid ground", what)]


def _cameras(frames: Sequence[Frame], sample: Sample) -> list[Finding]:
    """Cameras stand in free space and see something of their grid."""
    total = buried = blind = 0
    for frame in frames:
        grid = frame.occupancy
        assert grid is not None
        for view in frame.views:
            small = view.camera.resized(64, max(8, round(64 * view.camera.height / view.camera.width)))
            seen = render_depth(grid, small)
            total += 1
            buried += bool((seen.depth < _CLOSE).mean() > 0.5)
            blind += bool((seen.voxel >= 0).mean() < 0.02)
    if not total:
        return []
    if buried > total / 2:
        return [
            Finding(
                "warning",
                "grid cameras",
                f"{buried} of {total} cameras stand in occupied voxels",
                "their pictures would be mapped onto the inside of a voxel",
                "check axes, frame and free label of the grids",
            )
        ]
    if blind > total / 2:
        return [
            Finding(
                "warning",
                "grid cameras",
                f"{blind} of {total} cameras see nothing of their grid",
                "the grid is elsewhere, or behind them",
                "check occupancy_frame and the poses",
            )
        ]
    return [Finding("ok", "grid cameras", f"{total - blind} of {total} cameras see their grid from free space")]


def _path(frames: Sequence[Frame], sample: Sample) -> list[Finding]:
    """The vehicle drives through free space, so grids are free where it was. Tells axes without a LiDAR."""
    if not sample.has_rig or sample.has_lidar:
        return []
    shares: dict[str, list[float]] = {}
    places = np.array([
        a.T_world_ego[:3, 3] * (1 - w) + b.T_world_ego[:3, 3] * w
        for a, b in sample.pairs for w in np.linspace(0, 1, 5)
    ]).reshape(-1, 3) + np.array([0.0, 0.0, 1.2])  # fmt: skip
    for frame in frames:
        grid = frame.occupancy
        assert grid is not None
        away = np.linalg.norm(places - frame.T_world_ego[:3, 3], axis=1)
        flat = grid.spec.flat(grid.spec.index(transform(invert(grid.T_world_grid), places[away > 4])))
        flat = flat[flat >= 0]
        if len(flat) < 4:
            continue
        for words, axes, flips in symmetries(grid.spec.shape):
            if not flips[2]:
                occupied = np.ascontiguousarray(turned(grid.occupied, axes, flips))
                shares.setdefault(words, []).append(1 - float(occupied.reshape(-1)[flat].mean()))
    if GIVEN not in shares:
        return []
    means = {name: float(np.mean(values)) for name, values in shares.items()}
    other = best_other(means, GIVEN, gain=_GAIN, least=0.3)
    if other is None:
        return [Finding("ok", "grid path", f"{means[GIVEN]:.0%} of the vehicle's way is free in the grids")]
    return [
        Finding(
            "warning",
            "grid axes",
            f"the vehicle drives through what its grids call occupied; read {other} it does not",
            f"{means[GIVEN]:.0%} of its way is free as given, {means[other]:.0%} otherwise",
            "axes are [x, y, z]: x forward, y left, z up",
        )
    ]
