"""Parts of one stage side by side in threads, for compiled kernels that let go of the interpreter's lock.

What the parts are is fixed by the work alone and never by the number of threads, so that the bytes are the same for any
`--jobs`. While other stages keep the cores busy, threads gain nothing and lose nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Found = TypeVar("Found")
_pool: ThreadPoolExecutor | None = None


def allow_threads(count: int) -> None:
    """How many parts this process computes at a time from now on; one without it."""
    global _pool
    _pool = ThreadPoolExecutor(count) if count > 1 else None


def in_parts(call: Callable[[slice], Found], count: int, size: int) -> list[Found]:
    """What `call` gives for each part of `size` (the last may be smaller) of `count` items, in order."""
    parts = [slice(at, min(at + size, count)) for at in range(0, count, size)]
    return list(_pool.map(call, parts)) if _pool is not None and len(parts) > 1 else [call(part) for part in parts]
