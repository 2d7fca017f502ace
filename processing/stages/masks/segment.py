"""Stage `segment`: the object's mask in every frame of one toss."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from processing.backends import make_segmenter, settings_of
from processing.run import CAMERA, Run, toss_keys
from processing.segment.background.segmenter import BackgroundSegmenter
from processing.segment.background.static_scene import StaticScene
from processing.segment.detect.detection import Detection, read_detection
from processing.segment.robot.of_session import Rig
from processing.stages.masks.find import FindResult, example, given_masks, robot_frames, toss_with_mask
from processing.stages.recording.rig import RigResult
from processing.store import Done
from recordings.results.folder import write_hand, write_masks
from recordings.session import RgbdFrames

VERSION = 16


@dataclass(frozen=True)
class SegmentResult:
    """`empty`: frames without a mask; `with_depth`: whether any mask holds depth; `found_at`: the frame where the
    object was found, None with a given mask; `elsewhere`: spans (first, last) from which no motion leads into the toss;
    `robot`: drawn, or why not; `followed`: what the background segmenter counted."""

    frames: int
    empty: int
    given: int = 0
    not_found: bool = False
    with_depth: bool = False
    found_at: int | None = None
    elsewhere: tuple[tuple[int, int], ...] = ()
    without_depth: int = 0
    robot: Any = None
    followed: dict[str, int] | None = None


def segment(
    run: Run, toss: int, scene: Done, rig: Done[RigResult], found_in: Done[FindResult] | None
) -> Done[SegmentResult]:
    """From its given masks, else from where the stage `find` saw the object. Depth is as reported."""
    inputs = {"scene": scene.key, "rig": rig.key, **toss_keys(run, toss)}
    choice, given = run.config.given_masks, given_masks(run, toss)
    found_in = None if given else found_in
    shown = None if given or choice == "none" else toss_with_mask(run)
    inputs |= {} if found_in is None else {"found": found_in.key}
    inputs |= {} if shown is None else {"example": run.keys[f"toss_{shown:02d}"]}

    def compute(folder: Path) -> SegmentResult:
        frames = run.session.toss(toss).rgbd(CAMERA)
        drawn = robot_frames(run, toss, Rig.read(rig.folder))
        detection = None if found_in is None else read_detection(found_in.folder, toss)
        if found_in is not None and detection is None:
            return _not_found(frames, folder, toss)
        background = BackgroundSegmenter(StaticScene.read(scene.folder), run.camera, run.config.masks, drawn, detection)
        segmenter = make_segmenter(run.config.backends, background, run.device)
        robot = None if segmenter is background else drawn
        shown_as = None if shown is None else example(run, shown)
        progress = run.progress(f"toss {toss}: masks")
        found = sorted(segmenter.masks(frames, given, shown_as, robot, progress), key=lambda m: m.position)
        write_masks(folder, toss, [m.mask for m in found], np.array([m.confidence for m in found]))
        if drawn is not None:
            drawn.write(folder / f"toss_{toss:02d}.robot")
            write_hand(folder, toss, drawn.hand(frames.times_ns))
        least = run.config.track.view.least_samples
        tracked = (m for m in found if m.mask.sum() >= least)
        return SegmentResult(
            frames=len(found),
            empty=sum(not m.mask.any() for m in found),
            given=len(given),
            with_depth=any((frames[m.position].depth_m[m.mask] > 0).sum() >= least for m in tracked),
            **_where(detection),
            without_depth=len(frames.without_depth),
            robot=rig.result.robot if drawn is None else "drawn",
            followed=dict(background.counts),
        )

    named = settings_of(run.config.backends.segmenter, run.config.backends)
    config = {"given_masks": choice, "background": asdict(run.config.masks), **named}
    return run.store.run("segment", VERSION, config, inputs, SegmentResult, compute)


def _where(detection: Detection | None) -> dict[str, Any]:
    if detection is None:
        return {}
    return {"found_at": detection.start, "elsewhere": tuple((int(a), int(b)) for a, b in detection.elsewhere)}


def _not_found(frames: RgbdFrames, folder: Path, toss: int) -> SegmentResult:
    """A toss in which the object was not found: empty masks."""
    first = frames[0].depth_m
    write_masks(folder, toss, [np.zeros(first.shape, dtype=bool)] * len(frames), np.zeros(len(frames)))
    return SegmentResult(frames=len(frames), empty=len(frames), not_found=True)
