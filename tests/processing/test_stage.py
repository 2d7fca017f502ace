"""A stage is run once and read ever after; what is interrupted leaves nothing half done."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from processing.store import Store, fingerprint
from recordings.errors import BadInput, WriteFailed


@dataclass(frozen=True)
class Settings:
    size_m: float = 0.002
    count: int = 3


@dataclass(frozen=True)
class Counted:
    runs: int = 0
    of: tuple[int, ...] = ()


class Counter:
    def __init__(self) -> None:
        self.runs = 0

    def __call__(self, folder: Path) -> Counted:
        self.runs += 1
        (folder / "made.txt").write_text("whole")
        return Counted(self.runs, (1, 2))


INPUTS = {"toss_00": "aa", "calibration": "bb"}


@given(st.permutations(["a", "b", "c"]))
def test_the_order_of_inputs_does_not_change_the_key(names: list[str]) -> None:
    assert fingerprint("x", 1, {}, {n: n for n in names}) == fingerprint("x", 1, {}, {"a": "a", "b": "b", "c": "c"})


def test_every_part_of_the_key_changes_it() -> None:
    keys = {
        fingerprint("x", 1, Settings(), INPUTS),
        fingerprint("y", 1, Settings(), INPUTS),
        fingerprint("x", 2, Settings(), INPUTS),
        fingerprint("x", 1, Settings(size_m=0.003), INPUTS),
        fingerprint("x", 1, Settings(), {**INPUTS, "toss_00": "ab"}),
    }
    assert len(keys) == 5


def test_the_same_key_is_read_not_run(tmp_path: Path) -> None:
    work = Counter()
    first = Store(tmp_path).run("masks", 1, Settings(), INPUTS, Counted, work)
    second = Store(tmp_path).run("masks", 1, Settings(), INPUTS, Counted, work)
    assert work.runs == 1
    assert (first.reused, second.reused) == (False, True)
    assert second.result == first.result == Counted(1, (1, 2))
    assert first.folder.name == f"masks-{first.key[:8]}"


def test_stage_json_says_version_config_inputs_seconds_counts(tmp_path: Path) -> None:
    done = Store(tmp_path).run("masks", 7, Settings(), INPUTS, Counted, Counter())
    document = json.loads((done.folder / "stage.json").read_text())
    assert document["config"] == {"size_m": 0.002, "count": 3}
    assert (document["stage"], document["version"], document["inputs"]) == ("masks", 7, INPUTS)
    assert document["counts"] == {"runs": 1, "of": [1, 2]}
    assert min(document["seconds"], document["cpu_seconds"]) >= 0


def test_a_changed_setting_makes_a_new_folder_and_keeps_the_old(tmp_path: Path) -> None:
    work, store = Counter(), Store(tmp_path)
    old = store.run("masks", 1, Settings(), INPUTS, Counted, work)
    new = store.run("masks", 1, replace(Settings(), count=4), INPUTS, Counted, work)
    assert work.runs == 2
    assert old.folder != new.folder
    assert (old.folder / "made.txt").exists()


@pytest.mark.parametrize("trouble", [KeyboardInterrupt(), ValueError("broken")])
def test_an_interrupted_stage_leaves_nothing_and_runs_again(tmp_path: Path, trouble: BaseException) -> None:
    def fails(folder: Path) -> Counted:
        (folder / "half.txt").write_text("half")
        raise trouble

    with pytest.raises(type(trouble)):
        Store(tmp_path).run("masks", 1, Settings(), INPUTS, Counted, fails)
    assert list(tmp_path.iterdir()) == []
    assert not Store(tmp_path).run("masks", 1, Settings(), INPUTS, Counted, Counter()).reused


def test_what_a_killed_run_left_behind_is_not_taken_for_a_result(tmp_path: Path) -> None:
    name = f"masks-{fingerprint('masks', 1, Settings(), INPUTS)[:8]}"
    (tmp_path / f"{name}.partial").mkdir()
    (tmp_path / f"{name}.partial" / "half.txt").write_text("half")
    done = Store(tmp_path).run("masks", 1, Settings(), INPUTS, Counted, Counter())
    assert sorted(p.name for p in done.folder.iterdir()) == ["made.txt", "stage.json"]
    assert not (tmp_path / f"{name}.partial").exists()


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_one_clear_message(tmp_path: Path, code: int) -> None:
    def full(folder: Path) -> Counted:
        raise OSError(code, "No space left on device")

    with pytest.raises(WriteFailed, match="is full.*run the same command again"):
        Store(tmp_path).run("masks", 1, Settings(), INPUTS, Counted, full)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_behind_an_own_error_is_the_same_message(tmp_path: Path) -> None:
    def full(folder: Path) -> Counted:
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError as refused:
            raise WriteFailed("toss_00.track.npz could not be written") from refused

    with pytest.raises(WriteFailed, match="is full"):
        Store(tmp_path).run("masks", 1, Settings(), INPUTS, Counted, full)


def test_a_damaged_stage_json_is_named(tmp_path: Path) -> None:
    done = Store(tmp_path).run("masks", 1, Settings(), INPUTS, Counted, Counter())
    (done.folder / "stage.json").write_text("{")
    with pytest.raises(BadInput, match="remove that folder"):
        Store(tmp_path).run("masks", 1, Settings(), INPUTS, Counted, Counter())


SLOW_RUN = """
import sys, time
from pathlib import Path
from dataclasses import dataclass
from processing.store import Store
@dataclass(frozen=True)
class Nothing:
    pass
def work(folder):
    with open(sys.argv[2], "a") as log:
        log.write("ran\\n")
    time.sleep(1.0)
    (folder / "made.txt").write_text("whole")
    return Nothing()
print(Store(Path(sys.argv[1])).run("masks", 1, {}, {}, Nothing, work).name)
"""


def test_two_runs_on_one_results_folder_compute_a_stage_once(tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    command = [sys.executable, "-c", SLOW_RUN, str(tmp_path / "results"), str(log)]
    runs = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    names = {run.communicate(timeout=60)[0] for run in runs}
    assert [run.returncode for run in runs] == [0, 0, 0]
    assert len(names) == 1
    assert log.read_text().count("ran") == 1
    assert [p.name for p in (tmp_path / "results").iterdir()] == [next(iter(names)).strip()]
