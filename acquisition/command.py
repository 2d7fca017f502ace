"""What `toss-record` does, step by step."""

from __future__ import annotations

import argparse
import contextlib
import datetime
import platform
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from importlib import metadata
from pathlib import Path
from typing import Any

from acquisition.arm.throw import Thrower
from acquisition.disk import free_bytes
from acquisition.interrupts import Interrupts
from acquisition.live import LiveSession, require_follower
from acquisition.operator import Keyboard, Nobody, Operator, Unattended, single_keys
from acquisition.preflight import Preflight, of_recording, preflight
from acquisition.ready_rig import Setup, with_factory_models
from acquisition.rig import Rig
from acquisition.run import Options, SessionReport, SessionRun
from acquisition.setup import set_up
from acquisition.streaming.clock import SessionClock
from acquisition.streaming.recorder import Recorder
from recordings.console import DONE, FELL_SHORT, Outcome, progress_for
from recordings.errors import BadInput
from recordings.session_resume import next_toss, resume_session
from recordings.session_writer import SessionWriter, toss_name

WARM_UP_S = 2.0
RESUMED_AFTER_NS = 10_000_000_000


def run(args: argparse.Namespace) -> Outcome:
    """Everything between the arguments and the exit code."""
    if args.doctor:
        return _doctor(args.out or Path())
    if args.tosses < 1:
        raise BadInput(f"--tosses {args.tosses}; wanted 1 or more")
    if args.live:
        _refuse_live(args)
    setup = set_up(args.rig)
    if args.between:
        config = replace(setup.rig.recording, between_tosses=True)
        setup = replace(setup, rig=replace(setup.rig, recording=config))
    setup = at_speed(setup, args.speed)
    if args.dry_run:
        return _dry_run(setup, args.tosses, args.speed)
    operator = the_operator(setup, args)
    out = args.out if args.out is not None else new_folder(setup.rig, args.object)
    check_folder(out, args.resume)
    check_room(out, setup.rig.recording.reserve_gb)
    with Interrupts() as interrupts, single_keys(sys.stdin):
        report, checks, live = _record(args, setup, out, operator, interrupts)
    if setup.lab is not None and report.takes:
        from acquisition.synthetic.truth_sidecar import write_sidecar

        write_sidecar(setup.lab, out)
    if live is None:
        return outcome(report, checks)
    live.wait()
    done = outcome(report, checks)
    return replace(done, document={**done.document, "live": live.document()})


def _record(
    args: argparse.Namespace, setup: Setup, out: Path, operator: Operator, interrupts: Interrupts
) -> tuple[SessionReport, Preflight, LiveSession | None]:
    first = next_toss(out) if args.resume else 0
    clock = new_clock(out)
    recorder = Recorder(setup.rig, setup.devices, clock)
    live: LiveSession | None = None
    with contextlib.ExitStack() as open_things:
        if setup.lab is not None and args.calibration:
            show = setup.lab.show
            views = show.hand_eye_views if args.calibration == "hand-eye" else show.board_views
            setup.lab.stage.set_up(views(progress_for("preparing the simulated lab")))
        elif setup.lab is not None:
            setup.thrower.prepare(first, 0, progress_for("preparing the simulated lab"))
        open_things.enter_context(recorder)
        setup = replace(setup, calibration=with_factory_models(setup.calibration, recorder.devices.values()))
        if args.preview:
            open_things.enter_context(_preview(recorder))
        if setup.live:
            time.sleep(WARM_UP_S)
            checks = preflight(recorder, setup.calibration, out)
        else:
            checks = of_recording(recorder, setup.calibration, out)
        operator.say(checks.text())
        _go_on(checks, operator)
        thrower = setup.thrower if args.calibration else make_thrower(setup, recorder, operator, args.speed)
        measured = {} if args.calibration else thrower.get_ready()
        start = {**start_document(args, setup, clock, recorder, checks), **measured}
        with interrupts.shield():
            session = open_things.enter_context(open_session(out, start, setup, args.resume, operator))
        if args.calibration:
            from acquisition.views import record_views

            report = record_views(recorder, session, setup, args.calibration, operator, interrupts)
        else:
            if args.live:
                live = LiveSession(out, operator, recorder, pose=args.live == "pose")
                open_things.enter_context(live)
            session_run = SessionRun(
                recorder, thrower, session, setup.calibration, operator, progress_for("preparing"), interrupts
            )
            report = session_run.record(Options(args.tosses, first))
        with interrupts.shield():
            session.finish("complete" if not report.stopped else "stopped", report.stopped)
    for trouble in recorder.troubles():
        operator.say(f"{trouble.device}: {trouble.kind}: {trouble.text}")
    return report, checks, live


def _refuse_live(args: argparse.Namespace) -> None:
    """Raises BadInput where --live cannot be."""
    require_follower()
    if args.calibration:
        raise BadInput(f"--live looks at tosses; --calibration {args.calibration} records none: leave one of them out")


def _doctor(folder: Path) -> Outcome:
    from acquisition.doctor import doctor

    found = doctor(folder)
    rows = [asdict(row) for row in found.rows]
    return Outcome({"rows": rows}, found.text(), FELL_SHORT if found.failed else DONE)


def the_operator(setup: Setup, args: argparse.Namespace) -> Operator:
    """Who is asked. Raises BadInput for an arm that would move without anybody, before anything is opened."""
    moves = setup.moves_arm and not args.calibration
    if moves:
        from acquisition.arm.thrower import safe_to_move

        safe_to_move(setup.rig, setup.calibration)
    if not args.yes:
        return Keyboard()
    if not moves:
        return Nobody()
    if not setup.rig.unattended:
        raise BadInput(
            f"{setup.rig.source}: --yes would move a real arm without asking; nothing was moved. Leave --yes out and "
            "stay at the keys, or write `unattended = true` into the rig file where nobody can come near the arm "
            "(docs/safety.md)"
        )
    return Unattended()


def at_speed(setup: Setup, speed: float) -> Setup:
    """The set-up for motions at `speed`: slower tosses are longer takes. Raises BadInput for a speed that is none."""
    if not 0 < speed <= 1:
        raise BadInput(f"--speed {speed:g}; wanted more than 0 and at most 1, e.g. --speed 0.1 for a first session")
    if speed == 1:
        return setup
    if not setup.moves_arm:
        raise BadInput(
            f"--speed {speed:g} slows a real arm that tosses; rig '{setup.rig.name}' moves none: leave it out"
        )
    config = replace(setup.rig.recording, longest_toss_s=setup.rig.recording.longest_toss_s / speed)
    return replace(setup, rig=replace(setup.rig, recording=config))


def _dry_run(setup: Setup, tosses: int, speed: float) -> Outcome:
    """Plans only: what would be tossed, and how near to the limits."""
    thrower = make_thrower(setup, None, Nobody(), speed)
    planned = []
    for toss in range(tosses):
        plan = thrower.plan(toss) if hasattr(thrower, "plan") else None
        if plan is None:
            raise BadInput(f"rig '{setup.rig.name}' plans no tosses: its tosses are made by hand")
        planned.append(
            {
                "toss": toss,
                "seconds": plan.trajectory.duration_s,
                "release_s": plan.release_s,
                "command_s": plan.command_s,
                "window_s": plan.window_s,
                "position_m": plan.world_from_tool.translation_m.tolist(),
                "velocity_m_s": plan.linear_velocity_world_m_s.tolist(),
                "spin_rad_s": plan.angular_velocity_world_rad_s.tolist(),
            }
        )
    lines = [
        f"{toss_name(p['toss'])}  {p['seconds']:.2f} s, release at {p['release_s']:.3f} s "
        f"(told at {p['command_s']:.3f} s), window {1e3 * p['window_s']:.0f} ms, velocity "
        + " ".join(f"{v:+.2f}" for v in p["velocity_m_s"])
        + " m/s"
        for p in planned
    ]
    lines += _unchecked(setup)
    return Outcome({"tosses": planned}, "\n".join([*lines, "nothing moved, nothing was written"]))


def _unchecked(setup: Setup) -> list[str]:
    """What plans of a real arm did not know."""
    lines = []
    if setup.moves_arm and setup.calibration.find("world", "base") is None:
        lines.append("not calibrated: planned from world_from_base of the rig file; no arm is moved by it")
    if setup.moves_arm and setup.rig.workspace is None:
        lines.append("no [workspace]: only the arm itself and the table were kept clear; no arm is moved without it")
    return lines


def make_thrower(setup: Setup, recorder: Recorder | None, operator: Operator, speed: float) -> Thrower:
    """The simulated lab's own, the arm of a rig with [toss], or a person's hand."""
    if not setup.moves_arm:
        return setup.thrower
    from acquisition.arm.thrower import real_thrower

    return real_thrower(setup.rig, setup.calibration, recorder, operator, speed)


def _preview(recorder: Recorder) -> contextlib.AbstractContextManager[object]:
    from acquisition.preview import Preview

    return Preview(recorder)


def _go_on(checks: Preflight, operator: Operator) -> None:
    """A failed check stops a run that nobody watches; a person may go on."""
    if not checks.failed:
        return
    said = "; ".join(f"{r.check} {r.subject}: {r.found}" for r in checks.failed)
    if operator.headless:
        raise BadInput(f"the preflight failed ({said}); nothing was written. Mend it, or run without --yes to decide")
    operator.say("the preflight failed. s: record all the same   q: quit")
    if operator.wait_for_start() == "quit":
        raise BadInput(f"the preflight failed ({said}); nothing was written")


def check_room(out: Path, reserve_gb: float) -> None:
    """Raises BadInput for a disk that is full before anything is opened."""
    place, free = free_bytes(out)
    if free < reserve_gb * 1e9:
        raise BadInput(
            f"{place} has {free / 1e9:.2f} GB free, less than the reserve of {reserve_gb:g} GB; nothing was written. "
            "Free some space or choose another folder"
        )


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
    from recordings.mcap.file import McapFile

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


def start_document(
    args: argparse.Namespace, setup: Setup, clock: SessionClock, recorder: Recorder, checks: Preflight
) -> dict[str, Any]:
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
        "preflight": [asdict(row) for row in checks.rows],
        **_board(args, setup),
        "versions": {
            "tosslab": metadata.version("tosslab"),
            "python": platform.python_version(),
            "system": platform.platform(),
        },
    }


def _board(args: argparse.Namespace, setup: Setup) -> dict[str, Any]:
    if not args.calibration:
        return {}
    from acquisition.views import board_document

    return {"board": board_document(setup)}


def outcome(report: SessionReport, checks: Preflight) -> Outcome:
    """What the command says at its end."""
    document = {
        "session": str(report.folder),
        "asked": report.asked,
        "accepted": report.accepted,
        "stopped": report.stopped,
        "preflight": [asdict(row) for row in checks.rows],
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
    if report.asked:
        lines.append(f"{report.accepted} of {report.asked} tosses are in {report.folder}")
    if report.stopped:
        lines.append(f"stopped: {report.stopped}")
    lines.append(f"next: toss-session verify {report.folder}")
    good = report.accepted >= report.asked and not (report.asked == 0 and report.stopped)
    return Outcome(document, "\n".join(lines), DONE if good else FELL_SHORT)
