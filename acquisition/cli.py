"""`toss-record`: preflight, then toss after toss into a session folder."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from recordings.console import Outcome, command_parser, run_command

LIVE = ("toss", "pose")


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of toss-record."""
    parser = command_parser(
        "toss-record",
        "Record tosses into a session folder: preflight, countdown, take, verdict, one file per toss.",
        "toss-record --rig synthetic --tosses 3 --yes sessions/first",
        "toss-record --rig lab.toml --tosses 10 --object jack",
        "toss-record --rig lab.toml --tosses 10 --live sessions/jack",
        "toss-record --rig lab.toml --speed 0.1 sessions/rehearsal",
        "toss-record --rig lab.toml --calibration board sessions/calibration",
        "toss-record --rig replay:sessions/first --yes sessions/again",
        "toss-record --doctor",
    )
    parser.add_argument("out", nargs="?", type=Path, metavar="OUT", help="the session folder; must not exist")
    parser.add_argument(
        "--rig", default="synthetic", metavar="NAME_OR_TOML", help="synthetic, replay:SESSION, a rig file"
    )
    parser.add_argument("--tosses", type=int, default=1, metavar="N", help="how many accepted tosses are wanted")
    parser.add_argument("--object", default="object", metavar="NAME", help="what is tossed")
    parser.add_argument("--operator", default="", metavar="NAME", help="who records")
    parser.add_argument("--calibration", choices=("board", "hand-eye"), help="record views for calibration instead")
    parser.add_argument("--resume", action="store_true", help="go on with the session in OUT")
    parser.add_argument("--yes", action="store_true", help="ask nobody (a real arm: only with `unattended = true`)")
    parser.add_argument(
        "--speed",
        type=float,
        default=1.0,
        metavar="F",
        help="a real arm moves and tosses at F times its speed (0 to 1)",
    )
    parser.add_argument("--preview", action="store_true", help="show the devices live in rerun")
    parser.add_argument(
        "--live",
        nargs="?",
        const=LIVE[0],
        choices=LIVE,
        help="look at each toss when it is recorded, say what to throw next; `pose`: its pose while it flies, too",
    )
    parser.add_argument("--dry-run", action="store_true", help="plan and check the tosses; nothing moves or is written")
    parser.add_argument("--between", action="store_true", help="keep the frames between the tosses too")
    parser.add_argument("--doctor", action="store_true", help="what is installed, found and missing, and the fix")
    parser.set_defaults(work=_work)
    return run_command(parser, with_live(sys.argv[1:] if argv is None else argv))


def with_live(argv: Sequence[str]) -> list[str]:
    """The arguments with the value of `--live` bound to it: what follows it is its value only where it is one."""
    out = list(argv)
    for i in reversed([i for i, argument in enumerate(out) if argument == "--live"]):
        if i + 1 < len(out) and out[i + 1] in LIVE:
            out[i : i + 2] = [f"--live={out[i + 1]}"]
        else:
            out[i] = f"--live={LIVE[0]}"
    return out


def _work(args: argparse.Namespace) -> Outcome:
    from acquisition.command import run

    return run(args)


if __name__ == "__main__":
    sys.exit(main())
