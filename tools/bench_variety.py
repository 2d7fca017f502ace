"""The benchmark of variety: sessions drawn by seed, made, processed by two trackers, scored, deleted; one table.

python tools/bench_variety.py --split choose --n 20                 # settings may be chosen on these
python tools/bench_variety.py --split judge --n 60 --resume         # the judge table, at the end of an issue only
python tools/bench_variety.py --split choose --n 9 --family mug --variant bundlesdf-10 --tosses 2
python tools/bench_variety.py --make choose-003 --out DIR           # one session, kept
python tools/bench_variety.py --sheet docs/variety.png --n 24             # a random frame of each, to be looked at
python tools/bench_variety.py --move judge-007 --why "looked into: lost on the steel table"

A session at a time, made on the fly (path tracing needs Blender: `make blender`; VARIETY_BLENDER_DEVICE=CUDA has a
graphics card do it); what is finished stays in --out and `--resume` goes on. A session that cannot be shown, or on
which anything crashes, is counted and named.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from variety import marks, seeds, session
from variety.colour import blender
from variety.seeds import Case
from variety.shapes import FAMILIES
from variety.spec import Spec, draw
from variety.table import table

from acquisition.synthetic.truth_sidecar import SUFFIX
from recordings.errors import BadInput, TosslabError
from recordings.importers.folder import import_folder
from recordings.progress import Console

ROOT = Path(__file__).resolve().parent.parent
BASELINE = "frame-to-model"
VARIANTS = ("ours", "bundlesdf-10")
PROCESS = "import sys; from processing.cli import main; sys.exit(main(sys.argv[1:]))"


def main() -> int:
    given = _parser().parse_args()
    try:
        if given.move:
            fresh = seeds.move(given.move, date.today().isoformat(), given.why or "")
            print(f"{given.move} is a choose case from now on; {fresh.name} (seed {fresh.seed}) takes its place")
            return 0
        blender()
        if given.sheet:
            from variety.sheet import write_sheet

            wanted = seeds.cases("choose", 2 * given.n, seeds.read_ledger())
            print(f"{given.sheet}: {write_sheet(wanted, given.sheet, given.n, given.threads)} frames")
            return 0
        if given.make:
            return _make_one(given)
        return _bench(given)
    except TosslabError as wrong:
        print(wrong, file=sys.stderr)
        return wrong.exit_code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--split", choices=seeds.SPLITS)
    what.add_argument("--make", metavar="CASE", help="make this session and keep it")
    what.add_argument("--sheet", metavar="PNG", type=Path, help="a random frame of each of N choose cases")
    what.add_argument("--move", metavar="CASE", help="a judge case was looked into: it becomes a choose case")
    parser.add_argument("--why", help="reason of a move")
    parser.add_argument("--n", type=int, default=9, help="the first N cases of the split")
    parser.add_argument("--family", choices=FAMILIES, help="only this family of objects")
    parser.add_argument("--objects", type=Path, help="a folder of meshes with textures to toss instead")
    parser.add_argument("--tosses", type=int, help="at most so many tosses a session (for a quick look)")
    parser.add_argument("--variant", choices=VARIANTS, default=VARIANTS[0], help="beside the frame-to-model baseline")
    parser.add_argument("--out", type=Path, default=None, help="where results stay (default out/variety/SPLIT)")
    parser.add_argument("--resume", action="store_true", help="go on with what is in --out")
    parser.add_argument(
        "--sessions", type=Path, help="keep sessions there, and take those that are kept (made by the same generator)"
    )
    parser.add_argument("--threads", type=int, default=2, help="of the path tracer")
    return parser


def case_of(name: str) -> Case:
    """The case of a name, of either split. Raises BadInput."""
    parts = name.split("-")
    if len(parts) not in (2, 3) or parts[0] not in seeds.SPLITS or not all(p.isdigit() for p in parts[1:]):
        raise BadInput(f"{name} is no case; wanted for example choose-003, judge-007 or judge-007-1")
    split = seeds.SPLITS[seeds.SPLITS.index(parts[0])]  # type: ignore[arg-type]
    return Case(split, int(parts[1]), int(parts[2]) if len(parts) == 3 else 0)


def _make_one(given: argparse.Namespace) -> int:
    if given.out is None:
        raise BadInput("--make CASE needs --out DIR, a new folder")
    truth = session.make(
        draw(case_of(given.make), given.tosses), given.out, given.objects, Console(given.make), given.threads
    )
    print(f"{given.out} and {truth}")
    return 0


def _bench(given: argparse.Namespace) -> int:
    if given.sessions is not None and given.objects is not None:
        raise BadInput("--sessions keeps sessions of drawn objects; wanted it without --objects")
    out = given.out or ROOT / "out" / "variety" / given.split
    rows_folder = out / "rows"
    if rows_folder.exists() and not given.resume:
        raise BadInput(f"{out} holds results; go on with --resume, or choose another --out")
    rows_folder.mkdir(parents=True, exist_ok=True)
    wanted = [c for c in seeds.cases(given.split, given.n, seeds.read_ledger()) if _in_family(c, given.family)]
    for case in wanted:
        path = rows_folder / f"{case.name}.json"
        if not path.exists():
            row = run_case(case, out / "work" / case.name, given)
            path.with_suffix(".part").write_text(json.dumps(row, indent=1) + "\n")
            path.with_suffix(".part").rename(path)
            print(f"{case.name}: {row.get('failed') or 'done'}", file=sys.stderr, flush=True)
    text = table([json.loads((rows_folder / f"{c.name}.json").read_text()) for c in wanted], given.split)
    (out / "table.md").write_text(text + "\n")
    print(text)
    return 0


def _in_family(case: Case, family: str | None) -> bool:
    return family is None or FAMILIES[case.number % len(FAMILIES)] == family


def run_case(case: Case, work: Path, given: argparse.Namespace) -> dict[str, Any]:
    """One session from its seed to its row; whatever goes wrong is in the row, and nothing is left in `work`."""
    spec = draw(case, given.tosses)
    row: dict[str, Any] = {
        "case": case.name, "seed": case.seed, "family": "mesh" if given.objects else spec.family, "commit": _commit(),
        "spec": spec.to_json(), "runs": {},
    }  # fmt: skip
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    folder, began, cpu = work / case.name, time.time(), _cpu_s()
    try:
        folder, truth = _made(spec, folder, given)
        row["made"] = {"wall_s": round(time.time() - began, 1), "cpu_s": round(_cpu_s() - cpu, 1)}
        row["physics"] = json.loads((truth / "physics.json").read_text())
        imported = work / "imported" / case.name
        import_folder(folder, imported, None, None)
        row["floor_cm"] = marks.fusion_floor_cm(imported, truth, work / "floor")
        row["runs"][given.variant] = _processed(imported, truth, work / "ours", ["--variant", given.variant])
        row["runs"][BASELINE] = _processed(imported, truth, work / "baseline", ["--tracker", BASELINE])
    except BadInput as wrong:
        row["failed"] = f"skipped: {wrong}"
    except Exception as wrong:  # a session that crashes is a row of the table, not the end of it
        row["failed"] = (
            f"crashed: {type(wrong).__name__}: {wrong} ({traceback.format_exc(limit=-1).splitlines()[-3].strip()})"
        )
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return row


def _made(spec: Spec, folder: Path, given: argparse.Namespace) -> tuple[Path, Path]:
    """A session and its truth: the one that is kept, where there is one of this spec, or else made in `folder`."""
    if given.sessions is None:
        return folder, session.make(spec, folder, given.objects, Console(spec.name), given.threads)
    kept = given.sessions / spec.name
    truth = kept.with_name(spec.name + SUFFIX)
    told = truth / "spec.json"
    if not (kept.exists() and told.exists() and json.loads(told.read_text()) == json.loads(json.dumps(spec.to_json()))):
        made = session.make(spec, folder, given.objects, Console(spec.name), given.threads)
        given.sessions.mkdir(parents=True, exist_ok=True)
        for source, to in ((folder, kept), (made, truth)):
            shutil.rmtree(to, ignore_errors=True)
            shutil.move(source, to)
    return kept, truth


def _processed(imported: Path, truth: Path, out: Path, options: Sequence[str]) -> Mapping[str, Any]:
    """toss-process in a process of its own, without truth; then the marks."""
    command = [sys.executable, "-c", PROCESS, str(imported), "--out", str(out), *options]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    told: dict[str, Any] = {"cpu_s": round(stage_cpu_s(out), 1)}
    if done.returncode not in (0, 1):
        return told | {"failed": f"exit code {done.returncode}: {(done.stderr or done.stdout).strip()[-500:]}"}
    try:
        return told | {"marks": asdict(marks.read_marks(out, imported, truth)), "warnings": _warnings(out)}
    except TosslabError as wrong:
        return told | {"failed": f"no result: {wrong}"}


def stage_cpu_s(out: Path) -> float:
    """CPU seconds of all stages of a run. (Its workers outlive it, so that nobody waits for them who could ask.)"""
    return sum(float(json.loads(stage.read_text())["cpu_seconds"]) for stage in out.glob("*/stage.json"))


def _warnings(out: Path) -> list[str]:
    from recordings.results.folder import Results

    return [notice.text for notice in Results.open(out).find().warnings]


def _cpu_s() -> float:
    """CPU seconds of this process and of those it waited for."""
    own, others = (resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime


def _commit() -> str:
    if shutil.which("git") is None:
        return "unknown"
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    return done.stdout.strip() or "unknown"


if __name__ == "__main__":
    sys.exit(main())
