"""Images survive the round trip; what is none is refused."""

import cv2
import numpy as np
import pytest

from openvocab_occ.errors import DataError, NotFoundError
from openvocab_occ.io.images import read_depth, read_image, write_image


def test_colour_is_rgb_in_memory_and_survives_png(tmp_path, rng):
    image = rng.integers(0, 256, (6, 9, 3), dtype=np.uint8)
    write_image(tmp_path / "a.png", image)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), image)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png")), image[..., ::-1])


def test_depth_survives_png(tmp_path, rng):
    depth = rng.integers(0, 65536, (6, 9), dtype=np.uint16)
    write_image(tmp_path / "d.png", depth)
    np.testing.assert_array_equal(read_depth(tmp_path / "d.png"), depth)


def test_what_is_no_image_is_refused(tmp_path, rng):
    (tmp_path / "a.jpg").write_bytes(b"no image")
    with pytest.raises(DataError, match=r"image .*a\.jpg cannot be decoded: expected a JPEG or PNG"):
        read_image(tmp_path / "a.jpg")
    (tmp_path / "empty.jpg").touch()
    with pytest.raises(DataError, match=r"image .*empty\.jpg cannot be decoded"):
        read_image(tmp_path / "empty.jpg")
    with pytest.raises(NotFoundError, match="image not found"):
        read_image(tmp_path / "b.jpg")
    write_image(tmp_path / "c.png", rng.integers(0, 256, (6, 9, 3), dtype=np.uint8))
    with pytest.raises(DataError, match=r"depth image .*c\.png is not usable: expected 16-bit, one channel, got uint8"):
        read_depth(tmp_path / "c.png")


def test_an_unknown_ending_is_refused_and_nothing_is_written(tmp_path):
    with pytest.raises(DataError, match=r"image .*a\.xyz cannot be encoded"):
        write_image(tmp_path / "a.xyz", np.zeros((2, 2, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []
