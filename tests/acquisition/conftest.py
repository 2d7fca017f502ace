"""A small simulated lab whose pictures cost nothing, and one take recorded with it."""

from __future__ import annotations

import os
import pty
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from acquisition.drivers.aravis import Aravis
from acquisition.drivers.synthetic import SyntheticLab, SyntheticThrower
from acquisition.operator import Nobody
from acquisition.rig import DeviceEntry, RecordingConfig, Rig
from acquisition.run import Options, SessionReport, SessionRun, TossReport
from acquisition.streaming.clock import SessionClock
from acquisition.streaming.recorder import Recorder
from acquisition.streaming.streams import Tally
from acquisition.synthetic.lab_config import SyntheticConfig
from acquisition.verdict import Verdict
from recordings.errors import DeviceNotFound
from recordings.progress import Silent
from recordings.session_writer import SessionWriter

SMALL = SyntheticConfig(
    pictures="pool",
    color_size=(212, 120),
    mono_size=(160, 120),
    mono_cameras=1,
    wrap_after_s=-1.0,
    buffer_frames=150,  # the machine that tests may stop a process for seconds
)
PATIENT_S = 1.5
WARM_UP_S = 0.7


class OwnTime:
    """Seconds that passed, less those in which a busy machine let this process do nothing.

    A second thread only sleeps, a hundredth of a second at a time: what it oversleeps, others had the machine.
    """

    NAP_S = 0.01

    def __enter__(self) -> OwnTime:
        self.seconds = self.stopped_s = 0.0
        self._over = threading.Event()
        self._watch = threading.Thread(target=self._nap, daemon=True)
        self._watch.start()
        self._began = time.monotonic()
        return self

    def __exit__(self, *exc: object) -> None:
        self.seconds = time.monotonic() - self._began - self.stopped_s
        self._over.set()

    def _nap(self) -> None:
        before = time.monotonic()
        while not self._over.wait(self.NAP_S):
            now = time.monotonic()
            overslept_s = now - before - self.NAP_S
            self.stopped_s += overslept_s if overslept_s > self.NAP_S else 0.0
            before = now


@pytest.fixture
def own_time() -> type[OwnTime]:
    """`with own_time() as spent: ...` then `spent.seconds`."""
    return OwnTime


class Deciding(Nobody):
    """Keeps the recorder's verdict, never tries again, writes down what it is told."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[str] = []

    def say(self, text: str) -> None:
        self.told.append(text)

    def decide(self, verdict: Verdict) -> Any:
        return verdict.decision


@dataclass
class Recorded:
    """What became of a session in a test."""

    folder: Path
    report: SessionReport
    tallies: Mapping[str, Tally]
    clocks: Mapping[str, Any]
    operator: Deciding
    seconds: float
    """OwnTime of all takes."""
    lab: SyntheticLab = field(repr=False)

    @property
    def take(self) -> TossReport:
        return self.report.takes[0]


def small_rig(**recording: Any) -> Rig:
    devices = (
        DeviceEntry("d455", "rgbd", "synthetic"),
        DeviceEntry("mono0", "mono", "synthetic"),
        DeviceEntry("arm", "arm", "synthetic", rate_hz=200.0),
        DeviceEntry("gripper", "gripper", "synthetic", rate_hz=50.0),
    )
    config = replace(
        RecordingConfig(countdown_s=0.0, pre_trigger_s=0.3, queue_s=4.0, longest_gap_s=PATIENT_S, redo_at_most=0),
        **recording,
    )
    return Rig("small", devices, Path("small.toml"), "panda", recording=config)


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Recorded]:
    """record(inject=lambda lab: lab.faults("d455").inject("gap", at_s=0.4)): takes of a second each, in `folder`."""

    def run(
        inject: Callable[[SyntheticLab], object] = lambda lab: None,
        *,
        seconds: float = 1.0,
        tosses: int = 1,
        name: str = "session",
        config: SyntheticConfig = SMALL,
        before: Callable[[SyntheticLab], object] = lambda lab: None,
        operator: Deciding | None = None,
        **recording: Any,
    ) -> Recorded:
        lab = SyntheticLab(config)
        rig = small_rig(**recording)
        thrower = SyntheticThrower(lab)
        thrower.prepare(0, 0, Silent())
        devices = {d.name: lab.device(d.name, d.kind, d.rate_hz) for d in rig.devices}
        recorder = Recorder(rig, devices, SessionClock(time.monotonic_ns(), time.time_ns()))
        operator = operator or Deciding()
        folder = tmp_path / name
        before(lab)
        with recorder:
            time.sleep(WARM_UP_S)
            with SessionWriter(folder, {"object": {"name": "cube"}}, lab.show.calibration()) as session:
                inject(lab)
                whole = SessionRun(recorder, thrower, session, lab.show.calibration(), operator, Silent())
                with OwnTime() as spent:
                    report = whole.record(Options(tosses, fixed_s=seconds))
                session.finish("complete" if not report.stopped else "stopped", report.stopped)
            clocks = recorder.clocks()
        return Recorded(folder, report, recorder.tallies(), clocks, operator, spent.seconds, lab)

    return run


@pytest.fixture
def needs_aravis() -> None:
    try:
        Aravis.get()
    except DeviceNotFound as missing:
        pytest.skip(str(missing))


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """The typing end of a terminal whose other end is standard input."""
    typing, listening = pty.openpty()
    with open(listening, closefd=False) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield typing
    os.close(typing)
    os.close(listening)
