"""The tables of nuScenes (v1.0) for written traversals.

Added to the format: boxes carry `velocity`, `moves`, `kind`, `color`, `id`; scenes `condition`, `route`, `traversal`.
"""

import hashlib
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from openvocab_occ.datasets.city.sensors import PERIOD, RIG, T_EGO_LIDAR
from openvocab_occ.datasets.city.things import LABELS
from openvocab_occ.datasets.city.traversal import Traversal
from openvocab_occ.geometry.pose import wxyz_from_matrix

LIDAR = "LIDAR_TOP"
Rows = list[dict[str, Any]]
_CATEGORIES = {
    "car": "vehicle.car", "truck": "vehicle.truck", "bus": "vehicle.bus.rigid", "trailer": "vehicle.trailer",
    "construction vehicle": "vehicle.construction", "motorcycle": "vehicle.motorcycle", "bicycle": "vehicle.bicycle",
    "pedestrian": "human.pedestrian.adult", "traffic cone": "movable_object.trafficcone",
    "barrier": "movable_object.barrier",
}  # fmt: skip
_ATTRIBUTES = (
    "vehicle.moving", "vehicle.stopped", "vehicle.parked", "cycle.with_rider", "cycle.without_rider",
    "pedestrian.moving", "pedestrian.standing",
)  # fmt: skip
_VISIBILITY = ("v0-40", "v40-60", "v60-80", "v80-100")


def token(*words: object) -> str:
    """Return the token of something: 32 hexadecimal digits that depend on its name alone."""
    return hashlib.md5("/".join(map(str, words)).encode(), usedforsecurity=False).hexdigest()


def sample_token(drive: Traversal, index: int) -> str:
    """Return the token of a keyframe."""
    return token(drive.name, "sample", index)


def file_name(drive: Traversal, index: int, channel: str) -> str:
    """Return where a sensor's file of a keyframe lies, from the root."""
    micros = round((drive.start_time() + index * PERIOD + _delay(channel)) * 1e6)
    ending = "pcd.bin" if channel == LIDAR else "jpg"
    return f"samples/{channel}/{drive.name}__{channel}__{micros}.{ending}"


def build_tables(
    drives: Sequence[Traversal], records: Iterable[list[dict[str, Any]]], frames: int, size: tuple[int, int]
) -> dict[str, Rows]:
    """Return the rows of every table.

    Args:
        drives: The scenes.
        records: Of each scene the boxes of each keyframe, as `writer` stores them.
        frames: Keyframes of a scene.
        size: Width and height of the images.
    """
    tables: dict[str, Rows] = {
        name: [] for name in ("scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "log", "instance",
                              "sample_annotation")
    }  # fmt: skip
    tables["category"] = [
        {"token": token("category", name), "name": name, "description": "", "index": LABELS[label]}
        for label, name in _CATEGORIES.items()
    ]
    tables["attribute"] = [{"token": token("attribute", n), "name": n, "description": ""} for n in _ATTRIBUTES]
    tables["visibility"] = [
        {"token": str(i), "level": level, "description": f"{level[1:]} % visible from the middle of the rig"}
        for i, level in enumerate(_VISIBILITY, start=1)
    ]
    tables["sensor"] = [
        {"token": token("sensor", name), "channel": name, "modality": "lidar" if name == LIDAR else "camera"}
        for name in (*(mount.name for mount in RIG), LIDAR)
    ]
    for drive, boxes in zip(drives, records, strict=True):
        _scene(tables, drive, frames)
        _mounts(tables, drive, size)
        _data(tables, drive, frames, size)
        _annotations(tables, drive, boxes)
    logs = [row["token"] for row in tables["log"]]
    seed = drives[0].town.seed if drives else 0
    tables["map"] = [
        {
            "token": token("map", seed),
            "log_tokens": logs,
            "category": "semantic_prior",
            "filename": f"maps/city-{seed}.png",
        }
    ]
    return tables


def _delay(channel: str) -> float:
    return {mount.name: mount.delay for mount in RIG}.get(channel, 0.0)


def _scene(tables: dict[str, Rows], drive: Traversal, frames: int) -> None:
    samples = [sample_token(drive, i) for i in range(frames)]
    start = datetime.fromtimestamp(drive.start_time(), UTC)
    log = token(drive.name, "log")
    tables["log"].append({
        "token": log, "logfile": f"{drive.agent}-{start:%Y-%m-%d-%H-%M-%S}", "vehicle": drive.agent,
        "date_captured": f"{start:%Y-%m-%d}", "location": f"synthetic-city-{drive.town.seed}",
    })  # fmt: skip
    tables["scene"].append({
        "token": token(drive.name, "scene"), "log_token": log, "nbr_samples": frames, "first_sample_token": samples[0],
        "last_sample_token": samples[-1], "name": drive.name, "condition": drive.condition_name, "route": drive.route,
        "traversal": drive.number,
        "description": f"synthetic city, route {drive.route}, traversal {drive.number}, {drive.condition_name}",
    })  # fmt: skip
    for i, own in enumerate(samples):
        tables["sample"].append({
            "token": own, "timestamp": round((drive.start_time() + i * PERIOD) * 1e6),
            "prev": samples[i - 1] if i else "", "next": samples[i + 1] if i + 1 < frames else "",
            "scene_token": token(drive.name, "scene"),
        })  # fmt: skip


def _mounts(tables: dict[str, Rows], drive: Traversal, size: tuple[int, int]) -> None:
    mounts = [(m.name, m.T_ego_cam(), m.camera(*size).K.tolist()) for m in RIG] + [(LIDAR, T_EGO_LIDAR, [])]
    for name, T, K in mounts:
        tables["calibrated_sensor"].append({
            "token": token(drive.name, "mount", name), "sensor_token": token("sensor", name),
            "translation": T[:3, 3].tolist(), "rotation": wxyz_from_matrix(T[:3, :3]).tolist(), "camera_intrinsic": K,
        })  # fmt: skip


def _data(tables: dict[str, Rows], drive: Traversal, frames: int, size: tuple[int, int]) -> None:
    for channel in (*(mount.name for mount in RIG), LIDAR):
        tokens = [token(drive.name, channel, i) for i in range(frames)]
        width, height = (0, 0) if channel == LIDAR else size
        for i, own in enumerate(tokens):
            time = i * PERIOD + _delay(channel)
            T = drive.T_world_ego(time)
            micros = round((drive.start_time() + time) * 1e6)
            tables["ego_pose"].append({
                "token": own, "timestamp": micros, "rotation": wxyz_from_matrix(T[:3, :3]).tolist(),
                "translation": T[:3, 3].tolist(),
            })  # fmt: skip
            tables["sample_data"].append({
                "token": own, "sample_token": sample_token(drive, i), "ego_pose_token": own,
                "calibrated_sensor_token": token(drive.name, "mount", channel), "timestamp": micros,
                "fileformat": "pcd" if channel == LIDAR else "jpg", "is_key_frame": True, "height": height,
                "width": width, "filename": file_name(drive, i, channel), "prev": tokens[i - 1] if i else "",
                "next": tokens[i + 1] if i + 1 < frames else "",
            })  # fmt: skip


def _annotations(tables: dict[str, Rows], drive: Traversal, boxes: list[dict[str, Any]]) -> None:
    """Add the boxes of a scene and link those of one instance; boxes are in order of time."""
    tracks: dict[int, Rows] = {}
    for box in boxes:
        own = token(drive.name, "box", box["id"], box["index"])
        yaw = box["yaw"]
        length, width, height = box["size"]
        row = {
            "token": own, "sample_token": sample_token(drive, box["index"]),
            "instance_token": token(drive.name, "instance", box["id"]), "visibility_token": str(box["visibility"]),
            "attribute_tokens": [token("attribute", box["attribute"])] if box["attribute"] else [],
            "translation": box["center"], "size": [width, length, height],
            "rotation": [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))], "prev": "", "next": "",
            "num_lidar_pts": box["lidar_points"], "num_radar_pts": 0, "velocity": box["velocity"],
            "moves": box["moves"], "kind": box["kind"], "color": box["color"], "id": box["id"],
        }  # fmt: skip
        track = tracks.setdefault(box["id"], [])
        if track:
            row["prev"], track[-1]["next"] = track[-1]["token"], own
        track.append(row)
        tables["sample_annotation"].append(row)
    names = {LABELS[label]: name for label, name in _CATEGORIES.items()}
    labels = {box["id"]: box["label"] for box in boxes}
    for number, track in tracks.items():
        tables["instance"].append({
            "token": track[0]["instance_token"], "category_token": token("category", names[labels[number]]),
            "nbr_annotations": len(track), "first_annotation_token": track[0]["token"],
            "last_annotation_token": track[-1]["token"],
        })  # fmt: skip
