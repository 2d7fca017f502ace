"""Many sessions: each in a process of its own, on this machine or on a Slurm cluster (submitit)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from recordings.errors import BadInput

if TYPE_CHECKING:
    from recordings.progress import Progress

Where = Literal["local", "slurm"]
AT_ONCE = 1
"""Local processes at a time: one session keeps two cores busy."""
POLL_S = 0.5
HOURS = 8


@dataclass(frozen=True)
class Task:
    """One session: what is shown for it, and the folder that keeps its job's logs."""

    name: str
    logs: Path
    arguments: tuple[Any, ...]


def run_all(
    work: Callable[..., dict[str, Any]], tasks: Sequence[Task], where: Where, progress: Progress
) -> list[dict[str, Any]]:
    """`work(*arguments)` of every task, in their order. One that fails gives `{"error": why}` and stops no other.

    Raises BadInput where Slurm is asked for and not there.
    """
    import submitit

    if where == "slurm" and submitit.SlurmExecutor.affinity() < 0:
        raise BadInput(
            "--executor slurm: `srun` is not on this machine; run on a Slurm login node, or --executor local"
        )
    waiting, running, results = list(enumerate(tasks)), dict[int, Any](), dict[int, dict[str, Any]]()
    limit = len(tasks) if where == "slurm" else AT_ONCE
    try:
        while len(results) < len(tasks):
            while waiting and len(running) < limit:
                k, task = waiting.pop(0)
                running[k] = _executor(where, task).submit(work, *task.arguments)
            for k in [k for k, job in running.items() if job.done()]:
                results[k] = _result(running.pop(k), tasks[k])
                progress.step(len(results), len(tasks), tasks[k].name)
            time.sleep(POLL_S)
    except KeyboardInterrupt:
        for job in running.values():
            job.cancel()
        raise
    return [results[k] for k in range(len(tasks))]


def _executor(where: Where, task: Task) -> Any:
    import submitit

    task.logs.mkdir(parents=True, exist_ok=True)
    executor = submitit.AutoExecutor(folder=task.logs, cluster=where)
    executor.update_parameters(timeout_min=60 * HOURS, cpus_per_task=2, mem_gb=8, name="tosslab")
    return executor


def _result(job: Any, task: Task) -> dict[str, Any]:
    """What the job gave, or the last line of why it did not."""
    why = job.exception()
    if why is None:
        return dict(job.result())
    last = str(why).strip().splitlines()[-1] if str(why).strip() else type(why).__name__
    return {"error": f"the process ended without a result ({last}); its log is in {task.logs}"}
