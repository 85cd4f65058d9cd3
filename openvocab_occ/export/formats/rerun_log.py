"""Rerun recordings, `.rrd`: voxels, boxes of objects, cameras along the drive, what moved."""

from pathlib import Path
from typing import Any

import numpy as np

from openvocab_occ.errors import MissingExtraError
from openvocab_occ.io.files import PathLike, written_file
from openvocab_occ.objects import SceneMap


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


def _log_camera(rr: Any, log: Any, camera: Any) -> None:
    at = f"world/{camera.name or 'camera'}"
    T = camera.T_world_cam
    log.log(at, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
    log.log(at, rr.Pinhole(image_from_camera=camera.K, resolution=(camera.width, camera.height),
                           camera_xyz=rr.ViewCoordinates.RDF))  # fmt: skip
