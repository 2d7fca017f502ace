"""The person at the rig: keys from a terminal, each of them heard, the terminal left as it was."""

from __future__ import annotations

import os
import sys
import termios

import pytest

from acquisition.operator import Keyboard, Nobody, single_keys
from acquisition.verdict import Verdict


def test_keys_need_no_enter_and_none_is_lost(terminal: int) -> None:
    asked = Keyboard()
    with single_keys(sys.stdin):
        os.write(terminal, b"sxz dq")
        heard = [asked.key() for _ in range(6)]
        assert heard == ["start", "stop", None, "start", "redo", "quit"]
        assert asked.key() is None


def test_the_terminal_is_left_as_it_was(terminal: int) -> None:
    before = termios.tcgetattr(sys.stdin.fileno())
    with single_keys(sys.stdin):
        assert not termios.tcgetattr(sys.stdin.fileno())[3] & termios.ICANON
    assert termios.tcgetattr(sys.stdin.fileno()) == before


@pytest.mark.parametrize("key, decision", [(b"a", "accept"), (b"r", "reject"), (b"d", "redo")])
def test_the_last_word_on_a_take_is_the_persons(
    key: bytes, decision: str, terminal: int, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = Keyboard()
    with single_keys(sys.stdin):
        os.write(terminal, b"?" + key)
        assert asked.decide(Verdict("reject", ("no release was seen",))) == decision
    assert "no release was seen" in capsys.readouterr().err


def test_quitting_instead_of_deciding_interrupts(terminal: int) -> None:
    asked = Keyboard()
    with single_keys(sys.stdin):
        os.write(terminal, b"q")
        with pytest.raises(KeyboardInterrupt):
            asked.decide(Verdict("accept"))


def test_a_note_is_a_line(terminal: int) -> None:
    asked = Keyboard()
    with single_keys(sys.stdin):
        os.write(terminal, b"n")
        assert asked.key() == "note"
        os.write(terminal, b"slipped a little\n")
        assert asked.note() == "slipped a little"


def test_nobody_keeps_what_is_good_and_tries_again_what_is_not() -> None:
    nobody = Nobody()
    assert nobody.decide(Verdict("accept")) == "accept"
    assert nobody.decide(Verdict("reject")) == "redo"
    assert nobody.wait_for_start() == "start"


def test_without_a_terminal_a_line_is_a_key_and_the_end_quits(monkeypatch: pytest.MonkeyPatch) -> None:
    listening, typing = os.pipe()
    os.write(typing, b"start\n\nn\nslipped\na\n")
    os.close(typing)
    with open(listening) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        asked = Keyboard()
        heard = [asked.key() for _ in range(3)]
        assert heard == ["start", None, "note"]
        assert asked.note() == "slipped"
        assert [asked.key(), asked.key()] == ["accept", "quit"]
