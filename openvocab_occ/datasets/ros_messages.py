"""ROS messages as arrays: images, compressed images, camera info, point clouds. ROS 1 and 2 differ only in names."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8

from openvocab_occ.errors import DataError
from openvocab_occ.geometry import Camera, pose
from openvocab_occ.geometry.camera import Lens
from openvocab_occ.io.images import decode_image

_RGB_OF: Mapping[str, tuple[int, tuple[int, int, int]]] = {
    "rgb8": (3, (0, 1, 2)), "bgr8": (3, (2, 1, 0)), "rgba8": (4, (0, 1, 2)), "bgra8": (4, (2, 1, 0)),
    "8UC3": (3, (2, 1, 0)), "8UC4": (4, (2, 1, 0)), "mono8": (1, (0, 0, 0)), "8UC1": (1, (0, 0, 0)),
}  # fmt: skip
"""Bytes of a pixel, and which of them are red, green and blue."""
_OPENCV_CODES = {
    "bayer_rggb8": "COLOR_BayerBG2RGB", "bayer_bggr8": "COLOR_BayerRG2RGB", "bayer_gbrg8": "COLOR_BayerGR2RGB",
    "bayer_grbg8": "COLOR_BayerGB2RGB", "yuv422": "COLOR_YUV2RGB_UYVY", "uyvy": "COLOR_YUV2RGB_UYVY",
    "yuv422_yuy2": "COLOR_YUV2RGB_YUY2", "yuyv": "COLOR_YUV2RGB_YUY2",
}  # fmt: skip
_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_LENSES: Mapping[str, Lens] = {
    "plumb_bob": "brown", "rational_polynomial": "brown", "equidistant": "fisheye", "fisheye": "fisheye", "": "brown",
    "none": "brown",
}  # fmt: skip


def seconds(stamp: Any) -> float:
    """Return a ROS time as seconds."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def image_of(message: Any, what: str) -> UInt8[np.ndarray, "h w 3"]:
    """Return the RGB pixels of an Image or CompressedImage."""
    if not hasattr(message, "encoding"):
        return decode_image(bytes(message.data), what)
    name = message.encoding
    if name in _RGB_OF:
        size, order = _RGB_OF[name]
        return np.ascontiguousarray(_pixels(message, np.dtype(np.uint8), size, what)[..., list(order)])
    if name in _OPENCV_CODES:
        import cv2

        size = 1 if name.startswith("bayer") else 2
        raw = _pixels(message, np.dtype(np.uint8), size, what)
        return cv2.cvtColor(raw, getattr(cv2, _OPENCV_CODES[name]))  # pyright: ignore[reportReturnType]
    known = ", ".join([*_RGB_OF, *_OPENCV_CODES])
    raise DataError(f"{what} has an encoding that is not supported", expected=known, got=name)


def depth_of(message: Any, what: str) -> Float32[np.ndarray, "h w"]:
    """Return metres of a depth Image: 16UC1 in millimetres or 32FC1 in metres (REP 118); 0 where there is none."""
    name = getattr(message, "encoding", "a compressed image")
    if name in ("16UC1", "mono16"):
        raw = _pixels(message, np.dtype(np.uint16), 1, what)[..., 0]
        return np.where(raw == np.iinfo(np.uint16).max, 0, raw).astype(np.float32) / np.float32(1000)
    if name == "32FC1":
        metres = _pixels(message, np.dtype(np.float32), 1, what)[..., 0]
        return np.where(np.isfinite(metres) & (metres > 0), metres, 0).astype(np.float32)
    raise DataError(f"{what} is no depth image", expected="16UC1 or 32FC1", got=name)


def _pixels(message: Any, dtype: np.dtype[Any], channels: int, what: str) -> np.ndarray:
    """Return (h, w, channels) of a raw image, whose rows may be padded."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(bytes(message.data), dtype=np.uint8)
    row = width * channels * dtype.itemsize
    if step < row or len(data) < height * step:
        raise DataError(
            f"{what} is cut off", expected=f"{height} rows of {max(row, step)} bytes", got=f"{len(data)} bytes"
        )
    packed = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row])
    order = ">" if message.is_bigendian else "<"
    values = packed.reshape(-1).view(dtype.newbyteorder(order)).astype(dtype)
    return values.reshape(height, width, channels)


def camera_of(message: Any, what: str) -> Camera:
    """Return the camera of a CameraInfo, at the identity; K and D as calibrated, for images that are not rectified."""
    K = np.asarray(getattr(message, "K", getattr(message, "k", None)), dtype=np.float64).reshape(3, 3)
    D = getattr(message, "D", getattr(message, "d", ()))
    distortion = tuple(float(v) for v in np.ravel(D))
    model = str(message.distortion_model)
    if model not in _LENSES:
        raise DataError(
            f"{what} has a distortion model that is not supported", expected=", ".join(_LENSES), got=model,
            fix="map the rectified images",
        )  # fmt: skip
    lens = _LENSES[model]
    if not any(distortion):
        lens, distortion = "pinhole", ()
    if K[0, 0] == 0:
        raise DataError(f"{what} is not calibrated", expected="a focal length above 0", got=0)
    return Camera(K, int(message.width), int(message.height), np.eye(4), distortion, lens)


def points_of(message: Any, what: str) -> Float32[np.ndarray, "n 3"]:
    """Return x, y, z of a PointCloud2; returns that are not finite are left out."""
    fields = {field.name: field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise DataError(f"{what} has no {', '.join(missing)}", expected="fields x, y, z", got=", ".join(fields))
    order = ">" if message.is_bigendian else "<"
    kind = np.dtype({
        "names": ["x", "y", "z"],
        "formats": [order + _POINT_TYPES[int(fields[name].datatype)] for name in "xyz"],
        "offsets": [int(fields[name].offset) for name in "xyz"],
        "itemsize": int(message.point_step),
    })  # fmt: skip
    width, height, row = int(message.width), int(message.height), int(message.row_step)
    data = bytes(message.data)
    if len(data) < height * row or row < width * kind.itemsize:
        raise DataError(f"{what} is cut off", expected=f"{height * row} bytes", got=len(data))
    rows = [np.frombuffer(data, kind, width, r * row) for r in range(height)]
    cloud = np.concatenate(rows) if rows else np.empty(0, kind)
    points = np.stack([cloud[name].astype(np.float32) for name in "xyz"], axis=-1)
    return points[np.isfinite(points).all(axis=1)]


def transform_of(message: Any) -> Float[np.ndarray, "4 4"]:
    """Return T_parent_child of a TransformStamped."""
    t, q = message.transform.translation, message.transform.rotation
    return pose((t.x, t.y, t.z), (q.w, q.x, q.y, q.z))
