"""What `toss-record` does, step by step."""

from __future__ import annotations

import argparse
import datetime
import platform
import sys
import time
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from acquisition.clock import SessionClock
from acquisition.interrupts import Interrupts
from acquisition.operator import Keyboard, Nobody, Operator, single_keys
from acquisition.recorder import Recorder
from acquisition.rig import Rig
from acquisition.run import Options, SessionReport, SessionRun
from acquisition.setup import Setup, set_up
from recordings.console import DONE, FELL_SHORT, Outcome, progress_for
from recordings.errors import BadInput
from recordings.session_resume import next_toss, resume_session
from recordings.session_writer import SessionWriter, toss_name

WARM_UP_S = 2.0
RESUMED_AFTER_NS = 10_000_000_000


def run(args: argparse.Namespace) -> Outcome:
    """Everything between the arguments and the exit code."""
    if args.tosses < 1:
        raise BadInput(f"--tosses {args.tosses}; wanted 1 or more")
    setup = set_up(args.rig)
    out = args.out if args.out is not None else new_folder(setup.rig, args.object)
    check_folder(out, args.resume)
    operator: Operator = Nobody() if args.yes else Keyboard()
    with Interrupts() as interrupts, single_keys(sys.stdin):
        report = _record(args, setup, out, operator, interrupts)
    if setup.lab is not None:
        from acquisition.synthetic.beside import write_beside

        write_beside(setup.lab, out)
    return outcome(report)


def _record(
    args: argparse.Namespace, setup: Setup, out: Path, operator: Operator, interrupts: Interrupts
) -> SessionReport:
    first = next_toss(out) if args.resume and out.exists() else 0
    setup.thrower.prepare(first, 0, progress_for("preparing the simulated lab"))
    clock = new_clock(out)
    recorder = Recorder(setup.rig, setup.devices, clock)
    with recorder:
        time.sleep(WARM_UP_S)
        session = open_session(out, start_document(args, setup, clock, recorder), setup, args.resume, operator)
        with session:
            session_run = SessionRun(
                recorder, setup.thrower, session, setup.calibration, operator, progress_for("preparing"), interrupts
            )
            report = session_run.record(Options(args.tosses, first))
            with interrupts.shield():
                session.finish("complete" if not report.stopped else "stopped", report.stopped)
    return report


def new_folder(rig: Rig, object_name: str) -> Path:
    """<data root>/<date>_<object>_<nn>, not there yet."""
    day = datetime.date.today().isoformat()
    for number in range(1, 1000):
        path = rig.data_root / f"{day}_{object_name}_{number:02d}"
        if not path.exists():
            return path
    raise BadInput(f"{rig.data_root} holds 999 sessions of {object_name} of today; give a folder: toss-record ... OUT")


def check_folder(out: Path, resume: bool) -> None:
    """Raises BadInput for a folder that would be written into without being asked."""
    empty = not out.exists() or (out.is_dir() and not any(out.iterdir()))
    if not empty and not resume:
        raise BadInput(f"{out} exists already; nothing was written. Go on with it by --resume, or choose another name")
    if resume and not (out / "session.json").is_file():
        raise BadInput(f"{out} is no session to go on with: it has no session.json; leave --resume out")


def new_clock(out: Path) -> SessionClock:
    """Session time starts at 0; a resumed session goes on after its latest file."""
    starts_ns = 0
    for path in sorted(out.glob("*.mcap")) if out.exists() else []:
        starts_ns = max(starts_ns, _last_ns(path) + RESUMED_AFTER_NS)
    return SessionClock(time.monotonic_ns(), time.time_ns(), starts_ns)


def _last_ns(path: Path) -> int:
    from recordings.mcap_file import McapFile

    try:
        with McapFile(path) as file:
            ends = [file.topic_index(topic).log_time_ns for topic in file.channels]
            return max((int(times[-1]) for times in ends if len(times)), default=0)
    except BadInput:
        return 0  # cut off: what can be saved of it is older than the next toss all the same


def open_session(out: Path, start: Mapping[str, Any], setup: Setup, resume: bool, operator: Operator) -> SessionWriter:
    if not resume:
        return SessionWriter(out, start, setup.calibration)
    session, recovered = resume_session(out)
    for report in recovered:
        operator.say(f"{report.source}: was cut off; what could be read of it is kept beside its bytes (.cut)")
    return session


def start_document(args: argparse.Namespace, setup: Setup, clock: SessionClock, recorder: Recorder) -> dict[str, Any]:
    """Who, what, with which devices and settings, and the one reading of the wall clock."""
    rig = setup.rig
    described = {name: device.describe() for name, device in recorder.devices.items()}
    return {
        "name": args.out.resolve().name if args.out is not None else "",
        "who": args.operator or "toss-record",
        "object": {"name": args.object},
        "clock": {"source": "host monotonic clock", "anchor": clock.anchor, "stamps": "device clocks, mapped"},
        "rig": {
            "name": rig.name,
            "file": rig.source.name,
            "text": rig.source.read_text() if rig.source.is_file() else "",
            "cameras": [d.name for d in rig.devices if d.kind in ("rgbd", "mono")],
            "arm": {"panda": "franka_panda", "ur5e": "ur5e"}.get(rig.robot or ""),
            "devices": described,
        },
        "versions": {
            "tosslab": metadata.version("tosslab"),
            "python": platform.python_version(),
            "system": platform.platform(),
        },
    }


def outcome(report: SessionReport) -> Outcome:
    """What the command says at its end."""
    document = {
        "session": str(report.folder),
        "asked": report.asked,
        "accepted": report.accepted,
        "stopped": report.stopped,
        "tosses": [
            {
                "toss": t.toss,
                "decision": t.decision,
                "verdict": t.verdict.text(),
                "seconds": t.seconds,
                "bytes": t.bytes,
                "ended_by": t.ended_by,
                "events": {e.kind: e.time_ns for e in t.events.records()},
                "streams": {
                    topic: {
                        "received": c.received,
                        "written": c.written,
                        "dropped": dict(c.dropped),
                        "missed": c.missed,
                    }
                    for topic, c in t.counts.items()
                },
            }
            for t in report.takes
        ],
    }
    lines = [f"{toss_name(t.toss)}  {t.decision:<7} {t.seconds:5.1f} s  {t.bytes / 1e6:6.1f} MB" for t in report.takes]
    lines.append(f"{report.accepted} of {report.asked} tosses are in {report.folder}")
    if report.stopped:
        lines.append(f"stopped: {report.stopped}")
    lines.append(f"next: toss-session verify {report.folder}")
    good = report.accepted >= report.asked
    return Outcome(document, "\n".join(lines), DONE if good else FELL_SHORT)
