"""`toss-truth`: where the object really was, from AprilTags in the ground-truth cameras; or a TagSLAM configuration."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from calibration.cli import positive_m
from recordings.console import DONE, FELL_SHORT, Outcome, Usage, command_parser, json_text, progress_for, run_command
from recordings.errors import BadInput

DESCRIPTION = """Find where the object really was from AprilTags in a session's ground-truth cameras, and write the
session's truth/: a pose with covariance and status at every colour frame, residuals and a verdict. The cameras' places
come from calibration.json (`toss-calibrate cameras`); where they are not there, table tags in view must do. The tags'
places on the object are found. With `tagslam DIR` it runs a TagSLAM configuration as it is (a session of that name is
written ./tagslam)."""
EXAMPLES = (
    "toss-truth sessions/cube --tag-size 0.0614",
    "toss-truth sessions/cube --mesh cube.obj --replace",
    "toss-truth tagslam tagslam_test/test_01 --out poses.json",
)
TAGSLAM_DESCRIPTION = """Run a TagSLAM configuration as it is: cameras.yaml, camera_poses.yaml and tagslam.yaml with the
detections of tag_detections.bag[.bz2] or detections.npz. Writes every body's poses by stamp."""


def main(argv: Sequence[str] | None = None) -> int:
    arguments = list(sys.argv[1:] if argv is None else argv)
    words = [a for a in arguments if not a.startswith("-")]
    if words[:1] == ["tagslam"]:
        arguments.remove("tagslam")
        return run_command(_tagslam_parser(), arguments)
    return run_command(_parser(), arguments)


def _parser() -> Any:
    parser = command_parser("toss-truth", DESCRIPTION, *EXAMPLES)
    parser.add_argument("session", type=Path, metavar="SESSION", help="a session folder, or: tagslam DIR")
    parser.add_argument("--tag-size", type=positive_m, metavar="M", help="side of the tags' black square, metres; "
                        "left out, it is measured between cameras of known place")  # fmt: skip
    parser.add_argument("--layout", type=Path, metavar="FILE", help="known places of the tags on the object: JSON with "
                        "tags [{id, size_m, T_tagged_tag or T_object_tag}]")  # fmt: skip
    parser.add_argument("--family", default="tag36h11", help="tag family (default: %(default)s)")
    parser.add_argument("--ignore", type=int, nargs="+", default=[], metavar="ID", help="tags to leave out")
    parser.add_argument("--mono-only", action="store_true", help="leave out the D455's own view of the tags, which "
                        "otherwise places it next to impacts")  # fmt: skip
    parser.add_argument("--toss", metavar="I[-J]", help="only these tosses (default: all with mono images)")
    parser.add_argument("--mesh", type=Path, metavar="FILE", help="the object's known shape, metres: goes into truth/, "
                        "and the tags are laid on it")  # fmt: skip
    parser.add_argument("--object-from-tagged", type=Path, metavar="FILE", help="JSON with the 4x4 from the tags' body "
                        "to the object's (the mesh's) frame; with --mesh it is found if left out")  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="write here (default: SESSION/truth)")
    parser.add_argument("--replace", action="store_true", help="an earlier truth/ of this command may be replaced")
    parser.set_defaults(work=_work)
    return parser


def _tagslam_parser() -> Any:
    parser = command_parser("toss-truth tagslam", TAGSLAM_DESCRIPTION, EXAMPLES[-1])
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder of the configuration and its detections")
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="where the poses go (default: only a summary)")
    parser.set_defaults(work=_work_tagslam)
    return parser


def _work_tagslam(args: argparse.Namespace) -> Outcome:
    from groundtruth.tagslam.answer import answer_document, answer_text
    from groundtruth.tagslam.config import read_config
    from groundtruth.tagslam.detections import read_recording
    from groundtruth.tagslam.solve import run_tag_slam
    from recordings.whole_file import write_bytes

    if not args.folder.is_dir():
        raise BadInput(
            f"{args.folder} is no folder; wanted one with cameras.yaml, camera_poses.yaml, tagslam.yaml and detections "
            "(a session named tagslam is written ./tagslam)"
        )
    started = time.process_time()
    config = read_config(args.folder)
    result = run_tag_slam(config, read_recording(args.folder), progress=progress_for("toss-truth"))
    cpu_s = round(time.process_time() - started, 2)
    document = {**answer_document(result), "notes": list(config.notes), "cpu_s": cpu_s}
    text = "\n".join([answer_text(document), *(f"note: {n}" for n in config.notes)])
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(args.out, json_text(document).encode())
        return Outcome({"out": args.out, **_summary(document)}, f"{text}\nwrote {args.out}")
    return Outcome(document, f"{text}\nnothing written; `--out poses.json` keeps the poses")


def _summary(document: dict[str, Any]) -> dict[str, Any]:
    counts = {name: len(rows) for name, rows in document["bodies"].items()}
    return {**{k: v for k, v in document.items() if k not in ("bodies", "tags")}, "poses": counts}


def _work(args: argparse.Namespace) -> Outcome:
    from groundtruth.session_truth import TruthConfig, find_truth, replace_folder, write_session_truth
    from recordings.session import Session

    with Session.open(args.session) as session:
        out: Path = args.out or (session.path if session.path.is_dir() else session.path.parent) / "truth"
        if out.exists() and not args.replace:
            raise BadInput(f"{out} exists; nothing was written. Type --replace to make it anew, or `--out FOLDER`")
        sizes, layout = _layout(args.layout) if args.layout else (None, None)
        config = TruthConfig(
            args.family, args.tag_size, frozenset(args.ignore), layout, sizes, mono_only=args.mono_only
        )
        tosses = _tosses(session, args.toss)
        truth = find_truth(session, tosses, config, progress_for("toss-truth"))
        offset, notes = _offset(args, truth)
        if out.exists():
            replace_folder(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        document = write_session_truth(truth, out, offset, args.mesh)
    verdict = truth.verdict
    text = _text(document, verdict, notes, out)
    return Outcome({"out": out, **document, "notes": notes}, text, DONE if verdict.good else FELL_SHORT)


def _tosses(session: Any, chosen: str | None) -> list[int]:
    from groundtruth.session_detections import mono_cameras

    if chosen is None:
        found = [t for t in session.tosses if mono_cameras(session.toss(t))]
        return found or list(session.tosses)
    first, _, last = chosen.partition("-")
    if not first.isdigit() or not (last or first).isdigit():
        raise Usage(f"--toss {chosen}: wanted a number or a range, for instance 3 or 0-4")
    wanted = range(int(first), int(last or first) + 1)
    for toss in wanted:
        session.file(toss)
    return list(wanted)


def _layout(path: Path) -> tuple[dict[int, float], dict[int, Any]]:
    """Sizes and tagged_from_tag by id."""
    import numpy as np

    from recordings.bounded.documents import read_json
    from recordings.geometry import Transform

    try:
        tags = read_json(path)["tags"]
        poses = {int(t["id"]): np.array(t.get("T_tagged_tag", t.get("T_object_tag")), dtype=np.float64) for t in tags}
        layout = {i: Transform.from_matrix("tagged", f"tag_{i}", pose).matrix for i, pose in poses.items()}
        sizes = {int(t["id"]): float(t["size_m"]) for t in tags}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as wrong:
        raise BadInput(
            f"{path} is no layout ({type(wrong).__name__}: {wrong}); wanted JSON with tags, a list of id, size_m and "
            "T_tagged_tag (4x4; the tag's frame x right, y down, z into the print)"
        ) from wrong
    if len(layout) != len(tags):
        twice = sorted(i for i in layout if sum(int(t["id"]) == i for t in tags) > 1)
        raise BadInput(f"{path} has tag {twice[0]} twice; wanted every id once")
    return sizes, layout


def _offset(args: argparse.Namespace, truth: Any) -> tuple[Any, list[str]]:
    """object_from_tagged: as given, else by laying the tags on the mesh, else none."""
    from groundtruth.offset import read_object_from_tagged
    from groundtruth.session_truth import fit_mesh

    if args.object_from_tagged is not None:
        return read_object_from_tagged(args.object_from_tagged), []
    if args.mesh is None:
        return None, []
    fit = fit_mesh(truth, args.mesh)
    alike = f"; {fit.alike} placements fit alike (a symmetric shape), one of them was taken" if fit.alike > 1 else ""
    return fit.object_from_tagged, [f"the tags lie on the mesh to {1000 * fit.rms_m:.2f} mm{alike}"]


def _text(document: dict[str, Any], verdict: Any, notes: list[str], out: Path) -> str:
    accuracy = document["accuracy"]
    px = accuracy["reprojection_px"]
    lines = [f"corners: median {px['median']:.3f} px, rms {px['rms']:.3f} px ({px['corners']})"]
    lines += [f"  {name}: {value:.3f} px" for name, value in verdict.residual_px.items() if name != "all"]
    if accuracy["position_sigma_m"] is not None:
        lines.append(
            f"poses: standard deviation {1000 * accuracy['position_sigma_m']:.2f} mm, "
            f"{accuracy['rotation_sigma_rad'] * 57.29578:.3f} deg"
        )
    for toss, counts in document["frames"].items():
        lines.append(f"toss {toss}: " + ", ".join(f"{n} {status}" for status, n in counts.items() if n))
    lines += [*verdict.notes, *notes]
    lines += [f"warning: {w}" for w in verdict.warnings] + [f"fault: {f}" for f in verdict.faults]
    lines.append(f"verdict: {'good' if verdict.good else 'not fit for scores'}; wrote {out}")
    return "\n".join(lines)
