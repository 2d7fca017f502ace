"""The console's promises: one message, exit codes, JSON alone on stdout."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from recordings.console import Outcome, add_command, command_parser, json_text, run_command
from recordings.errors import BadInput, WriteFailed

Run = Callable[..., int]


@pytest.fixture
def run() -> Run:
    def call(work: Callable[[argparse.Namespace], Outcome], *argv: str) -> int:
        parser = command_parser("toss-thing", "Does a thing. And more.", "toss-thing sessions/cube")
        parser.set_defaults(work=work)
        return run_command(parser, argv)

    return call


def _raising(error: BaseException) -> Callable[[argparse.Namespace], Outcome]:
    def work(args: argparse.Namespace) -> Outcome:
        raise error

    return work


@pytest.mark.parametrize(
    "error, code",
    [
        (BadInput("no such thing"), 2),
        (WriteFailed("disk full"), 2),
        (KeyboardInterrupt(), 130),
        (OSError(28, "No space left", "x"), 2),
    ],
)
def test_an_error_is_one_message_on_stderr_and_its_exit_code(run, capsys, error, code):
    assert run(_raising(error)) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("toss-thing: ")
    assert err.count("\n") == 1


def test_with_json_an_error_is_one_object_on_stdout_too(run, capfd):
    assert run(_raising(BadInput("no such thing")), "--json") == 2
    out, err = capfd.readouterr()
    assert json.loads(out) == {"error": "no such thing", "kind": "BadInput", "exit_code": 2}
    assert "no such thing" in err


def test_a_fault_of_ours_shows_its_traceback_and_is_not_taken_for_work_done(run, capsys):
    assert run(_raising(ZeroDivisionError("oops"))) == 2
    err = capsys.readouterr().err
    assert "Traceback" in err
    assert "please report" in err


def test_with_json_what_libraries_print_goes_to_stderr(run, capfd):
    def work(args: argparse.Namespace) -> Outcome:
        print("python chatter")  # noqa: T201
        os.write(1, b"c chatter\n")
        return Outcome({"a": 1}, "text", 1)

    assert run(work, "--json") == 1
    out, err = capfd.readouterr()
    assert json.loads(out) == {"a": 1}
    assert "python chatter" in err
    assert "c chatter" in err


def test_what_libraries_warn_of_does_not_reach_a_user(run, capsys):
    def work(args: argparse.Namespace) -> Outcome:
        warnings.warn("'@' is faster on contiguous arrays", RuntimeWarning, stacklevel=1)
        return Outcome({}, "done")

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert run(work) == 0
        assert capsys.readouterr().err == ""
        with pytest.warns(RuntimeWarning):  # elsewhere they are as they were
            work(argparse.Namespace())


def test_python_s_own_options_bring_libraries_warnings_back():
    code = (
        "import warnings; from recordings.console import without_library_warnings as quiet\n"
        "with quiet(): warnings.warn('said')"
    )
    for options, said in (([], False), (["-W", "default"], True)):
        done = subprocess.run([sys.executable, *options, "-c", code], capture_output=True, text=True, check=True)
        assert ("said" in done.stderr) is said


def test_without_json_the_text_is_printed(run, capsys):
    assert run(lambda args: Outcome({"a": 1}, "all is well\n")) == 0
    assert capsys.readouterr().out == "all is well\n"


def test_json_is_strict_and_takes_arrays_paths_and_nan():
    document = {"x": np.array([1.0, np.nan]), "n": np.int64(3), "p": Path("a/b"), "inf": float("inf"), 4: (True, None)}
    text = json_text(document)
    assert json.loads(text) == {"x": [1.0, None], "n": 3, "p": "a/b", "inf": None, "4": [True, None]}


def test_a_usage_error_exits_2_and_json_says_it_on_stdout(capsys):
    parser = command_parser("toss-thing", "Does a thing.", "toss-thing a")
    commands = parser.add_subparsers()
    add_command(commands, "go", "Goes. Far.", "toss-thing go x").add_argument("where")
    assert run_command(parser, ["go", "--json"]) == 2
    out, err = capsys.readouterr()
    assert json.loads(out)["kind"] == "Usage"
    assert "usage:" in err
    assert "where" in err


def test_help_ends_with_a_copyable_example(capsys):
    parser = command_parser("toss-thing", "Does a thing.", "toss-thing sessions/cube")
    assert run_command(parser, ["--help"]) == 0
    assert capsys.readouterr().out.rstrip().endswith("toss-thing sessions/cube")


def test_a_command_without_anything_to_do_shows_its_help_and_exits_2(capsys):
    assert run_command(command_parser("toss-thing", "Does a thing."), []) == 2
    assert "usage: toss-thing" in capsys.readouterr().err


def test_a_reader_that_goes_away_is_no_error():
    program = (
        "from recordings.console import *\n"
        "p = command_parser('t', 'd')\n"
        "p.set_defaults(work=lambda a: Outcome({}, 'line\\n' * 200000))\n"
        "raise SystemExit(run_command(p, []))\n"
    )
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", f'{sys.executable} -c "$1" | head -1', "-", program],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "line\n"
    assert done.stderr == ""
