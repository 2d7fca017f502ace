"""Writing an .rrd so that a refused write is an error: rerun's own file writer may wait for ever on a full disk."""

from __future__ import annotations

import os
import threading
from pathlib import Path

from recordings.errors import WriteFailed

BLOCK_BYTES = 1 << 20


class PipedFile:
    """A path that a program writes to (`path`), whose bytes a thread carries into a file.

    The writer never sees the disk's refusal: what cannot be written is thrown away, and `close` raises it.
    """

    def __init__(self, out: Path) -> None:
        self._out = out
        self._refused: OSError | None = None
        self._file = open(out, "wb", buffering=0)  # noqa: SIM115 (closed in close)
        self._reader, self._writer = os.pipe()
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    @property
    def path(self) -> Path:
        return Path(f"/dev/fd/{self._writer}")

    def close(self) -> None:
        """Call when the writer has closed its end. Raises WriteFailed where the disk refused a write."""
        if self._writer < 0:
            return
        os.close(self._writer)
        self._writer = -1
        self._thread.join()
        os.close(self._reader)
        self._file.close()
        if self._refused is not None:
            raise WriteFailed(f"{self._out} cannot be written: {self._refused.strerror}") from self._refused

    def _carry(self) -> None:
        while block := os.read(self._reader, BLOCK_BYTES):
            if self._refused is None:
                self._write(block)
        if self._refused is None:
            try:
                os.fsync(self._file.fileno())
            except OSError as refused:
                self._refused = refused

    def _write(self, block: bytes) -> None:
        left = memoryview(block)
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError as refused:
            self._refused = refused
