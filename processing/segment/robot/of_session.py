"""The robot of a session: its path in every toss, where it stands, and what of the picture it may hide."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool
from numpy import ndarray as Array

from processing.segment.background.foreground import kernel
from processing.segment.robot.render import RobotView
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform
from recordings.results.stage_files import stage_document, stage_file
from recordings.robot.arm import PANDA_TOOL, ArmPath, panda
from recordings.session import Session

CAMERA = "d455"
BASE = "base"


@dataclass(frozen=True, eq=False)
class Rig:
    """The result. `camera_from_base` is None where no robot is known; `arm_delay_s` is added to an image's time before
    the joints are asked. `depth_scale` is what depth is to be divided by: the posterior's mean;
    `estimated_scale` and `scale_sigma` are what the session alone says (NaN where it says nothing)."""

    camera_from_base: Transform | None
    arm_delay_s: float
    depth_scale: float
    estimated_scale: float
    scale_sigma: float

    @staticmethod
    def read(folder: Path) -> Rig:
        """From a finished stage's folder."""
        path = folder / "rig.json"
        stored = stage_document(path)
        with stage_file(path):
            matrix, scale = stored["camera_from_base"], [stored[k] for k in ("estimated_scale", "scale_sigma")]
            base = None if matrix is None else Transform.from_matrix(CAMERA, BASE, np.array(matrix))
            estimate = [float("nan") if x is None else float(x) for x in scale]
            return Rig(base, float(stored["arm_delay_s"]), float(stored["depth_scale"]), *estimate)


class RobotOfSession:
    """The robot of a session, where it can be drawn: joint states of a known arm, and a calibrated base.

    `missing` gives the reason why there is none; None where there is one.
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
