"""The process that speaks with a Franka Hand. See acquisition.drivers.franka_hand.

Two threads: one reads the width, the other obeys. libfranka's binding holds the interpreter's lock while it waits for
a state, so the reader sleeps until shortly before the next one is due: a command then leaves within EARLY_S.
"""

from __future__ import annotations

import struct
import sys
import threading
import time
from typing import Any, NoReturn

from acquisition.drivers.workers.process import WorkerEnd

SAMPLE = struct.Struct("<QqddB")
"""State number, host time in ns, width in m, largest width in m, grasped."""
EARLY_S = 0.004
LONGEST_S = 0.2
SETTLE = 0.9
"""Share of the old estimate of the state's period that a new one leaves."""


class Reader(threading.Thread):
    """Passes on every state; `lost` says why, once none come."""

    def __init__(self, end: WorkerEnd, gripper: Any) -> None:
        super().__init__(daemon=True)
        self._end, self._gripper = end, gripper
        self._period_s = 0.0
        self.ended = threading.Event()

    def run(self) -> None:
        before_s: float | None = None
        while not self.ended.is_set():
            try:
                state = self._gripper.read_once()
            except RuntimeError as error:
                self._end.event("lost", reason=str(error))
                self.ended.set()
                return
            now_s = time.monotonic()
            row = (state.time.to_msec(), time.monotonic_ns(), state.width, state.max_width, state.is_grasped)
            self._end.emit(b"S", SAMPLE.pack(*row))
            if before_s is not None:
                self._learn(now_s - before_s)
            before_s = now_s
            time.sleep(max(self._period_s - EARLY_S, 0.0))

    def _learn(self, gap_s: float) -> None:
        """A gap shorter than the estimate is believed at once, a longer one slowly: rather too early than too late."""
        slowly_s = SETTLE * self._period_s + (1 - SETTLE) * gap_s if self._period_s else gap_s
        self._period_s = min(gap_s, LONGEST_S, slowly_s)


def obey(end: WorkerEnd, gripper: Any, message: dict[str, Any]) -> None:
    """Run one command to its end and say how it went."""
    kind, sent = message["do"], time.monotonic_ns()
    end.event("sent", kind=kind, width=message.get("width", 0.0), sent=sent)
    succeeded, error = False, ""
    try:
        if kind == "grasp":
            epsilon = message["epsilon"]
            succeeded = gripper.grasp(message["width"], message["speed"], message["force"], epsilon, epsilon)
        elif kind == "move":
            succeeded = gripper.move(message["width"], message["speed"])
        elif kind == "homing":
            succeeded = gripper.homing()
        else:
            succeeded = gripper.stop()
    except RuntimeError as failed:
        error = str(failed)
    end.event("acknowledged", sent=sent, acknowledged=time.monotonic_ns(), succeeded=succeeded, error=error)


def main() -> NoReturn:
    end = WorkerEnd()
    with end.failing("missing", ImportError):
        from panda_py import libfranka
    with end.failing("connect", RuntimeError):
        gripper = libfranka.Gripper(sys.argv[1])
    end.event("open", version=gripper.server_version())
    reader = Reader(end, gripper)
    reader.start()
    while not reader.ended.is_set():
        for message, _ in end.commands(timeout_s=0.1):
            if message["do"] == "quit":
                reader.ended.set()
                end.leave()
            obeying = threading.Thread(target=obey, args=(end, gripper, message), daemon=True)
            obeying.start()
    end.leave()


if __name__ == "__main__":
    main()
