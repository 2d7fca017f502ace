"""Stage `rig`: what the recording itself says about the rig, once a session.

Where the robot really stands, how late its clock runs, and by how much the depth camera reports too far: rig.json
holds it (`segment/robot/of_session.py`: `Rig`).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from processing.run import CAMERA, Run
from processing.segment.background.depth_scale import TableScale, posterior_scale, table_scale
from processing.segment.background.static_scene import StaticScene
from processing.segment.robot.fit import RobotFit, RobotObservation, choose_observations, fit_robot
from processing.segment.robot.of_session import RobotOfSession
from processing.store import Done
from recordings.geometry import Transform
from recordings.robot.arm import PANDA_TOOL

VERSION = 4
HALF_STEP_NS = 5_000_000


@dataclass(frozen=True)
class RigResult:
    """Reported / true depth as it is used, the estimate and its standard deviation (None: nothing tells), and what the
    table and the robot said: figures, or why they said nothing."""

    depth_scale: float
    estimated_scale: float | None
    scale_sigma: float | None
    table: Any
    robot: Any


def refine_rig(run: Run, scene: Done) -> Done[RigResult]:
    """From frames of all tosses of the run and the static scene."""
    inputs = {"scene": scene.key, "calibration": run.keys["calibration"]}
    inputs |= {f"toss_{t:02d}": run.keys[f"toss_{t:02d}"] for t in run.recorded}
    return run.store.run("rig", VERSION, run.config.rig, inputs, RigResult, lambda folder: _refine(run, scene, folder))


def _refine(run: Run, scene: Done, folder: Path) -> RigResult:
    learned = StaticScene.read(scene.folder)
    table = _table(run, learned)
    robot = RobotOfSession(run.session)
    why_not = robot.missing(run.recorded)
    fit = None if why_not else _fit(run, robot, learned, table)
    scale, sigma = _scale(fit, table)
    used = posterior_scale(scale, sigma, run.config.rig.scale)
    base = fit.camera_from_base if fit is not None else robot.camera_from_base
    document = {
        "camera_from_base": None if why_not or base is None else base.matrix.tolist(),
        "arm_delay_s": 0.0 if fit is None else fit.delay_s,
        "depth_scale": used,
        "estimated_scale": _finite(scale),
        "scale_sigma": _finite(sigma),
    }
    (folder / "rig.json").write_text(json.dumps(document, indent=1) + "\n")
    said = why_not or _robot_counts(fit, robot.camera_from_base)
    return RigResult(round(used, 5), _finite(scale), _finite(sigma), _table_counts(table), said)


def _table(run: Run, scene: StaticScene) -> TableScale | None:
    if run.world_from_camera is None:
        return None
    return table_scale(scene, run.camera, run.world_from_camera, run.config.rig.scale)


def _fit(run: Run, robot: RobotOfSession, scene: StaticScene, table: TableScale | None) -> RobotFit | None:
    assert robot.camera_from_base is not None
    streams = [run.session.toss(t).rgbd(CAMERA) for t in run.recorded]
    paths = [robot.path(t) for t in run.recorded]

    def speed(toss: int, frame: int) -> float:
        path, at = paths[toss], int(streams[toss].times_ns[frame])
        if path is None or not path.covers(at):
            return float("nan")
        early, late = (path.links(at + d)[PANDA_TOOL].translation_m for d in (-HALF_STEP_NS, HALF_STEP_NS))
        return float(np.linalg.norm(late - early) / (2e-9 * HALF_STEP_NS))

    chosen = choose_observations([len(s) for s in streams], speed, run.config.rig.robot)
    observations = [RobotObservation(streams[t][i], path) for t, i in chosen if (path := paths[t]) is not None]
    camera, progress = run.camera, run.progress("robot")
    prior = None if table is None else (table.scale, table.sigma)
    return fit_robot(observations, camera, robot.camera_from_base, scene, run.config.rig.robot, prior, progress.step)


def _scale(fit: RobotFit | None, table: TableScale | None) -> tuple[float, float]:
    """The best estimate of the scale and its standard deviation: the robot's holds the table's as its prior."""
    if fit is not None and fit.refused is None:
        return fit.depth_scale, float(np.hypot(fit.sigma[-1], 0.0003))
    return (table.scale, table.sigma) if table is not None else (float("nan"), float("nan"))


def _finite(value: float) -> float | None:
    return round(value, 6) if np.isfinite(value) else None


def _table_counts(table: TableScale | None) -> dict[str, Any] | str:
    if table is None:
        return "the table is not seen, or its place is not calibrated"
    turned = {"table": round(table.turned_at_table, 5), "camera": round(table.turned_at_camera, 5)}
    return {"scale": round(table.scale, 5), "sigma": round(table.sigma, 5), "tilt_deg": round(table.tilt_deg, 3),
            "turned_at": turned}  # fmt: skip


def _robot_counts(fit: RobotFit | None, calibrated: Transform | None) -> dict[str, Any] | str:
    if fit is None or calibrated is None or fit.refused is not None:
        return f"place not refined: {fit.refused if fit is not None else 'no calibration'}"
    moved_m, turned_deg = fit.moved_from(calibrated)
    return {
        "moved_mm": round(1000 * moved_m, 2),
        "turned_deg": round(turned_deg, 3),
        "delay_ms": round(1000 * fit.delay_s, 2),
        "depth_residual_mm": [round(1000 * v, 2) for v in (fit.depth_before_m, fit.depth_after_m)],
        "outline_residual_px": [_finite(v) for v in (fit.outline_before_px, fit.outline_after_px)],
        "depth_samples": fit.depth_samples,
        "outline_samples": fit.outline_samples,
    }
