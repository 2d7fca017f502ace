"""Stages side by side: as many as there are slots, each once, the same bytes as in turn; nothing half is left."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cloudpickle
import pytest

from processing.engine import jobs
from processing.engine.each import InTurn, SideBySide, Task
from processing.engine.outcome import Fault, Lost, Outcome, outcome_of, raise_outcome
from processing.engine.workers import Worker
from processing.store import Store
from recordings.errors import BadInput, TosslabError, WriteFailed
from recordings.progress import Board

TOOLS = Path(__file__).resolve().parents[2] / "tools"
cloudpickle.register_pickle_by_value(sys.modules[__name__])  # a worker cannot import a test


class Here:
    """A slot in this process, which counts how many are at work."""

    at_work = 0
    most = 0
    lock = threading.Lock()

    def perform(self, task: Task) -> Outcome:
        with Here.lock:
            Here.at_work += 1
            Here.most = max(Here.most, Here.at_work)
        try:
            return outcome_of(task.call)
        finally:
            with Here.lock:
                Here.at_work -= 1

    def stop(self) -> None:
        pass


@pytest.fixture
def three() -> Iterator[SideBySide]:
    """An engine of three slots in this process."""
    Here.at_work = Here.most = 0
    with SideBySide([Here() for _ in range(3)], Board()) as engine:
        yield engine


def task(name: str, call: Callable[[], object]) -> Task:
    return Task(name, call, lambda: None)


@pytest.mark.parametrize("kind", ["in turn", "side by side"])
def test_results_come_in_the_order_of_the_items_however_the_calls_are_nested(three: SideBySide, kind: str) -> None:
    engine = InTurn() if kind == "in turn" else three

    def inner(a: int, b: int) -> int:
        engine.run(task(f"{a}.{b}", lambda: time.sleep(0.002 * (5 - b))))
        return 10 * a + b

    found = engine.each((2, 0, 1), lambda a: list(engine.each((3, 1), lambda b: inner(a, b)).values()))
    assert list(found.items()) == [(2, [23, 21]), (0, [3, 1]), (1, [13, 11])]


def test_no_more_are_computed_at_once_than_there_are_slots(three: SideBySide) -> None:
    three.each(
        range(4), lambda a: three.each(range(4), lambda b: three.run(task(f"{a}.{b}", lambda: time.sleep(0.01))))
    )
    assert Here.most == 3


def test_stages_are_asked_for_in_the_order_of_the_items_whatever_thread_is_faster() -> None:
    begun: list[str] = []

    def asks(engine: SideBySide, name: str, after_s: float) -> None:
        time.sleep(after_s)
        engine.run(task(name, lambda: begun.append(name)))

    with SideBySide([Here()], Board()) as engine:
        engine.each(
            (0, 1, 2), lambda a: engine.each((0, 1), lambda b: asks(engine, f"{a}.{b}", 0.05 * (a == 0) * (2 - b)))
        )
    assert [name for name in begun if name.endswith(".0")] == ["0.0", "1.0", "2.0"]
    assert all(begun.index(f"{a}.0") < begun.index(f"{a}.1") for a in range(3))


def test_two_that_ask_for_the_same_stage_get_it_computed_once(three: SideBySide) -> None:
    ran: list[int] = []

    def slow() -> None:
        ran.append(1)
        time.sleep(0.1)

    three.each(range(3), lambda _: three.run(task("the same", slow)))
    assert ran == [1]


def test_the_first_error_is_raised_what_was_begun_ends_and_the_rest_is_not_begun(three: SideBySide) -> None:
    begun, ended = [], []
    all_begun = threading.Barrier(3)

    def stage(k: int) -> None:
        begun.append(k)
        if len(begun) <= 3:
            all_begun.wait(60)
            time.sleep(0.05 if k else 0.1)
        if k < 2:
            raise BadInput(f"toss {k} is empty")
        time.sleep(0.3)
        ended.append(k)

    with pytest.raises(BadInput, match="toss [01] is empty"):
        three.each(range(30), lambda k: three.run(task(str(k), lambda: stage(k))))
    assert sorted(ended) == sorted(set(begun) - {0, 1})
    assert len(begun) < 12


def test_what_fails_for_one_who_minds_stops_no_other(three: SideBySide) -> None:
    def session(name: str) -> str:
        def stage(k: int) -> None:
            if name == "bad":
                raise BadInput("bad")

        try:
            three.each(range(3), lambda k: three.run(task(f"{name} {k}", lambda: stage(k))))
        except BadInput as wrong:
            return str(wrong)
        return "whole"

    assert three.each(("bad", "good"), session) == {"bad": "bad", "good": "whole"}


@pytest.mark.parametrize(
    "wrong",
    [BadInput("no toss"), WriteFailed("the disk is full"), OSError(errno.EACCES, "Permission denied", "x.txt")],
)
def test_an_error_of_another_process_is_the_same_error_here(wrong: Exception) -> None:
    def fails() -> None:
        raise wrong

    told = json.loads(json.dumps(outcome_of(fails)))
    with pytest.raises(type(wrong)) as found:
        raise_outcome(told)
    assert str(found.value) == str(wrong)


def test_a_fault_of_another_process_brings_its_lines_and_is_no_users_error() -> None:
    with pytest.raises(Fault, match=r"(?s)ZeroDivisionError.*in nothing_by_zero") as found:
        raise_outcome(outcome_of(nothing_by_zero))
    assert not isinstance(found.value, TosslabError)


def nothing_by_zero() -> float:
    return 0 / 0


@pytest.mark.parametrize(("cores", "free_gb", "wanted"), [(8, 64.0, 8), (8, 4.0, 2), (2, 0.5, 1), (4, None, 4)])
def test_as_many_jobs_as_cores_and_fewer_where_memory_is_short(
    monkeypatch: pytest.MonkeyPatch, cores: int, free_gb: float | None, wanted: int
) -> None:
    monkeypatch.setattr(jobs, "cores", lambda: cores)
    monkeypatch.setattr(jobs, "free_gb", lambda: free_gb)
    many, why = jobs.chosen_jobs(None)
    assert many == wanted
    assert (why is None) == (wanted == cores)
    assert jobs.chosen_jobs(5) == (5, None)
    with pytest.raises(BadInput, match="--jobs 0"):
        jobs.chosen_jobs(0)


@dataclass(frozen=True)
class Nothing:
    pass


def stage(store: Store, name: str, act: Callable[[], object]) -> None:
    """A stage that writes a file, then acts."""

    def compute(folder: Path) -> Nothing:
        (folder / "half.txt").write_text("half")
        act()
        return Nothing()

    store.run(name, 1, {}, {}, Nothing, compute)


@pytest.fixture
def workers() -> Iterator[SideBySide]:
    """An engine of two processes."""
    board = Board()
    with SideBySide([Worker(board), Worker(board)], board) as engine:
        yield engine


def test_a_worker_that_is_killed_leaves_no_half_stage_and_the_others_are_whole(
    workers: SideBySide, tmp_path: Path
) -> None:
    store = Store(tmp_path, workers)

    def act(name: str) -> None:
        if name == "shot":
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.3)

    with pytest.raises(Lost, match=r"computed shot-\w{8} was killed \(SIGKILL\).*--jobs N"):
        workers.each(("whole", "shot"), lambda name: stage(store, name, lambda: act(name)))
    assert [p.name.split("-")[0] for p in tmp_path.iterdir()] == ["whole"]
    stage(store, "after", lambda: None)  # another worker takes the place
    assert sorted(p.name.split("-")[0] for p in tmp_path.iterdir()) == ["after", "whole"]


def test_an_error_in_one_toss_is_raised_once_and_the_others_stages_are_kept(
    workers: SideBySide, tmp_path: Path
) -> None:
    store = Store(tmp_path, workers)

    def act(toss: int) -> None:
        if toss == 1:
            raise BadInput("toss 1 has no depth")

    with pytest.raises(BadInput, match="toss 1 has no depth"):
        workers.each(range(2), lambda t: stage(store, f"toss{t}", lambda: act(t)))
    assert [p.name.split("-")[0] for p in tmp_path.iterdir()] == ["toss0"]


LONG_RUN = """
import os, signal, sys, time
from pathlib import Path
from processing.engine.each import SideBySide
from processing.engine.workers import Worker
from processing.store import Store
from recordings.progress import Board

def main():
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where the tests run in a shell's background
    board, out = Board(), Path(sys.argv[1])
    with SideBySide([Worker(board), Worker(board)], board) as engine:
        store = Store(out / "results", engine)
        def stage(k):
            def compute(folder):
                (folder / "half.txt").write_text("half")
                (out / f"worker{k}").write_text(str(os.getpid()))
                time.sleep(600)
            store.run(f"stage{k}", 1, {}, {}, dict, compute)
        engine.each(range(3), stage)

if __name__ == "__main__":
    main()
"""


def gone(process: int) -> bool:
    """A zombie is gone too: whoever has to bury it may be slow."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


def wait_for(what: Callable[[], bool], seconds: float = 120) -> None:
    until = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.05)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks at processes through /proc")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_no_process_outlives_a_run_that_is_interrupted_or_killed(tmp_path: Path, how: signal.Signals) -> None:
    (tmp_path / "run.py").write_text(LONG_RUN)
    command = [sys.executable, str(tmp_path / "run.py"), str(tmp_path)]
    run = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True)

    def workers() -> list[int]:
        """Processes of the stages that were begun: two of the three, whichever came first."""
        return [int(text) for p in tmp_path.glob("worker*") if (text := p.read_text())]

    try:
        wait_for(lambda: len(workers()) == 2)
        if how == signal.SIGINT:
            os.killpg(run.pid, how)  # as a terminal does
        else:
            run.kill()
        run.wait(60)
        wait_for(lambda: all(gone(process) for process in workers()), 60)
    finally:
        run.kill()
    left = [p.name for p in (tmp_path / "results").iterdir()]
    assert not [name for name in left if (tmp_path / "results" / name / "stage.json").exists()]
    if how == signal.SIGINT:
        assert left == []  # what was killed with its parent is cleared by the next run


def without_seconds(document: Any) -> Any:
    if isinstance(document, dict):
        return {k: without_seconds(v) for k, v in document.items() if "seconds" not in k}
    return [without_seconds(v) for v in document] if isinstance(document, list) else document


def contents(results: Path) -> dict[str, str]:
    """sha256 of every file; of documents without the seconds that something took."""
    found = {}
    for path in sorted(p for p in results.rglob("*") if p.is_file()):
        data = path.read_bytes()
        if path.suffix == ".json":
            data = json.dumps(without_seconds(json.loads(data))).encode()
        found[str(path.relative_to(results))] = hashlib.sha256(data).hexdigest()
    return found


QUICK_ROWS = """
import sys
from dataclasses import replace
from pathlib import Path
from processing.config import Config
from processing.engine.each import InTurn, SideBySide
from processing.engine.workers import Shown, Worker
from processing.field.learn import LearnConfig
from processing.field.train import FieldConfig
from processing.pipeline.process import process
from processing.pipeline.start import start_run
from processing.variants import find_variant
from recordings.progress import Board
from recordings.session import Session

def rows(engine, out):
    few = replace(Config(), shape=LearnConfig(most_views=6, field=FieldConfig(steps=3, rays=128, pose_rounds=0)))
    session = Session.open(Path(sys.argv[1]))
    run = start_run(session, (0, 1), out, few, "multi-hypothesis", Shown(), engine=engine)
    engine.each(("ours", "bundlesdf-1"), lambda row: process(run, find_variant(row), "all"))

if __name__ == "__main__":
    board, out = Board(), Path(sys.argv[2])
    rows(InTurn(), out / "one")
    sys.path.insert(0, sys.argv[3])
    from compile_kernels import unforeseen
    assert not unforeseen(), unforeseen()
    with SideBySide([Worker(board, 2), Worker(board, 2)], board) as engine:
        rows(engine, out / "two")
"""


@pytest.mark.slow
def test_two_jobs_leave_the_same_bytes_as_one(record_tiny: Any, tmp_path: Path) -> None:
    (tmp_path / "rows.py").write_text(QUICK_ROWS)
    command = [sys.executable, str(tmp_path / "rows.py"), str(record_tiny(frames=6)), str(tmp_path), str(TOOLS)]
    subprocess.run(command, check=True)  # which also looks whether the kernels are those that set-up compiles
    one, two = contents(tmp_path / "one"), contents(tmp_path / "two")
    assert len(one) > 30
    assert one == two
