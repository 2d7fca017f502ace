"""Stage `find`: where the object is in the tosses that come without a mask, detected in all of them together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from jaxtyping import Bool
from numpy import ndarray as Array

from processing.given_masks import chosen_masks
from processing.run import CAMERA, Run
from processing.segment.background.segmenter import NOT_FOUND
from processing.segment.background.static_scene import StaticScene
from processing.segment.detect.candidates import Finder
from processing.segment.detect.detection import appearance_of, detections, tracklets_of, write_detections
from processing.segment.robot.frames import RobotFrames
from processing.segment.robot.of_session import Rig, RobotOfSession
from processing.segment.robot.render import RobotView
from processing.segment.segmenter import Example
from processing.store import Done
from recordings.errors import BadInput

VERSION = 6


@dataclass(frozen=True)
class FindResult:
    """`tosses`: those without a given mask; of them `not_found`, and where (frame) and how surely the others start."""

    tosses: tuple[int, ...]
    not_found: tuple[int, ...]
    starts: Mapping[str, int]
    scores: Mapping[str, float]


def find_object(run: Run, scene: Done, rig: Done) -> Done[FindResult] | None:
    """None where every toss came with a mask that is used. Raises BadInput where the object is found in no toss, and
    none came with a mask."""
    if all(given_masks(run, t) for t in run.tosses):
        return None
    inputs = {"scene": scene.key, "rig": rig.key, "calibration": run.keys["calibration"]}
    inputs |= {f"toss_{t:02d}": run.keys[f"toss_{t:02d}"] for t in run.recorded}
    config = {"given_masks": run.config.given_masks, **asdict(run.config.find)}
    return run.store.run("find", VERSION, config, inputs, FindResult, lambda folder: _find(run, scene, rig, folder))


def _find(run: Run, scene: Done, rig: Done, folder: Path) -> FindResult:
    finder = Finder(StaticScene.read(scene.folder), run.camera, run.config.find.things)
    placed, world = Rig.read(rig.folder), run.world_from_camera
    gravity = None if world is None else -world.rotation[2]
    without = [t for t in run.tosses if not given_masks(run, t)]
    tracklets = {}
    for toss in without:
        drawn = robot_frames(run, toss, placed)
        robot = None if drawn is None else drawn.coarser(finder.stride)
        frames, progress = run.session.toss(toss).rgbd(CAMERA), run.progress(f"toss {toss}: looking for the object")
        tracklets[toss] = tracklets_of(finder, frames, robot, gravity, run.config.find, progress.step)
    shown = None if run.config.given_masks == "none" else toss_with_mask(run)
    known = None if shown is None else appearance_of(example(run, shown), run.camera)
    found = detections(tracklets, known, finder.full_size, finder.stride, run.config.find)
    if not found and len(without) == len(run.recorded):
        raise BadInput(f"{run.session.path}: {NOT_FOUND}")
    write_detections(folder, found)
    return FindResult(
        tosses=tuple(without),
        not_found=tuple(t for t in without if t not in found),
        starts={str(t): s.start for t, s in found.items()},
        scores={str(t): round(s.score, 2) for t, s in found.items()},
    )


def given_masks(run: Run, toss: int) -> dict[int, Bool[Array, "h w"]]:
    """The given masks of a toss that are used, by position of the frame."""
    return chosen_masks(run.session.toss(toss).masks(), run.config.given_masks, toss == run.recorded[0])


def toss_with_mask(run: Run) -> int | None:
    """The first toss that came with a mask: it shows what the object looks like."""
    return next((t for t in run.tosses if run.session.toss(t).masks()), None)


def example(run: Run, toss: int) -> Example:
    """The first given mask of a toss, with its frame."""
    position, mask = min(run.session.toss(toss).masks().items())
    return Example(run.session.toss(toss).rgbd(CAMERA)[position], mask)


def robot_frames(run: Run, toss: int, rig: Rig) -> RobotFrames | None:
    """The robot in the frames of a toss; None where it is not known."""
    path = RobotOfSession(run.session).path(toss)
    if rig.camera_from_base is None or path is None:
        return None
    frames = run.session.toss(toss).rgbd(CAMERA)
    view = RobotView(path.robot, run.camera)
    return RobotFrames(frames, view, path, rig.camera_from_base, rig.arm_delay_s, rig.depth_scale)
