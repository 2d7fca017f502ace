"""The cycle (the paper's steps 3 to 6): contact learning on the tracks, and vision again on what its shape explains.

Passes are compared without truth, by their residuals on the raw images: see image_residuals.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from processing.refine.icp import ShapeSurface
from processing.refine.image_residuals import CHANCE, Explained, difference, explain, pooled
from processing.stages.contact import contact_stage
from processing.stages.held_out import Half, halves_of, held_out_losses, learned_by, why_no_halves
from processing.stages.joint import joint_stage
from processing.stages.second_pass import CycleConfig, align_stage, input_keys, second_field, second_tracks
from processing.stages.vision import field_stage
from processing.store import Counts, Done
from recordings.geometry import rotation_angle_rad
from recordings.notices import Notice
from recordings.results.folder import read_masks, read_shape, read_track, write_shape
from recordings.session_writer import write_json
from recordings.tracks import ObjectShape, ObjectTrack

if TYPE_CHECKING:
    from processing.pipeline import Run
    from processing.variants import Variant


@dataclass(frozen=True, eq=False)
class Pass:
    """Where a pass ended, per toss: the stages that hold its track, its masks, and the shape in the track's object
    frame. `passes`: what each pass of the cycle changed and how well it explains the raw images.
    `halves`: the shape so far had contact been learned from one half of the tosses, to judge the other half by.
    `warnings` are what a reader must know before he uses the result, `notes` how it was made."""

    tracks: Mapping[int, Done]
    shapes: Mapping[int, Done]
    masks: Mapping[int, Done]
    shared_frame: bool
    contact: Mapping[int, Done] = field(default_factory=dict)
    rollout: Done | None = None
    halves: tuple[Half, ...] = ()
    warnings: tuple[Notice, ...] = ()
    notes: tuple[str, ...] = ()
    passes: tuple[Mapping[str, Any], ...] = ()

    @staticmethod
    def joined(parts: Sequence[Pass]) -> Pass:
        """Passes on single tosses as one."""
        return Pass(
            {t: d for p in parts for t, d in p.tracks.items()},
            {t: d for p in parts for t, d in p.shapes.items()},
            {t: d for p in parts for t, d in p.masks.items()},
            shared_frame=False,
            contact={t: d for p in parts for t, d in p.contact.items()},
            warnings=tuple(dict.fromkeys(w for p in parts for w in p.warnings)),
            notes=tuple(dict.fromkeys(n for p in parts for n in p.notes)),
            passes=tuple(x for p in parts for x in p.passes),
        )


def run_cycle(run: Run, variant: Variant, start: Pass, name: str) -> Pass:
    """A row of the table from its first pass on."""
    if variant.refined == "joint":
        return _joint(run, start, name)
    refined = with_contact(run, start, name) if variant.contact else start
    if variant.refined == "contact":
        return refined
    start = replace(start, halves=halves_of(start.tracks, start.shapes))
    ended, losses = judged_pass(run, start, refined, name, variant.icp)
    told = _told(run, start, ended, start.masks, name, losses)
    refined, ended = (replace(x, notes=(*x.notes, *why_no_halves(start.tracks, losses[0]))) for x in (refined, ended))
    if told["worse_share"] > run.config.cycle.much_worse:
        seen = f"{name}: the second pass was not kept: it explains the raw images {_percent(told)} worse than the first"
        notice = Notice("second pass", "low", seen, "poses and shape are those before it")
        return replace(refined, passes=(told,), warnings=(*refined.warnings, notice))
    ended = replace(
        ended,
        passes=(told,),
        notes=(*ended.notes, *_said(told, run.config.cycle), *departures(run.config.cycle)),
    )
    return _until_converged(run, ended, name) if variant.refined == "converged" else ended


def departures(config: CycleConfig) -> tuple[str, ...]:
    """Where the second pass is not the paper's, and how to have the paper's."""
    starts = {"poses": "starts from the first pass's poses", "shape": "starts from the first pass's poses and shape"}
    notes = []
    if config.start != "anew":
        notes.append(f"second pass: {starts[config.start]} (the paper starts anew: --second-pass anew)")
    if config.redraw.depth != "rendered":
        notes.append("second pass: measured depth stays where it agrees (the paper draws all: --redraw rendered)")
    return tuple(notes)


def with_contact(run: Run, start: Pass, name: str) -> Pass:
    """Contact learning on the tracks with the shape as prior; its shape replaces vision's where it is not worse.

    Both are judged at the same poses, frame by frame. Poses laid anew onto depth for each shape would hide a wrong
    size (the faces in view can always be met); on recorded tosses they change the difference by less than 0.001 mm.
    """
    shape = next(iter(start.shapes.values()))
    learned = contact_stage(run, name, start.tracks, shape)
    kept_out = learned.counts.get("kept_out")
    if kept_out:
        return replace(start, warnings=(*start.warnings, _contact_kept_out(name, kept_out)))
    vision, corrected = (
        judged_frames(judge_stage(run, name, start.tracks, dict.fromkeys(start.tracks, s), start.masks))
        for s in (shape, learned)
    )
    contact, gap = dict.fromkeys(start.tracks, learned), difference(vision, corrected)
    if gap.worse:
        seen = f"{name}: the shape that contact learned fits the raw depth worse than vision's ({gap}): kept out"
        notice = Notice("contact", "medium", seen, "friction and rollouts are of that shape", "likely")
        return replace(start, contact=contact, warnings=(*start.warnings, notice))
    return replace(start, shapes=dict.fromkeys(start.tracks, learned), contact=contact)


def _contact_kept_out(name: str, why: str) -> Notice:
    return Notice("contact", "medium", f"{name}: contact learning was kept out: {why}")


def second_pass(run: Run, refined: Pass, masks: Mapping[int, Done], name: str, icp: bool) -> Pass:
    """The shape drawn at its poses (laid onto raw depth first where `icp`), and vision once more on that."""
    shape = next(iter(refined.shapes.values()))
    drawn = align_stage(run, name, refined.tracks, shape, masks, icp)
    tracks = second_tracks(run, name, drawn, shape, masks)
    field_of = second_field(run, name, tracks, drawn, shape, masks)
    return replace(refined, tracks=tracks, shapes=dict.fromkeys(tracks, field_of))


def judged_pass(
    run: Run, before: Pass, refined: Pass, name: str, icp: bool
) -> tuple[Pass, tuple[dict[int, float], dict[int, float]]]:
    """The second pass, and the contact losses per toss (J) before and after it, each toss judged by the half that did
    not learn from it: what contact corrects of the half's shape goes through the second pass as the row's does."""
    after = second_pass(run, refined, before.masks, name, icp)
    halves = learned_by(run, before.halves, before.tracks, name)
    body, seen = next(iter(refined.shapes.values())), next(iter(after.shapes.values()))
    corrected = body.key != next(iter(before.shapes.values())).key
    drawn = align_stage(run, name, refined.tracks, body, before.masks, icp)
    ended = []
    for half in halves:
        shape = seen
        if corrected and half.contact is not None:
            shape = second_field(run, f"{name}, {half.name}", after.tracks, drawn, half.contact, before.masks)
        ended.append(replace(half, shape=shape))
    losses = held_out_losses(run, name, before.tracks, halves), held_out_losses(run, name, after.tracks, ended)
    return replace(after, halves=tuple(ended)), losses


def _until_converged(run: Run, second: Pass, name: str) -> Pass:
    """After the second pass further ones, for as long as they explain the raw images better and change poses or shape;
    the best one is kept."""
    best, passes = second, list(second.passes)
    for number in range(3, 3 + run.config.cycle.most_passes):
        after, losses = judged_pass(run, best, with_contact(run, best, name), name, icp=True)
        told = {"pass": number, **_told(run, best, after, best.masks, name, losses)}
        passes.append(told)
        worse = 100 * told["worse_share"]
        if worse > 0:
            note = (
                f"converged: pass {number} explains the raw images no better (worse by {worse:.2f} %) and is left out"
            )
            return replace(best, passes=tuple(passes), notes=(*best.notes, note))
        best = after
        if told["same"]:
            note = f"converged: pass {number} changed nothing more"
            return replace(best, passes=tuple(passes), notes=(*best.notes, note))
    warning = Notice(
        "converged", "low", f"poses and shape still change after {run.config.cycle.most_passes} passes more"
    )
    return replace(best, passes=tuple(passes), warnings=(*best.warnings, warning))


def _joint(run: Run, start: Pass, name: str) -> Pass:
    """One pass of the cycle, then all terms in one objective; friction by contact learning at its poses and shape.
    Contact is among the terms, of all tosses: no toss is left that it could be judged by."""
    begun = second_pass(run, with_contact(run, start, name), start.masks, name, icp=True)
    shape = next(iter(begun.shapes.values()))
    solved = joint_stage(run, begun.tracks, shape, start.masks)
    tracks = dict.fromkeys(begun.tracks, solved)
    learned = contact_stage(run, name, tracks, solved)
    kept_out = learned.counts.get("kept_out")
    warnings = [_contact_kept_out(name, kept_out)] if kept_out else []
    if "kept_out" in solved.counts:
        warnings.append(Notice("joint", "medium", f"{name}: {solved.counts['kept_out']}"))
    ended = replace(begun, tracks=tracks, shapes=tracks, contact={} if kept_out else dict.fromkeys(tracks, learned),
                    warnings=(*start.warnings, *warnings))  # fmt: skip
    return replace(ended, passes=(_told(run, begun, ended, start.masks, name, ({}, {})),))


def certain_share(before: Mapping[int, float], after: Mapping[int, float]) -> float:
    """By how much the mean over tosses is larger afterwards, as a share; 0 where chance makes such a difference between
    so few tosses (t-test on pairs): a loss that hangs on some corners hitting the table is a rough judge."""
    both = [t for t in before if t in after]
    first, gaps = np.array([before[t] for t in both]), np.array([after[t] - before[t] for t in both])
    if len(both) < 2:
        return 0.0
    beyond = float(student.ppf(1 - CHANCE, len(both) - 1)) * gaps.std(ddof=1) / np.sqrt(len(both))
    return float(gaps.mean() / first.mean()) if abs(gaps.mean()) > beyond else 0.0


def _told(
    run: Run, before: Pass, after: Pass, masks: Mapping[int, Done], name: str,
    contact: tuple[Mapping[int, float], Mapping[int, float]],
) -> dict[str, Any]:  # fmt: skip
    """What changed from one pass to the next, and which of them explains the raw images better; and the contact of
    tosses held out, where `contact` has losses of both passes."""
    was, now = (judge_stage(run, name, x.tracks, x.shapes, masks).counts for x in (before, after))
    shares = [now[k] / was[k] - 1 for k in ("depth_m", "mask", "color") if was[k] and now[k] is not None]
    if all(contact):
        shares.append(certain_share(*contact))
        was, now = ({**w, "contact_j": float(np.mean(list(c.values())))} for w, c in zip((was, now), contact))
    if now["frames"] + now["lost"]:
        shares.append((now["lost"] - was["lost"]) / (now["frames"] + now["lost"]))
    turned, moved = pose_change(before.tracks, after.tracks)
    grown = shape_change(before.shapes, after.shapes)
    config = run.config.cycle
    same = turned < config.same_rotation_deg and moved < config.same_translation_m and grown < config.same_shape_m
    return {
        "of": name, "before": was, "after": now, "worse_share": float(np.mean(shares)) if shares else 0.0,
        "rotation_deg": turned, "translation_m": moved, "shape_m": grown, "same": bool(same),
    }  # fmt: skip


def _said(told: Mapping[str, Any], config: CycleConfig) -> tuple[str, ...]:
    """Of a second pass that was kept: how it explains the raw images, and what that means."""
    if told["same"]:
        return (f"{told['of']}: the second pass was kept: it only repeats the first one",)
    if told["worse_share"] > 0:
        limit = f"beyond {100 * config.much_worse:.0f} % it is left out"
        return (f"{told['of']}: the second pass was kept: it explains the raw images as well as the first "
                f"({_percent(told)} worse; {limit})",)  # fmt: skip
    return (f"{told['of']}: the second pass was kept: it explains the raw images better ({_percent(told)})",)


def _percent(told: Mapping[str, Any]) -> str:
    return f"{100 * abs(told['worse_share']):.1f} %"


def pose_change(before: Mapping[int, Done], after: Mapping[int, Done]) -> tuple[float, float]:
    """Median turn (deg) and shift of the object's origin (m) over frames that both have, each toss at its own frame."""
    turns, shifts = [], []
    for toss in before:
        a, b = (read_track(x[toss].folder, toss).camera_from_object for x in (before, after))
        both = np.isfinite(a[:, 0, 0]) & np.isfinite(b[:, 0, 0])
        for p, q in zip(a[both], b[both]):
            turns.append(np.degrees(rotation_angle_rad(p[:3, :3].T @ q[:3, :3])))
            shifts.append(np.linalg.norm(p[:3, 3] - q[:3, 3]))
    return (float(np.median(turns)), float(np.median(shifts))) if turns else (float("inf"), float("inf"))


def shape_change(before: Mapping[int, Done], after: Mapping[int, Done]) -> float:
    """Mean distance (m) of the new surface's vertices to the old surface."""

    toss = next(iter(before))
    old, new = read_shape(before[toss].folder), read_shape(after[toss].folder)
    nearest, _ = ShapeSurface(old).nearest(new.vertices_m)
    return float(np.linalg.norm(nearest - new.vertices_m, axis=1).mean())


def alone_start(run: Run, toss: int, first: Pass, alone: Done, masks: Done) -> Pass:
    """Where the cycle begins on one toss: p_i, and O in its object frame.

    A toss that is lost in P does not say how O lies in it (it may be another object's): its own shape is taken.
    """
    warnings: tuple[Notice, ...] = ()
    placed = place_stage(run, toss, first.tracks[toss], alone, first.shapes[toss])
    if not placed.counts["frames"]:
        placed = field_stage(run, f"toss {toss}", {toss: alone}, {toss: masks})
        seen = f"toss {toss} is lost among all tosses: the cycle begins with its own shape"
        warnings = (Notice("place", "medium", seen),)
    return Pass({toss: alone}, {toss: placed}, {toss: masks}, shared_frame=False, warnings=warnings)


def place_stage(run: Run, toss: int, together: Done, alone: Done, shape: Done) -> Done:
    """Stage `place`: O moved into p_i's object frame, by the motion that lays P's poses of toss i on p_i's."""
    inputs = {"together": together.key, "alone": alone.key, "shape": shape.key, "toss": str(toss)}

    def compute(folder: Path) -> Counts:
        own, shared = read_track(alone.folder, toss), read_track(together.folder, toss)
        own_from_shared, residual = placement(own, shared)
        write_shape(folder, moved_shape(read_shape(shape.folder), own_from_shared, own.object_frame))
        return {"toss": toss, **residual}

    return run.store.run("place", 1, {}, inputs, compute)


def placement(own: ObjectTrack, shared: ObjectTrack) -> tuple[Float[Array, "4 4"], dict[str, float | int]]:
    """own_object_from_shared_object by the frames that both tracked, and how far they are from agreeing.

    The chordal mean of all frames' motions, then once more without the frames further off than three times the median.
    """
    both = np.isfinite(own.camera_from_object[:, 0, 0]) & np.isfinite(shared.camera_from_object[:, 0, 0])
    if not both.any():
        return np.eye(4), {"frames": 0}
    steps = np.linalg.inv(own.camera_from_object[both]) @ shared.camera_from_object[both]
    use = np.ones(len(steps), dtype=bool)
    mean = np.eye(4)
    for _ in range(2):
        mean[:3, :3] = Rotation.from_matrix(steps[use, :3, :3]).mean().as_matrix()
        mean[:3, 3] = steps[use, :3, 3].mean(0)
        turn = np.array([float(rotation_angle_rad(s[:3, :3] @ mean[:3, :3].T)) for s in steps])
        shift = np.linalg.norm(steps[:, :3, 3] - mean[:3, 3], axis=1)
        use = (turn <= 3 * np.median(turn) + 1e-9) & (shift <= 3 * np.median(shift) + 1e-9)
    figures: dict[str, float | int] = {
        "rotation_deg": float(np.degrees(np.median(turn))),
        "translation_m": float(np.median(shift)),
    }
    return mean, {"frames": int(both.sum()), **figures}


def moved_shape(shape: ObjectShape, target_from_source: Float[Array, "4 4"], frame: str) -> ObjectShape:
    """The shape in another object frame."""
    vertices = shape.vertices_m @ target_from_source[:3, :3].T + target_from_source[:3, 3]
    return replace(shape, vertices_m=vertices, object_frame=frame)


def judge_stage(run: Run, name: str, tracks: Mapping[int, Done], shapes: Mapping[int, Done],
                masks: Mapping[int, Done]) -> Done:  # fmt: skip
    """Stage `judge`: how well shape and poses explain the raw images, without truth."""
    inputs = {**{f"shape_{t:02d}": s.key for t, s in shapes.items()}, **input_keys(tracks, masks)}

    def compute(folder: Path) -> Counts:
        parts: list[Explained] = []
        progress = run.progress(f"{name}: residuals on the raw images")
        for done, toss in enumerate(tracks):
            progress.step(done, len(tracks), f"toss {toss}")
            body, track = read_shape(shapes[toss].folder), read_track(tracks[toss].folder, toss)
            seen = read_masks(masks[toss].folder, toss)
            parts.append(explain(body, track, run.frames(toss), seen, run.camera, run.config.cycle.judge))
        every = pooled(parts)
        with open(folder / "residuals.npz", "wb") as out:
            np.savez(out, rows=every.rows)
        write_json(folder / "evidence.json", every.evidence().to_json())
        return every.evidence().to_json()

    return run.store.run("judge", 3, run.config.cycle.judge, inputs, compute)


def judged_frames(judged: Done) -> Explained:
    """The residuals of single frames that a stage `judge` keeps."""
    with np.load(judged.folder / "residuals.npz", allow_pickle=False) as stored:
        return Explained(stored["rows"], int(judged.counts["lost"]))
