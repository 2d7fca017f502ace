"""A vendor's client in a process of its own: what crosses the pipe between the driver and it.

Why a process: libfranka's Python binding never gives up the interpreter's lock while it waits for the arm, so one
motion would stop every other thread of the recorder; and a 1 kHz loop shall not wait for anybody's JPEG encoder.

Both ways go frames of one letter, a length and a payload: `J` is a JSON object, any other letter is raw bytes.
"""

from __future__ import annotations

import fcntl
import gc
import json
import os
import select
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from pathlib import Path
from typing import Any, NoReturn

from acquisition.devices import DeviceLost
from acquisition.streaming.streams import LOOPS, go_first

_HEAD = struct.Struct("<cI")
STDERR_LINES = 20
PIPE_BYTES = 1 << 20
KEPT_BYTES = 1 << 22
LEAVE_S = 0.5
STOP_S = 1.5
LAST_WORDS_S = 1.0


class Worker:
    """The driver's end: starts `python -m module arguments`, hands what it sends to `on_frame` in a thread of its own.

    `on_end` is called once, with the reason, when the child ends on its own.
    """

    def __init__(
        self,
        module: str,
        arguments: list[str],
        on_frame: Callable[[bytes, bytes], None],
        on_end: Callable[[str], None],
    ) -> None:
        self._on_frame, self._on_end = on_frame, on_end
        self._errors: deque[str] = deque(maxlen=STDERR_LINES)
        self._writing = threading.Lock()
        self._stopping = False
        self._child = subprocess.Popen(
            [sys.executable, "-m", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=Path(__file__).resolve().parents[3],
        )
        self._errors_reader = threading.Thread(target=self._collect_errors, daemon=True)
        self._frames_reader = threading.Thread(target=self._receive, daemon=True)
        self._errors_reader.start()
        self._frames_reader.start()

    def send(self, message: dict[str, Any], blob: bytes = b"") -> None:
        """A command, and the bytes that belong to it. Raises DeviceLost when the child is gone."""
        assert self._child.stdin is not None
        with self._writing:
            try:
                self._child.stdin.write(_frame(b"J", json.dumps(message | {"blob": len(blob)}).encode()) + blob)
                self._child.stdin.flush()
            except (OSError, ValueError) as error:
                raise DeviceLost(f"the driver's process is gone: {self._last_words()}") from error

    def stop(self) -> None:
        """End the child within 2 s, by force where it does not listen."""
        self._stopping = True
        try:
            self.send({"do": "quit"})
        except DeviceLost:
            pass
        try:
            self._child.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        for thread in (self._errors_reader, self._frames_reader):
            thread.join(0.2)
        for pipe in (self._child.stdin, self._child.stdout, self._child.stderr):
            if pipe is not None:
                _close(pipe)

    def _receive(self) -> None:
        pipe = self._child.stdout
        assert pipe is not None
        while True:
            head = pipe.read(_HEAD.size)
            if len(head) < _HEAD.size:
                break
            kind, size = _HEAD.unpack(head)
            self._on_frame(kind, pipe.read(size))
        if not self._stopping:
            self._child.wait()
            self._errors_reader.join(LAST_WORDS_S)  # what it said last may still be in the pipe
            self._on_end(self._last_words())

    def _collect_errors(self) -> None:
        assert self._child.stderr is not None
        for line in self._child.stderr:
            self._errors.append(line.decode(errors="replace").rstrip())

    def _last_words(self) -> str:
        return self._errors[-1] if self._errors else "it said nothing"


class WorkerEnd:
    """The child's end. Commands are looked at between two states, so nothing here waits unless told to.

    What the driver does not take in time is kept, up to KEPT_BYTES; then states are given up (their numbers show it),
    because a control loop that waits for a busy recorder is worse.
    """

    def __init__(self) -> None:
        self._out = os.dup(1)
        os.dup2(2, 1)  # whatever the vendor's library prints must not meet the frames
        if isinstance(sys.stdout, TextIOWrapper):
            sys.stdout.reconfigure(line_buffering=True)  # nor come after the error that the child ends by
        os.set_blocking(self._out, False)
        if hasattr(fcntl, "F_SETPIPE_SZ"):
            fcntl.fcntl(self._out, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self._waiting = bytearray()
        self._in = 0
        self._writing = threading.Lock()
        go_first(LOOPS)
        gc.disable()  # no pauses in a 1 kHz loop; nothing here makes cycles

    def emit(self, kind: bytes, payload: bytes) -> None:
        with self._writing:
            if kind == b"J" or len(self._waiting) < KEPT_BYTES:
                self._waiting += _frame(kind, payload)
            self._flush()

    def _flush(self) -> None:
        while self._waiting:
            try:
                sent = os.write(self._out, self._waiting)
            except BlockingIOError:
                return
            del self._waiting[:sent]

    def event(self, event: str, **detail: Any) -> None:
        self.emit(b"J", json.dumps({"event": event, **detail}).encode())

    @contextmanager
    def failing(self, kind: str, *expected: type[Exception]) -> Iterator[None]:
        """Around a part of opening: what it raises is told to the driver as a failure of this kind, and ends all."""
        try:
            yield
        except expected as error:
            self.event("failed", kind=kind, reason=str(error))
            self.leave()

    def leave(self) -> NoReturn:
        """End the process now: threads inside the vendor's library may still be waiting for an answer."""
        end_s = time.monotonic() + LEAVE_S
        while self._waiting and time.monotonic() < end_s:
            with self._writing:
                self._flush()
            time.sleep(0.001)
        os._exit(0)

    def waiting(self) -> bool:
        """Whether a command (or the end of the driver) is there."""
        return bool(select.select([self._in], [], [], 0)[0])

    def commands(self, timeout_s: float = 0.0) -> Iterator[tuple[dict[str, Any], bytes]]:
        """What has arrived, waiting at most `timeout_s` for the first. The driver's end reads as a "quit"."""
        while self._command_within(timeout_s):
            message = self._message()
            yield message
            if message[0]["do"] == "quit":
                return
            timeout_s = 0.0

    def _command_within(self, timeout_s: float) -> bool:
        """Wait for a command, and hand over meanwhile what the driver had no time for."""
        end_s = time.monotonic() + timeout_s
        while True:
            with self._writing:
                self._flush()
            full = [self._out] if self._waiting else []
            left_s = max(0.0, end_s - time.monotonic())
            if select.select([self._in], full, [], left_s)[0]:
                return True
            if time.monotonic() >= end_s:
                return False

    def _message(self) -> tuple[dict[str, Any], bytes]:
        head = self._exactly(_HEAD.size)
        if not head:
            return {"do": "quit"}, b""
        message = json.loads(self._exactly(_HEAD.unpack(head)[1]))
        return message, self._exactly(message["blob"])

    def _exactly(self, count: int) -> bytes:
        parts = bytearray()
        while len(parts) < count:
            part = os.read(self._in, count - len(parts))
            if not part:
                return b""
            parts += part
        return bytes(parts)


def _frame(kind: bytes, payload: bytes) -> bytes:
    return _HEAD.pack(kind, len(payload)) + payload


def _close(pipe: Any) -> None:
    try:
        pipe.close()
    except OSError:  # what was buffered for a child that is gone
        pass
