"""Image files as they lie: size and kind read from the header, bytes kept."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, UInt16
from numpy import ndarray as Array

from recordings.bounded.limits import jpeg_frame
from recordings.errors import BadInput
from recordings.geometry import CameraModel
from recordings.importers.common import read_bytes
from recordings.mcap.codec import decode_mask, decode_pixels
from recordings.records import EncodedImage

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}


@dataclass(frozen=True)
class Header:
    """What an image file says of itself. `channels` 1 is grey; a palette counts as colour."""

    encoding: Literal["jpeg", "png"]
    width: int
    height: int
    channels: int
    bits: int


def read_header(data: bytes, name: str) -> Header:
    """Kind and size of a JPEG or PNG. Raises BadInput for anything else, and for a file that was cut off or altered
    (PNG: every chunk's CRC; JPEG: its end mark)."""
    if data.startswith(PNG_MAGIC):
        return _png_header(data, name)
    if data.startswith(b"\xff\xd8"):
        return _jpeg_header(data, name)
    raise BadInput(f"{name} is neither JPEG nor PNG: it begins with {data[:8]!r}")


def _png_header(data: bytes, name: str) -> Header:
    at, header = len(PNG_MAGIC), None
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length
        if end > len(data):
            break
        if zlib.crc32(data[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            raise BadInput(f"{name} is damaged: a checksum in it differs; restore this image from its source")
        if kind == b"IHDR" and length == 13:
            width, height, bits, colour = struct.unpack_from(">IIBB", data, at + 8)
            header = Header("png", width, height, _PNG_CHANNELS.get(colour, 0), bits)
        if kind == b"IEND" and header is not None:
            return header
        at = end
    raise BadInput(f"{name} was cut off: it is a PNG without its end; restore this image from its source")


def _jpeg_header(data: bytes, name: str) -> Header:
    if b"\xff\xd9" not in data[-4096:]:
        raise BadInput(f"{name} was cut off: it is a JPEG without its end mark; restore this image from its source")
    at = jpeg_frame(data)
    if at is None:
        raise BadInput(f"{name} is damaged: a JPEG without a frame header; restore this image from its source")
    bits, height, width, channels = struct.unpack_from(">BHHB", data, at + 4)
    return Header("jpeg", width, height, channels, bits)


def read_encoded(
    path: Path, model: CameraModel, camera: str, index: int, time_ns: int, *, grey: bool = False
) -> EncodedImage:
    """A colour (or grey) image as its bytes are. Raises BadInput when its size is not the camera's."""
    data = read_bytes(path)
    header = read_header(data, str(path))
    if (header.width, header.height) != (model.width, model.height):
        raise BadInput(
            f"{path} is {header.width}x{header.height}, the camera {camera} {model.width}x{model.height}; "
            "wanted images of the size that the camera matrix belongs to"
        )
    if header.bits != 8 or (header.channels == 1) is not grey:
        wanted = "8-bit grey" if grey else "8-bit colour"
        raise BadInput(f"{path} has {header.channels} channels of {header.bits} bits; wanted {wanted}")
    return EncodedImage(camera, index, time_ns, time_ns, header.encoding, header.width, header.height, data)


def read_depth_png(path: Path) -> UInt16[Array, "h w"]:
    """A 16-bit one-channel PNG. Raises BadInput for anything else."""
    data = read_bytes(path)
    header = read_header(data, str(path))
    if header.encoding != "png" or header.bits != 16 or header.channels != 1:
        raise BadInput(
            f"{path}: {header.encoding} with {header.channels} channels of {header.bits} bits; wanted a 16-bit grey PNG"
        )
    raw = decode_pixels(data, str(path))
    if raw is None or raw.dtype != np.uint16 or raw.shape != (header.height, header.width):
        raise BadInput(f"{path} cannot be decoded as a 16-bit PNG; restore this image from its source")
    return raw


def read_mask(path: Path, width: int, height: int) -> Bool[Array, "h w"]:
    """A mask image (any value above 0 is inside) of a given size. Raises BadInput."""
    data = read_bytes(path)
    header = read_header(data, str(path))
    if (header.width, header.height) != (width, height):
        raise BadInput(
            f"{path} is {header.width}x{header.height}, the colour images are {width}x{height}; "
            "wanted a mask of the colour images' size"
        )
    return decode_mask(data, str(path))
