"""`toss-session`: look at a session, check it, recover it, bring recordings in, take them out."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any

from recordings.console import Outcome, Parser, add_command, command_parser, progress_for, run_command
from recordings.verify.command import add_commands

EXPORTS = {
    "folder": ("the folder layout: images, depth, times, joint states as files", "SESSION"),
    "bundlesdf": ("BundleSDF's folders: rgb, depth in mm, masks, cam_K.txt", "RESULTS"),
    "tum": ("one trajectory file per toss, as evo reads it", "RESULTS"),
    "bop": ("BOP's layout: scene_camera.json, scene_gt.json, models in mm", "RESULTS"),
    "mesh": ("shape.obj in the object frame of the poses, metres", "RESULTS"),
    "urdf": ("a simulation-ready URDF with learned mesh, inertia and friction", "RESULTS"),
    "mjcf": ("a simulation-ready MuJoCo model with learned mesh, inertia and friction", "RESULTS"),
    "drake-sdf": ("a simulation-ready SDFormat model for Drake", "RESULTS"),
    "video": ("a film of every toss: colour with the object's outline, the scene in 3D beside it (MP4)", "RESULTS"),
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
    add_commands(commands)
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
    for add in (_add_folder, _add_bundlesdf, _add_contactnets, _add_realsense, _add_rosbag):
        add(layouts)


def _add_folder(layouts: Any) -> None:
    parser = add_command(
        layouts,
        "folder",
        "Read the folder layout: session.json, toss_XX/{rgb,depth,timestamps.txt,mask_first.png}, mono/, calibration/.",
        "toss-session import folder recordings/cube_dev sessions/cube",
        "toss-session import folder recordings/cube_dev sessions/cube --truth recordings/cube_dev_truth",
    )
    parser.add_argument("source", metavar="DIR", type=Path, help="a folder with session.json and toss_00/{rgb,depth}")
    _add_out(parser)
    parser.add_argument("--truth", metavar="TRUTH_DIR", type=Path, help="a *_truth folder, read into truth/")
    parser.set_defaults(work=_import, layout="folder")


def _add_bundlesdf(layouts: Any) -> None:
    parser = add_command(
        layouts,
        "bundlesdf",
        "Read folders of BundleSDF, FoundationPose or YCBInEOAT: rgb, depth (uint16 mm), masks, cam_K.txt.",
        "toss-session import bundlesdf recordings/milk_00 recordings/milk_01 sessions/milk --fps 30",
    )
    parser.add_argument("sources", metavar="DIR", type=Path, nargs="+", help="one folder per toss")
    _add_out(parser)
    parser.add_argument("--fps", type=float, default=30.0, help="frames per second that times are made from (30)")
    parser.set_defaults(work=_import, layout="bundlesdf")


def _add_contactnets(layouts: Any) -> None:
    parser = add_command(
        layouts,
        "contactnets",
        "Read toss files of ContactNets or dair_pll: poses only, for contact learning alone.",
        "toss-session import contactnets recordings/contactnets sessions/tosses",
        "toss-session import contactnets recordings/tosses sessions/tosses --scale 0.0524 --dt 0.006756757",
    )
    parser.add_argument("source", metavar="PATH", type=Path, help="a folder of .pt files, one file, or their parent")
    _add_out(parser)
    parser.add_argument(
        "--scale", dest="scale_m", metavar="M", type=float, help="metres per unit of position (else params_processed)"
    )
    parser.add_argument("--dt", dest="dt_s", metavar="S", type=float, help="seconds per step (else params_processed)")
    parser.set_defaults(work=_import, layout="contactnets")


def _add_realsense(layouts: Any) -> None:
    parser = add_command(
        layouts,
        "realsense",
        "Read RealSense recordings, .bag or .db3: colour and depth with their own stamps, not aligned.",
        "toss-session import realsense recordings/take_00.db3 recordings/take_01.db3 sessions/milk",
    )
    parser.add_argument("sources", metavar="FILE", type=Path, nargs="+", help="one recording per toss")
    _add_out(parser)
    parser.set_defaults(work=_import, layout="realsense")


def _add_rosbag(layouts: Any) -> None:
    parser = add_command(
        layouts,
        "rosbag",
        "Read ROS 1 or ROS 2 bags (.bag, folder, .mcap, .db3) of the usual image topics.",
        "toss-session import rosbag recordings/take_00.bag sessions/milk",
        "toss-session import rosbag recordings/take_00 sessions/milk --color /camera/color/image_raw",
    )
    parser.add_argument("sources", metavar="BAG", type=Path, nargs="+", help="one bag per toss")
    _add_out(parser)
    parser.add_argument("--color", metavar="TOPIC", help="the colour images, where a bag has several")
    parser.add_argument("--depth", metavar="TOPIC", help="the depth images, where a bag has several")
    parser.set_defaults(work=_import, layout="rosbag")


def _add_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", metavar="OUT", type=Path, help="the session to make; must not exist yet, or be empty")


def _import(args: argparse.Namespace) -> Outcome:
    """The layout's importer, given what it asks for by name."""
    importer = getattr(import_module(f"recordings.importers.{args.layout}"), f"import_{args.layout}")
    asked = {name: getattr(args, name) for name in signature(importer).parameters if name != "progress"}
    return _said(importer(**asked, progress=progress_for("import")))


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
