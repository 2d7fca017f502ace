"""How long work tells where it is, without printing by itself."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Hashable
from typing import Protocol, runtime_checkable


@runtime_checkable
class Progress(Protocol):
    """Told by a stage how far it is."""

    def step(self, done: int, total: int, note: str = "") -> None: ...


class Silent:
    """For tests and callers that do not look."""

    def step(self, done: int, total: int, note: str = "") -> None:
        pass


@runtime_checkable
class Stream(Protocol):
    """What a console must be able to do: any text stream."""

    def write(self, text: str, /) -> object: ...

    def flush(self) -> None: ...

    def isatty(self) -> bool: ...


class Log:
    """When a stream that is no terminal was last written to: all stages of a run share one, so that together they
    write a line every ten seconds at most."""

    EVERY_S = 10.0

    def __init__(self) -> None:
        self._last_s = -float("inf")

    def due(self, now_s: float) -> bool:
        """Whether a line may be written now; then it counts as written."""
        if now_s - self._last_s < self.EVERY_S:
            return False
        self._last_s = now_s
        return True


class Pace:
    """How fast work goes on, from the steps reported so far: an estimate only where the older and the newer half of
    them agree; where they do not, the older half is forgotten. What is slow once (loading, compiling) then makes no
    estimate, rather than a wrong one."""

    LEAST_S = 4.0
    """Watched for so long before anything is foretold."""
    AGREE = 2.0
    """The paces of both halves differ by less than this factor."""

    def __init__(self) -> None:
        self._reports: list[tuple[float, int]] = []
        self._total = 0

    def report(self, now_s: float, done: int, total: int) -> None:
        """Another step. Where the work is another one (it starts anew, or has another size), so is the pace."""
        if self._reports and (done < self._reports[-1][1] or total != self._total):
            self._reports.clear()
        self._total = total
        if not self._reports or done > self._reports[-1][1]:
            self._reports.append((now_s, done))
        if self._watched() and not self._agree():
            self._reports = self._reports[self._halfway() :]

    def left_s(self, now_s: float) -> float | None:
        """Seconds still to go; None where nobody can know."""
        if not self._watched():
            return None
        end_s, done = self._reports[-1]
        each_s, waited_s = _seconds_each(self._reports[self._halfway()], self._reports[-1]), now_s - end_s
        if waited_s > self.AGREE * each_s + self.LEAST_S:  # a step that takes longer than those before it
            return None
        return max(each_s * (self._total - done) - waited_s, 0.0)

    def _watched(self) -> bool:
        return len(self._reports) > 2 and self._reports[-1][0] - self._reports[0][0] >= self.LEAST_S

    def _halfway(self) -> int:
        """The step nearest to the middle of the time that was watched."""
        half_s = 0.5 * (self._reports[0][0] + self._reports[-1][0])
        return min(range(1, len(self._reports) - 1), key=lambda i: abs(self._reports[i][0] - half_s))

    def _agree(self) -> bool:
        halfway = self._reports[self._halfway()]
        older, newer = _seconds_each(self._reports[0], halfway), _seconds_each(halfway, self._reports[-1])
        return max(older, newer) <= self.AGREE * min(older, newer)


def _seconds_each(first: tuple[float, int], last: tuple[float, int]) -> float:
    return (last[0] - first[0]) / (last[1] - first[1])


class Line:
    """One line on stderr, shown only when the work takes over two seconds. On a terminal it is written over; elsewhere
    `log` says when there may be another."""

    FIRST_SHOWN_S = 2.0
    EVERY_S = 0.2

    def __init__(self, stream: Stream | None = None, log: Log | None = None) -> None:
        self._stream: Stream = stream if stream is not None else sys.stderr
        self._log = None if self._stream.isatty() else log or Log()
        self.begin(time.monotonic())

    def begin(self, now_s: float) -> None:
        """Other work begins."""
        self._started_s, self._shown_s, self._ended = now_s, -float("inf"), False

    def show(self, text: str, now_s: float, left_s: float | None, last: bool) -> None:
        """The text, with the seconds since the work began and those left, where it may be shown now."""
        elapsed_s = now_s - self._started_s
        if elapsed_s < self.FIRST_SHOWN_S or (last and self._ended) or not self._due(now_s, last):
            return
        self._shown_s, self._ended = now_s, last
        left = "" if left_s is None else f", about {_words(left_s)} left"
        self._write(f"{text} ({_words(elapsed_s)}{left})", last)

    def clear(self) -> None:
        """Nothing goes on any more: a terminal's line is free for others."""
        if self._log is None and self._shown_s > self._started_s and not self._ended:
            self._write("", last=False)

    def _due(self, now_s: float, last: bool) -> bool:
        if self._log is not None:
            return self._log.due(now_s)
        return last or now_s - self._shown_s >= self.EVERY_S

    def _write(self, text: str, last: bool) -> None:
        if self._log is not None:
            self._stream.write(f"{text}\n")
        else:
            self._stream.write(f"\r\x1b[K{text}" + ("\n" if last else ""))
        self._stream.flush()


class Console:
    """One line with an estimate, of one work at a time."""

    def __init__(self, label: str, stream: Stream | None = None, log: Log | None = None) -> None:
        self._label = label
        self._line = Line(stream, log)
        self._pace = Pace()

    def step(self, done: int, total: int, note: str = "") -> None:
        now, last = time.monotonic(), done >= total
        self._pace.report(now, done, total)
        text = f"{self._label}: {done}/{total}{f' {note}' if note else ''}"
        self._line.show(text, now, None if last else self._pace.left_s(now), last)


class Board:
    """One line for all works that go on side by side, with one estimate for them and those that wait for their turn.

    A work is told by whom it is done (anything that can be a key), so that one that ends makes room for the next.
    """

    SHARE = 1000
    """Parts that each work is counted in."""

    def __init__(self, stream: Stream | None = None, log: Log | None = None) -> None:
        self._line, self._pace = Line(stream, log), Pace()
        self._going: dict[Hashable, tuple[str, int, int]] = {}
        self._ended, self._waiting = 0, 0
        self._lock = threading.Lock()

    def waiting(self, count: int) -> None:
        """So many works wait for their turn."""
        with self._lock:
            self._waiting = count

    def step(self, who: Hashable, label: str, done: int, total: int, note: str = "") -> None:
        """How far one of the works is."""
        with self._lock:
            now = time.monotonic()
            if not self._going and not self._ended:
                self._line.begin(now)
            self._going[who] = (label, done, total)
            self._show(now)

    def ended(self, who: Hashable) -> None:
        """One of the works has ended, told of or not."""
        with self._lock:
            self._ended += self._going.pop(who, None) is not None
            if not self._going and not self._waiting:
                self._ended, self._pace = 0, Pace()
                self._line.clear()

    def _show(self, now_s: float) -> None:
        whole = self._ended + len(self._going) + self._waiting
        done = self._ended + sum(done / max(total, 1) for _, done, total in self._going.values())
        self._pace.report(now_s, int(self.SHARE * done), self.SHARE * whole)
        works = [f"{label}: {done}/{total}" for label, done, total in self._going.values()]
        more = [f"{self._waiting} more wait"] if self._waiting else []
        self._line.show(" | ".join([*works, *more]), now_s, self._pace.left_s(now_s), last=False)


def _words(seconds: float) -> str:
    """Seconds up to two minutes, then minutes."""
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
