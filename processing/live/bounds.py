"""The follower comes last: it yields the processor to everything else, and its memory is bounded."""

from __future__ import annotations

import contextlib
import os
import resource
from pathlib import Path

NICEST = 19


def come_last() -> None:
    """Yield to all other programs. Where the system groups programs by session, the group too, if it is our own."""
    with contextlib.suppress(OSError):
        os.nice(NICEST)
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    if os.getsid(0) == os.getpid():
        with contextlib.suppress(OSError):
            Path("/proc/self/autogroup").write_text(f"{NICEST}\n")


def bound_memory(gigabytes: float) -> None:
    """Data beyond this is refused (MemoryError). A limit that is lower already stays."""
    wanted = int(gigabytes * 1e9)
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    most = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (most, hard))


def unbound_memory() -> None:
    """The whole pipeline afterwards has no bound: nobody records any more."""
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (hard, hard))
