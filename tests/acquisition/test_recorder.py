"""The path from a driver to the disk: queues that never wait, takes cut out of the stream, sessions that go on."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquisition import command
from acquisition.cli import main
from acquisition.detect import Moment, TossEvents
from acquisition.judge import judge
from acquisition.rig import RecordingConfig
from acquisition.setup import set_up
from acquisition.streaming.sequence_check import Trouble
from acquisition.streaming.stream_queue import Item, StreamQueue, Take
from acquisition.streaming.streams import BoundedQueue, Counter, Tally
from recordings.mcap.toss_writer import TossWriter
from recordings.session import Session
from recordings.session_writer import SessionWriter
from recordings.tracks import RigCalibration
from recordings.verify.verify import verify

ROOT = Path(__file__).resolve().parents[2]
RIG = """name = "pool"
robot = "panda"
[devices.d455]
kind = "rgbd"
driver = "synthetic"
[devices.mono0]
kind = "mono"
driver = "synthetic"
[devices.arm]
kind = "arm"
driver = "synthetic"
rate_hz = 200
[devices.gripper]
kind = "gripper"
driver = "synthetic"
rate_hz = 50
[recording]
countdown_s = 0
longest_toss_s = 1.5
longest_gap_s = 3
queue_s = 4
[simulation]
pictures = "pool"
color_size = [212, 120]
mono_size = [160, 120]
mono_cameras = 1
buffer_frames = 150
"""


@pytest.fixture
def rig(tmp_path: Path) -> str:
    path = tmp_path / "pool.toml"
    path.write_text(RIG)
    return str(path)


def test_a_full_queue_refuses_at_once_and_a_mark_always_finds_room() -> None:
    queue: BoundedQueue[int] = BoundedQueue(2)
    assert [queue.offer(k) for k in range(4)] == [True, True, False, False]
    mark = queue.mark()
    assert [queue.take(0.0), queue.take(0.0)] == [0, 1]
    assert queue.take(0.0) is mark
    assert queue.take(0.0) is None
    queue.close()
    assert not queue.offer(5)
    assert queue.closed


def test_a_tally_adds_up() -> None:
    counter = Counter()
    counter.received(10)
    counter.came_and_dropped("duplicate")
    counter.written(4)
    counter.idle(2)
    counter.dropped("queue full", 3)
    now = counter.tally()
    assert (now.received, now.dropped_total, now.waiting) == (11, 4, 1)
    assert now.since(Tally(received=1, dropped={"duplicate": 1})).dropped == {"queue full": 3}


@pytest.fixture
def writer(tmp_path: Path) -> TossWriter:
    return SessionWriter(tmp_path / "queues", {}).toss(0)


class Sheet:
    """A writer that remembers."""

    def __init__(self, slow_s: float = 0.0) -> None:
        self.written: list[int] = []
        self.slow_s = slow_s

    def write(self, take: Take, item: Item) -> int:
        time.sleep(self.slow_s)
        self.written.append(item.value)
        return item.count


def test_a_take_holds_the_ring_before_it_and_nothing_after_its_end(writer: TossWriter) -> None:
    sheet = Sheet()
    queue = StreamQueue("/x", 100.0, 5.0, 0.5, sheet.write)
    queue.start()
    now = time.monotonic_ns()
    for k in range(10):
        queue.offer(Item(k, now - (10 - k) * 100_000_000))  # one every 0.1 s, the last 0.1 s ago
    time.sleep(0.2)
    take = Take(writer, now - 450_000_000)
    queue.take = take
    queue.offer(Item(10, now))
    time.sleep(0.2)
    take.end_host_ns = now + 50_000_000
    assert queue.mark().wait(2)
    queue.offer(Item(11, now + 20_000_000))  # belongs to the take, but comes too late for it
    queue.offer(Item(12, now + 100_000_000))
    assert queue.stop(2.0)
    assert sheet.written[-1] == 10
    assert set(sheet.written) <= set(range(5, 11))
    tally = queue.counter.tally()
    assert tally.dropped == {"too late": 1}
    assert tally.received == 13 == tally.written + tally.idle + 1


def test_a_slow_writer_never_makes_the_driver_wait(writer: TossWriter, own_time: Any) -> None:
    queue = StreamQueue("/x", 100.0, 0.1, 0.5, Sheet(slow_s=0.05).write)
    queue.start()
    queue.take = Take(writer, 0)
    with own_time() as spent:
        for k in range(1000):
            queue.offer(Item(k, time.monotonic_ns()))
    assert spent.seconds < 0.5
    queue.stop(5.0)
    tally = queue.counter.tally()
    assert tally.dropped["queue full"] > 900
    assert tally.received == tally.written + tally.dropped_total + tally.idle


GOOD = {"/d455/color": Tally(received=100, written=100)}
STOPPED = Trouble(0, "arm", "user_stopped", "pressed", "error")
SEEN = TossEvents(Moment(1.0, 0.01, "x"), Moment(1.3, 0.01, "x"), Moment(2.0, 0.1, "x"))


@pytest.mark.parametrize(
    "counts, troubles, events, decision, says",
    [
        (GOOD, (), SEEN, "accept", "accept"),
        (GOOD, (), TossEvents(), "reject", "no release was seen"),
        (GOOD, (), TossEvents(Moment(1.0, 0.01, "x")), "accept", "not seen: first impact, rest"),
        ({"/a": Tally(received=100, written=97, dropped={"queue full": 3})}, (), SEEN, "accept", "3 of 100 lost"),
        ({"/a": Tally(received=80, written=80, missed=20)}, (), SEEN, "reject", "20 of 100 lost (20 missing"),
        ({"/a": Tally()}, (), SEEN, "reject", "/a: nothing was written"),
        (
            GOOD,
            (Trouble(0, "arm", "user_stopped", "pressed", "error"),),
            SEEN,
            "reject",
            "emergency stop (arm: pressed)",
        ),
        (GOOD, (Trouble(0, "mono0", "gap", "1 frame"),), SEEN, "accept", "accept"),
    ],
)
def test_the_verdict_says_why(counts: Any, troubles: Any, events: TossEvents, decision: str, says: str) -> None:
    verdict = judge(counts, troubles, events, RecordingConfig())
    assert verdict.decision == decision
    assert says in verdict.text()


def test_toss_record_writes_a_session_and_goes_on_with_it(
    rig: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["--rig", rig, "--object", "jack", "--yes", "--json", str(out)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["accepted"] == 1
    assert {row["check"] for row in told["preflight"]} >= {"device", "rate", "exposure", "clock", "disk", "flicker"}
    first = (out / "toss_00.mcap").read_bytes()
    assert main(["--rig", rig, "--yes", str(out)]) == 2
    assert "--resume" in capsys.readouterr().err
    assert main(["--rig", rig, "--yes", "--resume", str(out)]) == 0
    assert (out / "toss_00.mcap").read_bytes() == first
    assert verify(out).ok
    with Session.open(out) as session:
        assert session.tosses == (0, 1)
        assert session.object_name == "jack"
        ends, begins = session.toss(0).color().times_ns[-1], session.toss(1).color().times_ns[0]
        assert begins > ends
        arm = session.toss(1).arm_states()
        assert arm is not None
        assert np.isfinite(arm.finger_width_m).any()
        kinds = [e.kind for e in session.toss(1).events()]
        assert "release" in kinds
        assert kinds[-1] == "verdict"


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["--rig", "nowhere.toml"], "is no file"),
        (["--tosses", "0"], "wanted 1 or more"),
        (["--resume", "--yes", "nothing_there"], "no session.json"),
        (["--rig", "lab", "--dry-run", "--bogus"], "unrecognized arguments"),
    ],
)
def test_wrong_arguments_exit_with_2(arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert says in capsys.readouterr().err


def test_a_dry_run_plans_and_touches_nothing(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["--rig", "lab", "--dry-run", "--tosses", "2", "--json"]) == 0
    tosses = json.loads(capsys.readouterr().out)["tosses"]
    assert len(tosses) == 2
    assert all(t["window_s"] > 0.03 for t in tosses)


@pytest.mark.slow
@pytest.mark.parametrize("after_s", [0.5, 3.0, 4.5])
def test_ctrl_c_keeps_everything_so_far(after_s: float, rig: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "acquisition.cli", "--rig", rig, "--tosses", "50", "--yes", str(out)]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    ends = time.monotonic() + 60
    while not (out / "session.json").exists() and time.monotonic() < ends:
        time.sleep(0.05)
    time.sleep(after_s)
    os.kill(process.pid, signal.SIGINT)
    _, told = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "everything so far is kept" in told
    assert verify(out).ok
    stop = json.loads((out / "session.json").read_text())["stop"]
    assert stop["status"] == "interrupted"


@pytest.mark.slow
@pytest.mark.parametrize("after_s", [0.3, 2.0])
def test_a_killed_session_goes_on_by_resume(after_s: float, rig: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "acquisition.cli", "--rig", rig, "--tosses", "50", "--yes", str(out)]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)
    ends = time.monotonic() + 60
    while not (out / "toss_01.mcap").exists() and time.monotonic() < ends:
        time.sleep(0.02)
    time.sleep(after_s)
    process.kill()
    process.wait()
    first, before = (out / "toss_00.mcap").read_bytes(), len(list(out.glob("toss_*.mcap")))
    assert main(["--rig", rig, "--yes", "--resume", str(out)]) == 0
    assert (out / "toss_00.mcap").read_bytes() == first
    assert verify(out).ok
    with Session.open(out) as session:
        assert len(session.tosses) >= before
        starts = [session.toss(k).color().times_ns[0] for k in session.tosses if len(session.toss(k).color())]
    assert starts == sorted(starts)


def test_every_toss_of_a_session_is_replayed_though_its_cameras_are_not_in_all_of_them(
    sample_path: Path, tmp_path: Path
) -> None:
    again = tmp_path / "again"
    assert main(["--rig", f"replay:{sample_path}", "--tosses", "4", "--yes", str(again)]) == 0
    with Session.open(sample_path) as a, Session.open(again) as b:
        assert b.tosses == (0, 1, 2, 3)
        for toss in b.tosses:
            before, after = a.toss(toss).streams(), b.toss(toss).streams()
            for topic in ("/d455/color", "/d455/depth"):
                assert after[topic].count == before[topic].count
        assert b.toss(0).streams()["/mono2/image"].count == 36
    assert verify(again).ok


def test_a_rig_without_a_calibration_records_its_cameras_own_lenses(
    rig: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = set_up(rig)
    bare.calibration = RigCalibration(cameras={})
    monkeypatch.setattr(command, "set_up", lambda _: bare)
    assert main(["--rig", rig, "--yes", "--tosses", "1", str(tmp_path / "out")]) == 0
    with Session.open(tmp_path / "out") as session:
        assert session.calibration.camera("d455").width == 212
        assert session.calibration.find("world", "d455") is None
    assert "the session gets no camera poses" in capsys.readouterr().err


@pytest.mark.slow
def test_a_replayed_session_is_recorded_again(rig: str, tmp_path: Path) -> None:
    first, again = tmp_path / "first", tmp_path / "again"
    assert main(["--rig", rig, "--yes", str(first)]) == 0
    assert main(["--rig", f"replay:{first}", "--yes", str(again)]) == 0
    with Session.open(first) as a, Session.open(again) as b:
        before, after = a.toss(0).streams(), b.toss(0).streams()
        for topic in ("/d455/color", "/d455/depth", "/mono0/image", "/arm/joint_states"):
            assert after[topic].count == before[topic].count
        gaps = np.diff(a.toss(0).color().times_ns) - np.diff(b.toss(0).color().times_ns)
        assert np.abs(gaps).max() < 1e6
        np.testing.assert_array_equal(a.toss(0).depth()[5].raw, b.toss(0).depth()[5].raw)
