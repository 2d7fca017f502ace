"""Between a driver's own thread and the one that reads: bounded, never blocks the first, never hangs the second."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Generic, TypeVar

from acquisition.devices import DeviceLost

T = TypeVar("T")


class Inbox(Generic[T]):
    """A queue of at most `capacity`. A full one gives up its oldest, and counts it in `overflowed`."""

    def __init__(self, capacity: int) -> None:
        self.overflowed = 0
        self._items: deque[T] = deque()
        self._capacity = capacity
        self._changed = threading.Condition()
        self._lost: str | None = None

    def put(self, item: T) -> None:
        with self._changed:
            if len(self._items) >= self._capacity:
                self._items.popleft()
                self.overflowed += 1
            self._items.append(item)
            self._changed.notify_all()

    def lose(self, reason: str) -> None:
        """Nothing will come any more; what is here can still be taken. The first reason stays."""
        with self._changed:
            self._lost = self._lost or reason
            self._changed.notify_all()

    @property
    def lost(self) -> str | None:
        return self._lost

    def take(self, timeout_s: float) -> T | None:
        """The oldest item, or None after the timeout. Raises DeviceLost when it is empty for good."""
        with self._changed:
            return self._items.popleft() if self._wait(timeout_s) else None

    def take_all(self, timeout_s: float) -> list[T]:
        """Everything that is there, waiting for the first. Raises DeviceLost when it is empty for good."""
        with self._changed:
            self._wait(timeout_s)
            items = list(self._items)
            self._items.clear()
            return items

    def clear(self) -> None:
        with self._changed:
            self._items.clear()

    def _wait(self, timeout_s: float) -> bool:
        end = time.monotonic() + timeout_s
        while not self._items:
            if self._lost is not None:
                raise DeviceLost(self._lost)
            left = end - time.monotonic()
            if left <= 0 or not self._changed.wait(left):
                return bool(self._items)
        return True
