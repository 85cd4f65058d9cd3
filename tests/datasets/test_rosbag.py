"""Bags of ROS 1, ROS 2 and MCAP, written here: a vehicle that drives along x, its camera, its LiDAR and its TF."""

import cv2
import numpy as np
import pytest

from openvocab_occ.datasets import load_sequence
from openvocab_occ.errors import ConfigError, DataError, NotFoundError
from openvocab_occ.geometry import pose, transform, wxyz_from_matrix

rosbags = pytest.importorskip("rosbags", reason="the extra ros is not installed")
from rosbags import rosbag1, rosbag2  # noqa: E402
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402

TF = "tf2_msgs/msg/TFMessage"
KINDS = ("ros1", "sqlite3", "mcap")
K = [40.0, 0, 31.5, 0, 40.0, 17.5, 0, 0, 1]
T_EGO_CAM = np.array([[0.0, 0, 1, 1.5], [-1, 0, 0, 0.2], [0, -1, 0, 1.6], [0, 0, 0, 1]])
T_EGO_LIDAR = pose((0.9, 0, 1.8), (0.7071067811865476, 0, 0, -0.7071067811865476))
SPEED = 8.0
START = 1_700_000_000.0


def ego(time):
    """Driving along x; a slow bend is left out so that interpolation is exact."""
    return pose((SPEED * (time - START), 3.0, 0.0), (np.cos(0.2), 0, 0, np.sin(0.2)))


class Bag:
    """Writes messages of either version of ROS."""

    def __init__(self, kind, path):
        self.ros1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:  # tf2_msgs is no part of rosbags' ROS 1 types
            self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
        self.types = self.store.types
        if self.ros1:
            self.writer = rosbag1.Writer(path.with_suffix(".bag"))
            self.path = path.with_suffix(".bag")
        else:
            plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
            self.writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
            self.path = path
        self.connections = {}

    def header(self, time, frame):
        sec = int(time // 1)
        stamp = self.types["builtin_interfaces/msg/Time"](sec, round((time - sec) * 1e9))
        extra = {"seq": 0} if self.ros1 else {}
        return self.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **extra)

    def write(self, topic, name, time, **fields):
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        message = self.types[name](**fields)
        pack = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], round(time * 1e9), pack(message, name))

    def transform(self, topic, parent, child, time, T):
        q = wxyz_from_matrix(T[:3, :3])
        link = self.types["geometry_msgs/msg/TransformStamped"](
            header=self.header(time, parent), child_frame_id=child,
            transform=self.types["geometry_msgs/msg/Transform"](
                translation=self.types["geometry_msgs/msg/Vector3"](*map(float, T[:3, 3])),
                rotation=self.types["geometry_msgs/msg/Quaternion"](float(q[1]), float(q[2]), float(q[3]), float(q[0])),
            ),
        )  # fmt: skip
        self.write(topic, "tf2_msgs/msg/TFMessage", time, transforms=[link])

    def info(self, topic, time, model="plumb_bob", D=()):
        roi = self.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        names = "DKRP" if self.ros1 else "dkrp"
        values = (np.array(D, float), np.array(K), np.eye(3).ravel(), np.zeros(12))
        self.write(topic, "sensor_msgs/msg/CameraInfo", time, header=self.header(time, "cam"), height=36, width=64,
                   distortion_model=model, binning_x=0, binning_y=0, roi=roi,
                   **dict(zip(names, values, strict=True)))  # fmt: skip

    def image(self, topic, time, pixels, encoding, *, padding=0, frame="cam"):
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(pixels.shape[0], -1)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        self.write(topic, "sensor_msgs/msg/Image", time, header=self.header(time, frame), height=pixels.shape[0],
                   width=pixels.shape[1], encoding=encoding, is_bigendian=0, step=rows.shape[1],
                   data=rows.ravel())  # fmt: skip

    def cloud(self, topic, time, points):
        field = self.types["sensor_msgs/msg/PointField"]
        fields = [field(name=n, offset=4 + 4 * i, datatype=7, count=1) for i, n in enumerate("xyz")]
        data = np.zeros((len(points), 5), "<f4")
        data[:, 1:4] = points
        self.write(topic, "sensor_msgs/msg/PointCloud2", time, header=self.header(time, "lidar"), height=1,
                   width=len(points), fields=fields, is_bigendian=False, point_step=20, row_step=20 * len(points),
                   data=data.view(np.uint8).ravel(), is_dense=True)  # fmt: skip


IMAGE = np.zeros((36, 64, 3), np.uint8)
IMAGE[..., 0], IMAGE[..., 2] = 200, 50  # RGB


def fill(bag, *, tf=True):
    """Images every 0.1 s, but for one; sweeps 30 ms later; TF at 20 Hz, between the stamps of the images."""
    _, jpeg = cv2.imencode(".png", IMAGE[..., ::-1])
    bag.transform("/tf_static", "base_link", "cam", START, T_EGO_CAM)
    bag.transform("/tf_static", "base_link", "lidar", START, T_EGO_LIDAR)
    for k in range(-2, 12):
        time = START + 0.025 + 0.05 * k
        if tf:
            bag.transform("/tf", "map", "odom", time, np.eye(4))
            bag.transform("/tf", "odom", "base_link", time, ego(time))
    for i in (1, 0, 2, 3):  # one message comes late
        time = START + 0.1 * i
        bag.info("/cam/camera_info", time)
        bag.image("/cam/image_raw", time, IMAGE[..., ::-1], "bgr8", padding=3)
        if i != 2:
            bag.write("/right/image/compressed", "sensor_msgs/msg/CompressedImage", time + 0.01,
                      header=bag.header(time + 0.01, "cam"), format="png", data=jpeg.ravel())  # fmt: skip
            bag.info("/right/camera_info", time)
        bag.image("/cam/depth", time, np.full((36, 64), 2500, np.uint16), "16UC1")
        point = transform(np.linalg.inv(ego(time + 0.03) @ T_EGO_LIDAR), np.array([[12.0, 4.0, 1.0]]))
        bag.cloud("/points", time + 0.03, np.concatenate([point, [[np.nan, 0, 0]]]))


@pytest.fixture(params=KINDS)
def bag(request, tmp_path):
    made = Bag(request.param, tmp_path / "drive")
    with made.writer:
        fill(made)
    return made.path


def test_a_known_point_falls_on_its_pixel(bag):
    sequence = load_sequence("rosbag", bag)
    assert len(sequence) == 4
    for i, frame in enumerate(sequence):
        time = START + 0.1 * i
        assert frame.timestamp == pytest.approx(time)  # in order of stamps
        np.testing.assert_allclose(frame.T_world_ego, ego(time), atol=1e-5)
        assert [v.name for v in frame.views] == ["/cam/image_raw", "/right/image/compressed"][: 1 if i == 2 else 2]
        for view, late in zip(frame.views, (0.0, 0.01), strict=False):
            np.testing.assert_array_equal(view.image, IMAGE)
            np.testing.assert_allclose(view.camera.T_world_cam, ego(time + late) @ T_EGO_CAM, atol=1e-5)
            local = np.array([[1.2, -0.6, 12.0]])
            pixels, _ = view.camera.project(transform(ego(time + late) @ T_EGO_CAM, local))
            np.testing.assert_allclose(pixels, [[31.5 + 4, 17.5 - 2]], atol=1e-3)
        # the standing point, in the ego frame of the image, whenever the sweep was
        np.testing.assert_allclose(transform(frame.T_world_ego, frame.points), [[12.0, 4.0, 1.0]], atol=1e-4)
        np.testing.assert_allclose(frame.poses["lidar"], ego(time + 0.03) @ T_EGO_LIDAR, atol=1e-5)


def test_topics_depth_and_tolerance(bag):
    sequence = load_sequence("rosbag", bag, images=["/cam/image_raw"], depth={"/cam/image_raw": "/cam/depth"},
                             points="", frames=["odom", "base_link"], tolerance=0.005)  # fmt: skip
    frame = sequence[1]
    assert (frame.views[0].depth == 2.5).all()
    assert frame.points is None
    narrow = load_sequence("rosbag", bag, tolerance=0.005)[0]  # the others are 10 and 30 ms away
    assert narrow.points is None
    assert len(narrow.views) == 1
    clouds = load_sequence("rosbag", bag, images=[])
    assert [f.timestamp - START for f in clouds] == pytest.approx([0.03, 0.13, 0.23, 0.33], abs=1e-6)
    with pytest.raises(ConfigError, match=r"the bag has no topic /nose: expected .*/points \(PointCloud2\)"):
        load_sequence("rosbag", bag, images=["/nose"])
    with pytest.raises(ConfigError, match="frames are not usable"):
        load_sequence("rosbag", bag, frames="map")


def test_tf_that_does_not_reach(tmp_path):
    made = Bag("mcap", tmp_path / "drive")
    with made.writer:
        fill(made)
        made.image("/cam/image_raw", START + 9, IMAGE, "rgb8")
    sequence = load_sequence("rosbag", made.path)
    with pytest.raises(NotFoundError, match=r"TF of 'base_link' in 'odom' has no pose at .*the nearest 8\.\d+ s away"):
        sequence[4]
    with pytest.raises(NotFoundError, match="TF does not connect 'base_link' with 'nowhere'"):
        load_sequence("rosbag", made.path, frames=["nowhere", "base_link"])[0]


def test_without_tf_and_calibration(tmp_path):
    made = Bag("sqlite3", tmp_path / "drive")
    with made.writer:
        fill(made, tf=False)
    with pytest.raises(ConfigError, match="TF frames of world and ego are not told"):
        load_sequence("rosbag", made.path)
    lone = Bag("sqlite3", tmp_path / "lone")
    with lone.writer:
        lone.image("/eye/image", START, IMAGE, "rgb8")
    with pytest.raises(NotFoundError, match="neither images with CameraInfo nor points"):
        load_sequence("rosbag", lone.path)
    (tmp_path / "junk.mcap").write_bytes(b"no bag")
    with pytest.raises(DataError, match=r"junk\.mcap cannot be opened"):
        load_sequence("rosbag", tmp_path / "junk.mcap")


@pytest.mark.parametrize(
    ("encoding", "pixels", "wanted"),
    [
        ("rgb8", IMAGE, IMAGE),
        ("rgba8", np.dstack([IMAGE, IMAGE[..., :1]]), IMAGE),
        ("mono8", IMAGE[..., 0], IMAGE[..., [0, 0, 0]]),
        ("bayer_rggb8", np.tile([[200, 0], [0, 50]], (18, 32)).astype(np.uint8), IMAGE),
    ],
)
def test_encodings(tmp_path, encoding, pixels, wanted):
    made = Bag("mcap", tmp_path / "drive")
    with made.writer:
        fill(made)
        made.image("/odd/image_raw", START, pixels, encoding, padding=2)
    image = load_sequence("rosbag", made.path, images=["/odd/image_raw"],
                          camera_info={"/odd/image_raw": "/cam/camera_info"})[0].views[0].image  # fmt: skip
    np.testing.assert_array_equal(image[4:-4, 4:-4], wanted[4:-4, 4:-4])
