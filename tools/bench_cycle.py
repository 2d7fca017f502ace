"""The whole cycle against the figures of its issue: the table's rows, the worst toss, seconds per stage, growth.

python tools/bench_cycle.py                         # cube_dev: every row in scope all, then 2 and 5 tosses of `ours`
python tools/bench_cycle.py --rows ours SESSION... --truth DIR...
python tools/bench_cycle.py --jobs 1,2 SESSION...   # `ours` on one core and on two: how much faster
python tools/bench_cycle.py --read RESULTS...       # what is there already: how much faster it could have been

CPU time, not wall time, except with --jobs, which wants a machine that has nothing else to do. What stages could reach
side by side is told from the seconds and inputs that they left: `slots` plays them through. Peak memory is that of the
largest process.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from processing.config import Config
from processing.evaluate.score import VariantScore, score_variant
from processing.evaluate.table import COLUMNS
from processing.evaluate.truth import open_truth
from processing.pipeline.process import process
from processing.pipeline.start import start_run
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
    parser.add_argument("--jobs", help="numbers of cores, and of stages at a time, to compare, for example 1,2")
    parser.add_argument("--read", nargs="+", type=Path, default=[], help="results folders that are there already")
    parser.add_argument("--keep", type=Path, help="keep the results here, and go on from what is there")
    given = parser.parse_args()
    for results in given.read:
        print(f"== {results}")
        stages(results)
    if given.read:
        return 0
    sessions = given.sessions or [DATA / "cube_dev"]
    truths = given.truth or [s.with_name(f"{s.name}_truth") for s in sessions]
    with tempfile.TemporaryDirectory() as place:
        root = given.keep or Path(place)
        for session, truth in zip(sessions, truths, strict=True):
            if given.jobs:
                side_by_side(opened(session, root), root, [int(n) for n in given.jobs.split(",")])
                continue
            bench(opened(session, root), truth, root / f"{session.name}_results", given.rows.split(","), given.scope)
    largest = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    print(f"peak memory {largest / 1e6:.2f} GB")
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


def side_by_side(session: Session, root: Path, jobs: Sequence[int]) -> None:
    """`ours` by command, anew with each number of jobs on as many cores: wall seconds, and how much faster than the
    first."""
    took = []
    for n in jobs:
        cores = sorted(os.sched_getaffinity(0))[:n]  # else one job's readers and OpenCV take a second one
        code = f"import os, sys; os.sched_setaffinity(0, {cores}); from processing.cli import main; sys.exit(main())"
        out, begun = root / f"{session.name}_jobs_{n}", time.monotonic()
        command = [sys.executable, "-c", code, str(session.path), "--jobs", str(n), "--out", str(out)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        took.append(time.monotonic() - begun)
        print(f"{session.name}: --jobs {n}: {took[-1]:.0f} s, {took[0] / took[-1]:.2f} times as fast as {jobs[0]}")
        stages(out)


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
    """CPU seconds of every stage, their sum, and what they could take side by side."""
    results = Results.open(out)
    spent: dict[str, float] = {}
    documents = [results.stage(name) for name in sorted(p.parent.name for p in out.glob("*/stage.json"))]
    for document in documents:
        spent[document["stage"]] = spent.get(document["stage"], 0.0) + float(document["cpu_seconds"])
    whole = sum(spent.values())
    print("   CPU-s " + ", ".join(f"{k} {v:.0f}" for k, v in spent.items()) + f"; all {whole:.0f}")
    for count in (2, 4, len(documents)):
        name = f"{count} slots" if count < len(documents) else "any number"
        print(f"   on {name}: {(took := slots(documents, count)):.0f} s, {whole / took:.2f} times as fast as on one")


def slots(documents: Sequence[Mapping[str, Any]], count: int) -> float:
    """Seconds that the stages take on so many slots, each begun when all that it reads is there, first come first
    served. What the pipeline decides between stages is taken to need the stages that it compares."""
    keys = {d["key"] for d in documents}
    waits = {d["key"]: {k for k in d["inputs"].values() if k in keys} for d in documents}
    cost = {d["key"]: float(d["cpu_seconds"]) for d in documents}
    ended: dict[str, float] = {}
    free = [0.0] * count
    while waits:
        ready = {
            k: max((ended[x] for x in needed), default=0.0) for k, needed in waits.items() if needed <= ended.keys()
        }
        slot = min(range(count), key=lambda i: free[i])
        key = min(ready, key=lambda k: (max(ready[k], free[slot]), ready[k], -cost[k]))
        free[slot] = ended[key] = max(ready[key], free[slot]) + cost[key]
        del waits[key]
    return max(ended.values())


if __name__ == "__main__":
    sys.exit(main())
