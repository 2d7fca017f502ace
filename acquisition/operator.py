"""The person at the rig: what is said to them, the keys they press. Headless runs have nobody there."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import time
from collections.abc import Iterator
from typing import Literal, Protocol, TextIO, runtime_checkable

from acquisition.verdict import Verdict

Key = Literal["start", "stop", "accept", "reject", "redo", "note", "quit"]
KEYS: dict[str, Key] = {
    "s": "start",
    " ": "start",
    "x": "stop",
    "a": "accept",
    "r": "reject",
    "d": "redo",
    "n": "note",
    "q": "quit",
}
POLL_S = 0.05


@runtime_checkable
class Operator(Protocol):
    """Told what happens, asked what to do."""

    headless: bool
    """Nobody is there to decide."""

    def say(self, text: str) -> None: ...
    def key(self) -> Key | None:
        """A key pressed since the last call."""

    def touched(self) -> bool:
        """Whether any key was pressed since the last call, whatever it is; it counts for nothing else."""

    def wait_for_start(self) -> Key:
        """`start`, or `quit`."""

    def decide(self, verdict: Verdict) -> Literal["accept", "reject", "redo"]:
        """The last word on a take."""

    def note(self) -> str:
        """A line about the take."""

    def line(self, question: str) -> str:
        """The answer to a question; empty where nobody is there."""


class Nobody:
    """`--yes`: starts at once, keeps what the recorder accepts, tries a rejected take again."""

    headless = True

    def __init__(self, out: TextIO | None = None) -> None:
        self._out = out if out is not None else sys.stderr

    def say(self, text: str) -> None:
        self._out.write(text + "\n")
        self._out.flush()

    def key(self) -> Key | None:
        return None

    def touched(self) -> bool:
        return False

    def wait_for_start(self) -> Key:
        return "start"

    def decide(self, verdict: Verdict) -> Literal["accept", "reject", "redo"]:
        return "accept" if verdict.decision == "accept" else "redo"

    def note(self) -> str:
        return ""

    def line(self, question: str) -> str:
        return ""


class Unattended(Nobody):
    """`--yes` with an arm that may move unattended: asks nobody, yet a key at its terminal stops it."""

    def touched(self) -> bool:
        if not sys.stdin.isatty() or not select.select([sys.stdin], [], [], 0.0)[0]:
            return False
        os.read(sys.stdin.fileno(), 1024)
        return True


class Keyboard(Nobody):
    """Single keys from a terminal; lines where stdin is no terminal."""

    headless = False

    def __init__(self, out: TextIO | None = None) -> None:
        super().__init__(out)
        self._typed = ""
        """Read from stdin and not looked at yet."""
        self._closed = False

    def key(self) -> Key | None:
        self._listen(0.0)
        if not self._typed:
            return "quit" if self._closed else None
        pressed = self._typed[0]
        length = 1 if sys.stdin.isatty() else (self._typed + "\n").index("\n") + 1
        self._typed = self._typed[length:]
        return KEYS.get(pressed.lower())

    def touched(self) -> bool:
        """The end of the input is a key, too: nobody could stop anything any more."""
        self._listen(0.0)
        typed, self._typed = self._typed, ""
        return bool(typed) or self._closed

    def _listen(self, seconds: float) -> None:
        """Past Python's own buffer, which `select` cannot see into."""
        if not self._closed and select.select([sys.stdin], [], [], seconds)[0]:
            read = os.read(sys.stdin.fileno(), 1024)
            self._typed += read.decode(errors="replace")
            self._closed = not read

    def wait_for_start(self) -> Key:
        self.say("s: start   q: quit")
        return self._wait(("start", "quit"))

    def decide(self, verdict: Verdict) -> Literal["accept", "reject", "redo"]:
        self.say(f"{verdict.text()}\na: accept   r: reject   d: reject and do it again   n: note")
        key = self._wait(("accept", "reject", "redo", "quit"))
        if key in ("accept", "reject", "redo"):
            return key
        raise KeyboardInterrupt

    def note(self) -> str:
        return self.line("note, then Enter:")

    def line(self, question: str) -> str:
        self.say(question)
        with single_keys(sys.stdin, lines=True):
            while "\n" not in self._typed and not self._closed:
                self._listen(POLL_S)
        line, _, self._typed = self._typed.partition("\n")
        return line.strip()

    def _wait(self, wanted: tuple[Key, ...]) -> Key:
        while True:
            key = self.key()
            if key in wanted:
                return key
            time.sleep(POLL_S)


@contextlib.contextmanager
def single_keys(stream: TextIO, lines: bool = False) -> Iterator[None]:
    """Keys come without Enter (or with `lines`, the other way round) while this is open; the terminal is left as it
    was."""
    if not stream.isatty():
        yield
        return
    import termios
    import tty

    before, cooked = (termios.tcgetattr(stream.fileno()) for _ in range(2))
    cooked[3] |= termios.ICANON | termios.ECHO
    try:
        if lines:
            termios.tcsetattr(stream.fileno(), termios.TCSADRAIN, cooked)
        else:
            tty.setcbreak(stream.fileno())
        yield
    finally:
        termios.tcsetattr(stream.fileno(), termios.TCSADRAIN, before)
