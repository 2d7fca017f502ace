"""`toss-session info | verify | recover`: arguments and words; the work is in inspect, verify and recover."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recordings.console import DONE, FELL_SHORT, Outcome, add_command, progress_for

if TYPE_CHECKING:
    from recordings.mcap.recover import Recovered


def add_commands(subparsers: Any) -> None:
    """Add the three subcommands to `toss-session`."""
    info = add_command(
        subparsers,
        "info",
        "What a session or file holds: streams, rates, gaps, drops, object, calibration age. Reads only the index.",
        "toss-session info sessions/cube",
    )
    info.add_argument("path", type=Path, metavar="PATH", help="a session folder or one file, of any suffix")
    info.set_defaults(work=_info)
    verify = add_command(
        subparsers,
        "verify",
        "Check a session or file: CRCs, manifest, counts, stamps, frame numbers, depth unit, intrinsics. "
        "Damage gives exit code 1, warnings alone 0.",
        "toss-session verify sessions/cube",
    )
    verify.add_argument("path", type=Path, metavar="PATH", help="a session folder or one file, of any suffix")
    verify.set_defaults(work=_verify)
    recover = add_command(
        subparsers,
        "recover",
        "Write a new, whole, indexed file (or session) from a damaged one. IN stays as it is; OUT must not exist.",
        "toss-session recover sessions/cube/toss_03.mcap saved.mcap",
        "toss-session recover sessions/cube sessions/cube_saved",
    )
    recover.add_argument("source", type=Path, metavar="IN", help="a damaged file, or a session folder with some")
    recover.add_argument("out", type=Path, metavar="OUT", help="the new file or folder")
    recover.set_defaults(work=_recover)


def _info(args: argparse.Namespace) -> Outcome:
    from recordings.verify.inspect import inspect

    info = inspect(args.path)
    return Outcome(info.to_json(), info.to_text(), FELL_SHORT if info.damaged else DONE)


def _verify(args: argparse.Namespace) -> Outcome:
    from recordings.verify.verify import verify

    report = verify(args.path, progress_for("verify"))
    return Outcome(report.to_json(), report.to_text(), DONE if report.ok else FELL_SHORT)


def _recover(args: argparse.Namespace) -> Outcome:
    from recordings.mcap.recover_session import recover

    reports = recover(args.source, args.out, progress_for("recover"))
    lines = [line for report in reports for line in _words(report)]
    lines.append(f"next: toss-session verify {args.out}")
    return Outcome({"out": str(args.out), "files": [r.to_json() for r in reports]}, "\n".join(lines))


def _words(report: Recovered) -> list[str]:
    if not report.out:
        return [f"{report.source}: nothing could be saved ({'; '.join(report.damage)})"]
    kept = f"{sum(report.kept.values())} messages kept"
    if report.whole:
        return [f"{report.source}: whole, {kept}"]
    lost = [f"  lost {n} of {topic}" for topic, n in report.lost.items()]
    gone = [
        f"  {n} frame numbers of {topic} are missing in what was kept" for topic, n in report.missing_numbers.items()
    ]
    places = [f"  {text}" for text in report.damage[:10]]
    more = [f"  and {len(report.damage) - 10} more places"] if len(report.damage) > 10 else []
    return [
        f"{report.source}: {kept}, {report.skipped_bytes} bytes skipped",
        *places,
        *more,
        *lost,
        *gone,
        *(f"  {note}" for note in report.notes),
    ]
