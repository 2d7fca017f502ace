"""Slots on this machine: processes that compute the stages they are sent, one at a time.

A worker is begun when there is work for it. It takes no notice of Ctrl-C, which its parent hears; it ends when it is
stopped, and by itself when its parent is gone, however that ended.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from functools import partial
from importlib import import_module
from multiprocessing.connection import Connection, wait
from typing import Any

from processing.engine.each import Task
from processing.engine.outcome import Lost, Outcome, outcome_of
from processing.engine.parts import allow_threads
from recordings.progress import Board, Progress, Silent

PRELOADED = ["processing.pipeline.process"]
"""Imported once, in the process that all workers are forked from (where there is such a one)."""
REPORT_EVERY_S = 0.2
WARM_AFTER_S = 2.0
WARMED = "open3d"
"""Takes most of a second to import, and many stages ask for it: a worker that waits so long does it meanwhile."""


class AtWork:
    """How many workers compute a stage, written by their parent, read by each of them (`count.value`)."""

    def __init__(self) -> None:
        self.count = _context().RawValue("i", 0)
        self._lock = threading.Lock()

    def add(self, change: int) -> None:
        with self._lock:
            self.count.value += change


class Worker:
    """A process of our own; `board` shows how far its stage is, `threads` compute its stage's parts (parts.py) for as
    long as fewer workers than that are `at_work`."""

    def __init__(self, board: Board, threads: int = 1, at_work: AtWork | None = None) -> None:
        self._board, self._threads = board, threads
        self._at_work = at_work or AtWork()
        self._process: Any = None
        self._pipe: Connection | None = None
        self._stopped = False

    def perform(self, task: Task) -> Outcome:
        import cloudpickle

        pipe = self._begun()
        self._at_work.add(1)
        try:
            pipe.send_bytes(cloudpickle.dumps(task.call))
            while True:
                message = pipe.recv()
                if isinstance(message, dict):
                    return message
                self._board.step(self, *message)
        except (EOFError, OSError):
            raise Lost(self._why(task)) from None
        finally:
            self._at_work.add(-1)
            self._board.ended(self)

    def stop(self) -> None:
        self._stopped = True
        if self._process is not None:
            self._process.kill()

    def _begun(self) -> Connection:
        if self._stopped:
            raise Lost("stopped")
        if self._process is None:
            context = _context()
            self._pipe, theirs = context.Pipe()
            self._process = context.Process(
                target=work, args=(theirs, self._threads, self._at_work.count), name="toss-process stages", daemon=True
            )
            self._process.start()
            theirs.close()
        assert self._pipe is not None
        return self._pipe

    def _why(self, task: Task) -> str:
        """What became of the process; another one takes its place where there is more to do."""
        self._process.join()
        code, self._process = self._process.exitcode, None
        how = f"was killed ({signal.Signals(-code).name})" if code < 0 else f"ended with code {code}"
        return (
            f"the process that computed {os.path.basename(task.name)} {how}; where memory was short, take fewer at a "
            "time: --jobs N. Every finished stage is kept: run the same command again, it goes on from there"
        )


def begin_imports() -> None:
    """Workers' imports begin now, while this process still imports on its own."""
    from multiprocessing import forkserver

    if _context().get_start_method() == "forkserver":
        forkserver.ensure_running()


def _context() -> Any:
    """Workers are forked from a process that has imported everything and done nothing, where the system can."""
    if not sys.platform.startswith("linux"):
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    return context


_to_parent: Connection | None = None
"""In a worker: where to tell how far its stage is."""


def work(pipe: Connection, threads: int, at_work: Any) -> None:
    """What a worker does: computes what it is sent, until nothing is sent any more."""
    global _to_parent
    _to_parent = pipe
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _quiet()
    allow_threads(threads, lambda: at_work.value < threads)
    while True:
        try:
            if WARMED not in sys.modules and not pipe.poll(WARM_AFTER_S):
                import_module(WARMED)
            call = pipe.recv_bytes()
        except (EOFError, OSError):
            return
        pipe.send(outcome_of(partial(_called, call)))


def _called(call: bytes) -> None:
    import cloudpickle

    cloudpickle.loads(call)()


def _quiet() -> None:
    """As in the command itself: what libraries warn their programmers of is not for a user."""
    import warnings

    if not sys.warnoptions:
        warnings.simplefilter("ignore")


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)


class _Reporter:
    """A stage's progress in a worker, sent to where all of them are shown."""

    def __init__(self, label: str) -> None:
        self._label = label
        self._reported_s = -float("inf")

    def step(self, done: int, total: int, note: str = "") -> None:
        now = time.monotonic()
        if _to_parent is not None and (now - self._reported_s >= REPORT_EVERY_S or done >= total):
            self._reported_s = now
            _to_parent.send((self._label, done, total, note))


class Shown:
    """`run.progress` where stages are computed in slots: sent to the board by the process that computes one."""

    def __call__(self, label: str) -> Progress:
        return Silent() if _to_parent is None else _Reporter(label)
