"""Rerun recordings, `.rrd`: voxels, boxes of objects, cameras along the drive, what moved; and points back again."""

from pathlib import Path
from typing import Any

import numpy as np

from openvocab_occ.errors import DataError, MissingExtraError
from openvocab_occ.export.formats.cloud import Cloud
from openvocab_occ.io.files import PathLike, written_file
from openvocab_occ.objects import SceneMap

_POINTS, _COLORS = "Points3D:positions", "Points3D:colors"


def write_rrd(scene: SceneMap, path: PathLike) -> Path:
    """Write a recording. Nothing is sent anywhere; the Rerun viewer itself counts its users unless told not to."""
    try:
        import rerun as rr
    except ImportError as error:
        raise MissingExtraError(
            "Rerun recordings need rerun-sdk", got="not installed", fix="pip install 'openvocab_occ[rerun]'"
        ) from error
    size = scene.voxels.voxel_size
    with written_file(path) as scratch:
        log = rr.RecordingStream("openvocab_occ", recording_id=scene.provenance.name or "map")
        log.save(str(scratch))
        log.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        centers, colors = scene.voxels.centers, scene.voxels.colors
        log.log("world/voxels", rr.Points3D(centers, colors=colors, radii=size / 2), static=True)
        objects = list(scene.objects)
        log.log("world/objects", rr.Boxes3D(
            centers=[node.box.center for node in objects], sizes=[node.box.size for node in objects],
            rotation_axis_angles=[rr.RotationAxisAngle((0, 0, 1), rr.Angle(rad=node.box.yaw)) for node in objects],
            labels=[f"{node.id} {node.label}" for node in objects],
        ), static=True)  # fmt: skip
        layers = {layer.frame: layer for layer in scene.dynamic}
        for frame in scene.frames:
            log.set_time("frame", sequence=frame.index)
            log.set_time("time", timestamp=frame.timestamp)
            T = frame.T_world_ego
            log.log("world/ego", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
            layer = layers.get(frame.index)
            moved = (layer.keys + 0.5) * size if layer else np.empty((0, 3))
            log.log("world/moving", rr.Points3D(moved, colors=(255, 120, 0), radii=size / 2))
            for camera in frame.cameras:
                _log_camera(rr, log, camera)
        log.flush()
        log.disconnect()
    return Path(path)


def read_rrd(path: PathLike) -> Cloud:
    """Read the points of the first recording in a file, of all its entities below one another.

    Static points where there are any (those of a map), else all points of all times. Transforms between entities are
    not applied. Points without colours are black where others have some.

    Raises:
        MissingExtraError: rerun-sdk is not installed or older than 0.41, the first whose reader has its place.
        DataError: The file is no recording, or holds no points.
    """
    try:
        from rerun.chunk import RrdReader
    except ImportError as error:
        raise MissingExtraError(
            "reading Rerun recordings needs rerun-sdk 0.41 or later",
            got=str(error),
            fix="pip install -U 'rerun-sdk>=0.41'",
        ) from error
    try:
        found = [(chunk.is_static, chunk.to_record_batch()) for chunk in RrdReader(str(path)).stream()]
    except Exception as error:  # the reader is Rust and names no errors of its own
        raise DataError(f"{path} cannot be read", expected="a Rerun recording", got=error) from error
    clouds = [(still, *_points_of(batch)) for still, batch in found if _POINTS in batch.schema.names]
    clouds = [one for one in clouds if one[0]] or clouds
    points = np.concatenate([points for _, points, _ in clouds] or [np.empty((0, 3))])
    if not len(points):
        raise DataError(f"{path} holds no points", expected="an entity of Points3D", got="none")
    none = all(colors is None for *_, colors in clouds)
    parts = [np.zeros((len(p), 3), np.uint8) if colors is None else colors for _, p, colors in clouds]
    return Cloud(points.astype(np.float64), None if none else np.concatenate(parts))


def _points_of(batch: Any) -> tuple[np.ndarray, np.ndarray | None]:
    """Return positions and colours of the rows of a chunk; one colour may stand for all points of its row."""
    rows = [np.array(row or [], dtype=np.float64).reshape(-1, 3) for row in batch[_POINTS].to_pylist()]
    points = np.concatenate([np.empty((0, 3)), *rows])
    if _COLORS not in batch.schema.names:
        return points, None
    parts = [np.empty(0, np.uint32)]
    for row, given in zip(rows, batch[_COLORS].to_pylist(), strict=True):
        packed = np.array(given or [0], dtype=np.uint32)
        parts.append(packed if len(packed) == len(row) else np.full(len(row), packed[0]))
    packed = np.concatenate(parts)  # red, green, blue, alpha from the highest byte down
    return points, np.stack([packed >> 24, packed >> 16, packed >> 8], axis=1).astype(np.uint8)


def _log_camera(rr: Any, log: Any, camera: Any) -> None:
    at = f"world/{camera.name or 'camera'}"
    T = camera.T_world_cam
    log.log(at, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
    log.log(at, rr.Pinhole(image_from_camera=camera.K, resolution=(camera.width, camera.height),
                           camera_xyz=rr.ViewCoordinates.RDF))  # fmt: skip
