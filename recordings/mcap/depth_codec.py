"""Depth without loss, several times faster than PNG and never larger on recorded frames (schemas/tosslab.proto)."""

from __future__ import annotations

import threading

import cv2
import numpy as np
import zstandard
from jaxtyping import UInt16
from numpy import ndarray as Array

from recordings.bounded.limits import MOST_PIXELS
from recordings.errors import DamagedFile

DEPTH_CODEC = "delta-planes-zstd"
# Of zstd's settings only the compressor's; any decoder reads the frames. Short matches cost more than they save in the
# noise of the low bytes, and a table of 2^13 entries stays in the first-level cache.
_SETTINGS = zstandard.ZstdCompressionParameters(
    window_log=18,
    hash_log=13,
    chain_log=10,
    search_log=1,
    min_match=7,
    target_length=0,
    strategy=zstandard.STRATEGY_FAST,
)


class _Tools(threading.local):
    """zstandard's objects serve one thread at a time, and making one costs more than a small image."""

    def __init__(self) -> None:
        self.compressor = zstandard.ZstdCompressor(compression_params=_SETTINGS)
        self.decompressor = zstandard.ZstdDecompressor()


_tools = _Tools()


def pack_depth(raw: UInt16[Array, "h w"]) -> bytes:
    """Row differences modulo 2^16, zigzag, all low bytes then all high bytes, one zstd frame."""
    values = np.ascontiguousarray(raw, dtype=np.uint16).view(np.int16)
    delta = np.empty_like(values)
    delta[:, 0] = values[:, 0]
    np.subtract(values[:, 1:], values[:, :-1], out=delta[:, 1:])
    sign = delta >> 15
    np.left_shift(delta, 1, out=delta)
    np.bitwise_xor(delta, sign, out=delta)
    zigzag = delta.view(np.uint16)
    planes = np.empty((2, *zigzag.shape), dtype=np.uint8)
    np.copyto(planes[0], zigzag, casting="unsafe")
    np.copyto(planes[1], np.right_shift(zigzag, 8), casting="unsafe")
    return _tools.compressor.compress(planes.data)


def unpack_depth(data: bytes, height: int, width: int) -> UInt16[Array, "h w"]:
    """The inverse of pack_depth. Raises DamagedFile when the bytes do not hold height x width values."""
    size = 2 * height * width
    try:
        if not 0 < size <= 2 * MOST_PIXELS or zstandard.frame_content_size(data) != size:
            raise ValueError(f"they do not hold {width}x{height} values")
        planes = np.frombuffer(_tools.decompressor.decompress(data), dtype=np.uint8).reshape(2, height, width)
    except (zstandard.ZstdError, ValueError, MemoryError) as wrong:
        raise DamagedFile(f"a depth image's {len(data)} bytes cannot be unpacked: {wrong}") from wrong
    zigzag: Array = cv2.merge([planes[0], planes[1]]).reshape(height, -1).view("<u2")
    odd = np.bitwise_and(zigzag, 1)
    np.negative(odd, out=odd)
    delta = np.right_shift(zigzag, 1)
    np.bitwise_xor(delta, odd, out=delta)
    return np.cumsum(delta, axis=1, dtype=np.uint16)
