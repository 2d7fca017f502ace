"""`--live`: lines come to the console between takes, and whatever becomes of the follower, recording goes on."""

from __future__ import annotations

import os
import signal
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from acquisition import live
from acquisition.cli import main, with_live
from acquisition.devices import Image, Stamp
from acquisition.live import LiveSession, newest_frame
from acquisition.operator import Nobody
from acquisition.streaming.recorder import DepthThumbnail
from recordings.results.live import LiveWriter


class Listening(Nobody):
    def __init__(self) -> None:
        super().__init__()
        self.told: list[str] = []

    def say(self, text: str) -> None:
        self.told.append(text)


def until(true: Callable[[], object], seconds: float = 60.0) -> bool:
    ends = time.monotonic() + seconds
    while not true() and time.monotonic() < ends:
        time.sleep(0.02)
    return bool(true())


@pytest.fixture
def sleeper(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """In the follower's place a program that only waits."""
    (tmp_path / "waits.py").write_text("import time\ntime.sleep(600)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(live, "FOLLOWER", "waits")
    monkeypatch.setattr(live, "has_display", lambda: False)
    return tmp_path


def test_lines_wait_for_the_end_of_a_take_and_a_killed_follower_is_said(sleeper: Path) -> None:
    operator, recorder = Listening(), SimpleNamespace(take="one", latest={}, thumbnails=deque())
    with LiveSession(sleeper / "session", operator, recorder) as session:
        LiveWriter(sleeper / "session").say("verdict", "toss 0: good", 0)
        time.sleep(3 * live.POLL_S)
        assert "toss 0: good" not in operator.told
        recorder.take = None
        assert until(lambda: "toss 0: good" in operator.told)
        assert session._follower is not None
        os.kill(session._follower.pid, signal.SIGKILL)
        assert until(lambda: any("processing ended" in text and "recording goes on" in text for text in operator.told))
    assert session.wait()


def test_a_follower_has_a_session_of_its_own_so_that_ctrl_c_does_not_reach_it(sleeper: Path) -> None:
    with LiveSession(
        sleeper / "session", Listening(), SimpleNamespace(take=None, latest={}, thumbnails=deque())
    ) as session:
        assert session._follower is not None
        assert os.getsid(session._follower.pid) == session._follower.pid
        session._follower.kill()


def test_live_takes_what_follows_it_only_where_it_is_its_value() -> None:
    assert with_live(["--live", "pose", "out"]) == ["--live=pose", "out"]
    assert with_live(["--live", "out"]) == ["--live=toss", "out"]
    assert with_live(["--live"]) == ["--live=toss"]
    assert with_live(["--tosses", "2", "out"]) == ["--tosses", "2", "out"]


def test_live_is_refused_where_no_tosses_are_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--live", "--calibration", "board", "--yes", str(tmp_path / "out")]) == 2
    assert "leave one of them out" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def image(stream: str, number: int, device_ns: int, host_ns: int) -> Image:
    pixels = np.zeros((4, 6, 3), np.uint8) if stream == "color" else np.zeros((4, 6), np.uint16)
    return Image(stream, number, Stamp("clock", device_ns), host_ns, pixels)


def test_the_newest_frame_has_the_session_times_of_its_images() -> None:
    color, depth = image("color", 7, 1_000_000, 5_000), image("depth", 7, 1_004_000, 6_000)
    look = DepthThumbnail(6_000, 900_000, 7, depth.pixels, 0.001)
    recorder = SimpleNamespace(take=None, latest={"/d455/color": color, "/d455/depth": depth}, thumbnails=deque([look]))
    found = newest_frame(recorder)
    assert found is not None
    assert (found.time_ns, found.depth_time_ns, found.host_ns) == (896_000, 900_000, 6_000)
    recorder.latest["/d455/color"] = image("color", 8, 40_000_000, 9_000)  # its depth is not there yet
    assert newest_frame(recorder) is None
