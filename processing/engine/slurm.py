"""Slots on a Slurm cluster (submitit): each stage is a job.

A job is done when its own marker, a file written last and renamed, is there; one that has left Slurm's queue without it
ended without a result. The queue itself is asked (`squeue`), so that a cluster needs no accounting. A job whose node
fails is queued again by Slurm; the lock of a stage lets go of what the first one left.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import subprocess
import threading
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

from processing.engine.each import Task
from processing.engine.outcome import Lost, Outcome, outcome_of
from recordings.bounded.documents import read_json
from recordings.errors import BadInput

AT_ONCE = 64
"""Jobs in the queue at a time, where --jobs does not say."""
POLL_S = 0.5
QUEUE_POLL_S = 3.0
"""Slurm's controller is asked this often, once for all jobs."""
MARKER_WAIT_S = 15.0
"""A shared disk may show a marker this much later than Slurm shows the job's end."""
HOURS = 8
MEMORY_GB = 8
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


class Queue:
    """Slurm's queue, asked every few seconds for all jobs; what it cannot say for a while changes nothing."""

    def __init__(self) -> None:
        self._asked_s = float("-inf")
        self._states: dict[str, str] = {}
        self._jobs: set[str] = set()
        self._lock = threading.Lock()

    def add(self, job: str) -> None:
        with self._lock:
            self._jobs.add(job)

    def remove(self, job: str) -> None:
        with self._lock:
            self._jobs.discard(job)

    def ended(self, job: str) -> bool:
        """Whether the job will not run again."""
        with self._lock:
            if time.monotonic() - self._asked_s >= QUEUE_POLL_S:
                self._asked_s = time.monotonic()
                self._states = self._ask(sorted(self._jobs))
            return self._states.get(job) in ENDED

    def _ask(self, jobs: list[str]) -> dict[str, str]:
        """State by job number, GONE for those the queue does not know; the last states where it does not answer."""
        command = ["squeue", "--noheader", "--states=all", "--format=%A %T", f"--jobs={','.join(jobs)}"]
        try:
            answer = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        except (OSError, subprocess.TimeoutExpired):
            return self._states
        if answer.returncode != 0 and "Invalid job id" not in answer.stderr:
            return self._states
        states = dict(line.split()[:2] for line in answer.stdout.splitlines() if len(line.split()) >= 2)
        return {job: states.get(job, "GONE") for job in jobs}


class SlurmJob:
    """One place in the cluster's queue; `logs` is the folder of its jobs, their logs and markers."""

    def __init__(self, logs: Path, queue: Queue) -> None:
        self._logs, self._queue = logs, queue
        self._job: Any = None
        self._stopped = False

    def perform(self, task: Task) -> Outcome:
        marker = self._logs / f"{os.path.basename(task.name)}.{uuid.uuid4().hex}.done.json"
        self._job = job = self._submitted(task, marker)
        self._queue.add(job.job_id)
        try:
            self._wait(job, marker)
            return self._outcome(task, marker)
        finally:
            self._queue.remove(job.job_id)

    def stop(self) -> None:
        self._stopped = True
        if self._job is not None:
            self._job.cancel(check=False)

    def _submitted(self, task: Task, marker: Path) -> Any:
        import submitit

        self._logs.mkdir(parents=True, exist_ok=True)
        executor = submitit.AutoExecutor(folder=self._logs, cluster="slurm")
        executor.update_parameters(timeout_min=60 * HOURS, cpus_per_task=1, mem_gb=MEMORY_GB, name="tosslab",
                                   slurm_additional_parameters={"requeue": True})  # fmt: skip
        return executor.submit(marked, task.call, marker)

    def _wait(self, job: Any, marker: Path) -> None:
        """Until the marker is there, or the job ended long enough ago that none will come."""
        ended_s = None
        while not marker.exists() and not self._stopped:
            ended_s = (ended_s or time.monotonic()) if self._queue.ended(job.job_id) else None
            if ended_s is not None and time.monotonic() - ended_s >= MARKER_WAIT_S:
                return
            time.sleep(POLL_S)

    def _outcome(self, task: Task, marker: Path) -> Outcome:
        """What the job told, or its log's last line."""
        if marker.exists():
            outcome = read_json(marker)
            marker.unlink()
            return dict(outcome)
        last = ""
        with contextlib.suppress(OSError):
            last = self._job.paths.stderr.read_text(errors="replace").strip()
        why = f" ({last.splitlines()[-1][:300]})" if last else ""
        name = os.path.basename(task.name)
        raise Lost(f"the job that computed {name} ended without a result{why}; its log is in {self._logs}. Every "
                   "finished stage is kept: run the same command again, it goes on from there")  # fmt: skip


def marked(call: Callable[[], object], marker: Path) -> None:
    """In the job's process: the call, then how it ended as the marker, whole or not there."""
    outcome = outcome_of(call)
    partial = marker.with_suffix(".partial")
    partial.write_text(json.dumps(outcome))
    partial.replace(marker)


def slurm_jobs(count: int, logs: Path) -> list[SlurmJob]:
    """So many places in the queue. Raises BadInput where there is no Slurm."""
    import submitit

    logging.getLogger("submitit").setLevel(logging.ERROR)
    if submitit.SlurmExecutor.affinity() < 0:
        raise BadInput(
            "--executor slurm: `srun` is not on this machine; run on a Slurm login node, or --executor local"
        )
    queue = Queue()
    return [SlurmJob(logs, queue) for _ in range(count)]
