"""Progress is quiet for two seconds, then one line with an estimate, on the stream it was given."""

import io

import pytest

from recordings import progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_work_under_two_seconds_says_nothing(clock):
    out = io.StringIO()
    console = progress.Console("track", out)
    for done in range(1, 11):
        clock[0] += 0.19
        console.step(done, 10)
    assert out.getvalue() == ""


def test_longer_work_says_how_far_and_how_long_still(clock):
    out = io.StringIO()
    console = progress.Console("track", out)
    clock[0] += 5
    console.step(10, 40, "toss 3")
    assert out.getvalue() == "track: 10/40 toss 3 (5 s, about 15 s left)\n"


def test_what_comes_before_the_first_step_is_not_taken_for_the_pace(clock):
    out = io.StringIO()
    console = progress.Console("field", out)
    clock[0] += 5  # loading, compiling
    console.step(1, 101)
    clock[0] += 10
    console.step(11, 101)
    assert out.getvalue() == "field: 1/101  (5 s)\nfield: 11/101  (15 s, about 90 s left)\n"


def test_a_log_file_gets_few_lines_and_the_last_one_always(clock):
    out = io.StringIO()
    console = progress.Console("track", out)
    for done in range(1, 301):  # 30 seconds
        clock[0] += 0.1
        console.step(done, 300)
    lines = out.getvalue().splitlines()
    assert len(lines) <= 5
    assert lines[-1].startswith("track: 300/300")


def test_a_terminal_keeps_one_line_and_ends_it(clock):
    out = Terminal()
    console = progress.Console("track", out)
    for done in range(1, 101):
        clock[0] += 0.1
        console.step(done, 100)
    assert out.getvalue().count("\n") == 1
    assert out.getvalue().endswith("\n")
    assert "\r" in out.getvalue()


def test_work_of_which_nothing_is_done_yet_has_no_estimate(clock):
    out = io.StringIO()
    console = progress.Console("track", out)
    clock[0] += 3
    console.step(0, 0)
    console.step(0, 10)
    assert "left" not in out.getvalue()


def test_silent_is_silent(capsys):
    progress.Silent().step(1, 2)
    progress.Silent().value("loss", 1.0, at=3)
    assert capsys.readouterr() == ("", "")
