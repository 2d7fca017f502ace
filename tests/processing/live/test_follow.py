"""A session is followed while it is recorded: tosses come, go and fail; nothing but the live folder is touched."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from processing.cli import main
from processing.config import Config
from processing.live import bounds
from processing.live import follow as following
from processing.live.config import LiveConfig
from processing.live.follow import Followed, follow, followed_alone
from processing.live.look import Looked, Looker
from processing.live.side_work import SideWork
from processing.live.watch import ended, finished, finished_tosses
from recordings.errors import BadInput
from recordings.progress import Silent
from recordings.results.live import LineReader, live_folder, read_state, read_tosses

QUICK = LiveConfig(poll_s=0.01)


@pytest.fixture(autouse=True)
def as_nice_as_the_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process of the tests keeps its priority and its memory."""
    monkeypatch.setattr(bounds, "come_last", lambda: None)
    monkeypatch.setattr(bounds, "bound_memory", lambda gigabytes: None)
    monkeypatch.setattr(bounds, "unbound_memory", lambda: None)


def going_on(session: Path) -> Path:
    """The session as it is before its recorder has closed it."""
    document = json.loads((session / "session.json").read_text())
    (session / "session.json").write_text(json.dumps({**document, "stop": None}))
    return session


def follow_quickly(session: Path, **options: object) -> tuple[Followed, list[str]]:
    said: list[str] = []
    return follow(session, Config(), lambda _: Silent(), said.append, live=QUICK, **options), said  # type: ignore[arg-type]


def test_only_whole_files_are_finished_tosses(record_tiny: Callable[..., Path]) -> None:
    session = record_tiny(tosses=(0, 1), frames=4)
    data = (session / "toss_00.mcap").read_bytes()
    (session / "toss_02.mcap").write_bytes(data[: len(data) // 2])
    (session / "toss_03.mcap").write_bytes(b"")
    assert list(finished_tosses(session)) == [0, 1]
    before = finished(session / "toss_00.mcap")
    (session / "toss_00.mcap").unlink()
    assert finished(session / "toss_00.mcap") is None
    (session / "toss_00.mcap").write_bytes(data)
    assert finished(session / "toss_00.mcap") not in (None, before)


def test_a_session_has_ended_when_its_stop_document_is_written(record_tiny: Callable[..., Path]) -> None:
    session = record_tiny(tosses=(0,), frames=4)
    assert ended(session)
    assert not ended(going_on(session))
    (session / "session.json").write_text("{")
    assert not ended(session)


def test_each_toss_is_judged_and_placed_and_the_recording_stays_as_it_is(record_tiny: Callable[..., Path]) -> None:
    session = record_tiny(tosses=(0, 1))
    before = {path.name: path.read_bytes() for path in session.glob("*.*")}
    found, said = follow_quickly(session)
    assert found == Followed(looked_at=[0, 1])
    tosses = read_tosses(session)
    assert [(t.toss, t.placed) for t in tosses] == [(0, True), (1, True)]
    assert all(t.tracked >= 6 and len(t.camera_from_object) == t.frames for t in tosses)
    assert (live_folder(session) / "shape.ply").exists()
    assert [line.kind for line in LineReader(session).new()].count("verdict") == 2
    assert any(text.startswith("toss 0: ") for text in said)
    assert any("Next: " in text for text in said)
    assert {path.name: path.read_bytes() for path in session.glob("*.*")} == before
    state = read_state(session)
    assert state is not None
    assert state.state == "finishing"


def test_a_toss_that_is_taken_away_while_it_is_looked_at_is_left_out(
    record_tiny: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    session, look = record_tiny(tosses=(0, 1), frames=8), Looker.look

    def discarding(self: Looker, toss: int, file: object, step: Callable[[str], None]) -> Looked:
        if toss == 0:
            (session / "toss_00.mcap").unlink()
        return look(self, toss, file, step)  # type: ignore[arg-type]

    monkeypatch.setattr(Looker, "look", discarding)
    found, said = follow_quickly(session)
    assert found.looked_at == [1]
    assert not found.failed
    assert "toss 0 was taken away while it was looked at: left out of everything so far" in said
    assert [t.toss for t in read_tosses(session)] == [1]


def test_a_toss_that_cannot_be_looked_at_is_said_and_the_others_go_on(
    record_tiny: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(self: Looker, toss: int, file: object, step: object) -> Looked:
        raise BadInput(f"nothing to see in {toss}")

    monkeypatch.setattr(Looker, "look", failing)
    found, said = follow_quickly(record_tiny(tosses=(0, 1), frames=4))
    assert found.failed == {0: "nothing to see in 0", 1: "nothing to see in 1"}
    assert "toss 1: nothing to see in 1" in said


def test_too_little_memory_ends_the_following_and_says_so(
    record_tiny: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def greedy(self: Looker, toss: int, file: object, step: object) -> Looked:
        raise MemoryError

    monkeypatch.setattr(Looker, "look", greedy)
    found, _ = follow_quickly(record_tiny(tosses=(0,), frames=4))
    assert "recording goes on" in found.why


def test_without_a_calibrated_table_that_is_said_once(
    record_tiny: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        following._Follower, "_look_at", lambda self, toss, file, waiting: self.done.update({toss: file})
    )
    session = record_tiny(tosses=(0,), frames=4)
    calibration = json.loads((session / "calibration.json").read_text())
    (session / "calibration.json").write_text(json.dumps({**calibration, "transforms": []}))
    _, said = follow_quickly(session)
    assert said.count(following.NO_TABLE) == 1


def test_a_recorder_that_is_gone_ends_the_following(record_tiny: Callable[..., Path]) -> None:
    session = going_on(record_tiny(tosses=(), frames=4))
    nobody = 2**22 + 1  # beyond the largest process number
    assert "toss-record --resume --live" in follow_quickly(session, recorder=nobody)[0].why


def test_a_disk_that_refuses_ends_the_following(
    record_tiny: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    session = going_on(record_tiny(tosses=(), frames=4))
    monkeypatch.setattr(following.LiveWriter, "state", full)
    assert "cannot be written" in follow_quickly(session)[0].why


def test_a_second_follower_of_a_session_is_refused_by_the_first_ones_number(record_tiny: Callable[..., Path]) -> None:
    session = record_tiny(tosses=(0,), frames=4)
    with followed_alone(session), pytest.raises(BadInput, match=r"followed already, by process \d+"):
        follow_quickly(session)
    with followed_alone(session):
        pass


def test_a_machine_that_is_too_slow_says_by_how_much_it_is_behind(
    record_tiny: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        following._Follower, "_look_at", lambda self, toss, file, waiting: self.done.update({toss: file})
    )
    monkeypatch.setattr(following._Follower, "_waited_s", lambda self, file: 90.0)
    _, said = follow_quickly(record_tiny(tosses=(0, 1, 2), frames=4))
    assert [text for text in said if "behind" in text] == [
        "live: 90 s behind, 3 tosses wait; recording goes on as before"
    ]


def test_side_work_gives_its_result_once_and_can_be_ended() -> None:
    side = SideWork[int]()
    side.start("a", lambda: 41 + 1)
    found, ends = None, time.monotonic() + 30
    while found is None and time.monotonic() < ends:
        found = side.result()
    assert found == 42
    assert side.result() is None
    side.start("a", lambda: 1)
    assert not side.running  # done already
    side.start("b", lambda: time.sleep(60))
    assert side.running
    side.stop()
    assert not side.running


def test_follow_takes_one_session_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--follow", str(tmp_path / "none")]) == 2
    assert "does not exist" in capsys.readouterr().err
    assert main(["--follow", str(tmp_path), "other"]) == 2
    assert "leave out other" in capsys.readouterr().err


@pytest.mark.slow
def test_a_followed_session_has_the_bytes_of_one_that_is_processed_afterwards(record_tiny: Callable[..., Path]) -> None:
    session = record_tiny(tosses=(0, 1))
    other = shutil.copytree(session, session.with_name("other") / session.name)
    assert main(["--follow", str(session), "--variant", "bundlesdf-1"]) == 0
    assert main([str(other), "--variant", "bundlesdf-1"]) == 0
    kept, made = (
        {str(p.relative_to(s / "results")): p for p in (s / "results").rglob("*") if p.is_file()}
        for s in (session, other)
    )
    kept = {name: path for name, path in kept.items() if not name.startswith("live/")}
    assert kept.keys() == made.keys()
    for name, path in kept.items():
        if path.name != "stage.json":  # it holds the seconds
            assert path.read_bytes() == made[name].read_bytes(), name
