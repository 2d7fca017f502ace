"""A device as a context: opened on the way in, stopped and closed on the way out."""

from __future__ import annotations

from typing import TypeVar

Opened = TypeVar("Opened", bound="OpenedByContext")


class OpenedByContext:
    """What a driver with `open`, `stop` and `close` inherits."""

    def __enter__(self: Opened) -> Opened:
        self.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()
        self.close()

    def open(self) -> None:
        raise NotImplementedError

    def stop(self) -> None:
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError
