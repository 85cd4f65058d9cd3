"""ROS 1 and ROS 2 bags (`.bag`, folders of sqlite3 or MCAP): images, CameraInfo, TF and PointCloud2.

Needs the extra `ros` (the library `rosbags`, pure Python: no ROS installation).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from openvocab_occ.datasets import ros_messages as ros
from openvocab_occ.datasets.frame import Frame, FrameSequence, View
from openvocab_occ.datasets.tf_tree import TransformTree
from openvocab_occ.errors import ConfigError, DataError, MissingExtraError, NotFoundError
from openvocab_occ.geometry import Camera, invert, transform
from openvocab_occ.io.files import PathLike, existing

_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_INFO, _CLOUD, _TF = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"
_TF_ROS1 = "tf/msg/tfMessage"
_WORLDS = ("map", "odom", "world")
_EGOS = ("base_link", "base_footprint", "ego", "vehicle")


@dataclass(frozen=True)
class _Stamps:
    """The messages of a topic in order of their own stamps."""

    times: np.ndarray
    """Seconds, of the headers."""
    logged: Sequence[int]
    """Nanoseconds at which the bag holds them."""
    frame: str
    """TF frame of the sensor."""


@dataclass(frozen=True)
class _Rig:
    """What is read of a bag before any frame."""

    bag: Path
    cameras: Mapping[str, Camera]
    stamps: Mapping[str, _Stamps]
    tree: TransformTree
    images: Sequence[str]
    depths: Mapping[str, str]
    cloud: str | None
    world: str
    ego: str
    tolerance: float


def load_rosbag(
    root: PathLike | None,
    *,
    scene: str | None = None,
    images: Sequence[str] | None = None,
    depth: Mapping[str, str] | None = None,
    camera_info: Mapping[str, str] | None = None,
    points: str | None = None,
    frames: Sequence[str] | None = None,
    tolerance: float | int = 0.05,
) -> FrameSequence:
    """Open a bag. It is read through once for times, calibration and TF; pixels and points when a frame is asked for.

    The first image topic (without images, the point cloud) gives the frames; messages of the other topics are joined
    by nearest stamp. Each sensor stands where TF says it was at its own stamp, interpolated.

    Args:
        root: A `.bag`, an `.mcap`, or the folder of a ROS 2 bag.
        scene: A bag below the root.
        images: Image topics, raw or compressed; by default all that have a CameraInfo and are no depth.
        depth: Depth topic of an image topic, registered to it.
        camera_info: CameraInfo topic of an image topic; by default `camera_info` beside it.
        points: PointCloud2 topic; the first one by default, `""` for none.
        frames: TF frames of world and ego; by default `map`, `odom` or `world`, and `base_link`.
        tolerance: Seconds by which stamps of one frame may differ, and TF may be older or younger.
    """
    if root is None:
        raise ConfigError("rosbag needs a root", expected="a .bag, an .mcap or the folder of a bag", got=None)
    if not 0 <= tolerance < np.inf:
        raise ConfigError("tolerance is not usable", expected="seconds, 0 or more", got=tolerance)
    bag = existing(root, "bag")
    bag = existing(bag / scene, f"bag {scene}") if scene is not None else bag
    images = [images] if isinstance(images, str) else images
    with _open(bag) as reader:
        kinds = {c.topic: c.msgtype for c in reader.connections}
        infos = {i: t for i in _topics(kinds, *_IMAGES) if (t := _info_topic(i, camera_info, kinds)) is not None}
        depths = dict(depth or {})
        chosen = list(images) if images is not None else [t for t in infos if not _is_depth(t, depths)]
        _check_topics(kinds, [*chosen, *depths, *depths.values(), *([points] if points else [])])
        clouds = _topics(kinds, _CLOUD)
        cloud = points if points is not None else (clouds[0] if clouds else None)
        if not chosen and not cloud:
            raise NotFoundError(
                f"{bag.name} has neither images with CameraInfo nor points", expected="such topics", got=_list(kinds)
            )
        without = [t for t in chosen if t not in infos]
        if without:
            raise NotFoundError(
                f"no CameraInfo of {', '.join(without)}", expected="camera_info={image topic: its topic}",
                got=_list({t: k for t, k in kinds.items() if k == _INFO}) or "no such topic",
            )  # fmt: skip
        sensors = [*chosen, *[depths[t] for t in chosen if t in depths], *([cloud] if cloud else [])]
        rig = _index(reader, bag, chosen, infos, sensors, depths, cloud or None, frames, tolerance)
    lead = rig.stamps[chosen[0] if chosen else str(cloud)]
    return FrameSequence(
        bag.stem, range(len(lead.times)), lambda index: _frame(index, float(lead.times[index]), rig), source="rosbag",
        files=lambda index: [bag],
    )  # fmt: skip


def _open(bag: Path) -> Any:
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingExtraError(
            "bags need the library rosbags", expected="the extra ros", fix="pip install 'openvocab_occ[ros]'"
        ) from error
    try:
        reader = AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except (AnyReaderError, ValueError, KeyError, OSError) as error:
        raise DataError(f"bag {bag.name} cannot be opened", expected="ROS 1, ROS 2 or MCAP", got=error) from error
    return _Closing(reader)


class _Closing:
    """Closes a reader that is already open."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader

    def __enter__(self) -> Any:
        return self._reader

    def __exit__(self, *_: object) -> None:
        self._reader.close()


def _topics(kinds: Mapping[str, str], *wanted: str) -> list[str]:
    return sorted(topic for topic, kind in kinds.items() if kind in wanted)


def _list(kinds: Mapping[str, str]) -> str:
    return ", ".join(f"{topic} ({kind.split('/')[-1]})" for topic, kind in sorted(kinds.items()))


def _is_depth(topic: str, depths: Mapping[str, str]) -> bool:
    return topic in depths.values() or "depth" in topic


def _info_topic(image: str, given: Mapping[str, str] | None, kinds: Mapping[str, str]) -> str | None:
    """Find the CameraInfo of /cam/image_raw/compressed at /cam/camera_info."""
    if given and image in given:
        return given[image]
    parts = image.split("/")
    for cut in range(len(parts) - 1, 0, -1):
        candidate = "/".join([*parts[:cut], "camera_info"])
        if kinds.get(candidate) == _INFO:
            return candidate
        if cut < len(parts) - 1 and parts[cut] != "compressed" and not parts[cut].startswith("image"):
            break
    return None


def _check_topics(kinds: Mapping[str, str], wanted: Sequence[str]) -> None:
    unknown = [topic for topic in wanted if topic not in kinds]
    if unknown:
        raise ConfigError(f"the bag has no topic {', '.join(unknown)}", expected=_list(kinds) or "none: it is empty")


def _index(
    reader: Any,
    bag: Path,
    images: Sequence[str],
    infos: Mapping[str, str],
    sensors: Sequence[str],
    depths: Mapping[str, str],
    cloud: str | None,
    frames: Sequence[str] | None,
    tolerance: float,
) -> _Rig:
    """Go through the bag once."""
    tree = TransformTree(tolerance=tolerance)
    wanted_infos = {infos[topic] for topic in images}
    found: dict[str, Camera] = {}
    stamps: dict[str, list[tuple[float, int]]] = {topic: [] for topic in sensors}
    owner: dict[str, str] = {}
    connections = [
        c for c in reader.connections
        if c.topic in stamps or c.topic in wanted_infos or c.msgtype in (_TF, _TF_ROS1)
    ]  # fmt: skip
    for connection, logged, raw in reader.messages(connections=connections):
        if connection.topic in wanted_infos and connection.topic in found:
            continue
        message = reader.deserialize(raw, connection.msgtype)
        if connection.msgtype in (_TF, _TF_ROS1):
            static = connection.topic.endswith("tf_static")
            for link in message.transforms:
                parent, child = link.header.frame_id.lstrip("/"), link.child_frame_id.lstrip("/")
                time = None if static else ros.seconds(link.header.stamp)
                tree.add(parent, child, time, ros.transform_of(link))
        elif connection.topic in wanted_infos:
            found[connection.topic] = ros.camera_of(message, f"CameraInfo {connection.topic}")
        else:
            stamps[connection.topic].append((ros.seconds(message.header.stamp), logged))
            owner[connection.topic] = message.header.frame_id.lstrip("/")
    silent = [topic for topic in images if infos[topic] not in found]
    if silent:
        raise NotFoundError(f"no CameraInfo was recorded for {', '.join(silent)}", expected="at least one message")
    ordered = {
        topic: _Stamps(np.array([t for t, _ in rows]), [at for _, at in rows], owner.get(topic, ""))
        for topic, rows in ((topic, sorted(rows)) for topic, rows in stamps.items())
    }
    world, ego = _names(tree, frames)
    cameras = {topic: found[infos[topic]] for topic in images}
    return _Rig(bag, cameras, ordered, tree, images, depths, cloud, world, ego, tolerance)


def _names(tree: TransformTree, given: Sequence[str] | None) -> tuple[str, str]:
    if given is not None:
        if isinstance(given, str) or len(given) != 2:
            raise ConfigError("frames are not usable", expected="the TF frames of world and ego", got=given)
        return given[0], given[1]
    world = next((name for name in _WORLDS if name in tree.frames), None)
    ego = next((name for name in _EGOS if name in tree.frames), None)
    if world is None or ego is None:
        raise ConfigError(
            "TF frames of world and ego are not told", expected="frames=(world, ego)",
            got=", ".join(tree.frames) or "no TF in the bag",
        )  # fmt: skip
    return world, ego


def _frame(index: int, time: float, rig: _Rig) -> Frame:
    with _open(rig.bag) as reader:
        T_world_ego = rig.tree.pose(rig.world, rig.ego, time)
        poses = {"lidar_ego": T_world_ego}
        views = [view for topic in rig.images if (view := _view(reader, topic, time, rig)) is not None]
        points = None
        cloud = None if rig.cloud is None else _nearest(rig, rig.cloud, time)
        if rig.cloud is not None and cloud is not None:
            message = _message(reader, rig.cloud, cloud[1])
            poses["lidar"] = rig.tree.pose(rig.world, rig.stamps[rig.cloud].frame, cloud[0])
            local = ros.points_of(message, f"cloud {rig.cloud} at {cloud[0]:.3f} s")
            points = transform(invert(T_world_ego) @ poses["lidar"], local).astype(np.float32)
    return Frame(index, time, T_world_ego, tuple(views), None, points, f"{time:.9f}", poses)


def _view(reader: Any, topic: str, time: float, rig: _Rig) -> View | None:
    """Read the image next in time; None where there is none within the tolerance."""
    near = _nearest(rig, topic, time)
    if near is None:
        return None
    what = f"image {topic} at {near[0]:.3f} s"
    image = ros.image_of(_message(reader, topic, near[1]), what)
    camera = rig.cameras[topic].at(rig.tree.pose(rig.world, rig.stamps[topic].frame, near[0]))
    if image.shape[:2] != (camera.height, camera.width):
        camera = camera.resized(image.shape[1], image.shape[0])
    measured = None
    if topic in rig.depths and (shot := _nearest(rig, rig.depths[topic], near[0])) is not None:
        measured = ros.depth_of(_message(reader, rig.depths[topic], shot[1]), f"depth {rig.depths[topic]}")
    return View(image, camera, measured, name=topic)


def _nearest(rig: _Rig, topic: str, time: float) -> tuple[float, int] | None:
    """Return stamp and place of the message of a topic next in time, within the tolerance."""
    rows = rig.stamps[topic]
    if not len(rows.times):
        return None
    after = int(np.searchsorted(rows.times, time))
    best = min(
        (i for i in (after - 1, after) if 0 <= i < len(rows.times)), key=lambda i: abs(float(rows.times[i]) - time)
    )
    near = abs(float(rows.times[best]) - time) <= rig.tolerance
    return (float(rows.times[best]), rows.logged[best]) if near else None


def _message(reader: Any, topic: str, logged: int) -> Any:
    connections = [c for c in reader.connections if c.topic == topic]
    for connection, _, raw in reader.messages(connections=connections, start=logged, stop=logged + 1):
        return reader.deserialize(raw, connection.msgtype)
    raise DataError(f"the bag changed while it was read: {topic} at {logged} ns is gone")
