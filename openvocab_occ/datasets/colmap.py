"""COLMAP reconstructions: one camera a frame, in order of the images' names.

The world stays the model's, whose up and scale COLMAP does not know: `up=` names the axis that points up, `scale=` the
metres of its unit. The ego is the camera, its axes turned to x forward, y left, z up of the camera.
"""

from pathlib import Path

import numpy as np

from openvocab_occ.datasets.colmap_files import ColmapImage, read_model
from openvocab_occ.datasets.frame import Frame, FrameSequence, View
from openvocab_occ.errors import ConfigError, DataError, NotFoundError
from openvocab_occ.geometry import T_EGO_CAM_AXES, Camera, invert, turn_up
from openvocab_occ.io.files import PathLike, existing
from openvocab_occ.io.images import read_image

_PLACES = (".", "sparse/0", "sparse", "colmap/sparse/0")


def load_colmap(
    root: PathLike | None,
    *,
    scene: str | None = None,
    images: PathLike | None = None,
    up: str = "z",
    scale: float | int = 1.0,
) -> FrameSequence:
    """Open a reconstruction. COLMAP knows no times: each image has a second.

    An image file of another size than its camera (a smaller copy) gets the camera of that size.

    Args:
        root: The project, with `sparse/0` and `images`, or the model's own folder.
        scene: A sub-folder of the root.
        images: Folder of the images; by default `images` beside the model or above it.
        up: Axis of the model's world that points up.
        scale: Metres of a unit of the model.
    """
    if root is None:
        raise ConfigError("colmap needs a root", expected="a project with sparse/0 and images", got=None)
    if not (np.isfinite(scale) and scale > 0):
        raise ConfigError("scale is not usable", expected="metres above 0", got=scale)
    top = existing(root, "COLMAP project")
    project = top if scene is None else existing(top / scene, f"project {scene}")
    model = next((project / p for p in _PLACES if any((project / p).glob("cameras.*"))), None)
    if model is None:
        raise NotFoundError(
            f"no COLMAP model in {project}", expected="cameras.bin or cameras.txt there or in sparse/0", fix="export it"
        )
    cameras, found = read_model(model)
    folder = existing(images, "folder of images") if images is not None else _image_folder(model)
    turn = turn_up(up)

    def read(index: int) -> Frame:
        entry = found[index]
        T_world_cam = invert(entry.T_cam_world)
        T_world_cam[:3, 3] *= scale
        T_world_cam = turn @ T_world_cam
        view = _view(entry, cameras, folder, T_world_cam)
        T_world_ego = T_world_cam @ invert(T_EGO_CAM_AXES)
        token = Path(entry.name).with_suffix("").as_posix()
        return Frame(index, float(index), T_world_ego, (view,), token=token, poses={"lidar_ego": T_world_ego})

    return FrameSequence(
        project.name, range(len(found)), read, source="colmap", files=lambda index: [folder / found[index].name]
    )


def _image_folder(model: Path) -> Path:
    places = [model / "images", model.parent / "images", model.parent.parent / "images"]
    return next((place for place in places if place.is_dir()), places[-1])


def _view(entry: ColmapImage, cameras: dict[int, Camera], folder: Path, T_world_cam: np.ndarray) -> View:
    if entry.camera_id not in cameras:
        raise DataError(
            f"image {entry.name} has no camera", expected=f"camera {entry.camera_id}", got=sorted(cameras)[:8]
        )
    image = read_image(folder / entry.name)
    height, width = image.shape[:2]
    camera = cameras[entry.camera_id].at(T_world_cam)
    if (camera.width, camera.height) != (width, height):
        if abs(camera.width / width - camera.height / height) > 0.02 * camera.width / width:
            raise DataError(
                f"image {entry.name} does not fit its camera",
                expected=f"{camera.width} x {camera.height}, or a copy of that shape",
                got=f"{width} x {height}",
            )
        camera = camera.resized(width, height)
    return View(image, camera, name=f"camera {entry.camera_id}")
