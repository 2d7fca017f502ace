"""The whole cycle against the figures of its issue: the table's rows, the worst toss, seconds per stage, growth.

python tools/bench_cycle.py                         # cube_dev: every row in scope all, then 2 and 5 tosses of `ours`
python tools/bench_cycle.py --rows ours SESSION... --truth DIR...

One thread; CPU time, not wall time. Peak memory is that of this process.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from processing.config import Config
from processing.evaluate.score import VariantScore, score_variant
from processing.evaluate.table import COLUMNS
from processing.evaluate.truth import open_truth
from processing.pipeline import process
from processing.start import start_run
from processing.variants import BEYOND, TABLE, find_variant
from recordings.importers.folder import import_folder
from recordings.progress import Silent
from recordings.results.folder import Results
from recordings.session import Session

DATA = Path(os.environ.get("TOSSLAB_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
GROWTH = (2, 5)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sessions", nargs="*", type=Path, help="sessions, or folders of the folder layout")
    parser.add_argument("--truth", nargs="*", type=Path, default=[], help="one for each session")
    parser.add_argument("--rows", default=",".join(v.name for v in (*TABLE, *BEYOND)))
    parser.add_argument("--scope", choices=("one", "all"), default="all")
    parser.add_argument("--keep", type=Path, help="keep the results here, and go on from what is there")
    given = parser.parse_args()
    sessions = given.sessions or [DATA / "cube_dev"]
    truths = given.truth or [s.with_name(f"{s.name}_truth") for s in sessions]
    with tempfile.TemporaryDirectory() as place:
        root = given.keep or Path(place)
        for session, truth in zip(sessions, truths, strict=True):
            bench(opened(session, root), truth, root / f"{session.name}_results", given.rows.split(","), given.scope)
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB")
    return 0


def opened(path: Path, root: Path) -> Session:
    """The session, imported first where it is in the folder layout."""
    if not list(path.glob("toss_*/rgb")):
        return Session.open(path)
    imported = root / path.name
    if not imported.exists():
        import_folder(path, imported, None, None)
    return Session.open(imported)


def bench(session: Session, truth: Path, out: Path, rows: Sequence[str], scope: str) -> None:
    """Every row, then how the cost of `ours` grows with the tosses."""
    print(f"== {session.name}, scope {scope}")
    for name in rows:
        if scope == "one" and name in {v.name for v in BEYOND}:
            continue
        run_row(session, session.tosses, truth, out, name, scope)
    stages(out)
    if scope == "all" and "ours" in rows:
        for count in GROWTH:
            if count < len(session.tosses):
                few = out.with_name(f"{out.name}_{count}")
                run_row(session, session.tosses[:count], truth, few, "ours", scope)
                stages(few)


def run_row(session: Session, tosses: Sequence[int], truth: Path, out: Path, name: str, scope: str) -> None:
    """One row: its scores, the worst toss, and what its passes said."""
    run = start_run(session, tosses, out, Config(), "multi-hypothesis", lambda _: Silent())
    record = process(run, find_variant(name), scope)  # type: ignore[arg-type]
    results = Results.open(out)
    true = open_truth(truth, session, record.calibration)
    if true is None:
        raise SystemExit(f"{truth}: no truth")
    score = score_variant(results, record, true)
    figures = " ".join(f"{t.split()[0]} {score.values[c].value:.3f}" for c, t in COLUMNS if c in score.values)
    more = " ".join(
        f"{n} {score.values[n].value:.3f}"
        for n in ("global_add_auc", "global_adds_auc", "friction", "volume_error", "lost_frames")
        if n in score.values
    )
    print(f"{name:13s} {figures} | {more} | {worst(score)}", flush=True)
    for note in (*record.warnings, *record.notes[1:]):
        print(f"{'':13s}   {note}")


def worst(score: VariantScore) -> str:
    """The toss with the lowest area under its ADD curve."""
    from processing.evaluate.score import pose_values

    each = {t.toss: pose_values(t.errors, "")["add_auc"].value for t in score.tosses}
    low = min(each, key=lambda t: each[t])
    return f"worst toss {low}: ADD {each[low]:.2f}"


def stages(out: Path) -> None:
    """CPU seconds of every stage, and their sum."""
    results = Results.open(out)
    spent: dict[str, float] = {}
    for folder in sorted(p.parent.name for p in out.glob("*/stage.json")):
        document = results.stage(folder)
        spent[document["stage"]] = spent.get(document["stage"], 0.0) + float(document["cpu_seconds"])
    print("   CPU-s " + ", ".join(f"{k} {v:.0f}" for k, v in spent.items()) + f"; all {sum(spent.values()):.0f}")


if __name__ == "__main__":
    sys.exit(main())
