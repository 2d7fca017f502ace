# long because: a take from its plan to its verdict, on one screen after another
"""Recording a session: toss after toss into one folder, each with its verdict; nothing lost in silence.

report = record_session(recorder, thrower, session, options, operator)
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from acquisition.arm.asked import count_down, stopped
from acquisition.arm.limits import arm_model
from acquisition.arm.throw import Throw, Thrower
from acquisition.arm.toss import TossPlan
from acquisition.detect import Eye, TossEvents, TossWatcher
from acquisition.devices import Arm, DeviceLost, DeviceRefused, Gripper
from acquisition.interrupts import Interrupts
from acquisition.judge import judge
from acquisition.operator import Operator
from acquisition.streaming.recorder import Recorder, thumbnail_stride
from acquisition.streaming.sequence_check import Trouble
from acquisition.streaming.streams import Tally
from acquisition.verdict import Verdict
from recordings.errors import TosslabError, WriteFailed
from recordings.mcap.toss_writer import TossWriter
from recordings.progress import Progress
from recordings.records import HealthLine, TossCommand, TossEvent
from recordings.session_writer import SessionWriter, toss_name
from recordings.tracks import RigCalibration

POLL_S = 0.02
SLOW_S = 2.0
WAITS_AFTER_S = 4.0
"""After so long a take that does not end says what it waits for, and again after as long."""
PLAYED = "end of the recording"
ENDS_TAKE = ("lost", "silent", "reflex", "user_stopped", "error", "disk", "fault", "motion")


class DiskFull(TosslabError):
    """The next toss does not fit."""


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
        take = _Running(self, plan, fixed_s)
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
        take: _Running,
        events: TossEvents,
        troubles: Sequence[Trouble],
        verdict: Verdict,
        ended_by: str,
    ) -> tuple[Verdict, str]:
        try:
            self._write_story(writer, take, events, troubles, verdict)
            writer.finish()
            info = self._info(verdict, take, ended_by)
            self.session.add_info(toss, info)
            if "release_delay_s" in info["gripper"]:
                self.thrower.learn(info["gripper"]["release_delay_s"])
        except WriteFailed as refused:
            return Verdict("reject", (str(refused),)), "reject"
        return verdict, "accept"

    def _keep_interrupted(self, toss: int, writer: TossWriter, take: _Running, before: Mapping[str, Tally]) -> None:
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
        """Wait for the queues; stays answerable to Ctrl-C, and says so when the disk keeps everybody waiting."""
        self.recorder.end()
        self._ended_host_ns = time.monotonic_ns()
        tell = time.monotonic() + SLOW_S
        while not self.recorder.ended():
            if time.monotonic() > tell:
                self.operator.say("the disk is slow: still writing what was recorded")
                tell += SLOW_S
            time.sleep(POLL_S)

    def _counts(self, before: Mapping[str, Tally]) -> dict[str, Tally]:
        return {topic: tally.since(before[topic]) for topic, tally in self.recorder.tallies().items()}

    def _record_drops(self, writer: TossWriter, counts: Mapping[str, Tally]) -> None:
        for topic, tally in counts.items():
            if tally.dropped_total:
                writer.dropped(topic, tally.dropped_total)

    def _write_story(
        self, writer: TossWriter, take: _Running, events: TossEvents, troubles: Sequence[Trouble], verdict: Verdict
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

    def _info(self, verdict: Verdict, take: _Running, ended_by: str) -> dict[str, Any]:
        return {
            "verdict": verdict.text(),
            "warnings": list(verdict.warnings),
            "ended_by": ended_by,
            "clocks": self.recorder.clocks(),
            "gripper": take.gripper_story(),
            "motion": take.motion_story(),
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


class _Running:
    """A take while it is recorded."""

    def __init__(self, run: SessionRun, plan: TossPlan | None, fixed_s: float | None) -> None:
        self._run, self._plan, self._fixed_s = run, plan, fixed_s
        self.watcher = TossWatcher(by_hand=not run.recorder.rig.of_kind("gripper"))
        self.troubles: list[Trouble] = []
        self.notes: list[TossEvent] = []
        self.began_s = time.monotonic()
        self.seconds = 0.0
        self.write_failure = ""
        self.waited_for = ""
        """Of a take that was cut at the longest time: what had not happened."""
        self._throw: Throw | None = None
        before_ns = time.monotonic_ns() - round(run.config.pre_trigger_s * 1e9)
        self._seen_look_ns = self._seen_width_ns = before_ns
        still = [look for look in list(run.recorder.thumbnails) if look.host_ns > before_ns]
        if run.eye is not None and still:
            run.eye.learn([look.raw for look in still], still[-1].unit_m)

    def throw(self) -> None:
        """Set the arm going, where there is a plan."""
        devices = self._run.recorder.devices.values()
        arm = next((d for d in devices if isinstance(d, Arm)), None)
        if self._plan is None or arm is None:
            return
        gripper = next((d for d in devices if isinstance(d, Gripper)), None)
        toss = self._run.recorder.rig.toss
        opening = (toss.open_width_m, toss.open_speed_m_s) if toss is not None else (0.08, 0.1)
        self._throw = Throw(arm, gripper, self._plan, *opening)
        try:
            self._throw.start()
        except (DeviceRefused, DeviceLost) as refused:
            self.troubles.append(Trouble(time.monotonic_ns(), "arm", "motion", str(refused), "error"))

    def halt(self) -> None:
        if self._throw is not None:
            self._throw.halt()

    def watch(self) -> str:
        """Stay until the toss is over; returns what ended the take."""
        run, config = self._run, self._run.config
        rested_s: float | None = None
        say_s = time.monotonic() + WAITS_AFTER_S
        while True:
            time.sleep(POLL_S)
            now_s = time.monotonic()
            self.seconds = now_s - self.began_s
            if run.thrower.over():
                self._look()
                return PLAYED
            why = self._trouble() or self._key() or self._disk()
            if why:
                self.halt()
                return why
            self._look()
            if self._fixed_s is not None:
                if self.seconds >= self._fixed_s:
                    return "time"
                continue
            session_s = run.recorder.clock.session_ns(time.monotonic_ns()) / 1e9
            if rested_s is None and self.watcher.over(session_s) and (self._throw is None or self._throw.over()):
                rested_s = now_s
            if rested_s is not None and now_s - rested_s >= config.after_rest_s:
                return "rest"
            if rested_s is None and now_s > say_s:
                run.operator.say(f"still recording after {self.seconds:.0f} s: {self.waits_for()}. x: stop")
                say_s = now_s + WAITS_AFTER_S
            if self.seconds > config.longest_toss_s:
                self.halt()
                self.waited_for = self.waits_for()
                return "longest toss"

    def waits_for(self) -> str:
        """Why the take goes on, in words."""
        if self._throw is not None and not self._throw.over():
            return "the arm still moves"
        if self._run.eye is None:
            return "no calibrated depth camera watches the object, so that its rest is not seen"
        now_s = self._run.recorder.clock.session_ns(time.monotonic_ns()) / 1e9
        return self.watcher.waits_for(now_s)

    def _trouble(self) -> str:
        fresh = self._run.recorder.troubles() + self._run.watch_silence()
        if self._throw is not None:
            fresh += self._throw.troubles()
        self.troubles += fresh
        for trouble in fresh:
            self._run.operator.say(f"{trouble.device}: {trouble.kind}: {trouble.text}")
        return next((t.kind for t in fresh if t.level == "error" and t.kind in ENDS_TAKE), "")

    def _key(self) -> str:
        """Any key stops an arm that moves; else what the key says."""
        if self._throw is not None and not self._throw.over():
            return "stop key" if stopped(self._run.operator) else ""
        key = self._run.operator.key()
        if key == "note":
            now_ns = self._run.recorder.clock.session_ns(time.monotonic_ns())
            self.notes.append(TossEvent(now_ns, "note", "operator", self._run.operator.note()))
        if key == "quit":
            raise KeyboardInterrupt
        return "stop key" if key in ("stop", "reject", "redo", "accept") else ""

    def _disk(self) -> str:
        take = self._run.recorder.take
        if take is not None and take.failed:
            self.write_failure = take.failed
            return "disk"
        free = shutil.disk_usage(self._run.session.folder).free
        if free < self._run.config.reserve_gb * 1e9 / 2:
            self.write_failure = f"the disk ran down to {free / 1e9:.2f} GB"
            return "disk"
        return ""

    def _look(self) -> None:
        """Feed the watcher with what came since the last time."""
        run, recorder = self._run, self._run.recorder
        for sample in [s for s in list(recorder.widths) if s.host_ns > self._seen_width_ns]:
            self._seen_width_ns = sample.host_ns
            self.watcher.width(recorder.clock.session_ns(sample.host_ns) / 1e9, sample.width_m)
        if run.eye is None:
            return
        for look in [k for k in list(recorder.thumbnails) if k.host_ns > self._seen_look_ns]:
            self._seen_look_ns = look.host_ns
            q = recorder.joints_at(look.host_ns)
            near = self.watcher.expected_m(look.time_ns / 1e9, run.eye.tool_m(q))
            self.watcher.saw(run.eye.see(look.time_ns / 1e9, look.raw, look.unit_m, q, near))

    def command(self) -> TossCommand | None:
        """What the arm was asked, for the file."""
        started = self._throw.started_host_ns if self._throw is not None else None
        if self._plan is None or started is None:
            return None
        clock = self._run.recorder.clock
        start_ns = clock.session_ns(started)
        return TossCommand(
            start_ns,
            start_ns + round(self._plan.release_s * 1e9),
            self._plan.world_from_tool.matrix,
            self._plan.linear_velocity_world_m_s,
            self._plan.angular_velocity_world_rad_s,
        )

    def gripper_story(self) -> dict[str, Any]:
        """Command sent, acknowledged, first movement: the release delay of this toss."""
        if self._throw is None or self._throw.sent_host_ns is None:
            return {}
        clock, command = self._run.recorder.clock, self._throw.command()
        sent_ns = clock.session_ns(self._throw.sent_host_ns)
        story: dict[str, Any] = {"sent_session_ns": sent_ns}
        if command is not None and command.acknowledged_host_ns is not None:
            story["acknowledged_session_ns"] = clock.session_ns(command.acknowledged_host_ns)
        released = self.watcher.released
        if released is not None:
            story["release_delay_s"] = released.time_s - sent_ns / 1e9
        return story

    def motion_story(self) -> dict[str, Any]:
        if self._throw is None:
            return {}
        motion = self._throw.motion()
        return {"status": motion.status, "reason": motion.reason, "ticks": motion.ticks, "missed": motion.missed}


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


JPEG_SHARE, LOSSLESS_SHARE, DEPTH_SHARE = 0.25, 0.75, 0.4
ARM_BYTES_S = 400_000


def expected_bytes_s(recorder: Recorder) -> float:
    """Bytes per second on the disk, from the pictures that flow."""
    total = 0.0
    lossless = recorder.rig.recording.mono_encoding == "lossless"
    for topic, queue in recorder.queues.items():
        image = recorder.latest.get(topic)
        if image is None:
            total += ARM_BYTES_S if "arm" in topic else 0
            continue
        share = DEPTH_SHARE if topic.endswith("depth") else JPEG_SHARE
        if lossless and topic.endswith("/image"):
            share = LOSSLESS_SHARE
        total += image.pixels.nbytes * share * queue.rate_hz
    return total


def check_disk(folder: Path, bytes_s: float, longest_s: float, reserve_gb: float) -> None:
    """Raises DiskFull unless twice the longest toss and the reserve fit."""
    place = folder
    while not place.exists():
        place = place.parent
    free, wanted = shutil.disk_usage(place).free, 2 * bytes_s * longest_s + reserve_gb * 1e9
    if free < wanted:
        raise DiskFull(
            f"{place} has {free / 1e9:.2f} GB free; a toss of {longest_s:g} s at {bytes_s / 1e6:.0f} MB/s and the "
            f"reserve want {wanted / 1e9:.2f} GB. Free some space, choose another folder, or lower "
            "[recording] longest_toss_s or reserve_gb in the rig file"
        )
