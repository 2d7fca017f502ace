"""Carrying a toss out: the arm follows its trajectory, the gripper is told to open at the planned instant."""

from __future__ import annotations

import threading
import time
from typing import Any, Protocol, runtime_checkable

from acquisition.arm.toss import TossPlan
from acquisition.devices import Arm, DeviceLost, DeviceRefused, Gripper, GripperCommand, Motion
from acquisition.streaming.sequence_check import Trouble
from recordings.progress import Progress

STARTS_WITHIN_S = 1.5
ANSWERS_WITHIN_S = 2.0


@runtime_checkable
class Thrower(Protocol):
    """Where tosses come from: the simulated lab, an arm with its planner, or a person's hand (no plan)."""

    def prepare(self, toss: int, attempt: int, progress: Progress) -> TossPlan | None:
        """Bring arm and object to the start of the next toss. None: somebody tosses by hand."""

    def over(self) -> bool:
        """Nothing more will come of this toss (a recording has been played to its end)."""

    def learn(self, delay_s: float) -> None:
        """The release delay of a toss, from its data."""

    def get_ready(self) -> dict[str, Any]:
        """Once, before the first toss: measure what a session needs to know of the gripper. JSON, for the session."""


class ByHand:
    """A person tosses."""

    def prepare(self, toss: int, attempt: int, progress: Progress) -> TossPlan | None:
        return None

    def over(self) -> bool:
        return False

    def learn(self, delay_s: float) -> None:
        pass

    def get_ready(self) -> dict[str, Any]:
        return {}


class Throw:
    """One toss being carried out. `start` returns at once; ask `troubles` and `over` while it runs."""

    def __init__(
        self, arm: Arm, gripper: Gripper | None, plan: TossPlan, open_width_m: float, open_speed_m_s: float
    ) -> None:
        self._arm, self._gripper, self._plan = arm, gripper, plan
        self._open = open_width_m, open_speed_m_s
        self._stop = threading.Event()
        self._reported: set[str] = set()
        self._refused = ""
        self.sent_host_ns: int | None = None
        self._thread = threading.Thread(target=self._open_in_time, name="release", daemon=True)

    def start(self) -> None:
        """Raises DeviceRefused or DeviceLost where the arm does not move."""
        self._arm.move(self._plan.trajectory)
        self._thread.start()

    def halt(self) -> None:
        """Stop the arm; fingers that were not told to open yet stay closed."""
        self._stop.set()
        self._arm.halt()

    @property
    def started_host_ns(self) -> int | None:
        return self._arm.motion().started_host_ns

    def over(self) -> bool:
        return self._arm.motion().status in ("done", "aborted")

    def motion(self) -> Motion:
        return self._arm.motion()

    def command(self) -> GripperCommand | None:
        return self._gripper.command() if self._gripper is not None and self.sent_host_ns is not None else None

    def troubles(self) -> list[Trouble]:
        """What went wrong, each thing once."""
        now = time.monotonic_ns()
        found = []
        motion = self._arm.motion()
        if motion.status == "aborted":
            found.append(Trouble(now, "arm", "motion", f"its motion was aborted: {motion.reason}", "error"))
        if motion.missed:
            found.append(Trouble(now, "arm", "late cycles", f"{motion.missed} of {motion.ticks} cycles late"))
        command = self.command()
        late = self.sent_host_ns is not None and now - self.sent_host_ns > ANSWERS_WITHIN_S * 1e9
        if self._refused:
            found.append(Trouble(now, "gripper", "gripper", self._refused, "error"))
        elif command is not None and (command.error or command.succeeded is False):
            found.append(Trouble(now, "gripper", "gripper", command.error or "it did not succeed", "error"))
        elif command is not None and command.acknowledged_host_ns is None and late:
            found.append(Trouble(now, "gripper", "gripper", f"no answer within {ANSWERS_WITHIN_S:g} s", "error"))
        fresh = [t for t in found if t.kind not in self._reported]
        self._reported |= {t.kind for t in fresh}
        return fresh

    def _open_in_time(self) -> None:
        """Wait for the motion's true start, then for the instant of the command."""
        ends = time.monotonic() + STARTS_WITHIN_S
        while (started := self._arm.motion().started_host_ns) is None:
            if self._stop.wait(0.0005) or time.monotonic() > ends:
                return
        due_ns = started + round(self._plan.command_s * 1e9)
        while (left_ns := due_ns - time.monotonic_ns()) > 0:
            if self._stop.wait(left_ns / 1e9):
                return
        if self._gripper is None or self._arm.motion().status == "aborted":
            return
        try:
            self.sent_host_ns = time.monotonic_ns()
            self._gripper.release(*self._open)
        except (DeviceRefused, DeviceLost) as wrong:
            self._refused = str(wrong)
