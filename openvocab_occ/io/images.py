"""Images in and out; colour is RGB everywhere in this package."""

from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16

from openvocab_occ.errors import DataError
from openvocab_occ.io.files import PathLike, existing, written_file


def read_image(path: PathLike) -> UInt8[np.ndarray, "h w 3"]:
    """Read a colour image as RGB."""
    return decode_image(existing(path, "image").read_bytes(), path)


def read_depth(path: PathLike) -> UInt16[np.ndarray, "h w"]:
    """Read a one-channel 16-bit image."""
    import cv2

    image = _decode(existing(path, "depth image").read_bytes(), cv2.IMREAD_UNCHANGED, path)
    if image is None or image.ndim != 2 or image.dtype != np.uint16:
        got = "no image" if image is None else f"{image.dtype} {image.shape}"
        raise DataError(f"depth image {path} is not usable", expected="16-bit, one channel", got=got)
    return image  # pyright: ignore[reportReturnType]


def write_image(
    path: PathLike, image: UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]
) -> None:
    """Write RGB, grey or 16-bit; the format is told by the ending of the name."""
    import cv2

    pixels = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    try:
        done, data = cv2.imencode(Path(path).suffix, pixels)
    except cv2.error:  # an ending that OpenCV does not know
        done, data = False, None
    if not done or data is None:
        raise DataError(
            f"image {path} cannot be encoded",
            got=f"{image.dtype} {image.shape}",
            fix="name it .png, or .jpg for 8 bits",
        )
    with written_file(path) as scratch:
        scratch.write_bytes(data.tobytes())


def is_cut_off(content: bytes) -> bool:
    """Tell whether a JPEG or PNG lacks its end; OpenCV would fill the missing part with grey and say nothing.

    A JPEG's end marker must follow its last start of scan (a thumbnail within has markers of its own).
    """
    if content.startswith(b"\xff\xd8"):
        return content.rfind(b"\xff\xd9") <= content.rfind(b"\xff\xda")
    return content.startswith(b"\x89PNG") and b"IEND" not in content[-64:]


def decode_image(content: bytes, what: PathLike) -> UInt8[np.ndarray, "h w 3"]:
    """Return the RGB pixels of an encoded image."""
    import cv2

    bgr = _decode(content, cv2.IMREAD_COLOR, what)
    if bgr is None:
        raise DataError(f"image {what} cannot be decoded", expected="a JPEG or PNG", fix="is the file truncated?")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)  # pyright: ignore[reportReturnType]


def _decode(content: bytes, flags: int, what: PathLike) -> np.ndarray | None:
    """Return the pixels, or None where OpenCV finds no image, or nothing at all."""
    import cv2

    if is_cut_off(content):
        raise DataError(
            f"image {what} is truncated", expected="its end marker", got=f"{len(content)} bytes", fix="copy it again"
        )
    return cv2.imdecode(np.frombuffer(content, np.uint8), flags) if content else None
