"""The newest colour and depth image, from one process to others on the same machine, through shared memory.

The writer never waits and never knows who reads; a reader takes the newest frame, or notices that it was overwritten
and takes the next. A file of SLOTS equal slots after a head of 64 bytes: magic, slot size, the newest frame's number.
"""

from __future__ import annotations

import mmap
import os
import struct
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16
from numpy import ndarray as Array

from recordings.errors import BadInput

MAGIC = b"TOSSFRM1"
SLOTS = 4
_HEAD = struct.Struct("<8sQQ")
HEAD_BYTES = 64
_SLOT = struct.Struct("<QQqqqIIIId")
"""Number twice (before and after: they differ while it is written), times of colour, depth, receipt (ns), colour's and
depth's width and height, depth's unit (m)."""


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """A frame as it was received; times on the session clock (ns), `host_ns` on the host's monotonic one."""

    number: int
    time_ns: int
    depth_time_ns: int
    host_ns: int
    color_rgb: UInt8[Array, "h w 3"]
    depth_raw: UInt16[Array, "a b"]
    unit_m: float


def memory_folder() -> Path:
    """Where files are memory; where the system has no such place, its folder for temporary files."""
    shared = Path("/dev") / "shm"
    return shared if os.access(shared, os.W_OK) else Path(tempfile.gettempdir())


class FrameBoardWriter:
    """As a context: the file is there until its end. Frames larger than the first one do not fit and raise BadInput."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._map: mmap.mmap | None = None
        self._slot_bytes = 0
        self._number = 0

    def __enter__(self) -> FrameBoardWriter:
        return self

    def __exit__(self, *exc: object) -> None:
        if self._map is not None:
            self._map.close()
        self.path.unlink(missing_ok=True)

    def put(self, frame: LiveFrame) -> None:
        """The newest frame; its `number` is given here."""
        pixels = frame.color_rgb.nbytes + frame.depth_raw.nbytes
        if self._map is None:
            self._open(pixels)
        assert self._map is not None
        if pixels + _SLOT.size > self._slot_bytes:
            raise BadInput(
                f"a frame of {pixels} bytes after frames of {self._slot_bytes - _SLOT.size}; one size a session"
            )
        self._number += 1
        at = HEAD_BYTES + self._slot_bytes * (self._number % SLOTS)
        height, width = frame.color_rgb.shape[:2]
        rows, columns = frame.depth_raw.shape
        about = (frame.time_ns, frame.depth_time_ns, frame.host_ns, width, height, columns, rows, frame.unit_m)
        _SLOT.pack_into(self._map, at, self._number, 0, *about)
        begin = at + _SLOT.size
        memory = np.frombuffer(self._map, dtype=np.uint8)
        memory[begin : begin + frame.color_rgb.nbytes] = frame.color_rgb.reshape(-1)
        begin += frame.color_rgb.nbytes
        memory[begin : begin + frame.depth_raw.nbytes] = (
            np.ascontiguousarray(frame.depth_raw).reshape(-1).view(np.uint8)
        )
        del memory
        _SLOT.pack_into(self._map, at, self._number, self._number, *about)
        _HEAD.pack_into(self._map, 0, MAGIC, self._slot_bytes, self._number)

    def _open(self, pixels: int) -> None:
        self._slot_bytes = (_SLOT.size + pixels + 63) // 64 * 64
        with open(self.path, "xb+") as file:
            os.fchmod(file.fileno(), 0o600)
            file.truncate(HEAD_BYTES + SLOTS * self._slot_bytes)
            self._map = mmap.mmap(file.fileno(), 0)
        _HEAD.pack_into(self._map, 0, MAGIC, self._slot_bytes, 0)


class FrameBoardReader:
    """Reads what a writer puts. `newest` gives each frame at most once."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._map: mmap.mmap | None = None
        self._seen = 0
        self.missed = 0
        """Frames that were never seen, because newer ones came meanwhile."""

    def newest(self) -> LiveFrame | None:
        """None where no newer frame is there (or no writer yet). Raises BadInput for a file that is no board."""
        if self._map is None and not self._open():
            return None
        assert self._map is not None
        _, slot_bytes, number = _HEAD.unpack_from(self._map, 0)
        if number <= self._seen or len(self._map) < HEAD_BYTES + SLOTS * slot_bytes:
            return None
        at = HEAD_BYTES + slot_bytes * (number % SLOTS)
        first, last, time_ns, depth_ns, host_ns, width, height, columns, rows, unit_m = _SLOT.unpack_from(self._map, at)
        color_bytes, depth_bytes = 3 * width * height, 2 * columns * rows
        if first != last or _SLOT.size + color_bytes + depth_bytes > slot_bytes:
            return None
        begin = at + _SLOT.size
        color = np.frombuffer(self._map, np.uint8, color_bytes, begin).reshape(height, width, 3).copy()
        depth = np.frombuffer(self._map, np.uint16, columns * rows, begin + color_bytes).reshape(rows, columns).copy()
        if _SLOT.unpack_from(self._map, at)[:2] != (first, first):
            return None  # overwritten meanwhile: the next call takes the newer one
        self.missed += number - self._seen - 1 if self._seen else 0
        self._seen = number
        return LiveFrame(number, time_ns, depth_ns, host_ns, color, depth, unit_m)

    def _open(self) -> bool:
        try:
            with open(self._path, "rb") as file:
                found = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError):
            return False  # not there yet, or empty
        if len(found) < HEAD_BYTES or found[: len(MAGIC)] not in (MAGIC, bytes(len(MAGIC))):
            raise BadInput(f"{self._path} holds no live frames; wanted the file that toss-record --live pose writes")
        if found[: len(MAGIC)] != MAGIC:
            return False
        self._map = found
        return True
