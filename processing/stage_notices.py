"""What the stages noticed, told to the user: from what they counted, so that a result that was read says the same as
one that was made."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING

from processing.stages.rig import rig_stage
from processing.store import Done
from recordings.mcap import arm_codec
from recordings.notices import Notice

if TYPE_CHECKING:
    from processing.pipeline import Run

SEE = "look at these frames with `toss-view RESULTS`"
MANY_UNFIT = 1 / 3
"""Share of a toss's frames from which on more than noise is the likelier cause."""


def of_run(run: Run, scene: Done, masks: Mapping[int, Done]) -> list[Notice]:
    """Of the recording, the rig and the masks."""
    found = [*of_import(run), *of_rig(run, rig_stage(run, scene))]
    return found + [n for toss, done in masks.items() for n in of_masks(toss, done)]


def of_import(run: Run) -> list[Notice]:
    """What the import left out of the tosses."""
    return [
        Notice("import", "medium", f"toss {t}: {sentence}")
        for t in run.recorded
        for sentence in run.session.toss(t).info.get("warnings", ())
    ]


def of_rig(run: Run, done: Done) -> list[Notice]:
    """A robot that is not cut out, or only as calibrated; the depth scale that was applied."""
    found, counts, robot = [], done.counts, done.counts.get("robot")
    has_arm = any(arm_codec.TOPIC in run.session.toss(t).file.channels for t in run.recorded)
    if isinstance(robot, str) and robot.startswith("place not refined"):
        seen = f"the robot is cut out where the calibration has it: its {robot}"
        do = "check its place: `toss-calibrate hand-eye SESSION`"
        found.append(Notice("rig", "medium", seen, do))
    elif isinstance(robot, str) and has_arm:
        seen = f"the robot is not cut out of the images: {robot}"
        do = "where it touches the object, the masks may hold a part of it: look at them with `toss-view RESULTS`"
        found.append(Notice("rig", "medium", seen, do))
    scale = float(counts.get("depth_scale", 1.0))
    if scale != 1.0:
        side, sigma = "far" if scale > 1 else "near", 100 * float(counts.get("scale_sigma") or 0)
        seen = (
            f"the camera's depth reads {100 * abs(scale - 1):.2f} +- {sigma:.2f} % too {side}: all depth was corrected"
        )
        found.append(Notice("rig", "low", seen, sure="likely"))
    return found


def of_masks(toss: int, done: Done) -> list[Notice]:
    """Frames of bad light, frames in which others move, frames without depth."""
    counts, found = done.counts, []
    of = f"of {counts.get('frames', 0)} frames"
    if dark := counts.get("badly_exposed", 0):
        seen = f"toss {toss}: {dark} {of} are so dark or so bright that their colours say nothing"
        found.append(Notice("masks", "medium", seen, "change light or exposure"))
    if others := counts.get("others_moving", 0):
        seen = f"toss {toss}: in {others} {of} something else of the object's size moves"
        found.append(Notice("masks", "medium", seen, f"the masks may hold a part of it: {SEE}", "likely"))
    if bare := counts.get("without_depth", 0):
        found.append(Notice("masks", "low", f"toss {toss}: {bare} {of} came without a depth image"))
    return found


def of_track(toss: int, done: Done) -> list[Notice]:
    """Frames that no pose explains. What is behind them is told by how many they are."""
    unfit, frames = int(done.counts.get("unfit", 0)), max(int(done.counts.get("frames", 0)), 1)
    if not unfit:
        return []
    seen = f"toss {toss}: in {unfit} of {frames} frames no pose explains all that is seen"
    if unfit < MANY_UNFIT * frames:
        do = "most often noisy depth or blur, else a hand or an arm in the mask, seldom an object that is not rigid"
        return [Notice("track", "medium", seen, f"{do}: {SEE}")]
    do = "most often a mask that holds other things too, else several objects, or one that is not rigid"
    return [Notice("track", "high", seen, f"{do}: {SEE}")]


def of_contact(done: Done) -> list[Notice]:
    """What contact learning says of itself."""
    path = done.folder / "result.json"
    stored = json.loads(path.read_text()).get("warnings", []) if path.exists() else []
    return [Notice.from_json(n) for n in stored]
