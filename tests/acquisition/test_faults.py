"""Every fault has its verdict; nothing hangs, nothing is lost in silence."""

from __future__ import annotations

import errno
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from acquisition.drivers.synthetic import SyntheticLab
from acquisition.run import check_disk
from acquisition.synthetic.lab_config import SyntheticConfig
from recordings.errors import TosslabError
from recordings.mcap.sink import Sink
from recordings.session import Session
from recordings.verify.verify import verify

SMALL = SyntheticConfig(
    pictures="pool",
    color_size=(212, 120),
    mono_size=(160, 120),
    mono_cameras=1,
    wrap_after_s=-1.0,
    buffer_frames=150,
)
pytestmark = pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")


HANGS_S = 2.0
"""Nothing takes longer than this beyond a take's own length, on a machine that is free (conftest.OwnTime)."""


@dataclass(frozen=True)
class Case:
    """A fault of a device and what has to come of it: the decision, and words in the verdict or in the counts."""

    name: str
    device: str
    kind: str
    decision: str
    says: str
    at_s: float = 0.3
    for_s: float | None = None
    detail: tuple[tuple[str, float], ...] = ()
    quick: bool = False


CASES = (
    Case("camera unplugged", "d455", "unplug", "reject", "a device was lost (d455", quick=True),
    Case("grey camera unplugged", "mono0", "unplug", "reject", "a device was lost (mono0"),
    Case("arm unplugged", "arm", "unplug", "reject", "a device was lost (arm"),
    Case("camera unplugged and plugged in", "mono0", "unplug", "reject", "a device was lost (mono0", for_s=0.2),
    Case("camera falls silent", "d455", "silence", "reject", "a stream fell silent (/d455/color"),
    Case("grey camera falls silent", "mono0", "silence", "reject", "a stream fell silent (/mono0/image"),
    Case("arm falls silent", "arm", "silence", "reject", "a stream fell silent (/arm/joint_states"),
    Case("short silence", "mono0", "silence", "accept", "missing from the device", for_s=0.08),
    Case("frozen picture", "d455", "frozen", "reject", "a camera froze (/d455/color", quick=True),
    Case("frozen grey picture", "mono0", "frozen", "reject", "a camera froze (/mono0/image"),
    Case("every frame twice", "mono0", "duplicate", "accept", "duplicate"),
    Case("every colour frame twice", "d455", "duplicate", "accept", "duplicate"),
    Case("two frames in the wrong order", "mono0", "swap", "accept", "out of order"),
    Case("gap in the frame numbers", "mono0", "gap", "accept", "missing from the device", quick=True),
    Case("gap in both streams", "d455", "gap", "accept", "missing from the device"),
    Case("no trigger", "mono0", "lost_trigger", "reject", "a stream fell silent (/mono0/image"),
    Case("three triggers lost", "mono0", "lost_trigger", "reject", "missing from the device", for_s=0.2),
    Case("clock an hour on", "d455", "clock_step", "reject", "clock was set", detail=(("by_s", 3600.0),)),
    Case("clock an hour back", "mono0", "clock_step", "reject", "clock was set", detail=(("by_s", -3600.0),)),
    Case("clock 60 ms on", "mono0", "clock_step", "reject", "clock was set", detail=(("by_s", 0.06),), quick=True),
    Case("clock 60 ms back", "d455", "clock_step", "reject", "clock was set", detail=(("by_s", -0.06),)),
    Case("arm's clock set", "arm", "clock_step", "reject", "clock was set", detail=(("by_s", 5.0),)),
    Case("frames 50 ms late", "mono0", "late", "accept", "accept", detail=(("by_s", 0.05),)),
    Case("some NaN states", "arm", "nan", "accept", "invalid", for_s=0.06),
    Case("NaN states", "arm", "nan", "reject", "invalid", for_s=0.5),
    Case("reflex", "arm", "reflex", "reject", "the arm went into reflex", quick=True),
    Case("emergency stop", "arm", "user_stop", "reject", "emergency stop"),
    Case("gripper does not answer", "gripper", "gripper_timeout", "reject", "the gripper did not", at_s=0.0),
    Case("driver hangs", "mono0", "hang", "reject", "a stream fell silent", for_s=3.5),
    Case("images of another size", "mono0", "wrong_size", "reject", "images of another size"),
    Case("no depth", "d455", "no_depth", "reject", "a stream fell silent (/d455/depth"),
)


@pytest.mark.parametrize("case", [pytest.param(c, id=c.name, marks=() if c.quick else pytest.mark.slow) for c in CASES])
def test_a_fault_has_its_verdict_and_nothing_is_lost_in_silence(case: Case, record: Callable[..., Any]) -> None:
    slow = case.kind in ("gripper_timeout", "silence", "lost_trigger", "no_depth", "hang") and not (case.for_s or 9) < 1
    seconds = 4.0 if slow else 3.0 if case.decision == "accept" else 1.3

    def inject(lab: SyntheticLab) -> None:
        lab.faults(case.device).inject(case.kind, at_s=case.at_s, for_s=case.for_s, **dict(case.detail))

    done = record(inject, seconds=seconds)
    assert done.take.decision == case.decision, done.take.verdict.text()
    assert case.says in done.take.verdict.text()
    assert done.seconds < seconds + HANGS_S
    assert_everything_is_counted(done)


def assert_everything_is_counted(done: Any) -> None:
    """After the end nothing waits; an accepted take's file holds exactly what was counted as written."""
    for topic, tally in done.tallies.items():
        assert tally.waiting == 0, topic
        assert tally.received == tally.written + tally.dropped_total + tally.idle, topic
    kept = [t for t in done.report.takes if t.decision == "accept"]
    with Session.open(done.folder) as session:
        assert len(session.tosses) == len(kept)
        for take in kept:
            streams = session.toss(take.toss).streams()
            for topic, tally in take.counts.items():
                assert streams[topic].count == tally.written, topic
    assert not kept or verify(done.folder).ok


@pytest.mark.slow
def test_a_camera_that_comes_back_serves_the_next_take(record: Callable[..., Any]) -> None:
    done = record(lambda lab: lab.faults("mono0").inject("unplug", at_s=0.3, for_s=0.4), tosses=2, redo_at_most=3)
    decisions = [t.decision for t in done.report.takes]
    assert decisions[0] == "reject"  # perhaps the next one too, until the camera is back
    assert decisions[-2:] == ["accept", "accept"]
    assert [t.toss for t in done.report.takes][-2:] == [0, 1]
    assert_everything_is_counted(done)


@pytest.mark.slow
def test_frames_lost_now_and_then_are_counted_one_by_one(record: Callable[..., Any]) -> None:
    done = record(config=replace(SMALL, dropped_share=0.02), seconds=3.0)
    missed = sum(t.missed for t in done.take.counts.values())
    assert done.take.decision == "accept"
    assert 0 < missed < 20
    assert_everything_is_counted(done)


@pytest.mark.slow
def test_the_32_bit_clock_may_start_over_within_a_take(record: Callable[..., Any]) -> None:
    done = record(config=replace(SMALL, wrap_after_s=1.4), seconds=1.5)
    clock = next(c for name, c in done.clocks.items() if name.startswith("d455"))
    assert clock["wraps"] == 1
    assert not clock["steps"]
    assert done.take.decision == "accept"
    with Session.open(done.folder) as session:
        times_ns = session.toss(0).color().times_ns
    assert 25e6 < min(times_ns[1:] - times_ns[:-1]) < max(times_ns[1:] - times_ns[:-1]) < 42e6


@pytest.mark.parametrize(
    "code", [errno.ENOSPC, pytest.param(errno.EIO, marks=pytest.mark.slow)], ids=["no space", "I/O error"]
)
def test_a_disk_that_refuses_ends_the_take_at_once(
    code: int, record: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, ends_at = Sink._write, time.monotonic() + 1.6

    def refusing(self: Sink, data: memoryview) -> None:
        if self.path.name.startswith("toss") and time.monotonic() > ends_at:
            raise OSError(code, errno.errorcode[code])
        plain(self, data)

    monkeypatch.setattr(Sink, "_write", refusing)
    done = record(seconds=3.0)
    assert done.take.decision == "reject"
    assert "disk refused" in done.take.verdict.text()
    assert done.seconds < 4
    assert not list(done.folder.glob("toss_*"))
    assert_everything_is_counted(done)


@pytest.mark.slow
@pytest.mark.parametrize("stall_s, decision", [(0.2, "accept"), (6.0, "reject")])
def test_a_slow_disk_costs_counted_frames_and_never_holds_a_driver(
    stall_s: float, decision: str, record: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, stalls = Sink._write, [time.monotonic() + 1.2]

    def slow(self: Sink, data: memoryview) -> None:
        if self.path.name.startswith("toss") and stalls and time.monotonic() > stalls[0]:
            stalls.clear()
            time.sleep(stall_s)
        plain(self, data)

    monkeypatch.setattr(Sink, "_write", slow)
    done = record(seconds=2.5 if decision == "accept" else 7.5)
    assert done.take.decision == decision, done.take.verdict.text()
    if decision == "reject":
        assert "queue full" in done.take.verdict.text()
    assert all(not t.missed for t in done.take.counts.values())
    assert_everything_is_counted(done)


def test_what_keeps_a_finished_take_waiting_is_said_once_in_ten_seconds(
    record: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk stalls for five seconds just before the take's end, with all that comes behind it in the queues."""
    plain, stalls = Sink._write, [time.monotonic() + 1.2]

    def stalled(self: Sink, data: memoryview) -> None:
        if self.path.name.startswith("toss") and stalls and time.monotonic() > stalls[0]:
            stalls.clear()
            time.sleep(5.0)
        plain(self, data)

    monkeypatch.setattr(Sink, "_write", stalled)
    said = [text for text in record(seconds=1.0).operator.told if "still writing" in text]
    assert len(said) == 1
    assert re.search(r"still writing what was recorded, [1-9]\d* of /\S+ wait: the disk is slow, or the cores", said[0])


@pytest.mark.slow
def test_a_step_of_the_wall_clock_changes_nothing(record: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    plain = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: plain() + 3600 * 10**9)
    done = record()
    assert done.take.decision == "accept"
    assert not any(c["steps"] for c in done.clocks.values())


@pytest.mark.slow
def test_an_arm_in_reflex_refuses_the_toss(record: Callable[..., Any]) -> None:
    done = record(before=lambda lab: lab.faults("arm").inject("reflex"))
    assert done.take.decision == "reject"
    assert "stands in reflex" in done.take.verdict.text()


def test_a_device_that_is_not_there_stops_everything_before_anything_is_written(
    record: Callable[..., Any], tmp_path: Path
) -> None:
    with pytest.raises(TosslabError, match="mono0 is unplugged"):
        record(before=lambda lab: lab.faults("mono0").inject("unplug"))
    assert not (tmp_path / "session").exists()


def test_a_toss_that_does_not_fit_on_the_disk_is_not_begun(tmp_path: Path) -> None:
    with pytest.raises(TosslabError, match="Free some space"):
        check_disk(tmp_path / "new", 40e6, 10.0, reserve_gb=1e9)


@pytest.mark.slow
def test_frames_between_tosses_are_kept_on_request(record: Callable[..., Any]) -> None:
    done = record(tosses=2, between_tosses=True)
    assert [t.decision for t in done.report.takes] == ["accept", "accept"]
    with Session.open(done.folder) as session:
        before, after = session.toss(0).color(), session.toss(1).color()
        assert after[0].index == before[len(before) - 1].index + 1
    assert_everything_is_counted(done)


def test_a_take_that_does_not_end_says_why_while_it_runs_and_in_its_verdict(
    record: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acquisition.take.WAITS_AFTER_S", 0.5)
    done = record(seconds=None, longest_toss_s=3.0)
    said = [text for text in done.operator.told if text.startswith("still recording after")]
    assert said
    assert "the arm still moves" in said[0]
    cut = next(text for text in done.take.verdict.warnings if text.startswith("cut after 3 s"))
    assert "[recording] longest_toss_s" in cut
    assert cut.endswith("no calibrated depth camera watches the object, so that its rest is not seen")
