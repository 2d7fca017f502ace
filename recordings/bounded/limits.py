"""What a file may ask of this machine: every limit on decoding, in one place, and the decoders that keep it.

A few kilobytes can be made to unpack to gigabytes, a header can promise any size, a list can be nested without end.
What a file declares is therefore compared with these limits before memory is taken, and a decompressor stops at what
was declared. Recordings of real devices stay far below: the limits leave room for the largest sensors in use.
"""

from __future__ import annotations

import bz2
import math
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from numpy import ndarray as Array

MOST_PIXELS = 1 << 25
"""Of one image: 6464 x 5188 and the like."""
MOST_CHUNK_BYTES = 1 << 27
"""Of one chunk of a recording, unpacked: the largest raw image fits in."""
UNPACKED_FLOOR_BYTES = 1 << 28
UNPACKED_TIMES = 32
"""All compressed parts of a file together may unpack to the floor and this many times the file's size. Raw images of
a dark room reach 10."""
MOST_RECORDS = 1 << 19
"""Records in compressed chunks, above one for every 16 bytes of the file."""
MOST_DOCUMENT_BYTES = 1 << 24
"""Of a JSON document. A session's are a thousandth of it."""
MOST_CONFIG_BYTES = 1 << 18
"""Of a YAML file."""
DEEPEST = 100
"""Levels of nesting in a document."""
MOST_NODES = 100_000
"""Values of a YAML file, aliases written out; elements of an XML file."""
MOST_XML_BYTES = 1 << 24
MOST_ARRAY_BYTES = 1 << 28
"""All arrays of one .npz or .npy together."""
MOST_MESH_BYTES = 1 << 26
MOST_VERTICES = 2_000_000
MOST_JOINTS = 1_000
MOST_PICKLE_STEPS = 1_000_000
"""Opcodes in a checkpoint's pickle; a large network has some ten thousand."""
MOST_TENSOR_STEPS = 10_000
"""Opcodes in the pickle of one plain tensor; it takes some fifty."""
SEARCHED_TIMES = 8
"""A damaged file is searched for whole records by reading at most this many times its size."""
_BLOCK = 1 << 20


def unpacked_limit(file_bytes: int) -> int:
    """How many bytes a file of a size may unpack to, all in all."""
    return UNPACKED_FLOOR_BYTES + UNPACKED_TIMES * file_bytes


class Budget:
    """What the compressed parts of one file may still unpack to. Raises ValueError when it is spent."""

    def __init__(self, file_bytes: int) -> None:
        self.file_bytes = file_bytes
        self._bytes = unpacked_limit(file_bytes)
        self._records = MOST_RECORDS + file_bytes // 16

    def take(self, unpacked: int) -> None:
        self._bytes -= unpacked
        if self._bytes < 0:
            raise ValueError(
                f"its parts unpack to more than {unpacked_limit(self.file_bytes) >> 20} MiB, from a file of "
                f"{self.file_bytes} bytes: no recording does"
            )

    def record(self) -> None:
        self._records -= 1
        if self._records < 0:
            raise ValueError(f"more records than a file of {self.file_bytes} bytes may hold")


def unpack(compression: str, data: bytes | memoryview, size: int) -> bytes | memoryview:
    """A chunk's bytes, `compression` "" (none), zstd, lz4 or bz2, never more than the declared `size`.

    Raises ValueError when they are not `size` bytes, `size` is above the limit or the compression is unknown.
    """
    if size > MOST_CHUNK_BYTES:
        raise ValueError(f"a chunk that declares {size} bytes; wanted at most {MOST_CHUNK_BYTES}")
    try:
        if compression == "zstd" and zstandard.frame_content_size(data) not in (-1, size):
            raise ValueError("the chunk's head and its content disagree in size")
        raw = _unpack(compression, data, size)
    except (zstandard.ZstdError, RuntimeError, OSError, EOFError) as wrong:
        raise ValueError(f"{compression} data cannot be decompressed: {wrong}") from wrong
    if len(raw) != size:
        more = "more than " if len(raw) > size else ""
        raise ValueError(f"a chunk gave {more}{min(len(raw), size)} bytes, its head says {size}")
    return raw


def _unpack(compression: str, data: bytes | memoryview, size: int) -> bytes | memoryview:
    if compression == "":
        return data
    if compression == "zstd":
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    if compression == "lz4":
        return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    if compression == "bz2":
        return bz2.BZ2Decompressor().decompress(data, max_length=size + 1)
    raise ValueError(f"chunk compression '{compression}' is not known; wanted none, zstd, lz4 or bz2")


def unpack_some(compression: str, data: bytes) -> bytes:
    """As `unpack`, where no size is declared: any up to the limit. Raises ValueError."""
    if compression == "zstd" and zstandard.frame_content_size(data) > MOST_CHUNK_BYTES:
        raise ValueError(f"data that declares {zstandard.frame_content_size(data)} bytes")
    try:
        raw = bytes(_unpack(compression, data, MOST_CHUNK_BYTES))
    except (zstandard.ZstdError, RuntimeError, OSError, EOFError) as wrong:
        raise ValueError(f"{compression} data cannot be decompressed: {wrong}") from wrong
    if len(raw) > MOST_CHUNK_BYTES:
        raise ValueError(f"a chunk of more than {MOST_CHUNK_BYTES} bytes")
    return raw


def copy_unpacked(packed: Any, out: Any, file_bytes: int) -> None:
    """Unpack a stream into a file, up to what a file of that size may unpack to. Raises ValueError."""
    budget = Budget(file_bytes)
    while block := packed.read(_BLOCK):
        budget.take(len(block))
        out.write(block)


def read_bytes(path: Path, most: int, what: str) -> bytes:
    """A file's bytes, never more than `most`. Raises OSError, ValueError."""
    if (size := path.stat().st_size) > most:
        raise ValueError(f"{what} of {size} bytes; wanted at most {most}")
    with open(path, "rb") as file:
        return file.read(most)


@contextmanager
def open_npz(path: Path) -> Iterator[Any]:
    """The arrays of an .npz by name, once its directory and the arrays' headers were found within the limits.

    Whatever its bytes make numpy or zipfile raise comes out as ValueError, inside of the `with`, too.
    """
    try:
        _check_npz(path)
        with np.load(path, allow_pickle=False) as stored:
            yield stored
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, MemoryError) as wrong:
        raise ValueError(f"no whole .npz file: {wrong or type(wrong).__name__}") from wrong


def read_npy(path: Path) -> Array:
    """The array of an .npy file. Raises ValueError, OSError."""
    size = path.stat().st_size
    try:
        with open(path, "rb") as file:
            _check_array(file, size, path.name)
        return np.load(path, allow_pickle=False)
    except (EOFError, RuntimeError, MemoryError) as wrong:
        raise ValueError(f"no whole .npy file: {wrong or type(wrong).__name__}") from wrong


def _check_npz(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        total = sum(e.file_size for e in entries)
        if total > MOST_ARRAY_BYTES:
            raise ValueError(f"its arrays unpack to {total} bytes; wanted at most {MOST_ARRAY_BYTES}")
        for entry in entries:
            with archive.open(entry) as file:
                _check_array(file, entry.file_size, entry.filename)


def _check_array(file: Any, size: int, name: str) -> None:
    """An array's header against the bytes that are there: numpy takes the memory before it reads."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    promised = math.prod(shape) * dtype.itemsize
    if promised > min(size, MOST_ARRAY_BYTES):
        raise ValueError(f"{name} promises an array of {promised} bytes in {size}; wanted at most {MOST_ARRAY_BYTES}")


def image_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) that a PNG or JPEG declares, read from its header alone; None where it is neither."""
    if data[:8] == b"\x89PNG\r\n\x1a\n" and data[12:16] == b"IHDR" and len(data) >= 24:
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    at = jpeg_frame(data)
    if at is None:
        return None
    return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")


def jpeg_frame(data: bytes) -> int | None:
    """Where a JPEG's frame header (its SOF mark) begins; None where there is none."""
    at = 2 if data[:2] == b"\xff\xd8" else len(data)
    while at + 9 < len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF or 0xD0 <= marker <= 0xD8 or marker == 0x01:  # fill bytes and marks without a body
            at += 1 if marker == 0xFF else 2
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return at
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None
