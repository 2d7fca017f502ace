"""Parts of one stage side by side in threads, for work that lets go of the interpreter's lock.

What the parts are is fixed by the work alone and never by the number of threads, so that the bytes are the same for any
`--jobs`. While other stages keep the cores busy, threads only fight for the interpreter: none are taken then.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Found = TypeVar("Found")
_pool: ThreadPoolExecutor | None = None
_thread = threading.local()


def _always() -> bool:
    return True


_wanted = _always


def allow_threads(count: int, wanted: Callable[[], bool] = _always) -> None:
    """How many parts this process computes at a time from now on, while they are `wanted`; one without it."""
    global _pool, _wanted
    _pool, _wanted = ThreadPoolExecutor(count, initializer=_of_pool) if count > 1 else None, wanted


def _of_pool() -> None:
    _thread.of_pool = True


def side_by_side(call: Callable[[Item], Found], items: Sequence[Item]) -> Iterator[Found]:
    """What `call` gives for each item, in order, as they end. A part's own parts come one after the other: were they
    waited for, no thread might be left for them."""
    pool = None if len(items) < 2 or getattr(_thread, "of_pool", False) or not _wanted() else _pool
    return map(call, items) if pool is None else pool.map(call, items)


def in_parts(call: Callable[[slice], Found], count: int, size: int) -> list[Found]:
    """What `call` gives for each part of `size` (the last may be smaller) of `count` items, in order."""
    return list(side_by_side(call, [slice(at, min(at + size, count)) for at in range(0, count, size)]))
