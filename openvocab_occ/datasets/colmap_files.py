"""The cameras and images of a COLMAP model, from its text or binary files."""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from openvocab_occ.errors import DataError, NotFoundError
from openvocab_occ.geometry import Camera, pose
from openvocab_occ.geometry.camera import Lens

_MODELS: Mapping[int, tuple[str, int]] = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12),
}  # fmt: skip
"""Name and number of parameters of each model, by its id in binary files."""
_FOCALS = {"SIMPLE_PINHOLE": 1, "SIMPLE_RADIAL": 1, "RADIAL": 1, "SIMPLE_RADIAL_FISHEYE": 1, "RADIAL_FISHEYE": 1}
"""Models with one focal length; the others have two."""


@dataclass(frozen=True)
class ColmapImage:
    """A registered image."""

    image_id: int
    T_cam_world: Float[np.ndarray, "4 4"]
    camera_id: int
    name: str


def camera_of(model: str, width: int, height: int, parameters: list[float], where: str) -> Camera:
    """Return the camera of one of COLMAP's models; its principal point counts from the corner of the image."""
    count = _FOCALS.get(model, 2)
    fx, fy = parameters[0], parameters[count - 1]
    cx, cy, *rest = parameters[count:]
    lens: Lens = "pinhole"
    distortion: tuple[float, ...] = ()
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        lens, distortion = "brown", (*rest, *[0.0] * (4 - len(rest)))
    elif model in ("OPENCV", "FULL_OPENCV"):
        lens, distortion = "brown", tuple(rest)
    elif model in ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"):
        lens, distortion = "fisheye", (*rest, *[0.0] * (4 - len(rest)))
    elif model not in ("SIMPLE_PINHOLE", "PINHOLE"):
        raise DataError(
            f"camera model of {where} is not supported",
            expected="PINHOLE, RADIAL, OPENCV, FULL_OPENCV, their SIMPLE and FISHEYE kinds",
            got=model,
            fix="undistort: colmap image_undistorter",
        )
    K = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    return Camera(K, width, height, np.eye(4), distortion, lens)


def read_model(folder: Path) -> tuple[dict[int, Camera], list[ColmapImage]]:
    """Read `cameras` and `images` of a folder, `.bin` before `.txt`; images come in order of their names."""
    for ending, cameras, images in ((".bin", _cameras_bin, _images_bin), (".txt", _cameras_txt, _images_txt)):
        if (folder / f"cameras{ending}").is_file() and (folder / f"images{ending}").is_file():
            try:
                found = cameras(folder / f"cameras{ending}"), images(folder / f"images{ending}")
            except (struct.error, ValueError, IndexError, KeyError) as error:
                if isinstance(error, DataError):
                    raise
                raise DataError(
                    f"COLMAP model {folder} is damaged", expected=f"cameras{ending} and images{ending}", got=error
                ) from error
            return found[0], sorted(found[1], key=lambda image: image.name)
    raise NotFoundError(
        f"no COLMAP model in {folder}", expected="cameras and images, both .bin or both .txt", fix="check the path"
    )


def _cameras_txt(file: Path) -> dict[int, Camera]:
    found = {}
    for line in file.read_text().splitlines():
        if line.strip() and not line.startswith("#"):
            number, model, width, height, *rest = line.split()
            values = [float(value) for value in rest]
            wanted = dict(_MODELS.values()).get(model)
            if wanted is not None and len(values) != wanted:
                raise DataError(
                    f"camera {number} of {file.name} has wrong parameters", expected=wanted, got=len(values)
                )
            found[int(number)] = camera_of(model, int(width), int(height), values, f"camera {number} of {file.name}")
    return found


def _images_txt(file: Path) -> list[ColmapImage]:
    """Read every other line: each image has a second one, of its points, which may be empty."""
    lines = [line for line in file.read_text().split("\n") if not line.startswith("#")]
    found = []
    for line in lines[::2]:
        if line.strip():
            number, *values, camera, name = line.split(maxsplit=9)
            found.append(_image(int(number), [float(v) for v in values], int(camera), name.strip()))
    return found


def _image(number: int, values: list[float], camera: int, name: str) -> ColmapImage:
    return ColmapImage(number, pose(values[4:7], values[:4]), camera, name)


def _cameras_bin(file: Path) -> dict[int, Camera]:
    content = file.read_bytes()
    (count,), at = struct.unpack_from("<Q", content), 8
    found = {}
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<iiQQ", content, at)
        name, size = _MODELS[model]
        values = list(struct.unpack_from(f"<{size}d", content, at + 24))
        found[number] = camera_of(name, width, height, values, f"camera {number} of {file.name}")
        at += 24 + 8 * size
    return found


def _images_bin(file: Path) -> list[ColmapImage]:
    content = file.read_bytes()
    (count,), at = struct.unpack_from("<Q", content), 8
    found = []
    for _ in range(count):
        number, *values, camera = struct.unpack_from("<i7di", content, at)
        end = content.index(b"\0", at + 64)
        (points,) = struct.unpack_from("<Q", content, end + 1)
        found.append(_image(number, values, camera, content[at + 64 : end].decode()))
        at = end + 9 + 24 * points
    if at > len(content):
        raise DataError(f"{file.name} is cut off", expected=f"{at} bytes", got=len(content))
    return found
