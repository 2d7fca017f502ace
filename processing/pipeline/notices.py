"""The stages' notices, derived from their results: a result that was read says the same as one that was computed."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from processing.config import CycleConfig
from processing.refine.image_residuals import Difference
from processing.run import Run
from processing.sensor.noise import PUBLISHED
from processing.stages.field import FieldResult
from processing.stages.lose import SEE
from processing.stages.masks.segment import SegmentResult
from processing.stages.recording.noise import NoiseResult
from processing.stages.recording.rig import RigResult
from processing.stages.register import RegisterResult
from processing.stages.rollout import RolloutResult
from processing.stages.track import TrackResult
from processing.store import Done
from recordings.mcap import arm_codec
from recordings.notices import Notice
from recordings.results.stage_files import stage_document

SCALE_SAID = 0.001
"""A correction of depth by less is told by the record only."""
NOISY = 2.0
"""Depth that errs by this much more than the data sheet says is told."""
MANY_UNFIT = 1 / 3
"""Share of a toss's frames from which on more than noise is the likelier cause."""


def of_run(run: Run, rig: Done[RigResult], masks: Mapping[int, Done[SegmentResult]]) -> list[Notice]:
    """Of the recording, the rig and the masks."""
    found = [*of_import(run), *of_rig(run, rig)]
    return found + [n for toss, done in masks.items() for n in of_masks(toss, done)]


def of_import(run: Run) -> list[Notice]:
    """What the import left out of the tosses."""
    return [
        Notice("import", "medium", f"toss {t}: {sentence}")
        for t in run.recorded
        for sentence in run.session.toss(t).info.get("warnings", ())
    ]


def of_rig(run: Run, done: Done[RigResult]) -> list[Notice]:
    """A robot that is not cut out, or only as calibrated; the depth scale that was applied."""
    found, result, robot = [], done.result, done.result.robot
    has_arm = any(arm_codec.TOPIC in run.session.toss(t).file.channels for t in run.recorded)
    if isinstance(robot, str) and robot.startswith("place not refined"):
        seen = f"the robot is cut out where the calibration has it: its {robot}"
        do = "check its place: `toss-calibrate hand-eye SESSION`"
        found.append(Notice("rig", "medium", seen, do))
    elif isinstance(robot, str) and has_arm:
        seen = f"the robot is not cut out of the images: {robot}"
        do = "where it touches the object, the masks may hold a part of it: look at them with `toss-view RESULTS`"
        found.append(Notice("rig", "medium", seen, do))
    off, told, sigma = result.depth_scale - 1, result.estimated_scale, result.scale_sigma
    if told is not None and sigma is not None and abs(off) >= SCALE_SAID:
        side = "far" if told > 1 else "near"
        seen = f"the camera's depth reads {100 * abs(told - 1):.2f} +- {100 * sigma:.2f} % too {side}"
        by = f"all depth was corrected by {100 * abs(off):.2f} %, the more the surer that is"
        found.append(Notice("rig", "low", f"{seen}: {by}", sure="likely"))
    return found


def of_noise(done: Done[NoiseResult]) -> list[Notice]:
    """Depth that errs by far more than the camera's data sheet says."""
    found = done.result
    if not found.frames or found.sigma_at_1m < NOISY * PUBLISHED.sigma_at_1m:
        return []
    seen = (
        f"depth of the table scatters by {1e3 * found.sigma_at_1m:.0f} mm at 1 m "
        f"(data sheet: {1e3 * PUBLISHED.sigma_at_1m:.0f}), in patches of {found.patch_px:.0f} pixels"
    )
    do = "most often too little texture or projected light, else a dirty, shiny or moved camera; poses are less sure"
    return [Notice("noise", "low", seen, do)]


def of_masks(toss: int, done: Done[SegmentResult]) -> list[Notice]:
    """Frames of bad light, frames in which others move, frames without depth."""
    result, counts, found = done.result, done.result.followed or {}, []
    of = f"of {result.frames} frames"
    if dark := counts.get("badly_exposed", 0):
        seen = f"toss {toss}: {dark} {of} are so dark or so bright that their colours say nothing"
        found.append(Notice("masks", "medium", seen, "change light or exposure"))
    if others := counts.get("others_moving", 0):
        seen = f"toss {toss}: in {others} {of} something else of the object's size moves"
        found.append(Notice("masks", "medium", seen, f"the masks may hold a part of it: {SEE}", "likely"))
    if bare := result.without_depth:
        found.append(Notice("masks", "low", f"toss {toss}: {bare} {of} came without a depth image"))
    return found


def of_tracks(tracks: Mapping[int, Done[TrackResult]]) -> tuple[Notice, ...]:
    """Tosses in which no single rigid motion explains what is seen."""
    return tuple(n for toss, done in tracks.items() for n in of_track(toss, done))


def of_track(toss: int, done: Done[TrackResult]) -> list[Notice]:
    """Frames that no pose explains; the share of such frames decides which cause is named."""
    unfit, frames = done.result.unfit, max(done.result.frames, 1)
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
    stored = stage_document(path).get("warnings", []) if path.exists() else []
    return [Notice.from_json(n) for n in stored]


def of_register(done: Done[RegisterResult], located: Collection[int] = (), lost: Collection[int] = ()) -> list[Notice]:
    """Tosses that are not in the object frame of the others, or not surely; `located`: those that were found on the
    others' shape all the same; `lost`: those that have no shape of their own, either."""
    left_out = [t for t in done.result.not_joined if t not in located]
    found, unsure = [], list(done.result.ambiguous)
    do = f"most often they show other sides than the rest, or too little detail; seldom it is another object: {SEE}"
    for state, tosses in (("kept apart", [t for t in left_out if t not in lost]), ("lost", sorted(lost))):
        if tosses:
            seen = f"tosses {tosses} could not be brought into the object frame of the others: {state}"
            found.append(Notice("register", "high", seen, do))
    if unsure:
        seen = f"tosses {unsure}: the object looks alike from several sides; their object frame may be turned"
        found.append(Notice("register", "high", seen, "compare their frames in `toss-view RESULTS`", "possible"))
    return found


def of_shapes(shapes: Mapping[int, Done]) -> list[Notice]:
    """Tosses whose shape was learned from frames none of which is sure."""
    guessed = [t for t, done in shapes.items() if isinstance(done.result, FieldResult) and not done.result.sure]
    if not guessed:
        return []
    seen = f"tosses {guessed}: no frame has a pose that is sure: the shape is a guess, as they are"
    do = f"most often the masks hold other things, or the object is small, dark or blurred: {SEE}"
    return [Notice("shape", "high", seen, do)]


def kept_apart(tosses: Sequence[int]) -> Notice:
    """Tosses that no one shape explains with the others."""
    seen = f"tosses {list(tosses)}: no one shape explains their outlines and those of the others: kept apart"
    do = "most often an object that looks alike from several sides, else a track that is off; seldom another object"
    return Notice("register", "high", seen, f"{do}: {SEE}")


def not_among_others(toss: int) -> tuple[Notice, ...]:
    """A toss whose cycle begins with its own shape."""
    return (Notice("place", "medium", f"toss {toss} is not among the others: the cycle begins with its own shape"),)


def contact_kept_out(name: str, why: str) -> Notice:
    """Nothing was learned of contact."""
    return Notice("contact", "medium", f"{name}: contact learning was kept out: {why}")


def contact_shape_worse(name: str, gap: Difference) -> Notice:
    """Contact's shape was not kept."""
    seen = f"{name}: the shape that contact learned fits the raw depth worse than vision's ({gap}): kept out"
    return Notice("contact", "medium", seen, "friction and rollouts are of that shape", "likely")


def joint(name: str, contact: str | None, objective: str | None) -> list[Notice]:
    """What the joint objective could not do."""
    found = [contact_kept_out(name, contact)] if contact else []
    return found + ([Notice("joint", "medium", f"{name}: {objective}")] if objective else [])


def no_rollouts(done: Done[RolloutResult]) -> tuple[Notice, ...]:
    """Why Figure 4 is missing."""
    why = done.result.kept_out
    return (Notice("rollout", "low", f"no rollouts: {why}"),) if why else ()


def second_pass_not_kept(comparison: Mapping[str, Any], config: CycleConfig) -> Notice:
    """The second pass explains the raw images worse, or turns the poses by more than they err."""
    if comparison["worse_share"] > config.much_worse:
        why = f"it explains the raw images {_percent(comparison)} worse than the first"
    else:
        why = f"it turns the poses by {comparison['rotation_deg']:.1f} deg; wanted at most {config.far_deg:g}"
    seen = f"{comparison['of']}: the second pass was not kept: {why}"
    return Notice("second pass", "low", seen, "poses and shape are those before it")


def second_pass_kept(comparison: Mapping[str, Any], config: CycleConfig) -> tuple[str, ...]:
    """Of a second pass that was kept: how it explains the raw images, and what that means."""
    if comparison["same"]:
        return (f"{comparison['of']}: the second pass was kept: it only repeats the first one",)
    if comparison["worse_share"] > 0:
        limit = f"beyond {100 * config.much_worse:.0f} % it is left out"
        return (f"{comparison['of']}: the second pass was kept: it explains the raw images as well as the first "
                f"({_percent(comparison)} worse; {limit})",)  # fmt: skip
    return (
        f"{comparison['of']}: the second pass was kept: it explains the raw images better ({_percent(comparison)})",
    )


def departures(config: CycleConfig) -> tuple[str, ...]:
    """Where the second pass is not the paper's, and how to have the paper's."""
    starts = {"poses": "starts from the first pass's poses", "shape": "starts from the first pass's poses and shape"}
    notes = []
    if config.start != "anew":
        notes.append(f"second pass: {starts[config.start]} (the paper starts anew: --second-pass anew)")
    if config.redraw.depth != "rendered":
        notes.append("second pass: measured depth stays where it agrees (the paper draws all: --redraw rendered)")
    return tuple(notes)


def converged(comparison: Mapping[str, Any]) -> str:
    """Why no further pass was made."""
    number, worse = comparison["pass"], 100 * comparison["worse_share"]
    if worse > 0:
        return f"converged: pass {number} explains the raw images no better (worse by {worse:.2f} %) and is left out"
    return f"converged: pass {number} changed nothing more"


def not_converged(passes: int) -> Notice:
    """Passes ended before they converged."""
    return Notice("converged", "low", f"poses and shape still change after {passes} passes more")


def _percent(comparison: Mapping[str, Any]) -> str:
    return f"{100 * abs(comparison['worse_share']):.1f} %"
