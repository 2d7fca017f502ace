# ruff: noqa: T201 (this module is what prints for the commands)
"""What all toss-* commands share: one message per error, exit codes, `--json`, help that ends with a copyable example.

```
def main(argv: Sequence[str] | None = None) -> int:
    parser = command_parser("toss-thing", "What it does.", "toss-thing sessions/cube")
    parser.add_argument("session", type=Path)
    parser.set_defaults(work=_work)           # _work(args) -> Outcome, imports what is heavy when called
    return run_command(parser, argv)
```
Exit codes: 0 done; 1 done, but a check fell short; 2 bad input or usage; 130 interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from recordings.errors import BadInput, TosslabError
from recordings.progress import Board, Console, Log, Progress
from recordings.system_libraries import advice

DONE, FELL_SHORT, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
MOST_LISTED = 20
"""Of more tosses only the first and the last are named."""


@dataclass(frozen=True)
class Outcome:
    """What a command did: `document` is printed by `--json`, `text` otherwise. `exit_code` is DONE or FELL_SHORT."""

    document: Mapping[str, Any] = field(default_factory=dict)
    text: str = ""
    exit_code: int = DONE


Work = Callable[[argparse.Namespace], Outcome]


class Usage(TosslabError):
    """Arguments that do not fit together. `usage` is argparse's line."""

    def __init__(self, message: str, usage: str = "") -> None:
        super().__init__(message)
        self.usage = usage


class Parser(argparse.ArgumentParser):
    """argparse, whose errors take the same way as every other one."""

    def error(self, message: str) -> NoReturn:
        raise Usage(f"{message}; see `{self.prog} --help`", self.format_usage())


class VersionAsked(Exception):
    """`--version` was among the arguments."""


class _Version(argparse.Action):
    def __call__(self, *_: object) -> NoReturn:
        raise VersionAsked


def command_parser(prog: str, description: str, *examples: str) -> Parser:
    """A parser with `--json` and `--version`; `examples` are shown at the end of `--help`, each ready to be copied."""
    parser = Parser(prog=prog, **help_texts(description, *examples))
    parser.add_argument(
        "--version", action=_Version, nargs=0, help="print the version of tosslab and of what it runs on"
    )
    add_json(parser)
    return parser


def add_command(subparsers: Any, name: str, description: str, *examples: str) -> Parser:
    """A subcommand with `--json`, its first sentence in the parent's list, its examples at the end of its help."""
    parser: Parser = subparsers.add_parser(
        name, help=description.split(". ")[0].rstrip("."), **help_texts(description, *examples)
    )
    add_json(parser)
    return parser


def help_texts(description: str, *examples: str) -> dict[str, Any]:
    """Keyword arguments of ArgumentParser for a description and copyable examples."""
    title = "example:" if len(examples) == 1 else "examples:"
    return {
        "description": description,
        "epilog": "\n".join([title, *(f"  {e}" for e in examples)]) if examples else None,
        "formatter_class": argparse.RawDescriptionHelpFormatter,
    }


def add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--json",
        action="store_true",
        default=argparse.SUPPRESS,  # so that it may stand before or after a subcommand
        help="print one JSON object on stdout, everything else on stderr",
    )


def run_command(parser: Parser, argv: Sequence[str] | None = None) -> int:
    """Parse, call `args.work(args)`, print its Outcome, return the exit code. Errors become one message on stderr."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    as_json = "--json" in arguments
    try:
        args = parser.parse_args(arguments)
    except Usage as wrong:
        print(wrong.usage, end="", file=sys.stderr)
        return _print(_failed(str(wrong), parser.prog, wrong), as_json)
    except VersionAsked:
        return _print(_versions(parser.prog), as_json)
    except SystemExit as ended:  # --help
        return int(ended.code or 0)
    work: Work | None = getattr(args, "work", None)
    if work is None:
        parser.print_help(sys.stderr)
        return BAD_INPUT
    with _stdout_kept_clean(as_json), without_library_warnings():
        outcome = _guarded(work, args, parser.prog)
    return _print(outcome, as_json)


_log = Log()


def _versions(prog: str) -> Outcome:
    from recordings.version import versions

    found = versions()
    others = ", ".join(f"{name} {value}" for name, value in found.items() if name not in ("tosslab", "commit"))
    return Outcome(found, f"{prog} {found['tosslab']} (commit {found['commit']}; {others})")


def progress_for(label: str) -> Progress:
    """Progress on stderr, shown when the work takes over two seconds."""
    return Console(label, log=_log)


def shared_board() -> Board:
    """The same for works that go on side by side."""
    return Board(log=_log)


@contextlib.contextmanager
def without_library_warnings() -> Iterator[None]:
    """What libraries warn their programmers of is not for a user. Python's own options (-W, PYTHONWARNINGS) bring it
    back."""
    with warnings.catch_warnings():
        if not sys.warnoptions:
            warnings.simplefilter("ignore")
        yield


def chosen_tosses(given: str | None, there: Sequence[int], option: str) -> list[int]:
    """`I` or `I-J`: those numbers that exist; all where nothing is given. Raises BadInput where none does."""
    if given is None:
        return list(there)
    first, dash, last = given.partition("-")
    if not first.isdigit() or (dash and not last.isdigit()):
        raise BadInput(f"{option} {given}: wanted a toss number or a range, for example {option} 3 or {option} 0-8")
    if dash and int(last) < int(first):
        raise BadInput(f"{option} {given}: the range ends before it begins; wanted {option} {last}-{first}")
    chosen = [t for t in there if int(first) <= t <= int(last or first)]
    if not chosen:
        listed = ", ".join(map(str, there)) if len(there) <= MOST_LISTED else f"{there[0]} to {there[-1]}"
        raise BadInput(f"{option} {given}: no such tosses; the session has the tosses {listed or '(none)'}")
    return chosen


def has_display() -> bool:
    """Whether a viewer's window can open here."""
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def json_text(document: Mapping[str, Any]) -> str:
    """Strict JSON: NaN and infinity become null; arrays, numpy scalars, paths and dataclasses are taken."""
    return json.dumps(_plain(document), indent=1, allow_nan=False)


def _guarded(work: Work, args: argparse.Namespace, prog: str) -> Outcome:
    try:
        return work(args)
    except TosslabError as error:
        return _failed(str(error), prog, error, error.exit_code)
    except KeyboardInterrupt as error:
        return _failed("interrupted; everything so far is kept", prog, error, INTERRUPTED)
    except OSError as error:
        name = f"{error.filename}: " if error.filename else ""
        return _failed(f"{name}{error.strerror or error}", prog, error)
    except Exception as error:
        if isinstance(error, ImportError) and (missing := advice(error)):
            return _failed(missing, prog, error)
        traceback.print_exc(file=sys.stderr)
        fault = "a fault of tosslab, not of your input: please report the lines above"
        return _failed(f"{type(error).__name__}: {error}; {fault}", prog, error)


def _failed(message: str, prog: str, error: BaseException, exit_code: int = BAD_INPUT) -> Outcome:
    """Say it on stderr; what is left for stdout is the object of `--json`."""
    print(f"{prog}: {message}", file=sys.stderr)
    return Outcome({"error": message, "kind": type(error).__name__, "exit_code": exit_code}, "", exit_code)


def _print(outcome: Outcome, as_json: bool) -> int:
    """Print on stdout, return the exit code. A reader that went away (`| head`) is no error."""
    text = json_text(outcome.document) if as_json else outcome.text
    try:
        if text:
            print(text.rstrip("\n"), flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return outcome.exit_code


@contextlib.contextmanager
def _stdout_kept_clean(active: bool) -> Iterator[None]:
    """While the work runs, what libraries print on stdout (Python or C) goes to stderr."""
    if not active:
        yield
        return
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        os.dup2(2, 1)
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        _flush_c()
        os.dup2(kept, 1)
        os.close(kept)


def _flush_c() -> None:
    import ctypes

    with contextlib.suppress(OSError, AttributeError):  # no C library by that name: nothing to flush
        ctypes.CDLL(None).fflush(None)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (str, int, bool)):
        return value
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # numpy arrays and scalars, without importing numpy here
        return _plain(value.tolist())
    if hasattr(value, "__dataclass_fields__"):
        return {name: _plain(getattr(value, name)) for name in value.__dataclass_fields__}
    raise TypeError(f"{type(value).__name__} cannot be printed as JSON")
