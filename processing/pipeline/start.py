"""Where a run begins: what it needs of its session is checked, and the fingerprints of its inputs are taken."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from processing.config import Config
from processing.engine.each import Engine
from processing.run import CAMERA, MakeProgress, Run
from processing.segment.background.static_scene import StaticScene
from processing.segment.robot.of_session import Rig
from processing.sensor.frames import corrected_depth
from processing.sensor.table_plane import with_table_from_depth
from processing.stages.recording.rig import refine_rig
from processing.stages.recording.scene import learn_static_scene
from processing.stages.recording.still import without_waiting
from processing.store import Store
from recordings.errors import BadInput
from recordings.notices import Notice
from recordings.session import Session
from recordings.whole_file import file_sha256


def start_run(
    session: Session,
    tosses: Sequence[int],
    results: Path,
    config: Config,
    tracker: str,
    progress: MakeProgress,
    device: str = "cpu",
    engine: Engine | None = None,
) -> Run:
    """The run of these tosses into a results folder, its stages computed by `engine` (here, in turn). Raises BadInput
    where the session lacks what vision needs."""
    if not tosses:
        raise BadInput(f"{session.path} has no tosses; wanted a session with toss_00.mcap and so on")
    if CAMERA not in session.calibration.cameras:
        raise BadInput(
            f"{session.path}: the calibration has no intrinsics of {CAMERA}; it has "
            f"{sorted(session.calibration.cameras) or 'no camera'}. Vision needs them"
        )
    keys = {f"toss_{t:02d}": file_sha256(session.file(t)) for t in tosses}
    physics = json.dumps(session.start.get("object"), sort_keys=True, default=str).encode()
    keys |= {"calibration": _calibration_key(session), "physics": hashlib.sha256(physics).hexdigest()}
    return without_waiting(Run(session, tuple(tosses), Store(results, engine), config, tracker, device, progress, keys))


def with_table(run: Run) -> Run:
    """The same run with the table that the depth of the empty scene shows (`--table-from-depth`), in the metres in
    which the object is tracked."""
    scene = learn_static_scene(run)
    reported_m, rig = StaticScene.read(scene.folder).depth_m, Rig.read(refine_rig(run, scene).folder)
    metric_m = corrected_depth(reported_m, rig.depth_scale)
    calibration, found = with_table_from_depth(run.session.calibration, CAMERA, metric_m)
    session = run.session.with_calibration(calibration)
    seen = f"the table is from depth ({100 * found['share']:.0f} % of it, spread {1e3 * found['spread_m']:.1f} mm)"
    notice = Notice("table", "low", seen, "gravity is taken to be its normal")
    return replace(run, session=session, keys={**run.keys, "calibration": _calibration_key(session)},
                   warnings=(*run.warnings, notice))  # fmt: skip


def _calibration_key(session: Session) -> str:
    return hashlib.sha256(json.dumps(session.calibration.to_json(), sort_keys=True).encode()).hexdigest()
