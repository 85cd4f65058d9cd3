"""The doctor on real data: clean as it is, and flagged for the right reason once it is spoiled in a known way."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from openvocab_occ.datasets import load_sequence
from openvocab_occ.datasets.fused import join_fused
from openvocab_occ.geometry import GridSpec, transform
from openvocab_occ.occupancy import OCC3D_FREE, OCC3D_SPEC, OccupancyGrid
from openvocab_occ.occupancy.lidar import grid_from_lidar
from openvocab_occ.pipeline.doctor import examine
from openvocab_occ.pipeline.doctor.grids import check_grids
from openvocab_occ.pipeline.doctor.sample import Sample

pytestmark = pytest.mark.data


def bad(diagnosis):
    return findings(diagnosis.findings)


def findings(found):
    """Warnings and errors as {(level, check): what and why}."""
    texts = {}
    for f in found:
        if f.level in ("warning", "error"):
            texts.setdefault((f.level, f.check), []).append(f"{f.what} | {f.why}")
    return {key: " ".join(words) for key, words in texts.items()}


def look(folder, **options):
    return bad(examine(load_sequence("nuscenes-infos", folder, cameras=["CAM_FRONT", "CAM_BACK_LEFT"], **options)))


@pytest.fixture
def street(keyframe, tmp_path):
    """A copy of the keyframe, whose info file may be changed."""
    shutil.copytree(keyframe, tmp_path / "keyframe")
    for file in (tmp_path / "keyframe").glob("*.pkl"):
        file.unlink()

    def change(edit=None):
        file = tmp_path / "keyframe" / "info.json"
        info = json.loads(file.read_text())
        if edit is not None:
            edit(info["data_list"][0])
        file.write_text(json.dumps(info))
        return tmp_path / "keyframe"

    return change


def invert(entry, key):
    entry[key] = np.linalg.inv(np.array(entry[key])).tolist()


def invert_lidar2cam(frame):
    for image in frame["images"].values():
        invert(image, "lidar2cam")


def invert_cam2ego(frame):
    for image in frame["images"].values():
        image.pop("lidar2cam")
        invert(image, "cam2ego")


def opengl_axes(frame):
    for image in frame["images"].values():
        image["lidar2cam"] = (np.diag([1.0, -1, -1, 1]) @ np.array(image["lidar2cam"])).tolist()


def small_images(frame):
    for image in frame["images"].values():
        image["cam2img"] = (np.diag([0.5, 0.5, 1]) @ np.array(image["cam2img"])[:3, :3]).tolist()


def test_keyframe_is_clean(keyframe):
    diagnosis = examine(load_sequence("nuscenes-infos", keyframe))
    assert diagnosis.clean, bad(diagnosis)
    assert diagnosis.estimate is not None
    assert diagnosis.estimate.images == 6


@pytest.mark.parametrize(
    ("edit", "check", "words"),
    [
        (invert_lidar2cam, "rig", "not upright"),
        (invert_cam2ego, "rig", "not upright"),
        (opengl_axes, "rig", "not upright"),
        (lambda frame: invert(frame, "ego2global"), "poses", "look inverted"),
        (lambda frame: invert(frame["lidar_points"], "lidar2ego"), "LiDAR", ""),
        (small_images, "intrinsics", "0.5"),
    ],
    ids=["lidar2cam", "cam2ego", "opengl", "ego2global", "lidar2ego", "K"],
)
def test_keyframe_with_wrong_poses(street, edit, check, words):
    found = look(street(edit))
    assert any(c == check and words in what for (_, c), what in found.items()), found


@pytest.mark.parametrize("factor", [10, 0.1])
def test_keyframe_with_sweeps_in_other_units(street, factor):
    folder = street()
    (file,) = folder.glob("*.bin")
    sweep = np.fromfile(file, "<f4").reshape(-1, 5)
    sweep[:, :3] *= factor
    sweep.tofile(file)
    assert f"with points {1 / factor:g} times" in look(folder)["error", "LiDAR"]


@pytest.fixture(scope="module")
def labels(keyframe):
    """Occupancy of the keyframe as a network would give it, in the ego frame and in the LiDAR's."""
    frame = load_sequence("nuscenes-infos", keyframe)[0]
    T_lidar_ego = np.linalg.inv(frame.poses["lidar"]) @ frame.T_world_ego
    made = {}
    for name, T in (("lidar_ego", np.eye(4)), ("lidar", T_lidar_ego)):
        sensor = transform(T @ np.linalg.inv(T_lidar_ego), np.zeros((1, 3)))[0]
        grid = grid_from_lidar(transform(T, frame.points), sensor, OCC3D_SPEC, min_range=2.2)
        made[name] = np.where(grid.occupied, 15, OCC3D_FREE).astype(np.uint8)
    return made


def flips(labels):
    return {
        "xy": labels.transpose(1, 0, 2),
        "flip x": labels[::-1],
        "flip y": labels[:, ::-1],
        "flip z": labels[:, :, ::-1],
        "half turn": labels[::-1, ::-1],
        "quarter turn": np.rot90(labels),
    }


def test_grids_of_the_keyframe(keyframe, labels):
    frame = load_sequence("nuscenes-infos", keyframe, cameras=["CAM_FRONT"])[0]

    def look(array, name="lidar_ego"):
        grid = OccupancyGrid(array, OCC3D_SPEC, frame.poses[name])
        return findings(check_grids(Sample(1, [replace(frame, occupancy=grid)], [], [])))

    assert not look(labels["lidar_ego"])
    assert not look(labels["lidar"], "lidar")
    for name, array in flips(labels["lidar_ego"]).items():
        assert ("error", "grid axes") in look(array), name
    assert "'lidar'" in look(labels["lidar"])["error", "grid frame"]
    assert "occupied" in look(np.where(labels["lidar_ego"] == OCC3D_FREE, 0, 17).astype(np.uint8))["error", "grid"]


@pytest.fixture
def room(data, tmp_path):
    shutil.copytree(data / "rgbd_3dmatch", tmp_path / "room")
    return tmp_path / "room"


def test_room_is_clean(data):
    diagnosis = examine(load_sequence("rgbd", data / "rgbd_3dmatch"))
    assert diagnosis.clean, bad(diagnosis)


def test_room_with_inverted_poses(room):
    for file in room.rglob("*.pose.txt"):
        np.savetxt(file, np.linalg.inv(np.loadtxt(file)))
    found = bad(examine(load_sequence("rgbd", room)))
    assert "inverted" in found["error", "poses"]


def test_room_with_axes_of_opengl(room):
    for file in room.rglob("*.pose.txt"):
        np.savetxt(file, np.loadtxt(file) @ np.diag([1, -1, -1, 1]))
    found = bad(examine(load_sequence("rgbd", room)))
    assert "OpenGL" in found["error", "poses"]


@pytest.mark.parametrize("scale", [100, 10000])
def test_room_with_another_depth_scale(room, scale):
    found = bad(examine(load_sequence("rgbd", room, depth_scale=scale)))
    assert f"{scale / 1000:g} times as large" in found["error", "depth scale"]


def test_room_with_swapped_grids(room):
    """Grids fused of the depth itself, in the ego frame of each camera, with x and y swapped."""
    spec = GridSpec((-6.4, -6.4, -6.4), 0.1, (128, 128, 128))
    sequence = join_fused(load_sequence("rgbd", room), spec=spec)
    assert not bad(examine(sequence))

    def swap(frame):
        grid = frame.occupancy
        turn = (1, 0, 2)
        swapped = replace(grid, labels=grid.labels.transpose(turn), known=grid.known.transpose(turn))
        return replace(frame, occupancy=swapped)

    assert "yxz" in bad(examine(sequence.map(swap)))["error", "grid axes"]


def test_damaged_files_are_named(room):
    image = next(room.rglob("frame-000001.color.png"))
    image.write_bytes(image.read_bytes()[:5000])
    next(room.rglob("frame-000116.depth.png")).unlink()
    found = examine(load_sequence("rgbd", room))
    text = " ".join(f.what + f.why for f in found.findings if f.level == "error")
    assert "frame-000001.color.png is truncated" in text
    assert "frame-000116.depth.png" in text
    assert not found.clean


def test_report_is_a_page_with_pictures(room, tmp_path):
    examine(load_sequence("rgbd", room)).write_report(tmp_path / "report")
    page = (tmp_path / "report" / "index.html").read_text()
    for name in ("depth_agreement.png", "from_above.png"):
        assert f'src="{name}"' in page
        assert cv2.imread(str(tmp_path / "report" / name)) is not None
