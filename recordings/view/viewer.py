"""Rerun's own programs: the viewer, on this machine only, and its command line."""

from __future__ import annotations

import importlib.util
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import IO

import numpy as np
from rerun.experimental import ViewerClient, ViewerState

from recordings.errors import BadInput, TosslabError

LOOPBACK = "127.0.0.1"
START_TIMEOUT_S = 60.0
LOAD_TIMEOUT_S = 120.0
POLL_S = 0.1
NOTICES_GONE_S = 5.0
"""The viewer greets with notices over its window for about four seconds; no command takes them away."""
SAME_PICTURES = 3
"""A picture is complete when this many in a row are the same bytes and the viewer reports nothing as loading."""
NO_GRAPHICS = ("No graphics adapter was found", "Failed to get render context")
"""What the viewer says when it ends because there is no driver, or none that it can draw with."""
NO_VULKAN = (
    "the viewer found no graphics driver; without a graphics card it draws with Mesa's: "
    "`apt-get install -y libvulkan1 mesa-vulkan-drivers`"
)


class ViewerFailed(TosslabError):
    """The viewer did not start, or did not come to an end with what it was asked."""


class NoGraphics(ViewerFailed):
    """There is no graphics driver that the viewer could draw with."""


def rerun_program() -> str:
    """The path of rerun's program, from the package itself: it need not be on PATH."""
    spec = importlib.util.find_spec("rerun_cli")
    for folder in (spec.submodule_search_locations or []) if spec is not None else []:
        program = Path(folder) / ("rerun.exe" if sys.platform.startswith("win") else "rerun")
        if program.exists():
            return str(program)
    raise ViewerFailed("rerun's program is not installed; run `pip install rerun-sdk==0.41.0`")


def run_rerun(*arguments: str) -> None:
    """Run rerun's command line to its end. Raises BadInput with what it said where it fails."""
    environment = {**os.environ, "NO_COLOR": "1", "RUST_LOG": "error"}
    done = subprocess.run([rerun_program(), *arguments], capture_output=True, text=True, check=False, env=environment)
    if done.returncode != 0:
        raise BadInput(f"`rerun {' '.join(arguments)}` failed: {_gist(done.stderr + done.stdout)}")


class Viewer:
    """A viewer process that listens on the loopback address only. As a context: closed at the end unless detached."""

    def __init__(self, headless: bool, size: tuple[int, int] = (1280, 800)) -> None:
        self.url = ""
        self._started_s = 0.0
        self._headless = headless
        self._size = size
        self._process: subprocess.Popen[bytes] | None = None
        self._log: IO[bytes] | None = None
        self._client: ViewerClient | None = None

    def __enter__(self) -> Viewer:
        try:
            self._start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    @property
    def client(self) -> ViewerClient:
        if self._client is None:
            raise ViewerFailed("the viewer is not running")
        return self._client

    def close(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(5)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if self._log is not None:
            self._log.close()
        self._process = self._log = self._client = None

    @property
    def closed(self) -> bool:
        """Whether the window was closed, or the viewer ended by itself."""
        return self._process is None or self._process.poll() is not None

    def wait_until_closed(self) -> None:
        """Return when the user closes the window."""
        if self._process is not None:
            self._process.wait()

    def wait_for(self, timeline: str, end_ns: int) -> None:
        """Return when the recording in the viewer reaches `end_ns` on a timeline."""
        deadline = time.monotonic() + LOAD_TIMEOUT_S
        while not any(
            line.name == timeline and line.end is not None and line.end >= end_ns
            for recording in self.client.get_state().recordings
            for line in recording.timelines
        ):
            self._refuse_dead()
            if time.monotonic() > deadline:
                raise ViewerFailed(f"the recording did not arrive in the viewer within {LOAD_TIMEOUT_S:.0f} s")
            time.sleep(POLL_S)

    def show(self, timeline: str, time_ns: int) -> None:
        """Stop at a time of a timeline, once the recording is laid out (a later blueprint would start it again)."""
        self._loaded(time.monotonic() + LOAD_TIMEOUT_S)
        self.client.set_time(timeline, duration=np.timedelta64(time_ns, "ns"), play_state="paused")

    def picture(self) -> bytes:
        """A PNG of the whole window, taken when nothing is loading any more and the picture stands still."""
        same, last = 1, b""
        deadline = time.monotonic() + LOAD_TIMEOUT_S
        while same < SAME_PICTURES or time.monotonic() < self._started_s + NOTICES_GONE_S:
            state = self._loaded(deadline)
            now = self.client.take_screenshot()
            same = same + 1 if now == last else 1
            last = now
            _refuse_broken(state)
            time.sleep(POLL_S)
            if time.monotonic() > deadline:
                raise ViewerFailed(f"the viewer's picture did not come to rest within {LOAD_TIMEOUT_S:.0f} s")
        return last

    def _loaded(self, deadline: float) -> ViewerState:
        """The viewer's state once it shows a recording with views and loads nothing."""
        while True:
            state = self.client.get_state()
            if state.active_recording is not None and state.views and not state.loading:
                return state
            if time.monotonic() > deadline:
                raise ViewerFailed(
                    f"the viewer still loads {[s.name for s in state.loading]} after {LOAD_TIMEOUT_S:.0f} s"
                )
            time.sleep(POLL_S)

    def _start(self) -> None:
        port = free_port()
        self.url = f"rerun+http://{LOOPBACK}:{port}/proxy"
        arguments = ["--bind", LOOPBACK, "--port", str(port), "--hide-welcome-screen"]
        arguments += ["--window-size", "{}x{}".format(*self._size)]
        if self._headless:
            arguments.append("--headless")
        self._log = tempfile.TemporaryFile()  # noqa: SIM115
        environment = {**os.environ, "RERUN_APP_ONLY": "true"}  # no question about analytics
        if self._headless:
            environment["RUST_LOG"] = "error"  # information and warnings become notices over the picture
        command = [*(_ended_with_us() if self._headless else []), rerun_program(), *arguments]
        self._process = subprocess.Popen(command, stdout=self._log, stderr=self._log, env=environment)
        self._client = self._connect(port)

    def _connect(self, port: int) -> ViewerClient:
        deadline = time.monotonic() + START_TIMEOUT_S
        while True:
            self._refuse_dead()
            if _answers(port):
                try:
                    client = ViewerClient.connect(self.url)
                    client.get_state()
                    if self._headless:
                        client.take_screenshot()  # a driver that is missing shows only when something is drawn
                    self._started_s = time.monotonic()
                    return client
                except (RuntimeError, ConnectionError, OSError, ValueError):
                    pass  # it listens before it draws: ask again
            if time.monotonic() > deadline:
                raise ViewerFailed(f"the viewer did not answer within {START_TIMEOUT_S:.0f} s: {_gist(self._words())}")
            time.sleep(POLL_S)

    def _refuse_dead(self) -> None:
        if self._process is not None and self._process.poll() is not None:
            words = self._words()
            if any(sign in words for sign in NO_GRAPHICS):
                raise NoGraphics(NO_VULKAN)
            raise ViewerFailed(f"the viewer ended at once: {_gist(words)}")

    def _words(self) -> str:
        if self._log is None:
            return ""
        self._log.seek(0)
        return self._log.read().decode(errors="replace")


def _ended_with_us() -> list[str]:
    """Words before a command by which Linux ends it with the program that started it, killed or not; else none."""
    setpriv = shutil.which("setpriv")
    return [setpriv, "--pdeathsig", "TERM"] if setpriv is not None else []


def free_port() -> int:
    """A TCP port that nothing listens on."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(0.5)
        return probe.connect_ex((LOOPBACK, port)) == 0


def _refuse_broken(state: ViewerState) -> None:
    for view in state.views:
        for report in view.reports:
            if report.severity.lower() == "error":
                raise ViewerFailed(
                    f"the view '{view.name}' cannot draw: {report.summary} {report.details or ''}".rstrip()
                )


def _gist(text: str) -> str:
    """The line that says what went wrong: a panic's, else the last one that says anything."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    telling = [line for line in lines if "panicked at" in line or "rror" in line]
    return (telling or lines[-1:] or ["it said nothing"])[0]
