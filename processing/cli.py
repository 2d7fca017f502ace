"""`toss-process`: a session in, the object's shape and poses out, with honest scores."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from processing import backends
from processing.given_masks import add_masks_argument
from processing.variants import CONTACT_ONLY, DEFAULT, NAMES, TRACKERS, WITH_MODEL, rows_of
from recordings.console import Outcome, Parser, chosen_tosses, command_parser, progress_for, run_command, shared_board
from recordings.errors import BadInput, TosslabError
from recordings.notices import Notice

if TYPE_CHECKING:
    from processing.config import Config
    from processing.engine.each import Engine
    from processing.run import Run
    from processing.variants import Variant
    from recordings.results.folder import Scope
    from recordings.session import Session

SAMPLE = "sample"
SAMPLE_FOLDER = Path("samples") / "box_toss"
SAMPLE_RESULTS = Path("box_toss_results")
"""Of the shipped sample asked for by name: in the folder one works in, never among the program's installed files."""
CONTACT = "processing.contact_command"
FOR_REPORT = ("processing.evaluate.report", "matplotlib.backends.backend_agg", "open3d")
IMPORT_AFTER_S = 30.0
"""Stages that take longer leave time for it; at the start it would be in the way of the first ones."""
BASELINE_ROW = "bundlesdf-1"
_EVALUATING = threading.Lock()
"""Reports are drawn one after the other: what draws them keeps the picture it is at for itself."""
MODEL_ORDER = ("ours", "converged", "joint", "no-cycle", "no-contact", "no-icp", "bundlesdf-10", "contact-only")


def main(argv: Sequence[str] | None = None) -> int:
    """The command's entry point; returns its exit code."""
    return run_command(_parser(), argv)


def _parser() -> Parser:
    parser = command_parser(
        "toss-process",
        "Turn a session into the object's shape, its pose in every frame and its contact dynamics, and score them.\n"
        "A run that was stopped goes on where it was: finished stages are read, not run again.",
        "toss-process                                          # the shipped sample",
        "toss-process sessions/cube --out results/cube --truth recordings/cube_dev_truth",
        "toss-process --follow sessions/first                   # while another program records it",
    )
    parser.usage = "toss-process [SESSION ...] [--toss I-J] [--out DIR] [--truth DIR] [--model RESULTS] [more, below]"
    _add_everyday(parser)
    _add_table(parser.add_argument_group("the paper's table"))
    add_cycle_arguments(parser)
    import_module(CONTACT).add_arguments(parser)
    vision = parser.add_argument_group("masks, features and learned weights")
    add_masks_argument(vision)
    backends.add_arguments(vision)
    _add_developers(parser.add_argument_group("for developers"))
    parser.set_defaults(work=_work)
    return parser


def _add_everyday(parser: argparse.ArgumentParser) -> None:
    """What most people need, first in the help."""
    parser.add_argument(
        "sessions", metavar="SESSION", nargs="*", help="session folders, one .mcap file, or `sample` (the default)"
    )
    parser.add_argument("--toss", metavar="I|I-J", help="only these tosses")
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help=f"results folder (SESSION/results; of several sessions DIR/<name>; of `sample` ./{SAMPLE_RESULTS})",
    )
    parser.add_argument("--truth", metavar="DIR", type=Path, help="truth/ or a *_truth folder, opened for scores only")
    parser.add_argument("--model", metavar="RESULTS", type=Path, help="track with a shape that was learned before")
    parser.add_argument(
        "--follow",
        metavar="SESSION",
        type=Path,
        help="look at each toss while the session is recorded, then process it",
    )
    parser.add_argument(
        "--recorder", type=int, help=argparse.SUPPRESS
    )  # the process that records, of toss-record --live
    parser.add_argument("--live-pose", type=Path, help=argparse.SUPPRESS)  # its frames, of toss-record --live pose
    parser.add_argument(
        "--table-from-depth", action="store_true", help="table from depth: the calibration lacks it, or is wrong"
    )
    parser.add_argument("--jobs", metavar="N", type=int, help="stages at a time (cores, fewer where memory is short)")
    parser.add_argument(
        "--executor", choices=("local", "slurm"), default="local", help="where stages run: here, or each as a Slurm job"
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="cpu (default) or cuda")


def _add_table(group: Any) -> None:
    """Which row of the table is made."""
    group.add_argument("--variant", metavar="NAME", help=f"a row (default: {DEFAULT}) of: {', '.join(NAMES)}")
    group.add_argument("--scope", choices=("one", "all"), default="all", help="each toss alone, or all (default)")


def _add_developers(group: Any) -> None:
    """What compares and takes apart."""
    group.add_argument("--tracker", metavar="NAME", default=TRACKERS[0], help=f"one of: {', '.join(TRACKERS)}")
    group.add_argument("--start", choices=("truth",), help="truth: the first true pose is given (marked in the table)")


def add_cycle_arguments(parser: argparse.ArgumentParser) -> None:
    """What the second pass is given; `anew` and `rendered` are the paper's way."""
    group = parser.add_argument_group("the paper's second pass")
    group.add_argument(
        "--second-pass", choices=("shape", "poses", "anew"), default="shape",
        help="start from the first pass's poses and shape (default), its poses, or the first pose alone (the paper)",
    )  # fmt: skip
    group.add_argument(
        "--redraw", choices=("filled", "rendered"), default="filled",
        help="depth: the camera's own, filled by the shape's (default), or the shape's everywhere (the paper)",
    )  # fmt: skip
    group.add_argument(
        "--occlusion", choices=("fill", "subtract"), default="fill",
        help="what stands in front of the shape is filled (the paper's text) or cut out (its authors' code)",
    )  # fmt: skip
    group.add_argument("--renderer", choices=("raycast", "drake"), default="raycast", help="drake needs the extra sim")


def _work(args: argparse.Namespace) -> Outcome:
    name = args.variant or (DEFAULT if args.tracker == TRACKERS[0] else BASELINE_ROW)
    if name != CONTACT_ONLY:
        rows_of(name, args.scope)  # refuses by name, before anything is read
        _refuse_what_is_not_there(args)
    if args.follow is not None:
        return _follow(args, name)
    sessions = [_session_path(s) for s in args.sessions] or [_sample_path()]
    if len(sessions) > 1 and args.truth is not None:
        raise BadInput("--truth DIR belongs to one session; with several, each one's own truth/ is used")
    if args.truth is not None and not args.truth.is_dir():
        raise BadInput(f"{args.truth} is no truth: wanted a folder, a session's truth/ or a *_truth folder")
    with _engine(args, sessions[0]) as engine:
        if len(sessions) == 1:
            return _process(args, engine, sessions[0], name, several=False)
        return _many(args, engine, sessions, name)


@contextmanager
def _engine(args: argparse.Namespace, first: Path) -> Iterator[Engine]:
    """What computes the stages: this process, several on this machine, or jobs of a cluster."""
    from processing.engine.each import InTurn, SideBySide
    from processing.engine.jobs import chosen_jobs
    from processing.engine.parts import allow_threads
    from processing.engine.slurm import AT_ONCE, slurm_jobs
    from processing.engine.workers import AtWork, Worker, begin_imports

    jobs, why = (args.jobs or AT_ONCE, None) if args.executor == "slurm" else chosen_jobs(args.jobs)
    if why is not None:
        print(f"toss-process: {why}", file=sys.stderr)
    board = shared_board()
    if args.executor == "slurm":
        with SideBySide(slurm_jobs(jobs, _logs_of(args, first)), board) as engine:
            yield engine
    elif jobs == 1:
        yield InTurn()
    else:
        begin_imports()
        allow_threads(jobs)
        at_work = AtWork()
        with SideBySide([Worker(board, jobs, at_work) for _ in range(jobs)], board) as engine:
            yield engine


def _follow(args: argparse.Namespace, name: str) -> Outcome:
    """Every toss as it comes; then the session as if it had been asked for."""
    from processing.live.command import follow_session

    if args.live_pose is not None:
        from processing.live.pose.command import serve_poses

        return serve_poses(args.follow, args.live_pose, args.recorder)
    if args.sessions:
        raise BadInput(f"--follow {args.follow} follows one session; leave out {', '.join(args.sessions)}")

    def whole() -> Outcome:
        with _engine(args, args.follow) as engine:
            return _process(args, engine, args.follow, name, several=False)

    return follow_session(args.follow, args.recorder, config_of(args), _sample_path(), whole)


def _many(args: argparse.Namespace, engine: Engine, sessions: Sequence[Path], name: str) -> Outcome:
    """Sessions side by side; one that fails does not stop the others. Then a table over all."""
    from processing.evaluate.table import summary

    found = engine.each(sessions, lambda path: _alone(args, engine, path, name))
    codes = [int(f.pop("exit_code", TosslabError.exit_code)) for f in found.values()]
    documents = [{"session": path.stem, **f} for path, f in found.items()]
    return Outcome({"sessions": documents}, summary(documents), max(codes))


def _alone(args: argparse.Namespace, engine: Engine, path: Path, name: str) -> dict[str, Any]:
    """One of several sessions: its document, or why it failed."""
    import traceback

    from processing.engine.each import Stopped

    try:
        outcome = _process(args, engine, path, name, several=True)
    except Stopped:
        raise
    except TosslabError as wrong:
        return {"session": str(path), "error": str(wrong), "exit_code": wrong.exit_code}
    except Exception as wrong:
        traceback.print_exc(file=sys.stderr)
        return {"session": str(path), "error": f"{type(wrong).__name__}: {wrong}; its lines are above"}
    return {**outcome.document, "exit_code": outcome.exit_code}


def _logs_of(args: argparse.Namespace, path: Path) -> Path:
    """Where a cluster's jobs keep their logs."""
    base = SAMPLE_RESULTS if _by_name(args, path) else path if path.is_dir() else path.parent
    return Path(base if args.out is None else args.out) / ".jobs"


def _refuse_what_is_not_there(args: argparse.Namespace) -> None:
    if args.tracker not in TRACKERS:
        raise BadInput(f"there is no tracker '{args.tracker}'; available: {', '.join(TRACKERS)}")
    if args.model is not None and args.tracker != TRACKERS[0]:
        raise BadInput(f"--model needs --tracker {TRACKERS[0]}: {args.tracker} knows no shape")
    if args.model is not None and args.variant is not None:
        raise BadInput("--model RESULTS is a row of its own (with-model): leave out --variant")
    if args.model is not None and args.start is not None:
        raise BadInput("--start and --model exclude each other: a learned shape brings its own object frame")
    backends.chosen(args)
    if args.device == "cuda":
        _refuse_missing_gpu()


def _refuse_missing_gpu() -> None:
    import torch

    if not torch.cuda.is_available():
        raise BadInput("--device cuda: torch finds no CUDA device here; run with --device cpu")


def _session_path(given: str) -> Path:
    return _sample_path() if given == SAMPLE and not Path(given).exists() else Path(given)


def _sample_path() -> Path:
    import recordings

    path = Path(recordings.__file__).parent / SAMPLE_FOLDER
    if not path.exists():
        raise BadInput(f"the shipped sample is not at {path}; name a session: toss-process SESSION")
    return path


def _by_name(args: argparse.Namespace, path: Path) -> bool:
    """Whether this is the shipped sample without its path having been given."""
    return path == _sample_path() and path not in map(Path, args.sessions)


def _process(args: argparse.Namespace, engine: Engine, path: Path, name: str, several: bool) -> Outcome:
    from recordings.session import Session

    session = Session.open(path)
    try:
        out = _out_folder(args, session, several)
        if name == CONTACT_ONLY:
            return _contact_only(args, session, out)
        run = _vision(args, engine, session, name, out)
        with _EVALUATING:
            return _evaluate(args, session, out, run)  # truth is opened after every track and shape is written
    finally:
        session.close()


def _vision(args: argparse.Namespace, engine: Engine, session: Session, name: str, out: Path) -> Run:
    """Every row that was asked for."""
    from processing.engine.each import InTurn
    from processing.engine.workers import Shown
    from processing.pipeline.process import process
    from processing.pipeline.start import start_run, with_table
    from processing.run import each

    model = None if args.model is None else learned_shape_of(args.model)
    tosses = chosen_tosses(args.toss, session.tosses, "--toss")
    progress = progress_for if isinstance(engine, InTurn) else Shown()
    run = start_run(session, tosses, out, config_of(args), args.tracker, progress, args.device, engine)
    run = _started(args, with_table(run) if args.table_from_depth else run)
    rows: list[tuple[Variant, Scope]] = [(WITH_MODEL, "all")] if model is not None else rows_of(name, args.scope)
    with nullcontext() if isinstance(engine, InTurn) else _imports_meanwhile():
        each(run, rows, lambda row: process(run, *row, model))
    return run


@contextmanager
def _imports_meanwhile() -> Iterator[None]:
    """What the report needs takes seconds to import: done while workers compute the stages."""
    timer = threading.Timer(IMPORT_AFTER_S, lambda: [import_module(module) for module in FOR_REPORT])
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join()


def _started(args: argparse.Namespace, run: Run) -> Run:
    """`--start truth`: the run with the first true pose of every toss."""
    if args.start is None:
        return run
    from processing.evaluate.truth import start_poses

    starts = start_poses(args.truth, run.session, run.tosses, "d455")
    note = Notice("start", "high", "start: the first pose of every toss is the true one (--start truth)")
    return replace(run, starts=starts, warnings=(*run.warnings, note))


def learned_shape_of(results_path: Path) -> Path:
    """The stage folder with the shape of a results folder: that of the best row that is there. Raises BadInput."""
    from recordings.results.folder import Results

    results = Results.open(results_path)
    there = {name: results.find(name, scope) for name, scope in results.variants() if scope == "all"}
    for name in MODEL_ORDER:
        if name in there and (stage := there[name].shape) is not None:
            return results.path / stage
    raise BadInput(
        f"{results_path} holds no shape of all tosses together; it has {[n for n, _ in results.variants()]}: make one "
        "by `toss-process SESSION --out RESULTS`"
    )


def config_of(args: argparse.Namespace) -> Config:
    """The pipeline's settings that the command line asks for; everything else stays as it is by default."""
    from processing.config import Config, CycleConfig
    from processing.refine.redrawn_frames import RedrawConfig

    redraw = RedrawConfig(depth=args.redraw, occlusion=args.occlusion)
    cycle = CycleConfig(redraw=redraw, renderer=args.renderer, start=args.second_pass)
    return Config(given_masks=args.masks, backends=backends.chosen(args), cycle=cycle)


def _evaluate(args: argparse.Namespace, session: Session, out: Path, run: Run) -> Outcome:
    """Scores of all variants in the results folder, table and report."""
    from processing.evaluate.floor import coverage_floor
    from processing.evaluate.report import write_report
    from processing.evaluate.score import score_variant, true_mesh
    from processing.evaluate.table import collect, markdown, write_table
    from processing.evaluate.truth import open_truth
    from processing.pipeline.process import metric_frames_of
    from processing.store import locked
    from recordings.results.folder import Results

    results = Results.open(out)
    scores, mesh = {}, None
    for variant in results.variants():
        record = results.find(*variant)
        truth = open_truth(args.truth, session, record.calibration)
        if truth is not None:
            scores[variant] = score_variant(results, record, truth)
            if record.scope == "one":
                scores[variant] = scores[variant].with_more(*coverage_floor(run, metric_frames_of(run), record, truth))
            mesh = true_mesh(truth)
    rows = collect(results, scores)
    with locked(out / ".table.lock"):  # of two runs on one folder, each writes a whole table
        document = write_table(results, rows)
        write_report(results, document, rows, session, mesh)
    text = f"{markdown(document)}\nresults: {out}\nreport:  {out / 'report.html'}"
    return Outcome({"session": session.name, "results": str(out), **document}, text)


def _contact_only(args: argparse.Namespace, session: Session, out: Path) -> Outcome:
    outcome: Any = import_module(CONTACT).run(args, session, out, progress_for("contact-only"))
    return outcome if isinstance(outcome, Outcome) else Outcome({"results": str(out)}, f"results: {out}")


def _out_folder(args: argparse.Namespace, session: Session, several: bool) -> Path:
    """--out DIR is itself the results folder; by default SESSION/results, of one file beside it."""
    if args.out is not None:
        return args.out / session.path.resolve().stem if several else args.out
    path = session.path
    if _by_name(args, path):
        return SAMPLE_RESULTS
    return path / "results" if path.is_dir() else path.with_name(f"{path.stem}_results")


if __name__ == "__main__":
    sys.exit(main())
