"""Run once, resume always: a stage computes into `<stage>-<key8>.partial` and is renamed when whole.

The key covers the stage's name and version, its settings and the keys of its inputs; a name alone never decides what
may be reused. Two runs on one results folder meet at a lock per stage: the second waits and reads what the first made.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from processing.engine.each import Engine, InTurn, Task
from recordings.bounded.documents import read_json, tuples
from recordings.errors import BadInput, WriteFailed

Result = TypeVar("Result")
"""A frozen dataclass of plain values: what a stage counted and decided, kept in its stage.json."""
NO_SPACE = (errno.ENOSPC, errno.EDQUOT)
HALF = ".partial"
"""What the folder of a stage that is being computed ends with."""
SHOWN = 8
"""Characters of the key in a folder's name."""


@dataclass(frozen=True)
class Done(Generic[Result]):
    """A finished stage: its folder, its whole key, its result, and whether it was read rather than run."""

    folder: Path
    key: str
    result: Result
    reused: bool

    @property
    def name(self) -> str:
        """The folder's name, as variants refer to it."""
        return self.folder.name


def fingerprint(stage: str, version: int, config: Any, inputs: Mapping[str, str]) -> str:
    """sha256 of everything that decides a stage's output. `config` is a dataclass or JSON values."""
    content = {"stage": stage, "version": version, "config": plain(config), "inputs": dict(inputs)}
    return hashlib.sha256(json.dumps(content, sort_keys=True, allow_nan=False).encode()).hexdigest()


def plain(config: Any) -> Any:
    """Settings as JSON values."""
    return asdict(config) if is_dataclass(config) and not isinstance(config, type) else config


class Store:
    """A results folder in which stages are run or found; by `engine` they run here, or side by side elsewhere."""

    def __init__(self, results: Path, engine: Engine | None = None) -> None:
        self.results = results
        self.engine: Engine = engine if engine is not None else InTurn()
        with _spoken(results):
            try:
                results.mkdir(parents=True, exist_ok=True)
            except OSError as refused:
                if refused.errno in NO_SPACE:
                    raise
                reason = (refused.strerror or str(refused)).lower()
                raise BadInput(f"{results} cannot be made ({reason}); choose another place with --out DIR") from refused
            if not os.access(results, os.W_OK):
                raise BadInput(f"{results} cannot be written to; choose another place with --out DIR")

    def __getstate__(self) -> dict[str, Any]:
        return {"results": self.results, "engine": InTurn()}  # where a stage is computed, no other is sent on

    def run(
        self,
        stage: str,
        version: int,
        config: Any,
        inputs: Mapping[str, str],
        kind: type[Result],
        compute: Callable[[Path], Result],
    ) -> Done[Result]:
        """The finished stage: read where it is there, computed where not.

        `compute(folder)` writes the stage's files and returns its result, a dataclass of this `kind`.
        Raises WriteFailed when the disk is full; whatever interrupts it leaves no half stage behind.
        """
        key = fingerprint(stage, version, config, inputs)
        folder = self.results / f"{stage}-{key[:SHOWN]}"
        if (found := _finished(folder, key, kind)) is not None:
            return found
        about = {"stage": stage, "version": version, "key": key, "config": plain(config), "inputs": dict(inputs)}
        self.engine.run(Task(str(folder), partial(_make, folder, about, compute), partial(_clear, folder)))
        made = _finished(folder, key, kind)
        if made is None:
            raise WriteFailed(f"{folder} is not there, although its stage has ended; was it removed? Run again")
        return replace(made, reused=False)


def _make(folder: Path, about: Mapping[str, Any], compute: Callable[[Path], Any]) -> None:
    """Compute a stage, unless another run made it while this one waited for the lock."""
    half = folder.with_name(folder.name + HALF)
    with _spoken(folder.parent), locked(_lock_of(folder)):
        if (folder / "stage.json").exists():
            return
        shutil.rmtree(half, ignore_errors=True)  # of a run that was killed: the lock says that it is gone
        half.mkdir()
        try:
            _timed(half, compute, about)
            half.rename(folder)
        except BaseException:
            shutil.rmtree(half, ignore_errors=True)
            raise


def _clear(folder: Path) -> None:
    """What a process that was killed left of a stage."""
    with locked(_lock_of(folder)):
        shutil.rmtree(folder.with_name(folder.name + HALF), ignore_errors=True)


def _lock_of(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.lock")


def _timed(half: Path, compute: Callable[[Path], Any], about: Mapping[str, Any]) -> None:
    """Compute, then write stage.json with what it took; stage.json last, so that it marks a whole stage."""
    wall, cpu = time.monotonic(), time.process_time()
    result = compute(half)
    document = {
        **about,
        "seconds": round(time.monotonic() - wall, 3),
        "cpu_seconds": round(time.process_time() - cpu, 3),
        "counts": plain(result),
    }
    with open(half / "stage.json", "w") as out:
        json.dump(document, out, indent=1)
        out.flush()
        os.fsync(out.fileno())


def _finished(folder: Path, key: str, kind: type[Result]) -> Done[Result] | None:
    if not (folder / "stage.json").exists():
        return None
    document = read_json(folder / "stage.json", "; remove that folder and run again")
    if document.get("key") != key:
        raise BadInput(f"{folder} belongs to another key ({document.get('key')}); remove that folder and run again")
    return Done(folder, key, _as_result(kind, document.get("counts", {}), folder), reused=True)


def _as_result(kind: type[Result], document: Mapping[str, Any], folder: Path) -> Result:
    """A stage's result as it was written: lists are tuples again. Raises BadInput where it is another stage's."""
    try:
        return kind(**{name: tuples(value) for name, value in document.items()})
    except TypeError as wrong:
        raise BadInput(f"{folder}/stage.json is damaged ({wrong}); remove that folder and run again") from wrong


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Held by one process at a time; the system lets go of it however the holder ends."""
    while True:
        with open(path, "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not _is_still(path, lock.fileno()):  # its last holder removed it while this one waited
                continue
            try:
                yield
            finally:
                path.unlink(missing_ok=True)
            return


def _is_still(path: Path, descriptor: int) -> bool:
    try:
        return os.stat(path).st_ino == os.fstat(descriptor).st_ino
    except FileNotFoundError:
        return False


@contextmanager
def _spoken(results: Path) -> Iterator[None]:
    """A full disk in one clear message."""
    try:
        yield
    except WriteFailed as refused:
        cause = refused.__cause__
        if isinstance(cause, OSError) and cause.errno in NO_SPACE:
            raise WriteFailed(_full(results)) from refused
        raise
    except OSError as refused:
        if refused.errno in NO_SPACE:
            raise WriteFailed(_full(results)) from refused
        raise


def _full(results: Path) -> str:
    return (
        f"the disk that holds {results} is full. Every finished stage is kept; free some space "
        "(or choose another place with --out DIR) and run the same command again: it goes on from there"
    )
