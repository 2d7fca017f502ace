"""Motions that a person agrees to: said before, begun by a key, counted down, stopped by any key while they run."""

from __future__ import annotations

import time

from acquisition.devices import Arm
from acquisition.operator import Operator
from recordings.errors import TosslabError

POLL_S = 0.02
LATE_SHARE, LATE_S = 3.0, 10.0
"""A motion may take so many times its planned duration, and so much more, before it is halted."""


def ask(operator: Operator, text: str, countdown_s: float) -> None:
    """Say what will move and wait for a start; a key during the countdown asks anew. KeyboardInterrupt on quit.

    Keys that were pressed before the question do not count.
    """
    while True:
        operator.touched()
        operator.say(text)
        if operator.wait_for_start() == "quit":
            raise KeyboardInterrupt
        if count_down(operator, countdown_s):
            return
        operator.say("stopped: nothing moved")


def count_down(operator: Operator, seconds: float) -> bool:
    """Whole seconds, said one by one; false when a key stopped it. KeyboardInterrupt where nobody is asked."""
    for left in range(int(seconds), 0, -1):
        operator.say(f"{left}")
        ends = time.monotonic() + 1.0
        while time.monotonic() < ends:
            if stopped(operator):
                return False
            time.sleep(POLL_S)
    return True


def stopped(operator: Operator) -> bool:
    """Whether a key was pressed. Of a run that asks nobody it is the end: it would go on by itself."""
    touched = operator.touched()
    if touched and operator.headless:
        raise KeyboardInterrupt
    return touched


def watch_motion(arm: Arm, operator: Operator, planned_s: float, what: str) -> bool:
    """Stay while the arm moves; any key halts it (false). Raises TosslabError where it does not get there."""
    ends = time.monotonic() + LATE_SHARE * planned_s + LATE_S
    try:
        while arm.motion().status == "moving":
            if stopped(operator):
                arm.halt()
                operator.say(f"{what}: halted by a key")
                return False
            if time.monotonic() > ends:
                arm.halt()
                raise TosslabError(f"{what}: not there after {LATE_SHARE:g} times the planned time; it was halted")
            time.sleep(POLL_S)
    except BaseException:
        arm.halt()
        raise
    if arm.motion().status == "aborted":
        raise TosslabError(f"{what}: {arm.motion().reason}; nothing is recovered or tried again by itself")
    return True
