"""One stream's way to the disk: queue, pre-trigger ring, its own worker thread that encodes and writes."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from acquisition.streaming.clock import ClockLine
from acquisition.streaming.streams import WRITES, BoundedQueue, Counter, go_first
from recordings.errors import BadInput, TosslabError, WriteFailed
from recordings.mcap.toss_writer import TossWriter

WAIT_S = 0.1


@dataclass(frozen=True, eq=False)
class Item:
    """Something that a stream delivered: `value` for the writer, its instant on the device's unwrapped clock.

    `clock` is (device, counter, how often that counter was set); None: there is only the time of receipt.
    """

    value: Any
    host_ns: int
    count: int = 1
    clock: tuple[str, str, int] | None = None
    device_ns: int = 0


@dataclass(eq=False)
class Take:
    """One recording. `lines` maps device clocks to the host's, each kept as it was when it was first needed."""

    writer: TossWriter
    begin_host_ns: int
    end_host_ns: int | None = None
    failed: str = ""
    lines: dict[tuple[str, str, int], ClockLine] = field(default_factory=dict)
    marks: list[threading.Event] = field(default_factory=list)


Write = Callable[[Take, Item], int]
"""Writes an item; returns how many of its parts were written (the rest it has counted as dropped)."""


class StreamQueue:
    """`offer` is called by the device's thread and never waits; everything slow happens in the queue's own thread."""

    def __init__(
        self, topic: str, rate_hz: float, queue_s: float, ring_s: float, write: Write, hold_s: float = 0.0
    ) -> None:
        self.topic, self.rate_hz = topic, rate_hz
        self.counter = Counter()
        self.last_host_ns = time.monotonic_ns()
        self.take: Take | None = None
        self._queue: BoundedQueue[Item] = BoundedQueue(max(int(queue_s * rate_hz), 4))
        self._ring: deque[Item] = deque()
        self._left_ns = 0
        self._ring_ns, self._hold_ns = round(ring_s * 1e9), round(hold_s * 1e9)
        self._write = write
        self._thread = threading.Thread(target=self._run, name=f"queue {topic}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def offer(self, item: Item) -> None:
        self.last_host_ns = item.host_ns
        self.counter.received(item.count)
        if not self._queue.offer(item):
            self.counter.dropped("queue full", item.count)

    def mark(self) -> threading.Event:
        """Set when everything offered before has gone its way."""
        return self._queue.mark()

    def stop(self, timeout_s: float) -> bool:
        """Work off what is there. False where the thread did not end in time."""
        self._queue.close()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    @property
    def waiting(self) -> int:
        """Items that were received and are not worked off."""
        return len(self._queue)

    @property
    def fullest(self) -> int:
        return self._queue.fullest

    def _run(self) -> None:
        go_first(WRITES)
        while not self._queue.closed:
            got = self._queue.take(WAIT_S)
            if isinstance(got, threading.Event):
                self._flush(self.take, everything=True)
                self._leave()
                got.set()
            elif got is not None and got.host_ns <= self._left_ns:
                self.counter.dropped("too late", got.count)
            elif got is not None:
                self._ring.append(got)
                self._flush(self.take)
            elif self._hold_ns:
                self._flush(self.take)
        while self._ring:
            self.counter.idle(self._ring.popleft().count)

    def _leave(self) -> None:
        """Nothing more goes into the take that ends: its writer is about to be somebody else's."""
        if self.take is not None and self.take.end_host_ns is not None:
            self._left_ns = self.take.end_host_ns
            self.take = None

    def _flush(self, take: Take | None, everything: bool = False) -> None:
        now_ns = time.monotonic_ns()
        while self._ring:
            item = self._ring[0]
            if take is not None and (take.end_host_ns is None or item.host_ns <= take.end_host_ns):
                if not everything and now_ns - item.host_ns < self._hold_ns:
                    return
                self._ring.popleft()
                self._put(take, item)
            elif now_ns - item.host_ns <= self._ring_ns:
                return
            else:
                self._ring.popleft()
                self.counter.idle(item.count)

    def _put(self, take: Take, item: Item) -> None:
        if item.host_ns < take.begin_host_ns:
            self.counter.idle(item.count)
            return
        if take.failed:
            self.counter.dropped("write failed", item.count)
            return
        try:
            self.counter.written(self._write(take, item))
        except WriteFailed as refused:
            take.failed = str(refused)
            self.counter.dropped("write failed", item.count)
        except BadInput:
            self.counter.dropped("invalid", item.count)
        except TosslabError as wrong:
            take.failed = str(wrong)
            self.counter.dropped("write failed", item.count)
        except Exception as fault:
            take.failed = f"{type(fault).__name__}: {fault}"
            self.counter.dropped("write failed", item.count)
