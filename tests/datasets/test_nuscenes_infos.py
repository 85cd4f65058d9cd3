"""A real keyframe: what its poses say must agree with its pixels, its boxes and its sweep."""

import copy
import json
import shutil

import numpy as np
import pytest

from openvocab_occ.datasets import load_sequence
from openvocab_occ.errors import ConfigError, DataError, NotFoundError, PoseError, ShapeError
from openvocab_occ.geometry import invert, transform
from openvocab_occ.io.images import write_image

CHANNELS = ["CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"]


@pytest.mark.data
def test_boxes_project_where_the_file_says(keyframe):
    """`cam_instances` holds each box's projected centre and depth, computed by the makers of the file."""
    entry = json.loads((keyframe / "info.json").read_text())["data_list"][0]
    frame = load_sequence("nuscenes-infos", keyframe)[0]
    assert [view.name for view in frame.views] == CHANNELS
    checked = 0
    for view in frame.views:
        T_cam_world = invert(view.camera.T_world_cam)
        boxes = {i["bbox_label"]: [] for i in entry["instances"]}
        for instance in entry["instances"]:
            x, y, z = instance["bbox_3d"][:3]
            center = transform(frame.poses["lidar"], np.array([[x, y, z]]))
            boxes[instance["bbox_label"]].append(transform(T_cam_world, center)[0])
        for told in entry["cam_instances"][view.name]:
            near = np.array(boxes[told["bbox_label"]])
            gap = np.abs(near[:, 2] - told["depth"])
            x, y, z = view.camera.K @ near[gap.argmin()]
            assert gap.min() < 0.05
            assert np.hypot(x / z - told["center_2d"][0], y / z - told["center_2d"][1]) < 3  # pixels
            checked += 1
    assert checked > 50


@pytest.mark.data
def test_frames_of_the_rig(keyframe):
    frame = load_sequence("nuscenes-infos", keyframe)[0]
    assert frame.points is not None
    assert frame.points.shape == (34688, 3)
    ground = np.median(frame.points[np.hypot(*frame.points[:, :2].T) < 15][:, 2])
    assert abs(ground) < 0.3  # ego stands on the ground
    np.testing.assert_allclose(frame.poses["lidar_ego"], frame.T_world_ego)
    # the vehicle drove some decimetres, forward only, between the front left camera and the LiDAR
    moved = invert(frame.T_world_ego) @ frame.poses["cam_front_left_ego"]
    assert -0.6 < moved[0, 3] < -0.2
    assert np.abs(moved[1:3, 3]).max() < 0.03
    np.testing.assert_allclose(invert(frame.T_world_ego) @ frame.poses["lidar"], frame_lidar2ego(keyframe), atol=1e-4)


def frame_lidar2ego(keyframe):
    return json.loads((keyframe / "info.json").read_text())["data_list"][0]["lidar_points"]["lidar2ego"]


@pytest.mark.data
def test_pickle_and_json_give_the_same_frame(keyframe):
    (pickled,) = keyframe.glob("*.pkl")
    a, b = (load_sequence("nuscenes-infos", path, cameras=["CAM_BACK"])[0] for path in (pickled, keyframe))
    assert a.token == b.token
    assert a.timestamp == b.timestamp == pytest.approx(1532402927.647951)
    np.testing.assert_array_equal(a.views[0].camera.T_world_cam, b.views[0].camera.T_world_cam)
    np.testing.assert_array_equal(a.points, b.points)


def pose(x=0.0):
    T = np.eye(4)
    T[0, 3] = x
    return T.tolist()


def entry():
    return {
        "sample_idx": 0,
        "token": "abc",
        "timestamp": 10.5,
        "ego2global": pose(100),
        "images": {
            "CAM_FRONT": {"img_path": "f.png", "cam2img": [[8, 0, 3], [0, 8, 2], [0, 0, 1]], "cam2ego": pose(1)}
        },
        "lidar_points": {"num_pts_feats": 5, "lidar_path": "s.bin", "lidar2ego": pose(2)},
    }


@pytest.fixture
def write(tmp_path):
    write_image(tmp_path / "f.png", np.zeros((5, 7, 3), np.uint8))
    np.ones((4, 5), "<f4").tofile(tmp_path / "s.bin")

    def write(*entries, **changes):
        content = {"metainfo": {}, "data_list": list(entries), **changes}
        (tmp_path / "info.json").write_text(json.dumps({k: v for k, v in content.items() if v is not None}))
        return tmp_path

    return write


def changed(path, value):
    e = copy.deepcopy(entry())
    *way, last = path.split("/")
    inner = e
    for key in way:
        inner = inner[key]
    if value is None:
        del inner[last]
    else:
        inner[last] = value
    return e


def test_made_up_frame_without_lidar2cam(write):
    frame = load_sequence("nuscenes-infos", write(entry()))[0]
    assert frame.views[0].camera.position.tolist() == [101, 0, 0]
    assert frame.points is not None
    assert frame.points.tolist() == [[3, 1, 1]] * 4
    assert "cam_front_left_ego" not in frame.poses


def test_microseconds_become_seconds(write):
    assert load_sequence("nuscenes-infos", write(changed("timestamp", 1.5e15)))[0].timestamp == 1.5e9


NAN = np.full((4, 4), np.nan).tolist()
STRETCHED = np.diag([2, 2, 2, 1]).tolist()


@pytest.mark.parametrize(
    ("path", "value", "error", "message"),
    [
        ("ego2global", NAN, PoseError, r"ego2global of frame 0 \(abc\) holds NaN"),
        ("images/CAM_FRONT/cam2ego", STRETCHED, PoseError, "not a rotation"),
        ("lidar_points/lidar2ego", [[1, 0], [0, 1]], ShapeError, "lidar2ego of lidar_points of frame 0"),
        ("ego2global", None, DataError, "lacks ego2global"),
        ("images/CAM_FRONT/cam2img", None, DataError, r"CAM_FRONT of frame 0 \(abc\) lacks cam2img"),
        ("images/CAM_FRONT/img_path", "gone.png", NotFoundError, r"image of CAM_FRONT .* not found.*gone\.png"),
        ("lidar_points/lidar_path", "gone.bin", NotFoundError, r"LiDAR sweep .* not found.*gone\.bin"),
        ("lidar_points/num_pts_feats", 3, DataError, "cut off or of another kind"),
    ],
)  # fmt: skip
def test_bad_frames_name_what_is_wrong(write, path, value, error, message):
    sequence = load_sequence("nuscenes-infos", write(changed(path, value)))
    with pytest.raises(error, match=message):
        sequence[0]


def test_bad_files(write, tmp_path):
    with pytest.raises(DataError, match=r"older layout.*update_infos_to_v2"):
        load_sequence("nuscenes-infos", write(data_list=None, infos=[]))
    with pytest.raises(DataError, match="no info file: expected the key data_list"):
        load_sequence("nuscenes-infos", write(data_list=None))
    (tmp_path / "info.json").write_text("{")
    with pytest.raises(DataError, match="is not JSON"):
        load_sequence("nuscenes-infos", tmp_path)
    shutil.move(tmp_path / "info.json", tmp_path / "b.json")
    (tmp_path / "a.json").write_text("{}")
    with pytest.raises(ConfigError, match=r"several info files.*a\.json, b\.json"):
        load_sequence("nuscenes-infos", tmp_path)
    with pytest.raises(NotFoundError, match="info file or folder not found"):
        load_sequence("nuscenes-infos", tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(NotFoundError, match="no info file"):
        load_sequence("nuscenes-infos", tmp_path / "empty")


def test_scenes_and_cameras_by_name(write):
    folder = write({**entry(), "scene_token": "s1"}, {**entry(), "scene_token": "s2", "token": "second"})
    sequence = load_sequence("nuscenes-infos", folder, scene="s2")
    assert [frame.token for frame in sequence] == ["second"]
    assert sequence.name == "s2"
    with pytest.raises(ConfigError, match="no scene 's3': expected s1, s2"):
        load_sequence("nuscenes-infos", folder, scene="s3")
    with pytest.raises(ConfigError, match="no camera CAM_TOP: expected CAM_FRONT"):
        load_sequence("nuscenes-infos", folder, cameras=["CAM_TOP"])[0]
    with pytest.raises(ConfigError, match="nuscenes-infos has no option 'fast': expected cameras"):
        load_sequence("nuscenes-infos", folder, fast=True)
    with pytest.raises(ConfigError, match=r"kind of sequence is not known: expected city or .*, got 'kitty'"):
        load_sequence("kitty", folder)
