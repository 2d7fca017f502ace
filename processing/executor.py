"""Many sessions: each in a process of its own, on this machine or on a Slurm cluster (submitit).

A job is done when its own marker, a file written last and renamed, is there; one that has left Slurm's queue without it
ended without a result. The queue itself is asked (`squeue`), so that a cluster needs no accounting. A job whose node
fails is queued again by Slurm, and goes on where its finished stages end.
"""

from __future__ import annotations

import contextlib
import json
import logging
import subprocess
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from recordings.bounded.documents import read_json
from recordings.errors import BadInput

if TYPE_CHECKING:
    from recordings.progress import Progress

Where = Literal["local", "slurm"]
AT_ONCE = 1
"""Local processes at a time: one session keeps two cores busy."""
POLL_S = 0.5
QUEUE_POLL_S = 3.0
"""Slurm's controller is asked this often, once for all jobs."""
MARKER_WAIT_S = 15.0
"""A shared disk may show a marker this much later than Slurm shows the job's end."""
HOURS = 8
ENDED = [
    "BOOT_FAIL",
    "CANCELLED",
    "COMPLETED",
    "DEADLINE",
    "FAILED",
    "NODE_FAIL",
    "OUT_OF_MEMORY",
    "PREEMPTED",
    "REVOKED",
    "TIMEOUT",
    "GONE",
]
"""Slurm's words for a job that will not run again; GONE is ours, for one that the queue has forgotten."""


@dataclass(frozen=True)
class Task:
    """One session: what is shown for it, and the folder that keeps its job's logs."""

    name: str
    logs: Path
    arguments: tuple[Any, ...]


@dataclass
class _Running:
    """A job, its marker, how late that may be seen, and since when the job is known to have ended without one."""

    job: Any
    marker: Path
    wait_s: float
    ended_s: float | None = None


def run_all(
    work: Callable[..., dict[str, Any]], tasks: Sequence[Task], where: Where, progress: Progress
) -> list[dict[str, Any]]:
    """`work(*arguments)` of every task, in their order. One that fails gives `{"error": why}` and stops no other.

    What `work` gives must be a JSON object. Raises BadInput where Slurm is asked for and not there.
    """
    import submitit

    logging.getLogger("submitit").setLevel(logging.ERROR)
    if where == "slurm" and submitit.SlurmExecutor.affinity() < 0:
        raise BadInput(
            "--executor slurm: `srun` is not on this machine; run on a Slurm login node, or --executor local"
        )
    waiting, running, results = list(enumerate(tasks)), dict[int, _Running](), dict[int, dict[str, Any]]()
    limit = len(tasks) if where == "slurm" else AT_ONCE
    ended: Callable[[Mapping[int, _Running]], set[int]] = _Queue().ended if where == "slurm" else _ended_here
    try:
        while len(results) < len(tasks):
            while waiting and len(running) < limit:
                k, task = waiting.pop(0)
                running[k] = _submit(work, task, where)
            for k in _done(running, ended(running)):
                results[k] = _result(running.pop(k), tasks[k])
                progress.step(len(results), len(tasks), tasks[k].name)
            time.sleep(POLL_S)
    except KeyboardInterrupt:
        for one in running.values():
            one.job.cancel(check=False)
        raise
    return [results[k] for k in range(len(tasks))]


def _submit(work: Callable[..., dict[str, Any]], task: Task, where: Where) -> _Running:
    import submitit

    task.logs.mkdir(parents=True, exist_ok=True)
    executor = submitit.AutoExecutor(folder=task.logs, cluster=where)
    executor.update_parameters(timeout_min=60 * HOURS, cpus_per_task=2, mem_gb=8, name="tosslab")
    if where == "slurm":
        executor.update_parameters(slurm_additional_parameters={"requeue": True})
    marker = task.logs / f"{uuid.uuid4().hex}.done.json"
    wait_s = MARKER_WAIT_S if where == "slurm" else 0.0
    return _Running(executor.submit(_marked, work, task.arguments, marker), marker, wait_s)


def _marked(work: Callable[..., dict[str, Any]], arguments: tuple[Any, ...], marker: Path) -> None:
    """In the job's process: the work, then its result, or what it raised, as the marker, whole or not there."""
    try:
        _write_marker(marker, {"result": work(*arguments)})
    except Exception as wrong:
        _write_marker(marker, {"raised": f"{type(wrong).__name__}: {wrong}"})
        raise  # for the log


def _write_marker(marker: Path, told: dict[str, Any]) -> None:
    partial = marker.with_suffix(".partial")
    partial.write_text(json.dumps(told))
    partial.replace(marker)


def _done(running: Mapping[int, _Running], ended: set[int]) -> list[int]:
    """Jobs with a marker, and those that ended long enough ago that none will come."""
    now_s, done = time.monotonic(), []
    for k, one in running.items():
        one.ended_s = (one.ended_s or now_s) if k in ended else None
        if one.marker.exists() or (one.ended_s is not None and now_s - one.ended_s >= one.wait_s):
            done.append(k)
    return done


def _ended_here(running: Mapping[int, _Running]) -> set[int]:
    return {k for k, one in running.items() if one.job.done()}


class _Queue:
    """Slurm's queue, asked every few seconds; what it cannot say for a while changes nothing."""

    def __init__(self) -> None:
        self._asked_s = float("-inf")
        self._states: dict[str, str] = {}

    def ended(self, running: Mapping[int, _Running]) -> set[int]:
        if time.monotonic() - self._asked_s >= QUEUE_POLL_S and running:
            self._asked_s = time.monotonic()
            self._states = self._ask([one.job.job_id for one in running.values()])
        return {k for k, one in running.items() if self._states.get(one.job.job_id) in ENDED}

    def _ask(self, jobs: Sequence[str]) -> dict[str, str]:
        """State by job number, GONE for those the queue does not know; the last states where it does not answer."""
        command = ["squeue", "--noheader", "--states=all", "--format=%A %T", f"--jobs={','.join(jobs)}"]
        try:
            answer = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        except (OSError, subprocess.TimeoutExpired):
            return self._states
        if answer.returncode != 0 and "Invalid job id" not in answer.stderr:
            return self._states
        told = dict(line.split()[:2] for line in answer.stdout.splitlines() if len(line.split()) >= 2)
        return {job: told.get(job, "GONE") for job in jobs}


def _result(one: _Running, task: Task) -> dict[str, Any]:
    """What the job gave, or what it raised, or its log's last line."""
    last = ""
    if one.marker.exists():
        told = read_json(one.marker)
        one.marker.unlink()
        if "result" in told:
            return dict(told["result"])
        last = str(told["raised"])
    else:
        with contextlib.suppress(OSError):
            last = one.job.paths.stderr.read_text(errors="replace").strip()
    why = f" ({last.splitlines()[-1][:300]})" if last else ""
    return {"error": f"the process ended without a result{why}; its log is in {task.logs}"}
