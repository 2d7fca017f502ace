"""The engine: calls of stages that do not need each other, side by side.

What asks for stages (the pipeline, a row of the table, one of several sessions) runs here, in threads that cost nothing
while they wait; what computes them runs in slots, each of which does one stage at a time: a process on this machine
(`workers.py`) or a job on a cluster (`slurm.py`). However the asking is nested, no more stages are computed at once
than there are slots. A stage is whole when its own stage.json is there, wherever it was computed.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Protocol, TypeVar, runtime_checkable

from processing.engine.outcome import Lost, Outcome, raise_outcome
from recordings.progress import Board

Item = TypeVar("Item", bound=Hashable)
Found = TypeVar("Found")
ENDS_WITHIN_S = 10.0
"""What was stopped is waited for so long."""


@dataclass(frozen=True)
class Task:
    """A stage to be computed. `name`: its folder, by which two that ask for the same one meet; `call` leaves its result
    on the disk; `clear` removes what a call that was killed left there."""

    name: str
    call: Callable[[], object]
    clear: Callable[[], None]


@runtime_checkable
class Slot(Protocol):
    """Computes one stage at a time."""

    def perform(self, task: Task) -> Outcome:
        """How the call ended. Raises `Lost` where it ended without telling."""
        ...

    def stop(self) -> None:
        """Ends it at once, whatever it does; `perform` then raises `Lost`."""
        ...


@runtime_checkable
class Engine(Protocol):
    """Two verbs: `each` for those who ask, `run` for the store of stages."""

    def each(self, items: Iterable[Item], call: Callable[[Item], Found]) -> dict[Item, Found]:
        """`call` of every item, begun in their order. What the first of them raised is raised, once the others that
        were begun by then have ended; the rest is not begun."""
        ...

    def run(self, task: Task) -> None:
        """Returns when the stage is whole; raises what it raised."""
        ...


class InTurn:
    """One after the other, in this process."""

    def each(self, items: Iterable[Item], call: Callable[[Item], Found]) -> dict[Item, Found]:
        return {item: call(item) for item in items}

    def run(self, task: Task) -> None:
        task.call()


class Stopped(Exception):
    """A stage that was not begun, because another one beside it failed or the run was interrupted."""


@dataclass(eq=False)
class _Group:
    """The calls of one `each`, which end together: where one fails, no stage is begun any more for the others."""

    within: _Group | None
    failed: bool = False

    def stopped(self) -> bool:
        return self.failed or (self.within is not None and self.within.stopped())


@dataclass(eq=False)
class _Asked:
    """A stage that somebody waits for."""

    task: Task
    group: _Group | None
    done: Future[None] = field(default_factory=Future)


class SideBySide:
    """An engine with slots. Used as a context: what still runs at its end (Ctrl-C) is stopped and cleared away.

    The call of an item begins when the one before it has asked for its first stage, or has ended: so stages are asked
    for in the order of the items, whatever thread is faster, and what most depends on comes first.
    """

    def __init__(self, slots: Sequence[Slot], board: Board) -> None:
        self._slots, self._board = slots, board
        self._threads: list[threading.Thread] = []
        self._waiting: deque[_Asked] = deque()
        self._asked: dict[str, _Asked] = {}
        self._changed = threading.Condition()
        self._closed = False
        self._here = threading.local()

    def __enter__(self) -> SideBySide:
        return self

    def __exit__(self, *exc: object) -> None:
        with self._changed:
            self._closed = True
            for asked in self._waiting:
                asked.done.set_exception(Stopped())
            self._changed.notify_all()
        for slot in self._slots:
            slot.stop()
        for thread in self._threads:
            thread.join(ENDS_WITHIN_S)

    def each(self, items: Iterable[Item], call: Callable[[Item], Found]) -> dict[Item, Found]:
        group, wanted = _Group(getattr(self._here, "group", None)), list(items)
        around: tuple[threading.Event, ...] = getattr(self._here, "asked", ())
        asked = [threading.Event() for _ in wanted]
        found: dict[Item, Found] = {}
        failed: dict[Item, BaseException] = {}

        def one(number: int, item: Item) -> None:
            if number > 0:
                asked[number - 1].wait()
            self._here.group, self._here.asked = group, (*around, asked[number])
            try:
                found[item] = call(item)
            except BaseException as wrong:
                group.failed, failed[item] = True, wrong
            finally:
                asked[number].set()

        threads = [threading.Thread(target=one, args=each, daemon=True) for each in enumerate(wanted)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        _raise_first([failed[item] for item in wanted if item in failed])
        return {item: found[item] for item in wanted}

    def run(self, task: Task) -> None:
        with self._changed:
            asked = self._asked.get(task.name)
            if asked is None:
                asked = self._asked[task.name] = _Asked(task, getattr(self._here, "group", None))
                self._waiting.append(asked)
                self._board.waiting(len(self._waiting))
                self._begin()
                self._changed.notify()
        for event in getattr(self._here, "asked", ()):
            event.set()
        asked.done.result()

    def _begin(self) -> None:
        """As many threads as there is work for, each with a slot of its own."""
        if len(self._threads) < min(len(self._slots), len(self._asked)):
            slot = self._slots[len(self._threads)]
            self._threads.append(threading.Thread(target=self._serve, args=(slot,), daemon=True))
            self._threads[-1].start()

    def _serve(self, slot: Slot) -> None:
        while (asked := self._next()) is not None:
            try:
                if asked.group is not None and asked.group.stopped():
                    raise Stopped
                raise_outcome(self._performed(slot, asked.task))
            except BaseException as wrong:
                self._ended(asked)
                asked.done.set_exception(wrong)
            else:
                self._ended(asked)
                asked.done.set_result(None)

    def _performed(self, slot: Slot, task: Task) -> Outcome:
        try:
            return slot.perform(task)
        except Lost as gone:
            task.clear()
            raise (Stopped() if self._closed else gone) from None

    def _next(self) -> _Asked | None:
        with self._changed:
            while not self._waiting and not self._closed:
                self._changed.wait()
            if self._closed:
                return None
            asked = self._waiting.popleft()
            self._board.waiting(len(self._waiting))
            return asked

    def _ended(self, asked: _Asked) -> None:
        with self._changed:
            del self._asked[asked.task.name]


def _raise_first(failed: Sequence[BaseException]) -> None:
    """The first error in the order of the items; one that only was not begun tells nothing."""
    for wrong in (*(f for f in failed if not isinstance(f, Stopped)), *failed):
        raise wrong
