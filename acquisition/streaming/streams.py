"""What lies between a driver and the disk: a bounded queue that never makes a driver wait, and the counts of a stream.

Whatever was received ends as written, dropped (by cause) or idle (came between takes); until then it is `waiting`.
When a recorder has stopped nothing waits any more: received = written + dropped + idle, stream by stream.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, Literal, TypeVar

T = TypeVar("T")
LOOPS, READS, WRITES = -18, -15, -11
"""How nice to other programs are: control loops of arms, threads that read devices, those that encode and write."""
Cause = Literal["queue full", "duplicate", "out of order", "invalid", "write failed", "too late"]


def go_first(niceness: int) -> None:
    """Let the calling thread run before other programs', where this user may (root, or a limit on `nice`)."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)


@dataclass(frozen=True)
class Tally:
    """Counts of one stream. `missed` never came (gaps in the device's numbers): it is no part of `received`."""

    received: int = 0
    written: int = 0
    idle: int = 0
    waiting: int = 0
    missed: int = 0
    dropped: Mapping[str, int] = field(default_factory=dict)

    @property
    def dropped_total(self) -> int:
        return sum(self.dropped.values())

    def since(self, earlier: Tally) -> Tally:
        """What was counted after `earlier`."""
        dropped = {c: n - earlier.dropped.get(c, 0) for c, n in self.dropped.items() if n > earlier.dropped.get(c, 0)}
        return Tally(
            self.received - earlier.received,
            self.written - earlier.written,
            self.idle - earlier.idle,
            self.waiting - earlier.waiting,
            self.missed - earlier.missed,
            dropped,
        )


class Counter:
    """A stream's tally while it changes; every item is counted once on its way in and once on its way out."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._received = self._written = self._idle = self._missed = 0
        self._dropped: dict[str, int] = {}

    def received(self, count: int = 1) -> None:
        with self._lock:
            self._received += count

    def written(self, count: int = 1) -> None:
        with self._lock:
            self._written += count

    def idle(self, count: int = 1) -> None:
        with self._lock:
            self._idle += count

    def missed(self, count: int = 1) -> None:
        with self._lock:
            self._missed += count

    def dropped(self, cause: Cause, count: int = 1) -> None:
        with self._lock:
            self._dropped[cause] = self._dropped.get(cause, 0) + count

    def came_and_dropped(self, cause: Cause, count: int = 1) -> None:
        """Received, and dropped at the same door."""
        with self._lock:
            self._received += count
            self._dropped[cause] = self._dropped.get(cause, 0) + count

    def tally(self) -> Tally:
        """A snapshot; what is neither written nor dropped nor idle waits in the queue, the ring or a worker's hands."""
        with self._lock:
            gone = self._written + self._idle + sum(self._dropped.values())
            return Tally(
                self._received, self._written, self._idle, self._received - gone, self._missed, dict(self._dropped)
            )


class BoundedQueue(Generic[T]):
    """At most `size` items. `offer` never waits; `mark` always finds room, so that an end is never lost."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._items: deque[T | threading.Event] = deque()
        self._ready = threading.Condition()
        self._closed = False
        self.fullest = 0

    def __len__(self) -> int:
        """Items, without the marks between them."""
        with self._ready:
            return sum(not isinstance(item, threading.Event) for item in self._items)

    def offer(self, item: T) -> bool:
        """False where the queue is full: the item was not taken."""
        with self._ready:
            if self._closed or len(self._items) >= self._size:
                return False
            self._items.append(item)
            self.fullest = max(self.fullest, len(self._items))
            self._ready.notify()
            return True

    def mark(self) -> threading.Event:
        """An event that the reader sets when everything offered before has been worked off."""
        reached = threading.Event()
        with self._ready:
            self._items.append(reached)
            self._ready.notify()
        return reached

    def take(self, timeout_s: float) -> T | threading.Event | None:
        """The oldest item or mark; None after the timeout, or at once when closed and empty."""
        with self._ready:
            if not self._items and not self._closed:
                self._ready.wait(timeout_s)
            return self._items.popleft() if self._items else None

    def close(self) -> None:
        with self._ready:
            self._closed = True
            self._ready.notify_all()

    @property
    def closed(self) -> bool:
        with self._ready:
            return self._closed and not self._items
