"""`toss-calibrate`: arguments and words; the work is in commands.py."""

from __future__ import annotations

import argparse
import importlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from recordings.console import DONE, FELL_SHORT, Outcome, add_command, command_parser, progress_for, run_command
from recordings.errors import BadInput


def main(argv: Sequence[str] | None = None) -> int:
    parser = command_parser(
        "toss-calibrate",
        "Calibrate a rig from its own session and write calibration.json, with residuals, hold-out error, uncertainty "
        "and a verdict. Exit code 1: the calibration was refused and calibration.json stays as it was.",
        "toss-calibrate cameras sessions/cube",
        "toss-calibrate table sessions/cube --json",
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    _intrinsics(commands)
    _cameras(commands)
    _hand_eye(commands)
    _table(commands)
    _time(commands)
    return run_command(parser, argv)


def _add(commands: Any, name: str, description: str, work: str, *examples: str) -> argparse.ArgumentParser:
    parser = add_command(commands, name, description, *examples)
    parser.add_argument("session", type=Path, metavar="SESSION", help="a session folder")
    parser.add_argument("--dry-run", action="store_true", help="report only: calibration.json stays as it is")
    parser.set_defaults(work=_work(work))
    return parser


def positive_m(text: str) -> float:
    """A length on the command line."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < 10:
        raise argparse.ArgumentTypeError(f"{text}: wanted metres above 0, for instance 0.0614")
    return value


def _folder(path: Path) -> Path:
    """A session, which alone has a calibration.json to write."""
    if path.is_file():
        raise BadInput(
            f"{path} is a file; wanted a session folder, whose calibration.json is written: "
            f"`toss-calibrate COMMAND {path.parent}`"
        )
    return path


def _work(name: str) -> Callable[[argparse.Namespace], Outcome]:
    def work(args: argparse.Namespace) -> Outcome:
        module, function = name.split(":")
        done = getattr(importlib.import_module(f"calibration.{module}"), function)(
            _folder(args.session), args, progress_for("toss-calibrate")
        )
        return Outcome(done.document, done.text, FELL_SHORT if done.refused else DONE)

    return work


def _intrinsics(commands: Any) -> None:
    parser = _add(
        commands,
        "intrinsics",
        "Lenses of all cameras from the board views of calibration.mcap.",
        "commands:intrinsics",
        "toss-calibrate intrinsics sessions/cube --camera mono0",
    )
    parser.add_argument("--camera", action="append", help="only this camera (may be given again)")
    parser.add_argument(
        "--anew", action="store_true", help="take the fitted lens even where the given one explains the views as well"
    )
    parser.add_argument(
        "--lens",
        action="append",
        choices=("none", "brown-conrady", "rational", "fisheye"),
        help="lens models to try (default: none, brown-conrady, rational); the simplest that fits is taken",
    )


def _cameras(commands: Any) -> None:
    parser = _add(
        commands,
        "cameras",
        "Where all cameras stand to the D455: one bundle adjustment over board views, or over the tagged object.",
        "commands:cameras",
        "toss-calibrate cameras sessions/cube",
        "toss-calibrate cameras sessions/cube --from object --tag-size 0.0614",
    )
    parser.add_argument("--from", dest="source", choices=("board", "object"), default="board", help="default: board")
    parser.add_argument("--lenses", action="store_true", help="solve the lenses with the places")
    _object_arguments(parser)


def _hand_eye(commands: Any) -> None:
    parser = _add(
        commands,
        "hand-eye",
        "Where a camera stands to the robot, from board views with joint states.",
        "commands:hand_eye",
        "toss-calibrate hand-eye sessions/cube --mounting eye-to-hand",
    )
    parser.add_argument(
        "--mounting",
        choices=("eye-to-hand", "eye-in-hand"),
        default="eye-to-hand",
        help="camera fixed and board in the gripper (default), or the other way round",
    )
    parser.add_argument("--camera", default="d455", help="default: d455")


def _table(commands: Any) -> None:
    parser = _add(
        commands,
        "table",
        "The table's plane from the tags on it and from depth, tied together; gravity from flight where tags show it.",
        "commands_table:table",
        "toss-calibrate table sessions/cube",
    )
    parser.add_argument(
        "--move-world", action="store_true", help="put the world where the table's tags say it is (world_from_d455)"
    )
    _object_arguments(parser)


def _time(commands: Any) -> None:
    parser = _add(
        commands,
        "time",
        "Clock offsets of the ground-truth cameras and the arm against the D455, from the motion in all tosses.",
        "commands_toss:time",
        "toss-calibrate time sessions/cube --tag-size 0.0614",
    )
    _object_arguments(parser)


def _object_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--tag-size", type=positive_m, metavar="M", help="side of the object's tags' black square, m")
    parser.add_argument(
        "--tags", metavar="I-J", help="ids of the object's tags (default: all that are not on the table)"
    )


if __name__ == "__main__":
    raise SystemExit(main())
