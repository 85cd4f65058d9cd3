"""The written tree: whole, the same when resumed, linked as nuScenes' is."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from openvocab_occ.cli import main
from openvocab_occ.datasets.city import writer
from openvocab_occ.datasets.city.sensors import T_EGO_LIDAR
from openvocab_occ.datasets.city.writer import CityOptions, write_city
from openvocab_occ.errors import AlreadyExistsError, ConfigError
from openvocab_occ.geometry import Camera, pose, transform
from openvocab_occ.io.images import read_image
from openvocab_occ.occupancy import read_occ3d

OPTIONS = CityOptions(seed=7, traversals=2, conditions=("clear", "night"), frames=2, size=(128, 48), truth=True)


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("city") / "tree"
    report = write_city(root, OPTIONS)
    assert report["written"] == report["keyframes"] == 4
    return root


def table(tree: Path, name: str) -> list[dict]:
    return json.loads((tree / "v1.0-city" / f"{name}.json").read_text())


def digests(tree: Path) -> dict[str, str]:
    return {str(f.relative_to(tree)): hashlib.md5(f.read_bytes()).hexdigest() for f in tree.rglob("*") if f.is_file()}


def test_stopped_and_resumed_equals_one_pass(tree, tmp_path, monkeypatch):
    class Stopped(Exception):
        pass

    def stop(done, total):
        if done == 3:
            raise Stopped

    with pytest.raises(Stopped):
        write_city(tmp_path / "again", OPTIONS, progress=stop)
    assert not (tmp_path / "again" / "v1.0-city").exists()
    assert write_city(tmp_path / "again", OPTIONS)["written"] == 1
    assert digests(tmp_path / "again") == digests(tree)
    monkeypatch.setattr(writer, "_write_keyframe", None)  # nothing is written twice
    assert write_city(tmp_path / "again", OPTIONS)["written"] == 0


def test_tokens_link(tree):
    names = "scene sample sample_data ego_pose calibrated_sensor sensor log map category attribute instance visibility"
    rows = {name: table(tree, name) for name in [*names.split(), "sample_annotation"]}
    tokens = {name: {row["token"] for row in own} for name, own in rows.items()}
    assert all(len(tokens[name]) == len(own) for name, own in rows.items())
    for name, key, other in (
        ("scene", "log_token", "log"), ("scene", "first_sample_token", "sample"), ("sample", "scene_token", "scene"),
        ("sample_data", "sample_token", "sample"), ("sample_data", "ego_pose_token", "ego_pose"),
        ("sample_data", "calibrated_sensor_token", "calibrated_sensor"),
        ("calibrated_sensor", "sensor_token", "sensor"),
        ("sample_annotation", "sample_token", "sample"), ("sample_annotation", "instance_token", "instance"),
        ("sample_annotation", "visibility_token", "visibility"), ("instance", "category_token", "category"),
        ("instance", "first_annotation_token", "sample_annotation"),
    ):  # fmt: skip
        assert {row[key] for row in rows[name]} <= tokens[other], (name, key)
    for name in ("sample", "sample_data", "sample_annotation"):
        by_token = {row["token"]: row for row in rows[name]}
        for row in rows[name]:
            assert not row["next"] or by_token[row["next"]]["prev"] == row["token"]
    assert {t for row in rows["sample_annotation"] for t in row["attribute_tokens"]} <= tokens["attribute"]
    for row in rows["sample_data"]:
        assert (tree / row["filename"]).is_file()
    assert (tree / rows["map"][0]["filename"]).is_file()


def test_boxes_of_the_tables_are_in_the_pictures(tree):
    """Annotations with LiDAR points, projected as nuScenes' users do, meet their instance in the truth images."""
    sensors = {row["token"]: row["channel"] for row in table(tree, "sensor")}
    mounts = {row["token"]: row for row in table(tree, "calibrated_sensor")}
    egos = {row["token"]: row for row in table(tree, "ego_pose")}
    boxes = table(tree, "sample_annotation")
    met = total = 0
    for data in table(tree, "sample_data"):
        mount = mounts[data["calibrated_sensor_token"]]
        channel = sensors[mount["sensor_token"]]
        if not mount["camera_intrinsic"]:
            continue
        ego = egos[data["ego_pose_token"]]
        T = pose(ego["translation"], ego["rotation"]) @ pose(mount["translation"], mount["rotation"])
        camera = Camera(np.array(mount["camera_intrinsic"]), data["width"], data["height"], T)
        assert read_image(tree / data["filename"]).shape == (48, 128, 3)
        truth = np.load(tree / "truth" / channel / f"{Path(data['filename']).stem}.npz")
        for box in boxes:
            own = np.argwhere(truth["instance"] == box["id"])
            if box["sample_token"] != data["sample_token"] or len(own) < 6:
                continue
            w, length, h = box["size"]
            corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * (length, w, h) / 2
            pixels, depth = camera.project(transform(pose(box["translation"], box["rotation"]), corners))
            if (depth < 0.5).any():
                continue
            total += 1
            low, high = np.floor(pixels.min(axis=0)) - 1, np.ceil(pixels.max(axis=0)) + 1
            met += ((own[:, ::-1] >= low) & (own[:, ::-1] <= high)).all()
    assert total > 10
    assert met / total > 0.95


def test_sweeps_and_labels(tree):
    mounts = {row["token"]: row for row in table(tree, "calibrated_sensor")}
    sample = {row["token"]: row for row in table(tree, "sample")}
    names = {row["token"]: row["name"] for row in table(tree, "scene")}
    sweeps = [row for row in table(tree, "sample_data") if row["fileformat"] == "pcd"]
    assert len(sweeps) == 4
    for row in sweeps:
        points = np.fromfile(tree / row["filename"], "<f4").reshape(-1, 5)
        assert set(points[:, 4]) == set(range(32))
        mount = mounts[row["calibrated_sensor_token"]]
        np.testing.assert_allclose(pose(mount["translation"], mount["rotation"]), T_EGO_LIDAR, atol=1e-12)
        assert sample[row["sample_token"]]["timestamp"] == row["timestamp"]
        scene = names[sample[row["sample_token"]]["scene_token"]]
        grid = read_occ3d(tree / "gts" / scene / row["sample_token"] / "labels.npz")
        flat = grid.spec.flat(grid.spec.index(transform(T_EGO_LIDAR, points[:, :3])))
        # the rest lies in voxels that a surface fills too little to be theirs
        assert grid.occupied.reshape(-1)[flat[flat >= 0]].mean() > 0.97


def test_pictures_for_people(tree):
    for name in ("sheets/city-7-r0-t0.png", "maps/city-7.png"):
        image = read_image(tree / name)
        assert min(image.shape[:2]) > 200
        assert len(np.unique(image.reshape(-1, 3), axis=0)) > 5
    assert {"lanes"} == set(json.loads((tree / "lanes.json").read_text()))
    splits = json.loads((tree / "annotations.json").read_text())
    assert splits == {"train_split": ["city-7-r0-t0"], "val_split": ["city-7-r0-t1"]}


def test_what_is_refused(tree, tmp_path):
    (tmp_path / "mine.txt").write_text("x")
    with pytest.raises(AlreadyExistsError, match="is not empty: expected a new folder"):
        write_city(tmp_path, OPTIONS)
    with pytest.raises(AlreadyExistsError, match="other options: expected the same seed, got seed 7"):
        write_city(tree, CityOptions(seed=8, traversals=2, conditions=("clear", "night"), frames=2, size=(128, 48),
                                     truth=True))  # fmt: skip
    with pytest.raises(ConfigError, match="1 to 40 frames, got 0"):
        CityOptions(frames=0)
    with pytest.raises(ConfigError, match="nothing to write"):
        CityOptions(routes=0)
    with pytest.raises(ConfigError, match="condition is not known"):
        CityOptions(conditions=("snow",))


def test_command(tree, capsys):
    options = ["--seed", "7", "--routes", "1", "--traversals", "2", "--conditions", "clear", "night", "--frames", "2"]
    assert main(["city", "--out", str(tree), *options, "--size", "128", "48", "--truth", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["scenes"] == ["city-7-r0-t0", "city-7-r0-t1"]
    assert report["synthetic"]
    assert main(["city", "--out", str(tree), "--frames", "3"]) == 2
