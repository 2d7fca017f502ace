"""Progress is quiet for two seconds, then one line with an estimate, on the stream it was given."""

import io
import re

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
    for done in range(1, 11):
        clock[0] += 1.5
        console.step(done, 40, "toss 3")
    assert out.getvalue().splitlines()[-1] == "track: 9/40 toss 3 (14 s, about 46 s left)"


def test_what_comes_before_the_first_step_is_not_taken_for_the_pace(clock):
    out = io.StringIO()
    console = progress.Console("field", out)
    clock[0] += 5  # loading, compiling
    for done in range(1, 101):
        console.step(done, 101)
        clock[0] += 1
    lines = out.getvalue().splitlines()
    assert lines[0] == "field: 1/101 (5 s)"
    assert lines[1] == "field: 11/101 (15 s, about 90 s left)"


@pytest.mark.parametrize("slow_at", [1, 2, 5, 30])
def test_a_step_that_is_slow_once_does_not_make_the_rest_look_slow(clock, slow_at):
    """Seen: compiling in the second step made 62 s of work "about 1,780 s left"."""
    out = Terminal()
    console = progress.Console("track", out)
    for done in range(1, 112):
        clock[0] += 18 if done == slow_at else 0.4
        console.step(done, 111)
        for said in re.findall(r"about (\d+) s left", out.getvalue()):
            assert int(said) <= 62
        assert " min left" not in out.getvalue()
    assert "left" in out.getvalue()


def test_long_work_is_told_in_minutes(clock):
    out = io.StringIO()
    console = progress.Console("field", out)
    for done in range(1, 40):
        clock[0] += 4
        console.step(done, 1000)
    assert out.getvalue().splitlines()[-1] == "field: 37/1000 (2 min, about 64 min left)"


def test_another_phase_with_another_size_has_its_own_pace(clock):
    out = Terminal()
    console = progress.Console("track", out)
    for done in range(1, 51):
        clock[0] += 0.2
        console.step(done, 1000)
    out.truncate(0)
    clock[0] += 1
    console.step(1, 20)
    assert "left" not in out.getvalue()


def test_a_log_file_gets_a_line_every_ten_seconds_at_most_from_all_stages_together(clock):
    out, log = io.StringIO(), progress.Log()
    for stage in range(12):
        console = progress.Console(f"stage {stage}", out, log)
        for done in range(1, 51):  # 5 seconds each
            clock[0] += 0.1
            console.step(done, 50)
    lines = out.getvalue().splitlines()
    assert 5 <= len(lines) <= 6
    assert len({line.split(":")[0] for line in lines}) == len(lines)


def test_a_terminal_keeps_one_line_and_ends_it(clock):
    out = Terminal()
    console = progress.Console("track", out)
    for done in range(1, 101):
        clock[0] += 0.1
        console.step(done, 100)
    assert out.getvalue().count("\n") == 1
    assert out.getvalue().endswith("\n")
    assert "\r" in out.getvalue()


def test_the_end_told_twice_is_one_line(clock):
    out = Terminal()
    console = progress.Console("track", out)
    for _ in range(3):
        clock[0] += 3
        console.step(5, 5)
    assert out.getvalue().count("\n") == 1


def test_work_of_which_nothing_is_done_yet_has_no_estimate(clock):
    out = io.StringIO()
    console = progress.Console("track", out)
    clock[0] += 3
    console.step(0, 0)
    console.step(0, 10)
    assert "left" not in out.getvalue()


def test_silent_is_silent(capsys):
    progress.Silent().step(1, 2)
    assert capsys.readouterr() == ("", "")


def test_works_side_by_side_share_a_line_and_an_estimate_for_all_that_wait(clock):
    out = Terminal()
    board = progress.Board(out)
    board.waiting(2)
    for done in range(1, 81):
        clock[0] += 0.5
        board.step("a", "toss 0: poses", done, 100)
        board.step("b", "toss 1: poses", done, 100)
    line = out.getvalue().split("\x1b[K")[-1]
    assert line == "toss 0: poses: 80/100 | toss 1: poses: 79/100 | 2 more wait (40 s, about 60 s left)"


def test_when_nothing_goes_on_any_more_the_terminals_line_is_free(clock):
    out = Terminal()
    board = progress.Board(out)
    for done in range(1, 11):
        clock[0] += 1
        board.step("a", "toss 0: poses", done, 10)
    board.ended("a")
    assert out.getvalue().endswith("\r\x1b[K")
    board.step("a", "toss 1: poses", 1, 10)
    assert out.getvalue().endswith("\r\x1b[K")  # other work: quiet for two seconds again
