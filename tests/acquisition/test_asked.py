# long because: the plain devices and the questions that are asked of them belong on one page
"""Nothing moves unasked: said first, begun by a key, counted down, stopped by any key."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from acquisition.arm.asked import ask, count_down, watch_motion
from acquisition.arm.limits import arm_model
from acquisition.arm.throw import ByHand
from acquisition.arm.thrower import ArmThrower
from acquisition.arm.workspace import Space
from acquisition.command import at_speed, the_operator
from acquisition.devices import GripperCommand, GripperSample, JointTrajectory, Motion
from acquisition.operator import Keyboard, Nobody, Unattended
from acquisition.ready_rig import Setup
from acquisition.rig import Rig, TossConfig, Workspace, find_rig, read_rig
from acquisition.setup import NO_CALIBRATION, set_up
from acquisition.streaming.recorder import Recorder
from recordings.errors import BadInput, TosslabError
from recordings.geometry import Transform
from recordings.progress import Silent
from recordings.tracks import RigCalibration

HERE = Transform("world", "base", np.eye(3), np.zeros(3))
PANDA = arm_model("panda")
CALM = TossConfig(
    position_m=(0.5, 0.0, 0.35), velocity_m_s=(0.3, 0.0, 0.2), velocity_spread_m_s=0.0, held_mass_kg=0.2, dry_openings=3
)


class Person(Nobody):
    """Starts when asked, up to `starts` times; presses a key `presses_at` s after the last start (once)."""

    headless = False

    def __init__(self, starts: int = 100, presses_after_s: float | None = None) -> None:
        super().__init__()
        self.told: list[str] = []
        self.log: list[str] = []
        self._starts, self._after_s = starts, presses_after_s
        self._started_s: float | None = None
        self.answer = ""

    def say(self, text: str) -> None:
        self.told.append(text)
        self.log.append(text)

    def wait_for_start(self) -> Any:
        self.log.append("KEY")
        self._starts -= 1
        self._started_s = time.monotonic()
        return "start" if self._starts >= 0 else "quit"

    def touched(self) -> bool:
        due = self._started_s is not None and self._after_s is not None
        if due and time.monotonic() - self._started_s > self._after_s:  # type: ignore[operator]
            self._after_s = None
            return True
        return False

    def line(self, question: str) -> str:
        self.told.append(question)
        return self.answer


class PlainArm:
    """An arm that is where its trajectory says, in real time; notes what the person had done before each motion."""

    name, rate_hz = "arm", 100.0
    joint_names = tuple(f"panda_joint{k}" for k in range(1, 8))

    def __init__(self, person: Person, q: np.ndarray, fast: float = 1.0) -> None:
        self._person, self._fast = person, fast
        self._path = JointTrajectory(np.zeros(1), q[None], np.zeros((1, 7)))
        self._began_s, self._halted_s = 0.0, None
        self._status = "none"
        self.moves: list[JointTrajectory] = []
        self.loads: list[tuple[float, list[float]]] = []
        self.unfit = ""

    def at(self) -> np.ndarray:
        until = self._halted_s if self._halted_s is not None else time.monotonic()
        return self._path.at((until - self._began_s) * self._fast)[0]

    def move(self, trajectory: JointTrajectory) -> None:
        self._person.log.append("MOVE")
        self.moves.append(trajectory)
        self._path, self._began_s, self._halted_s = trajectory, time.monotonic(), None
        self._status = "moving"

    def may_move(self) -> None:
        if self.unfit:
            raise TosslabError(self.unfit)

    def motion(self) -> Motion:
        over = (time.monotonic() - self._began_s) * self._fast > self._path.duration_s
        if self._status == "moving" and over:
            self._status = "done"
        return Motion(self._status, "halted" if self._status == "aborted" else "")  # type: ignore[arg-type]

    def halt(self) -> None:
        if self._status == "moving":
            self._halted_s, self._status = time.monotonic(), "aborted"
            self._person.log.append("HALT")

    def set_load(self, mass_kg: float, centre_flange_m: np.ndarray, radius_m: float) -> None:
        self.loads.append((mass_kg, centre_flange_m.tolist()))

    def _nothing(self, *given: Any) -> Any: ...

    open = start = stop = close = read = describe = health = recover = __enter__ = __exit__ = _nothing


class PlainHand:
    """Fingers that obey at once."""

    name = "gripper"

    def __init__(self, person: Person, widths: Any) -> None:
        self._person, self._widths = person, widths
        self._command: GripperCommand | None = None
        self._width = 0.08

    def _go(self, width_m: float, kind: Any) -> None:
        self._person.log.append("HAND")
        now = time.monotonic_ns()
        self._widths.clear()
        for k in range(6):
            width = self._width + (width_m - self._width) * k / 5
            self._widths.append(GripperSample(k, "host", now, now + k * 1_000_000, width, 0.08, False))
        self._width = width_m
        self._command = GripperCommand(kind, width_m, now, now, True)

    def grasp(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        self._go(width_m, "grasp")

    def release(self, width_m: float, speed_m_s: float) -> None:
        self._go(width_m, "move")

    def command(self) -> GripperCommand | None:
        return self._command

    def _nothing(self, *given: Any) -> Any: ...

    open = start = stop = close = read = describe = health = __enter__ = __exit__ = _nothing


class PlainRecorder(Recorder):
    """What a thrower asks of a recorder."""

    def __init__(self, person: Person, q: np.ndarray, fast: float = 1.0) -> None:
        self.widths = deque()
        self.arm, self.hand = PlainArm(person, q, fast), PlainHand(person, self.widths)
        self.devices = {"arm": self.arm, "gripper": self.hand}

    def joints_at(self, host_ns: int) -> np.ndarray:
        return self.arm.at()


def thrower(person: Person, fast: float = 20.0, countdown_s: float = 1.0, **config: Any) -> tuple[ArmThrower, Any]:
    recorder = PlainRecorder(person, PANDA.ready_rad + 0.2, fast)
    space, toss = Space.of_table(HERE), replace(CALM, **config)
    return ArmThrower(PANDA, space, toss, recorder, person, 1.0, countdown_s), recorder  # type: ignore[arg-type]


def test_the_arm_says_what_it_will_do_and_waits_for_a_key_and_counts_down() -> None:
    person = Person()
    made, recorder = thrower(person)
    plan = made.prepare(0, 0, Silent())
    assert person.log.index("KEY") < person.log.index("MOVE")
    said = person.log[: person.log.index("MOVE")]
    assert "the arm will move to the start of toss_00: joints from (" in said[0]
    assert "cm, no part faster than" in said[0]
    assert said[-1] == "1"  # the countdown
    assert "put the object between the fingers: they close to 50 mm with 40 N" in person.log
    after = person.log[person.log.index("MOVE") :]
    assert after.index("KEY") < after.index("HAND")
    assert person.told[-1].startswith("next the arm tosses: ")
    np.testing.assert_allclose(recorder.arm.at(), plan.trajectory.q_rad[0], atol=1e-6)
    assert len(recorder.arm.moves) == 1  # the toss itself waits for its own start


def test_quitting_instead_moves_nothing() -> None:
    person = Person(starts=0)
    made, _ = thrower(person)
    with pytest.raises(KeyboardInterrupt):
        made.prepare(0, 0, Silent())
    with pytest.raises(KeyboardInterrupt):
        made.get_ready()
    assert "MOVE" not in person.log
    assert "HAND" not in person.log


def test_a_key_in_the_countdown_stops_it_and_asks_anew() -> None:
    person = Person(starts=1, presses_after_s=0.3)
    made, _ = thrower(person)
    with pytest.raises(KeyboardInterrupt):  # the second question is answered by q
        made.prepare(0, 0, Silent())
    assert "MOVE" not in person.log
    assert "stopped: nothing moved" in person.told
    assert person.log.count("KEY") == 2


def test_a_key_halts_the_arm_on_its_way_and_the_rest_is_asked_for_anew() -> None:
    person = Person(starts=1, presses_after_s=1.3)
    made, recorder = thrower(person, fast=1.0)
    with pytest.raises(KeyboardInterrupt):
        made.prepare(0, 0, Silent())
    assert person.log.count("MOVE") == 1
    assert person.log.index("MOVE") < person.log.index("HALT")
    asked = [text for text in person.told if "the arm will move" in text]
    assert len(asked) == 2
    assert asked[0] != asked[1]  # from where it stands now
    assert np.abs(recorder.arm.at() - recorder.arm.moves[0].q_rad[-1]).max() > 0.01


def test_dry_openings_ask_first_and_a_key_ends_them() -> None:
    person = Person()
    made, _ = thrower(person)
    assert made.get_ready()["release_delay"]["samples"] == 3
    assert person.log.index("KEY") < person.log.index("HAND")
    assert "the hand will close with 40 N and open to 80 mm 3 times" in person.told[0]
    hasty = Person(starts=1, presses_after_s=1.001)
    made, _ = thrower(hasty, dry_openings=100)
    with pytest.raises(KeyboardInterrupt):
        made.get_ready()
    assert hasty.log.count("HAND") < 200
    assert any("stopped after" in text for text in hasty.told)


def test_the_arm_is_told_its_load_when_it_has_one() -> None:
    person = Person()
    made, recorder = thrower(person, held_centre_m=(0.0, 0.0, 0.01))
    made.prepare(0, 0, Silent())
    masses = [mass for mass, _ in recorder.arm.loads]
    assert masses == [0.0, 0.2]
    # tool and flange of the Panda are 210.4 mm apart along z, turned about it
    np.testing.assert_allclose(recorder.arm.loads[1][1], [0, 0, 0.1034 + 0.107 - 0.107 + 0.01], atol=2e-3)


def test_a_mass_that_the_rig_does_not_say_is_asked_for() -> None:
    person = Person()
    person.answer = "0,35"
    made, recorder = thrower(person, held_mass_kg=None, dry_openings=0)
    assert made.get_ready()["held"]["mass_kg"] == 0.35
    made.prepare(0, 0, Silent())
    assert recorder.arm.loads[-1][0] == 0.35
    person.answer = "heavy"
    made, _ = thrower(person, held_mass_kg=None)
    with pytest.raises(BadInput, match="found 'heavy', wanted more than 0 and at most 3 kg"):
        made.get_ready()


def test_an_arm_that_is_not_fit_is_found_before_anything_is_asked() -> None:
    person = Person()
    made, recorder = thrower(person)
    recorder.arm.unfit = "not real-time"
    with pytest.raises(TosslabError, match="not real-time"):
        made.get_ready()
    assert person.log == []


def test_an_arm_that_does_not_get_there_is_not_tried_again() -> None:
    person = Person()
    made, recorder = thrower(person, fast=0.5)
    arm = recorder.arm
    moved = arm.move
    arm.move = lambda trajectory: (moved(trajectory), arm.halt())
    with pytest.raises(TosslabError, match="halted; nothing is recovered or tried again by itself"):
        made.prepare(0, 0, Silent())
    assert person.log.count("MOVE") == 1


def test_every_key_stops_also_those_that_mean_nothing(terminal: int) -> None:
    import tty

    tty.setcbreak(sys.stdin.fileno())
    for operator in (Keyboard(), Unattended()):
        assert not operator.touched()
        os.write(terminal, b"z")
        assert operator.touched()
        assert not operator.touched()
    os.write(terminal, b"\n")
    with pytest.raises(KeyboardInterrupt):  # of a run that asks nobody, a key is the end
        count_down(Unattended(), 1.0)


def test_a_key_from_before_the_question_starts_nothing(terminal: int) -> None:
    import tty

    tty.setcbreak(sys.stdin.fileno())
    os.write(terminal, b"sss")
    time.sleep(0.05)

    class Waits(Keyboard):
        def wait_for_start(self) -> Any:
            return "quit" if self.key() is None else "start"

    with pytest.raises(KeyboardInterrupt):
        ask(Waits(), "it will move", 0.0)


def test_an_arm_that_hangs_is_halted() -> None:
    person = Person()
    arm = PlainArm(person, PANDA.ready_rad, fast=0.0)
    arm.move(JointTrajectory(np.array([0.0, 1.0]), np.stack([PANDA.ready_rad] * 2), np.zeros((2, 7))))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("acquisition.arm.asked.LATE_S", 0.1)
        patch.setattr("acquisition.arm.asked.LATE_SHARE", 0.1)
        with pytest.raises(TosslabError, match="it was halted"):
            watch_motion(arm, person, 1.0, "the way")
    assert "HALT" in person.log


BOX = Workspace((-1.0, -1.0, -0.1), (1.0, 1.0, 1.5), ())
PLACED = RigCalibration(
    cameras={}, transforms=(HERE, *(Transform("world", n, np.eye(3), np.ones(3)) for n in ("d455", "mono0")))
)


def setup(**change: Any) -> Setup:
    rig: Rig = replace(read_rig(find_rig("ur5e")), **{"workspace": BOX, **change})
    return Setup(rig, {}, ByHand(), PLACED)


def asking(yes: bool = False, calibration: str | None = None) -> argparse.Namespace:
    return argparse.Namespace(yes=yes, calibration=calibration)


def test_yes_moves_a_real_arm_only_where_the_rig_says_unattended() -> None:
    assert isinstance(the_operator(setup(), asking()), Keyboard)
    with pytest.raises(BadInput, match="--yes would move a real arm without asking; nothing was moved"):
        the_operator(setup(), asking(yes=True))
    assert isinstance(the_operator(setup(unattended=True), asking(yes=True)), Unattended)
    assert isinstance(the_operator(setup(toss=None), asking(yes=True)), Nobody)  # it does not move


def test_a_calibration_needs_no_calibrated_arm_because_it_moves_none() -> None:
    bare = replace(setup(workspace=None), calibration=NO_CALIBRATION)
    assert type(the_operator(bare, asking(yes=True, calibration="hand-eye"))) is Nobody
    with pytest.raises(BadInput, match="not calibrated"):
        the_operator(bare, asking())


def test_the_simulated_lab_goes_on_unattended() -> None:
    simulated = set_up("synthetic")
    assert not simulated.moves_arm
    assert type(the_operator(simulated, asking(yes=True))) is Nobody


def test_speed_slows_a_real_arm_and_nothing_else() -> None:
    slow = at_speed(setup(), 0.1)
    assert slow.rig.recording.longest_toss_s == 10 * setup().rig.recording.longest_toss_s
    for wrong in (0.0, -1.0, 1.5, float("nan")):
        with pytest.raises(BadInput, match="more than 0 and at most 1"):
            at_speed(setup(), wrong)
    with pytest.raises(BadInput, match="moves none: leave it out"):
        at_speed(set_up("synthetic"), 0.5)


def test_a_failing_close_says_what_it_was() -> None:
    class Broken:
        name = "mono0"

        def close(self) -> None:
            raise ValueError("cable of smoke")

    recorder = object.__new__(Recorder)
    recorder._troubles, recorder._not_put_away = deque(), {}
    for _ in range(3):
        recorder.put_away("mono0", Broken().close)
    told = recorder.troubles()
    assert [(t.device, t.kind, t.text) for t in told] == [
        ("mono0", "not put away", "close failed: ValueError: cable of smoke")
    ]


class Pressing(Nobody):
    """Asked at a simulated lab: says yes, decides by the verdict, presses a key when `when` says so, once."""

    headless = False

    def __init__(self, when: Any) -> None:
        super().__init__()
        self.when, self.pressed, self.asked = when, False, 0
        self.told: list[str] = []

    def say(self, text: str) -> None:
        self.told.append(text)

    def wait_for_start(self) -> Any:
        self.asked += 1
        return "start"

    def touched(self) -> bool:
        if not self.pressed and self.when():
            self.pressed = True
            return True
        return False

    def decide(self, verdict: Any) -> Any:
        return verdict.decision


def test_any_key_stops_a_toss_while_the_arm_moves(record: Any) -> None:
    lab: list[Any] = []
    operator = Pressing(lambda: lab[0].arm.motion().status == "moving")
    done = record(lab.append, seconds=5.0, operator=operator)
    assert done.take.ended_by == "stop key"
    assert done.lab.arm.motion().status == "aborted"


def test_any_key_stops_the_countdown_of_a_toss_and_it_is_asked_for_anew(record: Any) -> None:
    operator = Pressing(lambda: True)
    done = record(seconds=0.5, operator=operator, countdown_s=1.0)
    assert operator.asked == 2
    assert operator.told.index("stopped: nothing moved") < operator.told.index("1", operator.told.index("1") + 1)
    assert done.take.ended_by == "time"
