"""Headers of image files, read without decoding."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from recordings.errors import BadInput
from recordings.importers.images import Header, read_header


@pytest.mark.parametrize("suffix, encoding", [(".jpg", "jpeg"), (".png", "png")])
@pytest.mark.parametrize("shape, channels", [((7, 13), 1), ((7, 13, 3), 3)])
def test_the_header_says_kind_and_size(suffix, encoding, shape, channels):
    data = cv2.imencode(suffix, np.zeros(shape, dtype=np.uint8))[1].tobytes()
    assert read_header(data, "image") == Header(encoding, 13, 7, channels, 8)


def test_a_depth_image_has_16_bits():
    data = cv2.imencode(".png", np.zeros((7, 13), dtype=np.uint16))[1].tobytes()
    assert read_header(data, "depth") == Header("png", 13, 7, 1, 16)


def test_a_progressive_jpeg_is_read_too():
    flags = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 2]
    data = cv2.imencode(".jpg", np.zeros((48, 64, 3), dtype=np.uint8), flags)[1].tobytes()
    assert read_header(data, "image") == Header("jpeg", 64, 48, 3, 8)


@pytest.mark.parametrize("damage", ["cut", "flip"])
def test_a_damaged_png_is_found_at_every_byte(damage):
    whole = cv2.imencode(".png", np.arange(35, dtype=np.uint8).reshape(5, 7))[1].tobytes()
    for at in range(len(whole)):
        spoilt = whole[:at] if damage == "cut" else whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]
        with pytest.raises(BadInput):
            read_header(spoilt, "mask")


def test_whatever_bytes_raise_nothing_but_bad_input():
    chance = np.random.default_rng(0)
    for suffix in (".jpg", ".png"):
        whole = cv2.imencode(suffix, chance.integers(0, 255, (9, 9, 3), dtype=np.uint8))[1]
        for _ in range(400):
            spoilt = whole.copy()
            spoilt[chance.integers(len(spoilt), size=3)] = chance.integers(0, 255, 3)
            try:
                read_header(spoilt.tobytes()[: int(chance.integers(1, len(spoilt) + 1))], "image")
            except BadInput:
                pass
