"""How long work tells where it is, without printing by itself."""

from __future__ import annotations

import sys
import time
from typing import Protocol, runtime_checkable


@runtime_checkable
class Progress(Protocol):
    """Told by a stage: `step` how far it is, `value` a figure on the way."""

    def step(self, done: int, total: int, note: str = "") -> None: ...

    def value(self, name: str, value: float, *, at: int) -> None: ...


class Silent:
    """For tests and callers that do not look."""

    def step(self, done: int, total: int, note: str = "") -> None:
        pass

    def value(self, name: str, value: float, *, at: int) -> None:
        pass


@runtime_checkable
class Stream(Protocol):
    """What a console must be able to do: any text stream."""

    def write(self, text: str, /) -> object: ...

    def flush(self) -> None: ...

    def isatty(self) -> bool: ...


class Console:
    """One line on stderr with an estimate, shown only when the work takes over two seconds."""

    FIRST_SHOWN_S = 2.0

    def __init__(self, label: str, stream: Stream | None = None) -> None:
        self._label = label
        self._stream: Stream = stream if stream is not None else sys.stderr
        self._every_s = 0.2 if self._stream.isatty() else 10.0
        self._started_s = time.monotonic()
        self._shown_s: float | None = None
        self._begun: tuple[int, float] | None = None
        """The first step that was told, and when: what came before it (loading, compiling) is not part of the pace."""

    def step(self, done: int, total: int, note: str = "") -> None:
        now = time.monotonic()
        self._begun = self._begun or (done, now)
        elapsed = now - self._started_s
        last = done >= total
        due = self._shown_s is None or now - self._shown_s >= self._every_s or last
        if elapsed < self.FIRST_SHOWN_S or not due:
            return
        self._shown_s = now
        estimate = "" if last else self._estimate(done, total, now)
        text = f"{self._label}: {done}/{total} {note} ({elapsed:.0f} s{estimate})"
        if self._stream.isatty():
            text = f"\r\x1b[K{text}" + ("\n" if last else "")
        else:
            text += "\n"
        self._stream.write(text)
        self._stream.flush()

    def value(self, name: str, value: float, *, at: int) -> None:
        pass

    def _estimate(self, done: int, total: int, now: float) -> str:
        """How long the rest takes at the pace since the first step (or since the beginning, where steps are big)."""
        first, begun_s = self._begun or (done, now)
        if done == first:
            first, begun_s = 0, self._started_s
        return f", about {(now - begun_s) / (done - first) * (total - done):.0f} s left" if done > 1 else ""
