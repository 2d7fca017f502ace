"""The mask stages of the pipeline: the scene without the object, and the object's mask in every frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool
from numpy import ndarray as Array

from processing.backends import make_segmenter, settings_of
from processing.given_masks import chosen_masks
from processing.segment.background.segmenter import NOT_FOUND, BackgroundSegmenter
from processing.segment.background.static_scene import (
    StaticScene,
    calibrated_table_depth,
    learn_scene,
    seen_table_depth,
)
from processing.segment.detect.candidates import Finder
from processing.segment.detect.detection import courses_of, look_of, read_sighting, sightings, write_sightings
from processing.segment.robot.frames import RobotFrames
from processing.segment.robot.render import RobotView
from processing.segment.segmenter import Example
from processing.stages.rig import CAMERA, Rig, RobotOfSession, rig_stage
from processing.stages.scene_frames import hidden_by_robot, keys_beside, read, scene_frames
from processing.store import Counts, Done
from recordings.errors import BadInput
from recordings.records import RgbdFrame
from recordings.results.folder import write_hand, write_masks
from recordings.session import RgbdFrames

if TYPE_CHECKING:
    from processing.pipeline import Run


def static_scene(run: Run) -> Done:
    """Stage `scene`: what the camera sees without the object, from frames of all tosses of the run and of those beside
    them in the session that can be read and show the same."""
    inputs = {name: run.keys[name] for name in ("calibration", *(f"toss_{t:02d}" for t in run.recorded))}
    inputs |= keys_beside(run)
    return run.store.run("scene", 6, run.config.scene, inputs, lambda folder: _learn_scene(run, folder))


def scene_notes(run: Run) -> tuple[str, ...]:
    """Which tosses of the session, not of the run, were of no use for the scene, and why."""
    left_out = static_scene(run).counts.get("left_out", {})
    return tuple(f"toss {t} gives no frames of the background: {why}" for t, why in left_out.items())


def _learn_scene(run: Run, folder: Path) -> Counts:
    found = scene_frames(run)
    progress = run.progress("static scene")

    def frames() -> Iterator[RgbdFrame]:
        for done, at in enumerate(found.chosen):
            progress.step(done, len(found.chosen))
            yield read(found, at)

    hidden = hidden_by_robot(run, [(t, int(found.streams[t].times_ns[i])) for t, i in found.chosen])
    table = calibrated_table_depth(run.session.calibration, CAMERA)
    # a plane that only depth tells helps to learn what is beneath the object; nobody takes it for a calibrated table
    seen = seen_table_depth([read(found, at).depth_m for at in found.chosen[:: max(1, len(found.chosen) // 9)]],
                            run.camera) if table is None else table  # fmt: skip
    scene = learn_scene(frames(), seen, run.config.scene, hidden, [t for t, _ in found.chosen])
    scene = replace(scene, table_depth_m=np.zeros_like(scene.table_depth_m)) if table is None else scene
    scene.write(folder)
    return {
        "frames": len(found.chosen),
        "tosses": sorted(found.streams),
        "left_out": {str(t): why for t, why in found.left_out.items()},
        "pixels_with_depth": int((scene.depth_m > 0).sum()),
        "known_share": round(float(scene.known.mean()), 4),
        "robot_left_out": hidden is not None,
    }


def object_masks(run: Run, toss: int, scene: Done) -> Done:
    """Stage `segment`: the object's mask in every frame of one toss."""
    name = f"toss_{toss:02d}"
    rig = rig_stage(run, scene)
    inputs = {"scene": scene.key, "rig": rig.key, name: run.keys[name], "calibration": run.keys["calibration"]}
    choice = run.config.given_masks
    given = _given(run, toss)
    found_in = None if given else finding(run, scene, rig)
    shown = None if given or choice == "none" else _toss_with_mask(run)
    if found_in is not None:
        inputs["found"] = found_in.key
    if shown is not None:
        inputs["example"] = run.keys[f"toss_{shown:02d}"]

    def compute(folder: Path) -> Counts:
        frames = run.session.toss(toss).rgbd(CAMERA)
        learned = StaticScene.read(scene.folder)
        found_rig = Rig.read(rig.folder)
        drawn = _robot_frames(run, toss, found_rig)
        sighting = None if found_in is None else read_sighting(found_in.folder, toss)
        if found_in is not None and sighting is None:
            return _not_found(frames, folder, toss)
        background = BackgroundSegmenter(learned, run.camera, run.config.masks, drawn, sighting)
        segmenter = make_segmenter(run.config.backends, background, run.device)
        robot = None if segmenter is background else drawn
        example = None if shown is None else _example(run, shown)
        progress = run.progress(f"toss {toss}: masks")
        found = sorted(segmenter.masks(frames, given, example, robot, progress), key=lambda m: m.position)
        write_masks(folder, toss, [m.mask for m in found], np.array([m.confidence for m in found]))
        if drawn is not None:
            drawn.write(folder / f"{name}.robot")
            write_hand(folder, toss, drawn.hand(frames.times_ns))
        empty = sum(not m.mask.any() for m in found)
        least = run.config.track.view.least_samples
        tracked = (m for m in found if m.mask.sum() >= least)
        with_depth = any((frames[m.position].depth_m[m.mask] > 0).sum() >= least for m in tracked)
        return {
            "frames": len(found),
            "empty": empty,
            "with_depth": with_depth,
            "given": len(given),
            "found_at": None if sighting is None else sighting.start,
            "elsewhere": [] if sighting is None else [list(span) for span in sighting.elsewhere],
            "without_depth": len(frames.without_depth),
            **background.counts,
            "robot": rig.counts["robot"] if drawn is None else "drawn",
        }

    named = settings_of(run.config.backends.segmenter, run.config.backends)
    config = {"given_masks": choice, "background": asdict(run.config.masks), **named}
    return run.store.run("segment", 6, config, inputs, compute)


def _given(run: Run, toss: int) -> dict[int, Bool[Array, "h w"]]:
    """The given masks of a toss that are used."""
    return chosen_masks(run.session.toss(toss).masks(), run.config.given_masks, toss == run.recorded[0])


def _not_found(frames: RgbdFrames, folder: Path, toss: int) -> Counts:
    """A toss in which the object was not found: empty masks."""
    first = frames[0].depth_m
    write_masks(folder, toss, [np.zeros(first.shape, dtype=bool)] * len(frames), np.zeros(len(frames)))
    return {"frames": len(frames), "empty": len(frames), "given": 0, "not_found": True}


def finding(run: Run, scene: Done, rig: Done) -> Done:
    """Stage `find`: where the object is in the tosses that come without a mask, told by all of them together.

    Raises BadInput where it is found in none, and none came with a mask.
    """
    inputs = {"scene": scene.key, "rig": rig.key, "calibration": run.keys["calibration"]}
    inputs |= {f"toss_{t:02d}": run.keys[f"toss_{t:02d}"] for t in run.recorded}
    config = {"given_masks": run.config.given_masks, **asdict(run.config.find)}
    return run.store.run("find", 5, config, inputs, lambda folder: _find(run, scene, rig, folder))


def _find(run: Run, scene: Done, rig: Done, folder: Path) -> Counts:
    finder = Finder(StaticScene.read(scene.folder), run.camera, run.config.find.things)
    placed, world = Rig.read(rig.folder), run.session.calibration.find("world", CAMERA)
    gravity = None if world is None else -world.rotation[2]
    without = [t for t in run.tosses if not _given(run, t)]
    courses = {}
    for toss in without:
        drawn = _robot_frames(run, toss, placed)
        robot = None if drawn is None else drawn.coarser(finder.stride)
        frames, progress = run.session.toss(toss).rgbd(CAMERA), run.progress(f"toss {toss}: looking for the object")
        courses[toss] = courses_of(finder, frames, robot, gravity, run.config.find, progress.step)
    shown = None if run.config.given_masks == "none" else _toss_with_mask(run)
    known = None if shown is None else look_of(_example(run, shown), run.camera)
    found = sightings(courses, known, finder.full_size, finder.stride, run.config.find)
    if not found and len(without) == len(run.recorded):
        raise BadInput(f"{run.session.path}: {NOT_FOUND}")
    write_sightings(folder, found)
    return {
        "tosses": without,
        "not_found": [t for t in without if t not in found],
        "starts": {str(t): s.start for t, s in found.items()},
        "scores": {str(t): round(s.score, 2) for t, s in found.items()},
    }


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
