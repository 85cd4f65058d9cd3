"""A hand-made nuScenes tree of one rig whose geometry is known, and what is wrong with trees in practice."""

import json
import shutil

import numpy as np
import pytest

from openvocab_occ.datasets import load_sequence
from openvocab_occ.errors import ConfigError, DataError, NotFoundError
from openvocab_occ.geometry import invert, pose, transform, wxyz_from_matrix
from openvocab_occ.io.images import write_image
from openvocab_occ.occupancy import OCC3D_FREE, OCC3D_SPEC, OccupancyGrid, write_occ3d

FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # camera axes in the ego frame, looking along x
CHANNELS = {"CAM_FRONT": ((1.5, 0.0, 1.6), 0.0), "CAM_FRONT_LEFT": ((1.4, 0.5, 1.6), 55.0)}
LIDAR_MOUNT = pose((0.9, 0.0, 1.8), (0.7071067811865476, 0, 0, -0.7071067811865476))  # x right, y forward
K = [[40.0, 0, 31.5], [0, 40.0, 17.5], [0, 0, 1]]


def ego(frame, late=0.0):
    """The vehicle drives along a bend; `late` seconds after the keyframe it has moved on by 10 m/s."""
    yaw = 0.3 + 0.1 * frame
    T = pose((100 + 5 * frame, 200 + frame, 0), (np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)))
    return T @ pose((10 * late, 0, 0))


def mount(channel):
    position, yaw = CHANNELS[channel]
    yaw = np.deg2rad(yaw)
    T = pose(position, (np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)))
    T[:3, :3] = T[:3, :3] @ FORWARD
    return T


def row(T, **more):
    return {"translation": T[:3, 3].tolist(), "rotation": wxyz_from_matrix(T[:3, :3]).tolist(), **more}


def write_tree(root, *, scenes=("scene-0001", "scene-0002"), frames=3, lidar=True, version="v1.0-mini", shuffled=True):
    tables = {name: [] for name in ("scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor", "log")}
    tables["log"] = [{"token": "log", "logfile": "n1", "vehicle": "n", "date_captured": "d", "location": "boston"}]
    sensors = [*CHANNELS, "LIDAR_TOP"]
    for name in sensors:
        T, intrinsic = (LIDAR_MOUNT, []) if name == "LIDAR_TOP" else (mount(name), K)
        tables["sensor"].append({"token": f"s-{name}", "channel": name, "modality": "x"})
        tables["calibrated_sensor"].append(
            row(T, token=f"m-{name}", sensor_token=f"s-{name}", camera_intrinsic=intrinsic)
        )
        if name != "LIDAR_TOP" or lidar:
            (root / "samples" / name).mkdir(parents=True)
    for s, scene in enumerate(scenes):
        tables["scene"].append(
            {"token": f"t{s}", "name": scene, "log_token": "log", "description": "Rain", "nbr_samples": 1}
        )
        for i in range(frames):
            token = f"{scene}-{i}"
            stamp = 1_000_000_000_000_000 + s * 10_000_000 + i * 500_000
            tables["sample"].append(
                {"token": token, "timestamp": stamp, "scene_token": f"t{s}", "prev": "", "next": ""}
            )
            for n, name in enumerate(sensors):
                late = 0.0 if name == "LIDAR_TOP" else -0.01 * (n + 1)
                file = f"samples/{name}/{token}.{'bin' if name == 'LIDAR_TOP' else 'png'}"
                tables["ego_pose"].append(row(ego(i, late), token=f"e-{token}-{name}", timestamp=stamp))
                tables["sample_data"].append({
                    "token": f"d-{token}-{name}", "sample_token": token, "ego_pose_token": f"e-{token}-{name}",
                    "calibrated_sensor_token": f"m-{name}", "filename": file, "timestamp": stamp, "is_key_frame": True,
                    "width": 64, "height": 36,
                })  # fmt: skip
                if name != "LIDAR_TOP":
                    write_image(root / file, np.full((36, 64, 3), 10 * i, np.uint8))
                elif lidar:
                    sweep = np.zeros((2, 5), "<f4")
                    sweep[0, :3] = transform(invert(LIDAR_MOUNT), np.array([[10.0, 1.0, 0.5]]))[0]
                    sweep[1, 0] = np.nan
                    sweep.tofile(root / file)
            tables["sample_data"].append({**tables["sample_data"][-1], "is_key_frame": False, "filename": "sweeps/x"})
    if shuffled:
        for name in ("sample", "sample_data", "ego_pose"):
            tables[name].reverse()
    (root / version).mkdir(parents=True)
    for name, rows in tables.items():
        (root / version / f"{name}.json").write_text(json.dumps(rows))
    return root


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return write_tree(tmp_path_factory.mktemp("nuscenes"))


@pytest.fixture
def tree(made, tmp_path):
    return shutil.copytree(made, tmp_path / "tree")


def test_a_known_point_falls_on_its_pixel(tree):
    sequence = load_sequence("nuscenes", tree, scene="scene-0002")
    assert len(sequence) == 3
    assert sequence.name == "scene-0002"
    assert sequence.info["location"] == "boston"
    for i, frame in enumerate(sequence):
        assert frame.token == f"scene-0002-{i}"  # in order of time, though the tables are not
        assert frame.views[0].image.max() == 10 * i
        np.testing.assert_allclose(frame.T_world_ego, ego(i), atol=1e-9)
        for n, view in enumerate(frame.views):
            # a point 12 m in front of the camera, where the vehicle was when it took the picture
            local = np.array([[1.2, -0.6, 12.0]])
            world = transform(ego(i, -0.01 * (n + 1)) @ mount(view.name), local)
            pixels, depth = view.camera.project(world)
            np.testing.assert_allclose(pixels[0], [31.5 + 4.0, 17.5 - 2.0], atol=1e-6)
            assert depth[0] == pytest.approx(12.0)
        np.testing.assert_allclose(frame.points, [[10.0, 1.0, 0.5]], atol=1e-5)  # the NaN is left out
        np.testing.assert_allclose(frame.poses["lidar"], ego(i) @ LIDAR_MOUNT, atol=1e-9)
        np.testing.assert_allclose(frame.poses["cam_front_left_ego"], ego(i, -0.02), atol=1e-9)
        assert frame.timestamp == pytest.approx(1_000_000_010 + 0.5 * i)


def test_official_splits(tree):
    scenes = tree / "v1.0-mini" / "scene.json"
    scenes.write_text(scenes.read_text().replace("scene-0002", "scene-1073"))
    (tree / "v1.0-mini").rename(tree / "v1.0-trainval")
    assert {f.token[:10] for f in load_sequence("nuscenes", tree, split="train")} == {"scene-0001"}
    assert len(load_sequence("nuscenes", tree, split="val")) == 3
    (tree / "v1.0-trainval").rename(tree / "v1.0-test")
    assert len(load_sequence("nuscenes", tree, split="test")) == 6


def test_scenes_splits_and_versions(tree):
    assert len(load_sequence("nuscenes", tree)) == 6
    assert load_sequence("nuscenes", tree, scene="t0").name == "scene-0001"
    with pytest.raises(ConfigError, match="has no scene 'scene-9': expected scene-0001, scene-0002"):
        load_sequence("nuscenes", tree, scene="scene-9")
    assert len(load_sequence("nuscenes", tree, split="train")) == 6  # of v1.0-mini, all but two scenes
    assert len(load_sequence("nuscenes", tree, split="val")) == 0
    with pytest.raises(ConfigError, match="v1.0-mini has no split 'test': expected train or val"):
        load_sequence("nuscenes", tree, split="test")
    (tree / "annotations.json").write_text(json.dumps({"train_split": ["scene-0001"], "val_split": ["scene-0002"]}))
    assert [f.token for f in load_sequence("nuscenes", tree, split="val")] == [f"scene-0002-{i}" for i in range(3)]
    with pytest.raises(ConfigError, match="has no split 'test': expected train or val"):
        load_sequence("nuscenes", tree, split="test")
    shutil.copytree(tree / "v1.0-mini", tree / "v1.0-trainval")
    with pytest.raises(ConfigError, match=r"several versions: expected version=, got v1\.0-mini, v1\.0-trainval"):
        load_sequence("nuscenes", tree)
    assert len(load_sequence("nuscenes", tree, version="v1.0-trainval")) == 6


def test_labels_and_own_predictions(tree):
    labels = np.full(OCC3D_SPEC.shape, OCC3D_FREE, np.uint8)
    labels[150, 100, 3] = 4
    for i in range(3):
        grid = OccupancyGrid(labels, OCC3D_SPEC)
        write_occ3d(tree / "gts" / "scene-0001" / f"scene-0001-{i}" / "labels.npz", grid)
    sequence = load_sequence("nuscenes", tree, scene="scene-0001", cameras=["CAM_FRONT"])
    frame = sequence[1]
    assert frame.occupancy is not None
    (car,) = np.flatnonzero(frame.occupancy.occupied)
    center = frame.occupancy.centers(np.array([car]))
    np.testing.assert_allclose(center, transform(ego(1), np.array([[20.2, 0.2, 0.4]])), atol=1e-9)
    assert (tree / "gts/scene-0001/scene-0001-1/labels.npz") in sequence.files(1)
    assert load_sequence("nuscenes", tree, scene="scene-0001", labels=False)[0].occupancy is None
    assert load_sequence("nuscenes", tree, scene="scene-0002")[0].occupancy is None  # has no folder
    np.savez(tree / "mine.npz", pred=labels)
    with pytest.raises(ConfigError, match="one file for 3 frames"):
        load_sequence("nuscenes", tree, scene="scene-0001", occupancy="mine.npz")


@pytest.mark.parametrize("kind", ["lidar", "cam_front_left_ego", "lidar_ego", "world"])
def test_own_predictions_in_any_frame(tree, kind):
    np.savez(tree / "scene-0002-1.npz", pred=np.full(OCC3D_SPEC.shape, OCC3D_FREE, np.uint8))
    sequence = load_sequence("nuscenes", tree, scene="scene-0002", occupancy="{token}.npz", occupancy_frame=kind)
    wanted = {
        "lidar": ego(1) @ LIDAR_MOUNT,
        "cam_front_left_ego": ego(1, -0.02),
        "lidar_ego": ego(1),
        "world": np.eye(4),
    }
    np.testing.assert_allclose(sequence[1].occupancy.T_world_grid, wanted[kind], atol=1e-9)


def test_missing_parts_and_dangling_files(tree):
    sequence = load_sequence("nuscenes", tree, scene="scene-0001")
    image = tree / "samples" / "CAM_FRONT" / "scene-0001-1.png"
    assert image in sequence.files(1)
    image.write_bytes(image.read_bytes()[:-20])
    with pytest.raises(DataError, match=r"scene-0001-1\.png is truncated"):
        sequence[1]
    image.unlink()
    with pytest.raises(NotFoundError, match=r"image not found.*scene-0001-1\.png"):
        sequence[1]
    assert len(sequence[0].views) == 2  # the others are not touched
    sweep = tree / "samples" / "LIDAR_TOP" / "scene-0001-0.bin"
    sweep.write_bytes(sweep.read_bytes()[:-3])
    with pytest.raises(DataError, match="cut off"):
        sequence[0]
    shutil.rmtree(tree / "samples" / "LIDAR_TOP")
    frame = load_sequence("nuscenes", tree, scene="scene-0001")[0]
    assert frame.points is None
    assert "lidar" in frame.poses
    with pytest.raises(ConfigError, match="no camera CAM_TOP: expected CAM_FRONT"):
        load_sequence("nuscenes", tree, cameras=["CAM_TOP"])[0]


def test_damaged_tables(tree):
    poses = tree / "v1.0-mini" / "ego_pose.json"
    poses.write_text("[]")
    with pytest.raises(DataError, match="table ego_pose lacks a row"):
        load_sequence("nuscenes", tree)[0]
    poses.write_text(json.dumps([{"token": "x"}]))
    with pytest.raises(DataError, match=r"ego_pose\.json cannot be read.*translation"):
        load_sequence("nuscenes", tree)
    with pytest.raises(NotFoundError, match="no nuScenes tables"):
        load_sequence("nuscenes", tree / "samples")


def test_an_empty_scene_has_no_frames(tmp_path):
    tree = write_tree(tmp_path, frames=0)
    assert len(load_sequence("nuscenes", tree, scene="scene-0001")) == 0
    assert list(load_sequence("nuscenes", tree)) == []


def test_ten_thousand_frames_open_without_reading_any(made, tmp_path):
    """No image of the later frames exists: opening, slicing and asking for names must not look for them."""
    source = made / "v1.0-mini"
    shutil.copytree(source, tmp_path / "v1.0-mini")
    tables = {name: json.loads((source / f"{name}.json").read_text()) for name in ("sample", "sample_data", "ego_pose")}
    one = [d for d in tables["sample_data"] if d["sample_token"] == "scene-0001-0" and d["is_key_frame"]]
    for i in range(10_000):
        stamp = 2_000_000_000_000_000 + i
        tables["sample"].append({**tables["sample"][0], "token": f"x{i}", "timestamp": stamp, "scene_token": "t0"})
        tables["sample_data"] += [{**d, "token": f"x{i}", "sample_token": f"x{i}", "filename": "gone"} for d in one]
    for name, rows in tables.items():
        (tmp_path / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    sequence = load_sequence("nuscenes", tmp_path, scene="scene-0001")
    assert len(sequence) == 10_003
    assert len(sequence[5_000:]) == 5_003
    assert sequence.files(9_000)[0].name == "gone"
    with pytest.raises(NotFoundError):
        sequence[9_000]
