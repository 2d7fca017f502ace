"""The mask stages of the pipeline: the scene without the object, and the object's mask in every frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool
from numpy import ndarray as Array

from processing.backends import make_segmenter, settings_of
from processing.given_masks import chosen_masks
from processing.rig import CAMERA, Rig, RobotOfSession, rig_stage
from processing.segment.background import BackgroundSegmenter
from processing.segment.robot_frames import RobotFrames
from processing.segment.robot_view import RobotView
from processing.segment.segmenter import Example
from processing.segment.static_scene import StaticScene, calibrated_table_depth, learn_scene, sample_positions
from processing.stage import Counts, Done
from recordings.records import RgbdFrame
from recordings.results import write_masks
from recordings.robot import panda

if TYPE_CHECKING:
    from processing.pipeline import Run


def static_scene(run: Run) -> Done:
    """Stage `scene`: what the camera sees without the object, from frames of all tosses of the run."""
    inputs = {name: run.keys[name] for name in ("calibration", *(f"toss_{t:02d}" for t in run.tosses))}
    return run.store.run("scene", 3, run.config.scene, inputs, lambda folder: _learn_scene(run, folder))


def _learn_scene(run: Run, folder: Path) -> Counts:
    streams = [run.session.toss(t).rgbd(CAMERA) for t in run.tosses]
    chosen = sample_positions([len(s) for s in streams], run.config.scene.frames)
    progress = run.progress("static scene")

    def frames() -> Iterator[RgbdFrame]:
        for done, (toss, position) in enumerate(chosen):
            progress.step(done, len(chosen))
            yield streams[toss][position]

    hidden = _hidden_by_robot(run, [(run.tosses[t], int(streams[t].times_ns[i])) for t, i in chosen])
    table = calibrated_table_depth(run.session.calibration, CAMERA)
    scene = learn_scene(frames(), table, run.config.scene, hidden)
    scene.write(folder)
    return {
        "frames": len(chosen),
        "pixels_with_depth": int((scene.depth_m > 0).sum()),
        "known_share": round(float(scene.known.mean()), 4),
        "robot_left_out": hidden is not None,
    }


def _hidden_by_robot(run: Run, at: Sequence[tuple[int, int]]) -> list[Bool[Array, "h w"]] | None:
    """Where the robot, or what it holds, may stand in front of the scene, at (toss, time); None without a robot."""
    robot = RobotOfSession(run.session)
    if robot.missing(run.tosses) is not None:
        return None
    camera, settings = run.session.calibration.camera(CAMERA), run.config.scene
    view = RobotView(panda(), camera)
    return [robot.hides(view, camera, toss, time_ns, settings.robot_margin_px, settings.held_m) for toss, time_ns in at]


def object_masks(run: Run, toss: int, scene: Done) -> Done:
    """Stage `segment`: the object's mask in every frame of one toss."""
    name = f"toss_{toss:02d}"
    rig = rig_stage(run, scene)
    inputs = {"scene": scene.key, "rig": rig.key, name: run.keys[name], "calibration": run.keys["calibration"]}
    choice = run.config.given_masks
    given = chosen_masks(run.session.toss(toss).masks(), choice, toss == run.tosses[0])
    shown = None if given or choice == "none" else _toss_with_mask(run)
    if shown is not None:
        inputs["example"] = run.keys[f"toss_{shown:02d}"]

    def compute(folder: Path) -> Counts:
        frames = run.session.toss(toss).rgbd(CAMERA)
        learned = StaticScene.read(scene.folder)
        found_rig = Rig.read(rig.folder)
        drawn = _robot_frames(run, toss, found_rig)
        background = BackgroundSegmenter(learned, run.session.calibration.camera(CAMERA), run.config.masks, drawn)
        segmenter = make_segmenter(run.config.backends, background, run.device)
        robot = None if segmenter is background else drawn
        example = None if shown is None else _example(run, shown)
        progress = run.progress(f"toss {toss}: masks")
        found = sorted(segmenter.masks(frames, given, example, robot, progress), key=lambda m: m.position)
        write_masks(folder, toss, [m.mask for m in found], np.array([m.confidence for m in found]))
        if drawn is not None:
            drawn.write(folder / f"{name}.robot")
        empty = sum(not m.mask.any() for m in found)
        return {
            "frames": len(found),
            "empty": empty,
            "given": len(given),
            "without_depth": len(frames.without_depth),
            **background.counts,
            "robot": rig.counts["robot"] if drawn is None else "drawn",
        }

    named = settings_of(run.config.backends.segmenter, run.config.backends)
    config = {"given_masks": choice, "background": asdict(run.config.masks), **named}
    return run.store.run("segment", 2, config, inputs, compute)


def _robot_frames(run: Run, toss: int, rig: Rig) -> RobotFrames | None:
    """The robot in the frames of a toss; None where it is not known."""
    path = RobotOfSession(run.session).path(toss)
    if rig.camera_from_base is None or path is None:
        return None
    frames, camera = run.session.toss(toss).rgbd(CAMERA), run.session.calibration.camera(CAMERA)
    scale = rig.depth_scale
    return RobotFrames(frames, RobotView(path.robot, camera), path, rig.camera_from_base, rig.arm_delay_s, scale)


def _toss_with_mask(run: Run) -> int | None:
    """The first toss that came with a mask: it shows what the object looks like."""
    return next((t for t in run.tosses if run.session.toss(t).masks()), None)


def _example(run: Run, toss: int) -> Example:
    position, mask = min(run.session.toss(toss).masks().items())
    return Example(run.session.toss(toss).rgbd(CAMERA)[position], mask)
