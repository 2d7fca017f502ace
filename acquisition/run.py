"""Recording a session: toss after toss into one folder, each with its verdict; nothing lost in silence.

report = record_session(recorder, thrower, session, options, operator)
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from acquisition.arm.asked import count_down
from acquisition.arm.limits import arm_model
from acquisition.arm.throw import Thrower
from acquisition.arm.toss import TossPlan
from acquisition.detect import Eye, TossEvents
from acquisition.disk import check_disk, expected_bytes_s
from acquisition.interrupts import Interrupts
from acquisition.judge import judge
from acquisition.operator import Operator
from acquisition.streaming.recorder import Recorder, thumbnail_stride
from acquisition.streaming.sequence_check import Trouble
from acquisition.streaming.streams import Tally
from acquisition.take import PLAYED, POLL_S, AtTheRig, WatchedTake
from acquisition.verdict import Verdict
from recordings.errors import WriteFailed
from recordings.mcap.toss_writer import TossWriter
from recordings.progress import Progress
from recordings.records import HealthLine, TossEvent
from recordings.session_writer import SessionWriter, toss_name
from recordings.tracks import RigCalibration

SLOW_S, AGAIN_S = 2.0, 10.0


@dataclass(frozen=True)
class Options:
    """What the command asks for. `fixed_s`: takes of this length, whatever is seen (calibrations, benches)."""

    tosses: int = 1
    first_toss: int = 0
    fixed_s: float | None = None


@dataclass
class TossReport:
    """What became of one take."""

    toss: int
    verdict: Verdict
    decision: str
    seconds: float
    bytes: int
    counts: Mapping[str, Tally]
    events: TossEvents
    ended_by: str


@dataclass
class SessionReport:
    """What became of a session."""

    folder: Path
    asked: int
    takes: list[TossReport] = field(default_factory=list)
    stopped: str = ""

    @property
    def accepted(self) -> int:
        return sum(t.decision == "accept" for t in self.takes)


@dataclass(frozen=True, eq=False)
class Opened:
    """A take's file, and the counts when it was opened."""

    writer: TossWriter
    before: Mapping[str, Tally]


class SessionRun:
    """One session being recorded."""

    def __init__(
        self,
        recorder: Recorder,
        thrower: Thrower,
        session: SessionWriter,
        calibration: RigCalibration,
        operator: Operator,
        progress: Progress,
        interrupts: Interrupts | None = None,
    ) -> None:
        self.recorder, self.thrower, self.session = recorder, thrower, session
        self.interrupts = interrupts or Interrupts()
        self.operator, self.progress = operator, progress
        self.config = recorder.rig.recording
        self.eye = make_eye(recorder, calibration)
        self._rate_bytes_s = expected_bytes_s(recorder)
        self._silent: set[str] = set()
        self._at = AtTheRig(recorder, thrower, operator, self.config, self.eye, session.folder, self.watch_silence)
        self._ended_host_ns: int | None = None

    def record(self, options: Options) -> SessionReport:
        """All tosses that were asked for; ends early by the disk, the emergency stop or `quit`."""
        report = SessionReport(self.session.folder, options.tosses)
        attempt, rejected, toss = 0, 0, options.first_toss
        while toss < options.first_toss + options.tosses and not report.stopped:
            check_disk(self.session.folder, self._rate_bytes_s, self.config.longest_toss_s, self.config.reserve_gb)
            opened = self._open(toss) if self.config.between_tosses else None
            plan = self.thrower.prepare(toss, attempt, self.progress)
            if not self._started():
                report.stopped = "quit"
                self._drop(toss, opened)
                break
            take = self._take(toss, plan, options.fixed_s, opened)
            report.takes.append(take)
            self.operator.say(f"{toss_name(toss)}: {take.decision} ({take.verdict.text()})")
            if take.decision == "accept":
                toss, attempt, rejected = toss + 1, 0, 0
                continue
            rejected += 1
            if take.decision == "reject" or self.operator.headless:
                attempt += 1  # another toss under the same number; `redo` asks for the same one again
            report.stopped = next((r for r in take.verdict.reasons if "emergency stop" in r), "")
            if not report.stopped and self.operator.headless and rejected > self.config.redo_at_most:
                report.stopped = f"{toss_name(toss)} was rejected {rejected} times"
        return report

    def _open(self, toss: int) -> Opened:
        """A new file, which takes what is in the rings and all that comes."""
        self.recorder.troubles()
        before = self.recorder.tallies()
        reach_ns = time.monotonic_ns() - round(self.config.pre_trigger_s * 1e9)
        if self.config.between_tosses and self._ended_host_ns is not None:
            reach_ns = self._ended_host_ns + 1
        with self.interrupts.shield():
            writer = self.session.toss(toss, {"clocks": self.recorder.clocks()})
            self.recorder.begin(writer, reach_ns)
        return Opened(writer, before)

    def _drop(self, toss: int, opened: Opened | None) -> None:
        """The frames before a toss that did not come."""
        if opened is not None:
            with self.interrupts.shield():
                self._close()
                self.session.discard(toss)

    def _take(self, toss: int, plan: TossPlan | None, fixed_s: float | None, opened: Opened | None) -> TossReport:
        opened = opened or self._open(toss)
        writer, before = opened.writer, opened.before
        take = WatchedTake(self._at, plan, fixed_s)
        try:
            take.throw()
            ended_by = take.watch()
            self._close()
            events = take.watcher.events()
            troubles = take.troubles + self.recorder.troubles()
            counts = self._counts(before)
            expects_toss = fixed_s is None and ended_by != PLAYED
            verdict = judge(counts, troubles, events, self.config, expects_toss, take.write_failure, take.waited_for)
            decision: str = self.operator.decide(verdict)
        except BaseException:
            with self.interrupts.shield():
                self._keep_interrupted(toss, writer, take, before)
            raise
        with self.interrupts.shield():
            self._record_drops(writer, counts)
            size = writer.bytes_written
            if decision == "accept":
                verdict, decision = self._keep(toss, writer, take, events, troubles, verdict, ended_by)
            if decision != "accept":
                self.session.discard(toss)
        if take.seconds > 1:
            self._rate_bytes_s = max(0.5 * self._rate_bytes_s, size / take.seconds)
        return TossReport(toss, verdict, decision, take.seconds, size, counts, events, ended_by)

    def _keep(
        self,
        toss: int,
        writer: TossWriter,
        take: WatchedTake,
        events: TossEvents,
        troubles: Sequence[Trouble],
        verdict: Verdict,
        ended_by: str,
    ) -> tuple[Verdict, str]:
        try:
            self._write_events(writer, take, events, troubles, verdict)
            writer.finish()
            info = self._info(verdict, take, ended_by)
            self.session.add_info(toss, info)
            if "release_delay_s" in info["gripper"]:
                self.thrower.learn(info["gripper"]["release_delay_s"])
        except WriteFailed as refused:
            return Verdict("reject", (str(refused),)), "reject"
        return verdict, "accept"

    def _keep_interrupted(self, toss: int, writer: TossWriter, take: WatchedTake, before: Mapping[str, Tally]) -> None:
        """Everything so far stays, as a whole file that says so."""
        take.halt()
        try:
            self._close()
            self._record_drops(writer, self._counts(before))
            writer.finish("interrupted")
            self.session.add_info(toss, {"verdict": "interrupted"})
        except WriteFailed:
            pass  # what the disk took can be recovered

    def _started(self) -> bool:
        """A start and its countdown, which any key stops; false for quit."""
        while self.operator.wait_for_start() != "quit":
            if count_down(self.operator, self.config.countdown_s):
                return True
            self.operator.say("stopped: nothing moved")
        return False

    def _close(self) -> None:
        """Wait for the queues; stays answerable to Ctrl-C, and says what keeps everybody waiting."""
        self.recorder.end()
        self._ended_host_ns = time.monotonic_ns()
        next_warning_s = time.monotonic() + SLOW_S
        while not self.recorder.ended():
            if time.monotonic() > next_warning_s:
                topic, many = self.recorder.most_waiting()
                seen = f"still writing what was recorded, {many} of {topic} wait"
                self.operator.say(f"{seen}: the disk is slow, or the cores are busy with something else")
                next_warning_s += AGAIN_S
            time.sleep(POLL_S)

    def _counts(self, before: Mapping[str, Tally]) -> dict[str, Tally]:
        """What came of each stream; of those alone that are to be expected in this toss."""
        absent = {name for name, device in self.recorder.devices.items() if device.health().absent}
        tallies = self.recorder.tallies().items()
        return {topic: tally.since(before[topic]) for topic, tally in tallies if topic.split("/")[1] not in absent}

    def _record_drops(self, writer: TossWriter, counts: Mapping[str, Tally]) -> None:
        for topic, tally in counts.items():
            if tally.dropped_total:
                writer.dropped(topic, tally.dropped_total)

    def _write_events(
        self, writer: TossWriter, take: WatchedTake, events: TossEvents, troubles: Sequence[Trouble], verdict: Verdict
    ) -> None:
        """The command, the events, the health lines and the verdict, into the toss's file."""
        now_ns = self.recorder.clock.session_ns(time.monotonic_ns())
        command = take.command()
        if command is not None:
            writer.command(command)
        for trouble in troubles:
            time_ns = self.recorder.clock.session_ns(trouble.host_ns)
            writer.health(HealthLine(time_ns, trouble.level, trouble.device, f"{trouble.kind}: {trouble.text}"))
        for event in (*events.records(), *take.notes):
            writer.event(event)
        writer.event(TossEvent(now_ns, "verdict", "toss-record", verdict.text()))

    def _info(self, verdict: Verdict, take: WatchedTake, ended_by: str) -> dict[str, Any]:
        return {
            "verdict": verdict.text(),
            "warnings": list(verdict.warnings),
            "ended_by": ended_by,
            "clocks": self.recorder.clocks(),
            "gripper": take.gripper_summary(),
            "motion": take.motion_summary(),
            "fullest_queues": {topic: queue.fullest for topic, queue in self.recorder.queues.items()},
        }

    def watch_silence(self) -> list[Trouble]:
        """Streams that have said nothing for too long, each told once until it speaks again."""
        found = []
        for topic, seconds in self.recorder.silent_since_s().items():
            limit_s = max(self.config.longest_gap_s, 5 / self.recorder.queues[topic].rate_hz)
            if seconds > limit_s and topic not in self._silent:
                self._silent.add(topic)
                text = f"nothing came for {seconds:.1f} s"
                found.append(Trouble(time.monotonic_ns(), topic, "silent", text, "error"))
            elif seconds <= limit_s:
                self._silent.discard(topic)
        return found


def make_eye(recorder: Recorder, calibration: RigCalibration) -> Eye | None:
    """What watches the depth camera; None where the calibration does not say where it stands."""
    rgbd = next((d for d in recorder.rig.devices if d.kind == "rgbd"), None)
    if rgbd is None:
        return None
    name = f"{rgbd.name}_depth" if f"{rgbd.name}_depth" in calibration.cameras else rgbd.name
    if name not in calibration.cameras or calibration.find("world", name) is None:
        return None
    robot = recorder.rig.robot
    return Eye(
        calibration.camera(name),
        calibration.transform("world", name),
        thumbnail_stride(calibration.camera(name).width),
        arm_model(robot) if robot is not None else None,
        calibration.find("world", "base"),
    )
