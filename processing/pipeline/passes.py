"""Where a pass ended, and what tells one pass from another without truth: its poses and shape, its residuals on the raw
images, its contact loss of tosses that nothing was learned from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from scipy.special import stdtrit

from processing.images import Images
from processing.refine.icp import ShapeSurface
from processing.refine.image_residuals import CHANCE
from processing.run import Run, both, each
from processing.stages.held_out import Half, judge_by_contact, losses_of
from processing.stages.judge import judge
from processing.store import Done
from recordings.geometry import rotation_angle_rad
from recordings.notices import Notice
from recordings.results.folder import read_shape, read_track


@dataclass(frozen=True, eq=False)
class Pass:
    """Per toss the stages that hold its track, and the shape in the track's object frame; the stage `contact` that was
    learned. `passes`: what each pass of the cycle changed and how well it explains the raw images. `halves`: the shape
    so far had contact been learned from one half of the tosses, to judge the other half by.
    `warnings` are what a reader must know before he uses the result, `notes` how it was made."""

    tracks: Mapping[int, Done]
    shapes: Mapping[int, Done]
    shared_frame: bool
    contact: Mapping[int, Done] = field(default_factory=dict)
    rollout: Done | None = None
    halves: tuple[Half, ...] = ()
    warnings: tuple[Notice, ...] = ()
    notes: tuple[str, ...] = ()
    passes: tuple[Mapping[str, Any], ...] = ()

    @property
    def shape(self) -> Done:
        """The one shape of a pass over all tosses, or over one."""
        return next(iter(self.shapes.values()))

    @staticmethod
    def joined(parts: Sequence[Pass]) -> Pass:
        """Passes on single tosses as one."""
        return Pass(
            {t: d for p in parts for t, d in p.tracks.items()},
            {t: d for p in parts for t, d in p.shapes.items()},
            shared_frame=False,
            contact={t: d for p in parts for t, d in p.contact.items()},
            warnings=tuple(dict.fromkeys(w for p in parts for w in p.warnings)),
            notes=tuple(dict.fromkeys(n for p in parts for n in p.notes)),
            passes=tuple(x for p in parts for x in p.passes),
        )


def comparison(run: Run, before: Pass, after: Pass, images: Mapping[int, Images], name: str) -> dict[str, Any]:
    """What changed from one pass to the next, and which of them explains the raw images better (`worse_share`: mean of
    how much larger the residuals are, as a share); and the contact loss (J) of tosses held out, where both passes have
    one."""

    def explained(of: Pass) -> dict[str, Any]:
        return asdict(judge(run, name, of.tracks, of.shapes, images).result)

    def contact_j(of: Pass) -> dict[int, float]:
        judged = each(run, of.halves, lambda half: judge_by_contact(run, name, of.tracks, half))
        return losses_of([*judged.values()])

    (was, now), contact = both(
        run,
        lambda: both(run, lambda: explained(before), lambda: explained(after)),
        lambda: both(run, lambda: contact_j(before), lambda: contact_j(after)),
    )
    shares = [now[k] / was[k] - 1 for k in ("depth_m", "mask", "color") if was[k] and now[k] is not None]
    if all(contact):
        shares.append(certain_share(*contact))
        was, now = ({**w, "contact_j": float(np.mean(list(c.values())))} for w, c in zip((was, now), contact))
    if now["frames"] + now["lost"]:
        shares.append((now["lost"] - was["lost"]) / (now["frames"] + now["lost"]))
    turned, moved = pose_change(before.tracks, after.tracks)
    grown, config = shape_change(before.shapes, after.shapes), run.config.cycle
    same = turned < config.same_rotation_deg and moved < config.same_translation_m and grown < config.same_shape_m
    return {
        "of": name, "before": was, "after": now, "worse_share": float(np.mean(shares)) if shares else 0.0,
        "rotation_deg": turned, "translation_m": moved, "shape_m": grown, "same": bool(same),
    }  # fmt: skip


def certain_share(before: Mapping[int, float], after: Mapping[int, float]) -> float:
    """By how much the mean over tosses is larger afterwards, as a share; 0 where chance makes such a difference between
    so few tosses (t-test on pairs): a loss that hangs on some corners hitting the table is a rough judge."""
    both = [t for t in before if t in after]
    first, gaps = np.array([before[t] for t in both]), np.array([after[t] - before[t] for t in both])
    if len(both) < 2:
        return 0.0
    beyond = float(stdtrit(len(both) - 1, 1 - CHANCE)) * gaps.std(ddof=1) / np.sqrt(len(both))
    return float(gaps.mean() / first.mean()) if abs(gaps.mean()) > beyond else 0.0


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
