"""`toss-session`: look at a session, check it, recover it, bring recordings in, take them out."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from recordings.console import Outcome, Parser, add_command, command_parser, progress_for, run_command

EXPORTS = {
    "folder": ("the folder layout: images, depth, times, joint states as files", "SESSION"),
    "bundlesdf": ("BundleSDF's folders: rgb, depth in mm, masks, cam_K.txt", "RESULTS"),
    "tum": ("one trajectory file per toss, as evo reads it", "RESULTS"),
    "bop": ("BOP's layout: scene_camera.json, scene_gt.json, models in mm", "RESULTS"),
    "mesh": ("shape.obj in the object frame of the poses, metres", "RESULTS"),
    "urdf": ("a simulation-ready URDF with learned mesh, inertia and friction", "RESULTS"),
    "mjcf": ("a simulation-ready MuJoCo model with learned mesh, inertia and friction", "RESULTS"),
    "drake-sdf": ("a simulation-ready SDFormat model for Drake", "RESULTS"),
    "rrd": ("one file for the rerun viewer", "SESSION"),
    "lerobot": ("a LeRobot v3 dataset", "SESSION"),
    "mcap": ("the session with depth in Foxglove's standard schema, for any viewer", "SESSION"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """The command's entry point; returns its exit code."""
    return run_command(_parser(), argv)


def _parser() -> Parser:
    parser = command_parser(
        "toss-session",
        "Look at a session, check it, recover it, bring recordings in, take them out.",
        "toss-session info sessions/cube",
        "toss-session import folder recordings/cube_dev sessions/cube",
        "toss-session export tum sessions/cube tracks",
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    if find_spec("recordings.cli_inspect"):  # being written
        import_module("recordings.cli_inspect").add_commands(commands)
    _add_imports(commands)
    _add_exports(commands)
    return parser


def _add_imports(commands: Any) -> None:
    group = add_command(
        commands,
        "import",
        "Make a session from a recording of another layout. The recording stays as it is.",
        "toss-session import folder recordings/cube_dev sessions/cube",
    )
    layouts = group.add_subparsers(title="layouts", metavar="LAYOUT", required=True)
    folder = add_command(
        layouts,
        "folder",
        "Read the folder layout: session.json, toss_XX/{rgb,depth,timestamps.txt,mask_first.png}, mono/, calibration/.",
        "toss-session import folder recordings/cube_dev sessions/cube",
        "toss-session import folder recordings/cube_dev sessions/cube --truth recordings/cube_dev_truth",
    )
    folder.add_argument(
        "dir", metavar="DIR", type=Path, help="a folder with session.json and toss_00/rgb, toss_00/depth"
    )
    _add_out(folder)
    folder.add_argument(
        "--truth", metavar="TRUTH_DIR", type=Path, help="a *_truth folder, read into the session's truth/"
    )
    folder.set_defaults(work=_import_folder)


def _add_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", metavar="OUT", type=Path, help="the session to make; must not exist yet, or be empty")


def _import_folder(args: argparse.Namespace) -> Outcome:
    from recordings.importers.folder import import_folder

    return _said(import_folder(args.dir, args.out, args.truth, progress_for("import")))


def _said(report: Any) -> Outcome:
    """An ImportReport or ExportReport as what the command prints."""
    return Outcome(vars(report), report.text())


def _add_exports(commands: Any) -> None:
    group = add_command(
        commands,
        "export",
        "Write a session or its results in another layout. Nothing is overwritten.",
        "toss-session export tum sessions/cube tracks",
        "toss-session export mesh sessions/cube/results shape --variant ours --scope all",
    )
    formats = group.add_subparsers(title="formats", metavar="FORMAT", required=True)
    for name, (what, of) in EXPORTS.items():
        source = "sessions/cube" if of == "SESSION" else "sessions/cube/results"
        out = "cube.rrd" if name == "rrd" else f"out/{name}"
        parser = add_command(formats, name, f"Write {what}.", f"toss-session export {name} {source} {out}")
        parser.add_argument("source", metavar="RESULTS_OR_SESSION", type=Path, help="a results folder, or a session")
        parser.add_argument(
            "out", metavar="OUT", type=Path, help="the file to write" if name == "rrd" else "the folder to write"
        )
        parser.add_argument("--variant", metavar="NAME", help="not needed where the results hold one variant")
        parser.add_argument("--scope", choices=["one", "all"], help="not needed where the results hold one scope")
        parser.set_defaults(work=_export, format=name)


def _export(args: argparse.Namespace) -> Outcome:
    from recordings.exporters.export import export

    return _said(export(args.format, args.source, args.out, args.variant, args.scope, progress_for("export")))
