"""A client in a process of its own: it never waits for a busy driver, and its end is noticed."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path

import pytest

from acquisition.devices import DeviceLost
from acquisition.drivers.workers.process import Worker

CHILD = """
import sys, time
from acquisition.drivers.workers.process import WorkerEnd

end = WorkerEnd()
print("what a vendor's library prints")
slowest = 0.0
for k in range(int(sys.argv[1])):
    began = time.monotonic()
    end.emit(b"S", k.to_bytes(4, "little") * 1000)
    slowest = max(slowest, time.monotonic() - began)
end.event("done", slowest=slowest)
for message, blob in end.commands(timeout_s=5.0):
    if message["do"] == "quit":
        end.leave()
    if message["do"] == "fail":
        raise RuntimeError("so it goes")
    end.event("echo", said=message["say"], bytes=blob.hex())
for message, blob in end.commands(timeout_s=5.0):
    if message["do"] == "fail":
        raise RuntimeError("so it goes")
"""


class Driver:
    """Takes frames, but for as long as it is told to be busy."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path, frames: int, busy_s: float = 0.0) -> None:
        (folder / "child_of_test.py").write_text(CHILD)
        monkeypatch.setenv("PYTHONPATH", str(folder))
        monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
        self.numbers: list[int] = []
        self.events: list[dict[str, object]] = []
        self.ended = threading.Event()
        self.reason = ""
        self._busy_s = busy_s
        self.worker = Worker("child_of_test", [str(frames)], self.take, self.end)

    def take(self, kind: bytes, payload: bytes) -> None:
        if self._busy_s:
            time.sleep(self._busy_s)
            self._busy_s = 0.0
        if kind == b"S":
            self.numbers.append(int.from_bytes(payload[:4], "little"))
        else:
            self.events.append(json.loads(payload))

    def end(self, reason: str) -> None:
        self.reason = reason
        self.ended.set()

    def wait_for(self, event: str) -> dict[str, object]:
        end = time.monotonic() + 8.0
        while time.monotonic() < end:
            for found in self.events:
                if found["event"] == event:
                    return found
            time.sleep(0.01)
        raise AssertionError(f"no event '{event}' in {self.events}")


def call_on(worker: Worker) -> None:
    """Speak until nobody is there: the first words after its end may still fit into the pipe."""
    for _ in range(100):
        worker.send({"do": "say", "say": "anybody?"})
        time.sleep(0.01)


def test_a_busy_driver_costs_states_never_time(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    driver = Driver(monkeypatch, tmp_path, frames=3000, busy_s=1.5)  # 12 MB against 1 of pipe and 4 kept
    done = driver.wait_for("done")
    driver.worker.stop()
    assert isinstance(done["slowest"], float)
    assert done["slowest"] < 0.3
    assert 1000 < len(driver.numbers) < 3000
    assert driver.numbers == sorted(driver.numbers)
    assert driver.numbers[:1000] == list(range(1000))  # what was given up is the newest, in one piece


def test_commands_and_their_bytes_arrive_and_an_end_by_error_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    driver = Driver(monkeypatch, tmp_path, frames=3)
    driver.wait_for("done")
    assert driver.numbers == [0, 1, 2]
    driver.worker.send({"do": "say", "say": "hello"}, b"\x01\x02")
    assert driver.wait_for("echo") == {"event": "echo", "said": "hello", "bytes": "0102"}
    driver.worker.send({"do": "fail"})
    assert driver.ended.wait(5.0)
    assert "so it goes" in driver.reason
    with pytest.raises(DeviceLost, match="so it goes"):
        call_on(driver.worker)
    driver.worker.stop()
