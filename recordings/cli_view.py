"""`toss-view`: a session, a toss's file or a results folder, to look at."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from recordings.console import Outcome, Usage, command_parser, progress_for, run_command

DESCRIPTION = """Look at a session, a single .mcap file or a results folder in rerun: the coloured point cloud in the
world, the cameras, their images, the table's tags, the object where truth and estimates have it, joint states and
health as plots. Without --save and --screenshot it opens a window and stays until that is closed."""
EXAMPLES = (
    "toss-view sessions/cube",
    "toss-view sessions/cube/toss_03.mcap --screenshot toss_03.png",
    "toss-view sessions/cube/results --variant ours --save cube.rrd",
    "toss-view --live sessions/first",
)


def main(argv: Sequence[str] | None = None) -> int:
    parser = command_parser("toss-view", DESCRIPTION, *EXAMPLES)
    parser.add_argument("path", type=Path, metavar="PATH", help="a session, an .mcap file, a results folder or an .rrd")
    parser.add_argument("--save", type=Path, metavar="FILE.rrd", help="write it to a file that `rerun FILE.rrd` opens")
    parser.add_argument(
        "--screenshot",
        type=Path,
        metavar="FILE.png",
        help="write a picture of the first toss's flight; needs no display",
    )
    parser.add_argument("--toss", type=int, metavar="I", help="only this toss (default: all; the picture: the first)")
    parser.add_argument(
        "--variant", metavar="NAME", help="only this variant of the results (default: all, one visible)"
    )
    parser.add_argument("--scope", choices=("one", "all"), help="only this scope of the results")
    parser.add_argument(
        "--live",
        action="store_true",
        help="what is known of a session while it is recorded, until the window is closed",
    )
    parser.set_defaults(work=_work)
    return run_command(parser, argv)


def _work(args: argparse.Namespace) -> Outcome:
    _check_names(args)
    if args.live:
        return _live(args)
    from recordings.view import draw as view

    choice = view.Choice(args.toss, args.variant, args.scope)
    started = time.monotonic()
    written: dict[str, Any] = {}
    said = ""
    if args.save is not None:
        view.save_rrd(args.path, args.save, choice, progress=progress_for("toss-view --save"))
        written["save"] = args.save
    if args.screenshot is not None:
        shot = view.screenshot(args.path, args.screenshot, choice)
        said = shot.said
        written |= {"screenshot": args.screenshot} if shot.written else {}
    if args.save is None and args.screenshot is None:
        view.open_viewer(args.path, choice, progress=progress_for("toss-view"))
    lines = [f"wrote {file} ({file.stat().st_size / 1e6:.1f} MB)" for file in written.values()]
    document = {"path": args.path, **written, "seconds": round(time.monotonic() - started, 3), "note": said}
    return Outcome(document, "\n".join([*lines, *([said] if said else [])]))


def _live(args: argparse.Namespace) -> Outcome:
    if args.save is not None:
        raise Usage("--live shows what changes; leave out --save, or save the session afterwards")
    from recordings.view.so_far import show_live

    written = show_live(args.path, args.screenshot)
    return Outcome({"path": args.path, "screenshot": written}, "" if written is None else f"wrote {written}")


def _check_names(args: argparse.Namespace) -> None:
    """Wrong names are refused before minutes of work, not after."""
    for option, file, suffix in (("--save", args.save, ".rrd"), ("--screenshot", args.screenshot, ".png")):
        if file is not None and file.suffix.lower() != suffix:
            raise Usage(f"{option} writes a {suffix} file; found {file}, wanted {file.with_suffix(suffix).name}")


if __name__ == "__main__":
    sys.exit(main())
