"""How many stages are computed at a time on this machine."""

from __future__ import annotations

import os
from pathlib import Path

from recordings.errors import BadInput

STAGE_GB = 2.0
"""Memory that a stage may take: one process that ran every stage of ten 640x480 tosses was seen at 1.64 GB resident."""
GIB = 2**30
CGROUP = Path("/sys/fs/cgroup")


def cores() -> int:
    """Cores that this process may use: the machine's, less where it is confined to some or to a quota."""
    mine = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = _words(CGROUP / "cpu.max")
    if len(quota) == 2 and quota[0] != "max":
        mine = min(mine, max(1, round(int(quota[0]) / int(quota[1]))))
    return mine


def free_gb() -> float | None:
    """Memory that is free, or freed when asked for (GiB); None where the system does not tell."""
    fields = dict(line.split(":", 1) for line in _text(Path("/proc/meminfo")).splitlines() if ":" in line)
    free = [float(fields["MemAvailable"].split()[0]) * 1024] if "MemAvailable" in fields else []
    most, used = _words(CGROUP / "memory.max"), _words(CGROUP / "memory.current")
    if most and used and most[0] != "max":
        free.append(float(most[0]) - float(used[0]))
    return min(free) / GIB if free else None


def chosen_jobs(given: int | None) -> tuple[int, str | None]:
    """How many at a time, and what to tell where memory is shorter than cores. Raises BadInput below one."""
    if given is not None:
        if given < 1:
            raise BadInput(f"--jobs {given}: wanted how many stages are computed at a time, 1 or more")
        return given, None
    many, free = cores(), free_gb()
    fit = many if free is None else max(1, min(many, int(free / STAGE_GB)))
    if fit == many:
        return many, None
    return fit, f"--jobs {fit} on {many} cores: {free:.1f} GB of memory are free, and each may take {STAGE_GB}"


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""


def _words(path: Path) -> list[str]:
    return _text(path).split()
