"""A simulator in a process of its own, so that the load of the caller's Python does not slow its real-time loop.

    with ChildProcess("fci", host="127.0.0.3") as arm:
        arm.inject("reflex", at_s=0.5)
        arm.snapshot()     # the simulator's counters, as a dict

The child listens before `ChildProcess(...)` returns and ends with its parent (its standard input closes).
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from typing import Any, Protocol, runtime_checkable

from acquisition.streaming.streams import LOOPS, go_first
from recordings.errors import TosslabError

SIMULATORS = {"fci": "acquisition.simulators.fci:FciServer", "rtde": "acquisition.simulators.rtde:UrServer"}


@runtime_checkable
class Simulator(Protocol):
    """What every simulator here offers."""

    def inject(self, kind: str, at_s: float = 0.0, for_s: float | None = None, **detail: float | str) -> None: ...
    def clear(self, kind: str) -> None: ...
    def snapshot(self) -> dict[str, Any]: ...
    def close(self) -> None: ...


class SimulatorFailed(TosslabError):
    """The child process could not start the simulator, or refused a call."""


class ChildProcess:
    """The simulator `name` of SIMULATORS, started with these keyword arguments in a child process."""

    def __init__(self, name: str, **options: Any) -> None:
        command = [sys.executable, "-m", "acquisition.simulators.child_process", name, json.dumps(options)]
        self._child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._answer()

    def __enter__(self) -> ChildProcess:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def inject(self, kind: str, at_s: float = 0.0, for_s: float | None = None, **detail: float | str) -> None:
        """As Faults.inject."""
        self._call("inject", kind=kind, at_s=at_s, for_s=for_s, **detail)

    def clear(self, kind: str) -> None:
        self._call("clear", kind=kind)

    def snapshot(self) -> dict[str, Any]:
        return self._call("snapshot")

    def close(self) -> None:
        if self._child.stdin is None or self._child.stdin.closed:
            return
        self._child.stdin.close()
        try:
            self._child.wait(2.0)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        if self._child.stdout is not None:
            self._child.stdout.close()

    def _call(self, verb: str, **arguments: Any) -> Any:
        assert self._child.stdin is not None
        self._child.stdin.write(json.dumps([verb, arguments]) + "\n")
        self._child.stdin.flush()
        return self._answer()

    def _answer(self) -> Any:
        assert self._child.stdout is not None
        line = self._child.stdout.readline()
        if not line:
            raise SimulatorFailed("the simulator's process ended; its error output is above")
        answer = json.loads(line)
        if "error" in answer:
            raise SimulatorFailed(answer["error"])
        return answer["value"]


def serve(name: str, options: dict[str, Any]) -> None:
    """Run the simulator in this process and obey the lines on standard input until it closes.

    It goes before other programs: a real device has a machine of its own.
    """
    go_first(LOOPS)
    module, _, class_name = SIMULATORS[name].partition(":")
    try:
        simulator: Simulator = getattr(importlib.import_module(module), class_name)(**options)
    except (OSError, TosslabError) as error:
        _reply({"error": f"{name}: {error}"})
        return
    _reply({"value": None})
    try:
        for line in sys.stdin:
            verb, arguments = json.loads(line)
            _reply(_obey(simulator, verb, arguments))
    finally:
        simulator.close()


def _obey(simulator: Simulator, verb: str, arguments: dict[str, Any]) -> dict[str, Any]:
    try:
        return {"value": getattr(simulator, verb)(**arguments)}
    except TosslabError as error:
        return {"error": str(error)}


def _reply(answer: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    serve(sys.argv[1], json.loads(sys.argv[2]))
