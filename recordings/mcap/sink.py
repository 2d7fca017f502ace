"""The bytes of a file that is being written: counted, hashed, synced; a refused write is never forgotten."""

from __future__ import annotations

import hashlib
import os
import zlib
from pathlib import Path

from recordings.errors import BadInput, WriteFailed


class Sink:
    """An append-only file. `crc` and `sha256` are of everything written; `error` is the first refusal, kept for ever.

    Raises BadInput when the path exists, WriteFailed when the disk refuses or the file was closed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.position = 0
        self.crc = 0
        self.error: OSError | None = None
        self._sha256 = hashlib.sha256()
        self._open = True
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        except FileExistsError as there:
            raise BadInput(f"{path} exists already; nothing was written. Choose another name or remove it") from there
        except OSError as refused:
            raise WriteFailed(f"{path} cannot be created: {refused.strerror}") from refused

    @property
    def sha256(self) -> str:
        return self._sha256.hexdigest()

    def write(self, *parts: bytes | bytearray | memoryview) -> None:
        self.check()
        for part in parts:
            try:
                self._write(memoryview(part))
            except OSError as refused:
                self.error = refused
                self.check()
            self.position += len(part)
            self._sha256.update(part)
            self.crc = zlib.crc32(part, self.crc)

    def check(self) -> None:
        """Raises what the disk said first, or that the file is closed."""
        if self.error is not None:
            raise WriteFailed(
                f"{self.path}: the disk refused a write ({self.error.strerror}) after {self.position} bytes; "
                f"what was complete before is kept: `toss-session recover {self.path} NEW.mcap`"
            ) from self.error
        if not self._open:
            raise WriteFailed(f"{self.path} is closed already; nothing more can be written to it")

    def sync(self) -> None:
        try:
            os.fsync(self._file)
        except OSError as refused:
            self.error = self.error or refused

    def close(self) -> None:
        """Close once; an error of the close is latched, `raise_latched` tells it."""
        if not self._open:
            return
        self._open = False
        try:
            os.close(self._file)
        except OSError as refused:
            self.error = self.error or refused

    def raise_latched(self) -> None:
        if self.error is not None:
            self.check()

    def _write(self, view: memoryview) -> None:
        while len(view):
            view = view[os.write(self._file, view) :]
