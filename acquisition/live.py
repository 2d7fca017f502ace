"""`--live`: another process looks at each toss that is recorded; its lines come to the console between the takes.

Recording depends on nothing of it: it is started niced in a session of its own, may fall behind, end or be killed, and
all that is read of it is the file of its lines (recordings/results/live.py). Processing is never imported here.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Protocol, runtime_checkable

from acquisition.devices import Image
from acquisition.operator import Operator
from acquisition.streaming.recorder import DepthThumbnail
from acquisition.streaming.side_thread import SideThread
from recordings.console import has_display
from recordings.errors import BadInput
from recordings.live_frames import FrameBoardWriter, LiveFrame, memory_folder
from recordings.results.live import LineReader, live_folder, read_state

POLL_S, FEED_S = 0.2, 0.002
CAMERA = "d455"
MOST_GAP_NS = 20_000_000
FOLLOWER, VIEWER = "processing.cli", "recordings.cli_view"
NO_DISPLAY = "live: there is no display here; elsewhere on this machine: toss-view --live {session}"


@runtime_checkable
class Records(Protocol):
    """What is asked of a recorder: the take that it writes now, and what came last."""

    @property
    def take(self) -> object | None: ...
    @property
    def latest(self) -> Mapping[str, Image]: ...
    @property
    def thumbnails(self) -> Sequence[DepthThumbnail]: ...


def require_follower() -> None:
    """Raises BadInput where what --live starts is not installed."""
    if importlib.util.find_spec("processing") is None:
        raise BadInput(
            "--live needs the package `processing` beside this one; install tosslab whole, or leave --live out"
        )


class LiveSession:
    """The follower of a session that is being recorded, and the viewer. As a context: the lines are read until its end;
    the follower itself goes on, to make the session's results."""

    def __init__(self, session: Path, operator: Operator, recorder: Records, pose: bool = False) -> None:
        self._session, self._operator, self._recorder, self._pose = session, operator, recorder, pose
        self._follower: subprocess.Popen[bytes] | None = None
        self._viewer: subprocess.Popen[bytes] | None = None
        self._open = contextlib.ExitStack()
        self._said_end = False

    def __enter__(self) -> LiveSession:
        self._lines = LineReader(self._session, from_end=True)
        folder = live_folder(self._session)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with open(folder / "follow.log", "ab") as log:
                follow = ("--follow", str(self._session), "--recorder", str(os.getpid()))
                self._follower = _started(FOLLOWER, *follow, log=log)
                if self._pose:
                    self._feed = self._open.enter_context(FrameFeed(self._recorder))
                    self._front = _started(FOLLOWER, *follow, "--live-pose", str(self._feed.path), log=log)
                if has_display():
                    self._viewer = _started(VIEWER, "--live", str(self._session), log=log)
                else:
                    self._operator.say(NO_DISPLAY.format(session=self._session))
        except OSError as refused:
            self._operator.say(f"live: it cannot be started ({refused}); recording goes on without it")
        self._open.enter_context(SideThread("live", POLL_S, self._listen))
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def wait(self) -> bool:
        """Stay until the follower has made the results, saying its lines; Ctrl-C leaves it at that. Whether it
        ended."""
        if self._follower is None or self._follower.poll() is not None:
            self._say_lines()
            return True
        self._operator.say("live: recorded. The results are being made; Ctrl-C leaves that to the background")
        try:
            while self._follower.poll() is None:
                self._say_lines()
                time.sleep(POLL_S)
        except KeyboardInterrupt:
            self._operator.say(f"live: the results are made in the background: {live_folder(self._session)}/follow.log")
            return False
        self._say_lines()
        return True

    def document(self) -> dict[str, object]:
        """For --json."""
        state = read_state(self._session)
        code = None if self._follower is None else self._follower.poll()
        return {"state": None if state is None else state.state, "exit_code": code}

    def _listen(self) -> None:
        if self._recorder.take is None:
            self._say_lines()
            self._say_end()

    def _say_lines(self) -> None:
        for line in self._lines.new():
            self._operator.say(line.text)

    def _say_end(self) -> None:
        """Once, where the follower ended while tosses are still recorded."""
        if self._follower is not None and self._follower.poll() is not None and not self._said_end:
            self._said_end = True
            self._operator.say(
                f"live: processing ended (exit code {self._follower.returncode}); recording goes on. Why: "
                f"{live_folder(self._session)}/follow.log; again: toss-process --follow {self._session}"
            )


class FrameFeed:
    """The newest colour and depth image for the live pose, from a thread that may be slow. As a context."""

    def __init__(self, recorder: Records) -> None:
        self._recorder = recorder
        self.path = memory_folder() / f"toss-record-{os.getpid()}-frames"
        self._shown, self._open = -1, contextlib.ExitStack()

    def __enter__(self) -> FrameFeed:
        self._board = self._open.enter_context(FrameBoardWriter(self.path))
        self._open.enter_context(SideThread("live frames", FEED_S, self._feed))
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def _feed(self) -> None:
        frame = newest_frame(self._recorder)
        if frame is not None and frame.number != self._shown:
            self._shown = frame.number
            with contextlib.suppress(BadInput):  # another size in mid-session: the recorder tells of that
                self._board.put(frame)


def newest_frame(recorder: Records) -> LiveFrame | None:
    """Colour and depth that were received together last, with the session times that they have by now."""
    thumbnails = recorder.thumbnails
    color, depth = (recorder.latest.get(f"/{CAMERA}/{stream}") for stream in ("color", "depth"))
    if color is None or depth is None or not thumbnails or thumbnails[-1].number != depth.number:
        return None
    depth_ns = thumbnails[-1].time_ns
    gap_ns = color.mid_exposure_ns - depth.mid_exposure_ns
    if abs(gap_ns) > MOST_GAP_NS:  # of two frames, one of which is not there yet
        return None
    host_ns = max(color.host_ns, depth.host_ns)
    return LiveFrame(
        color.number, depth_ns + gap_ns, depth_ns, host_ns, color.pixels, depth.pixels, thumbnails[-1].unit_m
    )


def _started(module: str, *arguments: str, log: IO[bytes]) -> subprocess.Popen[bytes]:
    """A module of the same environment in a session of its own: Ctrl-C at the recorder's terminal does not reach it,
    and systems that share the processor by sessions give the recorder a share of its own."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).resolve().parent.parent),
                                                 *filter(None, [os.environ.get("PYTHONPATH", "")])])  # fmt: skip
    command = [sys.executable, "-m", module, *arguments]
    with contextlib.suppress(OSError):
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment, start_new_session=True
        )
    raise OSError(f"{sys.executable} -m {module} cannot be started")
