"""Stage `rig`: what the recording itself says about the rig, once a session.

Where the robot really stands, how late its clock runs, and by how much the depth camera reports too far: rig.json
holds it. The pipeline's stages take the frames through `processing.sensor.frames`, with their depth corrected.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Bool
from numpy import ndarray as Array

from processing.segment.background.depth_scale import DepthScaleSettings, TableScale, believed, table_scale
from processing.segment.background.foreground import kernel
from processing.segment.background.static_scene import StaticScene
from processing.segment.robot.fit import RobotFit, RobotFitSettings, Sight, choose_sights, fit_robot
from processing.segment.robot.render import RobotView
from processing.store import Counts, Done
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform
from recordings.robot.arm import PANDA_TOOL, ArmPath, panda
from recordings.session import Session

if TYPE_CHECKING:
    from processing.pipeline import Run

CAMERA = "d455"
BASE = "base"
HALF_STEP_NS = 5_000_000


@dataclass(frozen=True)
class RigSettings:
    """How the rig is checked against the recording."""

    robot: RobotFitSettings = field(default_factory=RobotFitSettings)
    scale: DepthScaleSettings = field(default_factory=DepthScaleSettings)


@dataclass(frozen=True, eq=False)
class Rig:
    """The result. `camera_from_base` is None where no robot is known; `arm_delay_s` is added to an image's time before
    the joints are asked. `depth_scale` is what depth is to be divided by: 1 where the estimate is not significant;
    `estimated_scale` and `scale_sigma` are the estimate itself (NaN where nothing tells)."""

    camera_from_base: Transform | None
    arm_delay_s: float
    depth_scale: float
    estimated_scale: float
    scale_sigma: float

    @staticmethod
    def read(folder: Path) -> Rig:
        """From a finished stage's folder."""
        stored = json.loads((folder / "rig.json").read_text())
        matrix = stored["camera_from_base"]
        base = None if matrix is None else Transform.from_matrix(CAMERA, BASE, np.array(matrix))
        estimate = [float("nan") if stored[k] is None else float(stored[k]) for k in ("estimated_scale", "scale_sigma")]
        return Rig(base, float(stored["arm_delay_s"]), float(stored["depth_scale"]), *estimate)


class RobotOfSession:
    """The robot of a session, where it can be drawn: joint states of a known arm, and a calibrated base.

    `missing` says why there is none; None where there is one.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self.camera_from_base = session.calibration.find(CAMERA, BASE)

    def path(self, toss: int) -> ArmPath | None:
        """The arm's path in a toss; None where it was not recorded, or is not the arm that is known here."""
        if toss not in self._paths:
            states = self._session.toss(toss).arm_states()
            try:
                self._paths[toss] = None if states is None else ArmPath(panda(), states)
            except BadInput:
                self._paths[toss] = None
        return self._paths[toss]

    @cached_property
    def _paths(self) -> dict[int, ArmPath | None]:
        return {}

    def hides(
        self, view: RobotView, camera: CameraModel, toss: int, time_ns: int, margin_px: int, held_m: float
    ) -> Bool[Array, "h w"]:
        """Pixels that the robot may hide, or what it holds: its drawing by the calibration with a wide margin, and
        all within `held_m` of the tool."""
        path = self.path(toss)
        nothing = np.zeros((camera.height, camera.width), dtype=bool)
        if path is None or self.camera_from_base is None or not path.covers(time_ns):
            return nothing
        root = self.camera_from_base @ Transform.identity(BASE, path.robot.root)
        links = {name: root @ link for name, link in path.links(time_ns).items()}
        drawn = (view.draw(links).depth_m > 0).astype(np.uint8)
        tool_m = links[PANDA_TOOL].translation_m
        if tool_m[2] > held_m and path.may_hold(time_ns):
            center = np.round(camera.project(tool_m[None])[0]).astype(int)
            cv2.circle(drawn, (int(center[0]), int(center[1])), int(camera.fx * held_m / tool_m[2]), 1, -1)
        return cv2.dilate(drawn, kernel(margin_px)) > 0

    def missing(self, tosses: tuple[int, ...]) -> str | None:
        """Why no robot can be drawn in any of these tosses."""
        if all(self.path(t) is None for t in tosses):
            named = [s.joint_names for t in tosses if (s := self._session.toss(t).arm_states()) is not None]
            other = f"; the recorded joints are {', '.join(named[0])}" if named else ""
            return f"no joint states of a Franka Panda in these tosses{other}"
        return "no base pose in the calibration" if self.camera_from_base is None else None


def rig_stage(run: Run, scene: Done) -> Done:
    """Stage `rig`, from frames of all tosses of the run and the static scene."""
    inputs = {"scene": scene.key, "calibration": run.keys["calibration"]}
    inputs |= {f"toss_{t:02d}": run.keys[f"toss_{t:02d}"] for t in run.recorded}
    return run.store.run("rig", 1, run.config.rig, inputs, lambda folder: _check_rig(run, scene, folder))


def _check_rig(run: Run, scene: Done, folder: Path) -> Counts:
    learned = StaticScene.read(scene.folder)
    table = _table(run, learned)
    robot = RobotOfSession(run.session)
    why_not = robot.missing(run.recorded)
    fit = None if why_not else _fit(run, robot, learned, table)
    scale, sigma = _scale(fit, table)
    used = believed(scale, sigma, run.config.rig.scale)
    base = fit.camera_from_base if fit is not None else robot.camera_from_base
    document = {
        "camera_from_base": None if why_not or base is None else base.matrix.tolist(),
        "arm_delay_s": 0.0 if fit is None else fit.delay_s,
        "depth_scale": used,
        "estimated_scale": _finite(scale),
        "scale_sigma": _finite(sigma),
    }
    (folder / "rig.json").write_text(json.dumps(document, indent=1) + "\n")
    counts = {"depth_scale": round(used, 5), "estimated_scale": _finite(scale), "scale_sigma": _finite(sigma)}
    return {**counts, "table": _table_counts(table), "robot": why_not or _robot_counts(fit, robot.camera_from_base)}


def _table(run: Run, scene: StaticScene) -> TableScale | None:
    world_from_camera = run.session.calibration.find("world", CAMERA)
    if world_from_camera is None:
        return None
    return table_scale(scene, run.session.calibration.camera(CAMERA), world_from_camera, run.config.rig.scale)


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

    chosen = choose_sights([len(s) for s in streams], speed, run.config.rig.robot)
    sights = [Sight(streams[t][i], path) for t, i in chosen if (path := paths[t]) is not None]
    camera, progress = run.session.calibration.camera(CAMERA), run.progress("robot")
    prior = None if table is None else (table.scale, table.sigma)
    return fit_robot(sights, camera, robot.camera_from_base, scene, run.config.rig.robot, prior, progress.step)


def _scale(fit: RobotFit | None, table: TableScale | None) -> tuple[float, float]:
    """The best estimate of the scale and its standard deviation: the robot's holds the table's as its prior."""
    if fit is not None and fit.refused is None:
        return fit.depth_scale, float(np.hypot(fit.sigma[-1], 0.0003))
    return (table.scale, table.sigma) if table is not None else (float("nan"), float("nan"))


def _finite(value: float) -> float | None:
    return round(value, 6) if np.isfinite(value) else None


def _table_counts(table: TableScale | None) -> Mapping[str, Any] | str:
    if table is None:
        return "the table is not seen, or its place is not calibrated"
    return {"scale": round(table.scale, 5), "sigma": round(table.sigma, 5), "tilt_deg": round(float(table.tilt_deg), 3)}


def _robot_counts(fit: RobotFit | None, calibrated: Transform | None) -> Mapping[str, Any] | str:
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
