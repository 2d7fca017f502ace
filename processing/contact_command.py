"""`toss-process SESSION --variant contact-only`: contact learning on poses that are there already."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from processing.pose_source import DEFAULT_STEPS
from recordings.console import Outcome
from recordings.progress import Progress

if TYPE_CHECKING:
    from recordings.session import Session


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `--variant contact-only`."""
    group = parser.add_argument_group("contact from poses alone (--variant contact-only)")
    group.add_argument("--train", metavar="I-J", help="tosses to learn from (default: all but the last)")
    group.add_argument("--test", metavar="I-J", help="tosses to roll out (default: all, the last one marked)")
    group.add_argument(
        "--geometry", choices=("box", "hull", "nonconvex"), help="hull with a shape to start from, else box"
    )
    group.add_argument(
        "--init", metavar="SIDE_M", type=float, help="start from a cube of this side (m), not from a shape"
    )
    group.add_argument(
        "--poses", choices=("truth", "track"), help="the track (default) or, marked in the result, the truth"
    )
    group.add_argument(
        "--steps", metavar="N", type=int, default=DEFAULT_STEPS, help="steps of 1/148 s to roll out (80)"
    )


def run(args: argparse.Namespace, session: Session, out_dir: Path, progress: Progress) -> Outcome:
    """What the command does; its document is what `--json` prints."""
    from processing.pipeline.contact_only import contact_only

    asked = (args.train, args.test, args.geometry, args.init, args.poses, args.steps)
    device = getattr(args, "device", "cpu") or "cpu"
    return Outcome(*contact_only(session, out_dir, *asked, device, progress, getattr(args, "truth", None)))
