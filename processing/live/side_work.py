"""Work that nobody waits for, in a process of its own that begins with everything this one holds and may be ended at
any instant: what took long is thrown away when a toss comes."""

from __future__ import annotations

import contextlib
import multiprocessing
from collections.abc import Callable, Hashable
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Generic, TypeVar

from recordings.errors import TosslabError

T = TypeVar("T")


class SideWork(Generic[T]):
    """One piece of work at a time, known by what it is `of`: the same is not done twice."""

    def __init__(self) -> None:
        self._of: Hashable = None
        self._process: BaseProcess | None = None
        self._answer: Connection | None = None

    @property
    def running(self) -> bool:
        """Whether work was begun whose result was not fetched."""
        return self._process is not None

    def start(self, of: Hashable, work: Callable[[], T | None]) -> None:
        """Begin, unless it runs or was done already."""
        if self._process is not None or of == self._of or not of:
            return
        context = multiprocessing.get_context("fork")  # warm kernels and all data are there at once
        self._answer, theirs = context.Pipe(duplex=False)
        self._process = context.Process(target=_answered, args=(theirs, work), daemon=True)
        self._process.start()
        theirs.close()
        self._of = of

    def result(self) -> T | None:
        """What it found; None where nothing is ready, or nothing was found."""
        if self._process is None or self._answer is None:
            return None
        found = None
        if self._answer.poll():
            with contextlib.suppress(EOFError, OSError):
                found = self._answer.recv()
        elif self._process.is_alive():
            return None
        self._end()
        return found

    def stop(self) -> None:
        """End it; what it was of may be begun again."""
        if self._process is not None:
            self._process.kill()
            self._end()
            self._of = None

    def forget(self) -> None:
        """What was done is of no use any more."""
        self.stop()
        self._of = None

    def _end(self) -> None:
        if self._process is not None:
            self._process.join()
        if self._answer is not None:
            self._answer.close()
        self._process = self._answer = None


def _answered(answer: Connection, work: Callable[[], T | None]) -> None:
    """The result, or nothing where it cannot be had."""
    found = None
    with contextlib.suppress(TosslabError, MemoryError, ArithmeticError, ValueError):
        found = work()
    answer.send(found)
    answer.close()
