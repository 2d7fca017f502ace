"""`toss-record --live pose`: the newest frame's pose, for as long as somebody records. Runs beside the follower, whose
shape so far it knows."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy import ndarray as Array

from processing.live.follow import alive
from processing.live.pose.front import LivePose, PoseFront
from processing.live.pose.serve import PoseFile, PoseServer, pose_line
from processing.run import CAMERA
from processing.segment.background.static_scene import StaticScene
from recordings.alignment.align import align_depth
from recordings.bounded.documents import as_dict, read_json
from recordings.console import Outcome
from recordings.errors import TosslabError
from recordings.live_frames import FrameBoardReader, LiveFrame
from recordings.records import RgbdFrame
from recordings.results.live import live_folder
from recordings.results.shape_file import read_shape
from recordings.session import Session
from recordings.tracks import RigCalibration
from recordings.whole_file import changed_ns

NICE = 5
IDLE_S = 0.002
STILL_FRAMES, STILL_M = 15, 0.002
"""The object stands still where its center moved less in so many frames: then a newer shape may be taken."""


@dataclass
class Counts:
    """What became of the frames."""

    frames: int = 0
    posed: int = 0
    worst_ms: float = 0.0


def serve_poses(session: Path, frames: Path, recorder: int) -> Outcome:
    """Until the recorder is gone. Raises BadInput where `session` is none, or `frames` are none."""
    with Session.open(session) as opened:
        calibration = opened.calibration
    os.nice(NICE)
    folder, reader, counts = live_folder(session), FrameBoardReader(frames), Counts()
    model = _Model(folder, calibration)
    with PoseServer(folder / "pose.json") as server, PoseFile(folder / "pose.mcap", calibration, CAMERA) as file:
        while alive(recorder) and (frames.exists() or not counts.frames):
            model.renew()
            frame = reader.newest()
            if frame is None or model.front is None:
                time.sleep(IDLE_S)
                continue
            pose = model.see(as_rgbd(frame, calibration))
            latency_ms = (time.monotonic_ns() - frame.host_ns) / 1e6
            server.send(pose_line(pose, CAMERA, latency_ms))
            file.write(pose)
            counts.frames += 1
            counts.posed += pose.camera_from_object is not None
            counts.worst_ms = max(counts.worst_ms, latency_ms)
    document = {**vars(counts), "missed": reader.missed}
    text = f"live pose: {counts.posed} of {counts.frames} frames, {reader.missed} passed over"
    return Outcome(document, text)


def as_rgbd(frame: LiveFrame, calibration: RigCalibration) -> RgbdFrame:
    """Depth in metres, aligned to colour, as a recorded frame has it."""
    depth_m: Float32[Array, "h w"] = frame.depth_raw.astype(np.float32) * np.float32(frame.unit_m)
    depth_camera = calibration.cameras.get(f"{CAMERA}_depth")
    if depth_camera is not None:
        camera = calibration.camera(CAMERA)
        depth_m = align_depth(depth_m, depth_camera, camera, calibration.transform(camera.frame, depth_camera.frame))
    return RgbdFrame(CAMERA, frame.number, frame.time_ns, frame.depth_time_ns, frame.color_rgb, depth_m)


class _Model:
    """The shape so far, as the front knows it; a newer one is taken while the object stands still or is not tracked."""

    def __init__(self, folder: Path, calibration: RigCalibration) -> None:
        self._folder, self._calibration = folder, calibration
        self._of: int | None = None
        self._recent: list[Array] = []
        self.front: PoseFront | None = None

    def see(self, frame: RgbdFrame) -> LivePose:
        assert self.front is not None
        pose = self.front.see(frame)
        at = None if pose.camera_from_object is None else pose.camera_from_object[:3, 3]
        self._recent = [] if at is None else [*self._recent[1 - STILL_FRAMES :], at]
        return pose

    def renew(self) -> None:
        changed = changed_ns(self._folder / "shape.json")
        still = len(self._recent) == STILL_FRAMES and float(np.ptp(self._recent, axis=0).max()) < STILL_M
        if changed is None or changed == self._of or (self.front is not None and self.front.tracking and not still):
            return
        try:
            shape, background = read_shape(self._folder), StaticScene.read(self._folder)
            scale = float(as_dict(read_json(self._folder / "front.json")).get("depth_scale", 1.0))
        except (TosslabError, OSError, ValueError):
            return  # it is being written: the next time
        camera, world = self._calibration.camera(CAMERA), self._calibration.find("world", CAMERA)
        self.front = PoseFront(camera, shape, background, world, depth_scale=scale)
        self._of, self._recent = changed, []
