"""A thread beside the recording, which may be slow: nothing of the recording waits for it."""

from __future__ import annotations

import threading
from collections.abc import Callable

LEFT_AFTER_S = 2.0


class SideThread:
    """Calls `step` every so often, from the start of its context to the end, which waits LEFT_AFTER_S at most."""

    def __init__(self, name: str, every_s: float, step: Callable[[], None]) -> None:
        self._every_s, self._step, self._stop = every_s, step, threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def __enter__(self) -> SideThread:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """No step is begun from here on."""
        self._stop.set()
        self._thread.join(LEFT_AFTER_S)

    def _run(self) -> None:
        while not self._stop.wait(self._every_s):
            self._step()
