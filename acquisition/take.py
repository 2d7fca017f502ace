"""One take while it is recorded: the toss is watched until it is over, and whatever speaks against going on ends it."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acquisition.arm.asked import stopped
from acquisition.arm.throw import Throw, Thrower
from acquisition.arm.toss import TossPlan
from acquisition.detect import Eye, TossWatcher
from acquisition.devices import Arm, DeviceLost, DeviceRefused, Gripper
from acquisition.operator import Operator
from acquisition.rig import RecordingConfig
from acquisition.streaming.recorder import Recorder
from acquisition.streaming.sequence_check import Trouble
from recordings.records import TossCommand, TossEvent

POLL_S = 0.02
WAITS_AFTER_S = 4.0
"""After so long a take that does not end says what it waits for, and again after as long."""
PLAYED = "end of the recording"
ENDS_TAKE = ("lost", "silent", "reflex", "user_stopped", "error", "disk", "fault", "motion")


@dataclass(frozen=True, eq=False)
class AtTheRig:
    """What a take has to do with. `silence` tells of streams that have said nothing for too long, each once."""

    recorder: Recorder
    thrower: Thrower
    operator: Operator
    config: RecordingConfig
    eye: Eye | None
    folder: Path
    silence: Callable[[], list[Trouble]]


class WatchedTake:
    """A take while it is recorded."""

    def __init__(self, run: AtTheRig, plan: TossPlan | None, fixed_s: float | None) -> None:
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
        fresh = self._run.recorder.troubles() + self._run.silence()
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
        free = shutil.disk_usage(self._run.folder).free
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

    def gripper_summary(self) -> dict[str, Any]:
        """Command sent, acknowledged, first movement: the release delay of this toss."""
        if self._throw is None or self._throw.sent_host_ns is None:
            return {}
        clock, command = self._run.recorder.clock, self._throw.command()
        sent_ns = clock.session_ns(self._throw.sent_host_ns)
        summary: dict[str, Any] = {"sent_session_ns": sent_ns}
        if command is not None and command.acknowledged_host_ns is not None:
            summary["acknowledged_session_ns"] = clock.session_ns(command.acknowledged_host_ns)
        released = self.watcher.released
        if released is not None:
            summary["release_delay_s"] = released.time_s - sent_ns / 1e9
        return summary

    def motion_summary(self) -> dict[str, Any]:
        if self._throw is None:
            return {}
        motion = self._throw.motion()
        return {"status": motion.status, "reason": motion.reason, "ticks": motion.ticks, "missed": motion.missed}
