"""The doctor on made-up drives: nothing to say of good ones, and each mistake told apart."""

import json
from dataclasses import replace

import numpy as np
import pytest

from openvocab_occ.cli import main
from openvocab_occ.datasets import load_sequence, write_recording
from openvocab_occ.datasets.frame import Frame, FrameSequence, View
from openvocab_occ.errors import DataError
from openvocab_occ.geometry import Camera, invert, look_at, pose, transform
from openvocab_occ.pipeline.doctor import examine
from openvocab_occ.pipeline.doctor.cameras import check_intrinsics
from openvocab_occ.pipeline.doctor.finding import Finding, best_other, worst
from openvocab_occ.pipeline.doctor.grids import symmetries, turned
from openvocab_occ.pipeline.doctor.lidar import find_ground
from openvocab_occ.pipeline.doctor.sample import Sample


def bad(diagnosis):
    texts = {}
    for f in diagnosis.findings:
        if f.level in ("warning", "error"):
            texts.setdefault((f.level, f.check), []).append(f"{f.what} | {f.why}")
    return {key: " ".join(words) for key, words in texts.items()}


def drive(frames, name="made up", source="test"):
    return FrameSequence(name, range(len(frames)), lambda i: frames[i], source=source)


@pytest.fixture(scope="module")
def street():
    """Two of the six cameras of four frames, which is enough to tell and quicker to look at."""
    frames = load_sequence("street", seed=3, frames=4)
    return [replace(frame, views=frame.views[:2]) for frame in frames]


@pytest.fixture(scope="module")
def lidar(street):
    """The street as a LiDAR on the vehicle sees it: true distances, in all directions."""
    from openvocab_occ.datasets.street import ego_pose
    from openvocab_occ.datasets.street import street as make
    from openvocab_occ.occupancy.rays import cast_rays

    world = make(3)
    yaw, pitch = np.meshgrid(np.radians(np.arange(0, 360, 1.0)), np.radians(np.arange(-30, 10, 1.5)))
    rays = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=-1).reshape(-1, 3)
    made = []
    for frame in street:
        T = ego_pose(frame.timestamp) @ pose((0.9, 0.0, 1.8))
        hits = cast_rays(world.world(frame.timestamp), T[:3, 3], rays @ T[:3, :3].T, 60.0)
        points = rays[hits.voxel >= 0] * hits.distance[hits.voxel >= 0, None]
        points = transform(invert(frame.T_world_ego) @ T, points).astype(np.float32)
        made.append(replace(frame, points=points, poses={**frame.poses, "lidar": T}))
    return made


def test_good_drives_are_clean(street, lidar):
    for frames in (street, lidar):
        diagnosis = examine(drive(frames))
        assert diagnosis.clean, bad(diagnosis)
        assert {"grid ground", "grid cameras"} <= {f.check for f in diagnosis.findings}


def inverted(frame):
    """Every pose written the other way round."""
    views = tuple(replace(v, camera=v.camera.at(invert(v.camera.T_world_cam))) for v in frame.views)
    poses = {name: invert(T) for name, T in frame.poses.items()}
    return replace(frame, T_world_ego=invert(frame.T_world_ego), views=views, poses=poses, occupancy=None)


def other_ego(frame):
    """Only the ego's pose inverted; sensors stay on the vehicle."""
    T = invert(frame.T_world_ego)
    views = tuple(
        replace(v, camera=v.camera.at(T @ invert(frame.T_world_ego) @ v.camera.T_world_cam)) for v in frame.views
    )
    poses = {name: T @ invert(frame.T_world_ego) @ P for name, P in frame.poses.items()}
    return replace(frame, T_world_ego=T, views=views, poses=poses, occupancy=None)


def turning(frames):
    """The same drive in a world that is turned and shifted, as maps of cities are."""
    T = pose((400.0, 1200.0, 0.0), (0.8, 0, 0, 0.6))
    return [
        replace(
            f, T_world_ego=T @ f.T_world_ego, poses={k: T @ P for k, P in f.poses.items()}, occupancy=None,
            views=tuple(replace(v, camera=v.camera.at(T @ v.camera.T_world_cam)) for v in f.views),
        )
        for f in frames
    ]  # fmt: skip


def test_inverted_poses_are_told_by_sweeps_and_cameras(lidar):
    frames = turning(lidar)
    assert examine(drive(frames)).clean
    found = bad(examine(drive([inverted(f) for f in frames])))
    assert any(level == "error" for level, _ in found), found
    found = bad(examine(drive([other_ego(f) for f in frames])))
    assert "inverted" in found["error", "poses"], found


@pytest.mark.parametrize("factor", [10.0, 0.1, 1000.0])
def test_sweeps_of_another_unit(lidar, factor):
    def scaled(frame):
        T_ego_lidar = invert(frame.T_world_ego) @ frame.poses["lidar"]
        local = transform(invert(T_ego_lidar), frame.points) * factor
        return replace(frame, points=transform(T_ego_lidar, local).astype(np.float32), occupancy=None)

    found = bad(examine(drive([scaled(f) for f in lidar[:2]])))
    assert f"with points {1 / factor:g} times as large" in found["error", "LiDAR"]


@pytest.mark.parametrize("has_lidar", [True, False])
def test_turned_grids(street, lidar, has_lidar):
    """With a LiDAR by what it measured; without, by the way that the vehicle takes through them."""

    def swapped(frame):
        grid = frame.occupancy
        labels, known = (np.ascontiguousarray(np.rot90(a)[:100, :80]) for a in (grid.labels, grid.known))
        pad = ((0, 100 - labels.shape[0]), (0, 80 - labels.shape[1]), (0, 0))
        labels, known = np.pad(labels, pad, constant_values=17), np.pad(known, pad)
        return replace(frame, occupancy=replace(grid, labels=labels, known=known))

    def flipped(frame):
        grid = frame.occupancy
        return replace(frame, occupancy=replace(grid, labels=grid.labels[::-1, ::-1], known=grid.known[::-1, ::-1]))

    frames = lidar if has_lidar else street
    changes = [flipped] if has_lidar else []
    for change in changes:
        found = bad(examine(drive([change(f) for f in frames])))
        assert any(check == "grid axes" for _, check in found), (change, found)
    found = bad(examine(drive([swapped(f) for f in frames])))
    assert any(check.startswith("grid") for _, check in found), found


def test_upside_down_grids_and_wrong_free_labels(street):
    def flipped(frame):
        grid = frame.occupancy
        return replace(frame, occupancy=replace(grid, labels=grid.labels[:, :, ::-1], known=grid.known[:, :, ::-1]))

    assert ("warning", "grid ground") in bad(examine(drive([flipped(f) for f in street[:2]])))
    wrong = [replace(f, occupancy=replace(f.occupancy, free_label=0)) for f in street[:2]]
    assert "label 17 is the most frequent" in str([f.advice for f in examine(drive(wrong)).findings])


@pytest.mark.parametrize(
    ("times", "level", "words"),
    [
        ([0.0, 0.5, 0.2, 0.7], "error", "times go back"),
        ([1.0, 1.0, 1.0, 1.0], "warning", "the same time"),
        ([1e15, 1e15 + 5e5, 1e15 + 1e6, 1e15 + 1.5e6], "warning", "microseconds"),
        ([0.0, 0.5, 1.0, 9.0], "note", "a gap"),
        ([0.0, 0.5, 1.0, 1.5], "ok", "times rise"),
    ],
)
def test_times(street, times, level, words):
    frames = [replace(f, timestamp=t) for f, t in zip(street, times, strict=False)]
    found = [f for f in examine(drive(frames)).findings if f.check == "timestamps"]
    assert [(f.level, words in f.what) for f in found] == [(level, True)], found


def camera_view(K, width, height):
    return View(np.zeros((height, width, 3), np.uint8), Camera(np.array(K, float), width, height), name="c")


@pytest.mark.parametrize(
    ("K", "words"),
    [
        ([[800, 0, 639.5], [0, 800, 359.5], [0, 0, 1]], None),
        ([[400, 0, 319.5], [0, 400, 179.5], [0, 0, 1]], "0.5 times this size"),
        ([[1600, 0, 1279.5], [0, 1600, 719.5], [0, 0, 1]], "2 times this size"),
        ([[800, 0, 359.5], [0, 800, 639.5], [0, 0, 1]], "turned by 90 degrees"),
        ([[8, 0, 639.5], [0, 8, 359.5], [0, 0, 1]], "field of view"),
        ([[800, 0, 639.5], [0, 800, 219.5], [0, 0, 1]], None),  # the sky was cut off
    ],
)
def test_intrinsics_against_the_size_of_images(K, words):
    frame = Frame(0, 0.0, np.eye(4), (camera_view(K, 1280, 720),))
    (finding,) = check_intrinsics(Sample(1, [frame], [], []))
    assert (finding.level == "ok") == (words is None)
    assert words is None or words in finding.what


def test_frames_that_cannot_be_read(street):
    def read(index):
        if index % 2:
            raise DataError(f"image {index} is truncated")
        return street[index]

    diagnosis = examine(FrameSequence("d", range(4), read, files=lambda i: []))
    assert "image 1 is truncated" in bad(diagnosis)["error", "frames"]
    empty = examine(FrameSequence("d", range(0), read))
    assert "no frames" in bad(empty)["error", "files"]
    assert empty.estimate is None


def test_ground_is_found_whatever_the_unit(rng):
    flat = np.concatenate([np.c_[rng.uniform(-15, 15, (600, 2)), rng.normal(-1.7, 0.02, 600)],
                           rng.uniform(-1.7, 3, (300, 3)) * [5, 5, 1]])  # fmt: skip
    for factor in (1.0, 1000.0):
        ground = find_ground(flat * factor)
        assert ground.height == pytest.approx(-1.7 * factor, rel=0.05)
        assert ground.normal[2] > 0.99
        assert ground.above > 0.9
    assert find_ground(flat[:50]) is None


def test_symmetries_are_all_different_and_undo_each_other(rng):
    box = rng.random((4, 4, 3)) < 0.5
    every = list(symmetries(box.shape))
    assert len(every) == 16
    assert len({turned(box, axes, flips).tobytes() for _, axes, flips in every}) == 16
    assert every[0][0] == "as given"
    assert len(list(symmetries((2, 3, 4)))) == 8
    assert len(list(symmetries((2, 2, 2)))) == 48


def test_another_reading_must_be_clearly_better():
    assert best_other({"a": 0.5, "b": 0.9}, "a", gain=1.3, least=0.1) == "b"
    assert best_other({"a": 0.8, "b": 0.9}, "a", gain=1.3, least=0.1) is None
    assert best_other({"a": 0.01, "b": 0.05}, "a", gain=1.3, least=0.1) is None
    assert best_other({"a": 0.5}, "a", gain=1.3, least=0.1) is None
    assert worst([]) == "ok"
    assert worst([Finding("note", "x", ""), Finding("warning", "x", "")]) == "warning"


def test_command(street, tmp_path, capsys):
    write_recording(tmp_path / "r", drive(street[:2]))
    assert main(["doctor", "recording", str(tmp_path / "r"), "--json", "--report", str(tmp_path / "report")]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["clean"]
    assert told["frames"] == 2
    assert told["estimate"]["images"] == 4
    assert "grid_on_images.png" in (tmp_path / "report" / "index.html").read_text()
    lines = (tmp_path / "r" / "frames.jsonl").read_text().splitlines()
    (tmp_path / "r" / "frames.jsonl").write_text("\n".join(lines).replace("000001.jpg", "gone.jpg"))
    assert main(["doctor", "recording", str(tmp_path / "r")]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "2 of 6 files are missing" in said
    assert "try:" in said
    assert main(["doctor", "recording", str(tmp_path / "r"), "--option", "fast=true"]) == 2
    assert "has no option 'fast'" in capsys.readouterr().err
    assert main(["doctor", "recording", str(tmp_path / "r"), "--option", "fast"]) == 2


def test_cameras_that_circle_an_object_are_not_taken_for_inverted(rng):
    """Captures for view synthesis: the inverted poses stand still, which proves nothing."""
    frames = []
    K = np.array([[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]])
    for i in range(8):
        angle = 2 * np.pi * i / 8
        T = look_at((3 * np.cos(angle), 3 * np.sin(angle), 1.5), (0, 0, 0.5))
        view = View(np.zeros((48, 64, 3), np.uint8), Camera(K, 64, 48, T))
        frames.append(Frame(i, float(i), T, (view,)))
    assert examine(drive(frames)).clean
    turned_over = [
        replace(f, views=(replace(f.views[0], camera=f.views[0].camera.at(invert(f.T_world_ego))),)) for f in frames
    ]
    assert "inverted" in bad(examine(drive(turned_over)))["warning", "rig"]
