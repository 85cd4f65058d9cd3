"""Images in and out; colour is RGB everywhere in this package."""

from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16

from openvocab_occ.errors import DataError
from openvocab_occ.io.files import PathLike, existing, written_file


def read_image(path: PathLike) -> UInt8[np.ndarray, "h w 3"]:
    """Read a colour image as RGB."""
    import cv2

    bgr = cv2.imdecode(np.frombuffer(existing(path, "image").read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    if bgr is None:
        raise DataError(f"image {path} cannot be decoded", expected="a JPEG or PNG", fix="is the file truncated?")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)  # pyright: ignore[reportReturnType]


def read_depth(path: PathLike) -> UInt16[np.ndarray, "h w"]:
    """Read a one-channel 16-bit image."""
    import cv2

    image = cv2.imdecode(np.frombuffer(existing(path, "depth image").read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
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
    done, data = cv2.imencode(Path(path).suffix, pixels)
    if not done:
        raise DataError(f"image {path} cannot be encoded", got=f"{image.dtype} {image.shape}")
    with written_file(path) as scratch:
        scratch.write_bytes(data.tobytes())
