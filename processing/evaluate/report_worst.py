"""The worst frames of a result, each with what is unusual about it: where to look first.

Worst is: no pose; then, where a truth is known, the largest error, else the worst fit to what other frames saw. The
reason names what was measured in the frame beside what is usual in its toss; where nothing stands out, that is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.engine.parts import side_by_side
from processing.evaluate.score import TossScore
from processing.evaluate.table import Row
from processing.motion.frame_phases import Phase
from processing.motion.thresholds import MOVING_M_S
from recordings.results.folder import Results
from recordings.results.track_notes import find_notes
from recordings.tracks import ObjectTrack, runs

WORST = 6
LEAST_FRAMES_BETWEEN = 4
"""Frames of one toss that are shown lie at least so far apart."""
LITTLE, BAD, MUCH = 0.6, 1.7, 1.6
"""Below this share of what is usual, or above it, a number is unusual: of what is seen, of the fit, of the speed."""
LEAST_RESIDUAL, SURE = 0.05, 0.5


@dataclass(frozen=True, eq=False)
class TossDiagnostics:
    """What is known of every frame of a toss; NaN where it is not. `mask_px`: the object's pixels; `at_edge`: 1 where
    they reach the image's edge; `phase` is empty where it is not known."""

    track: ObjectTrack
    error_m: Float[Array, " n"]
    error_deg: Float[Array, " n"]
    residual: Float[Array, " n"]
    on_surface: Float[Array, " n"]
    mask_px: Float[Array, " n"]
    mask_confidence: Float[Array, " n"]
    at_edge: Float[Array, " n"]
    phase: tuple[Phase, ...] = ()


@dataclass(frozen=True)
class Worst:
    """One frame to look at (the middle one of a run that is lost): what is wrong, and why as far as it was measured."""

    toss: int
    position: int
    what: str
    reasons: tuple[str, ...]


def worst_frames(results: Results, row: Row) -> list[Worst]:
    """The worst frames of a row, worst first: runs of lost ones (a half of them at most), then by error or fit."""
    every = dict(zip(row.tracks, side_by_side(lambda toss: diagnostics(results, row, toss), list(row.tracks))))
    lost = sorted(((b - a, t, a) for t, e in every.items() for a, b in runs(e.track.lost)), reverse=True)
    found = [_lost(every[t], a, a + n) for n, t, a in lost[: WORST // 2]]
    ranked = sorted(
        ((s, t, i) for t, e in every.items() for i, s in enumerate(_severity(e)) if np.isfinite(s)), reverse=True
    )
    taken: list[tuple[int, int]] = []
    for _, toss, i in ranked:
        if len(found) == WORST:
            break
        if all(t != toss or abs(i - k) >= LEAST_FRAMES_BETWEEN for t, k in taken):
            taken.append((toss, i))
            found.append(Worst(toss, i, _what(every[toss], i), reasons(every[toss], i)))
    return found


def diagnostics(results: Results, row: Row, toss: int) -> TossDiagnostics:
    """Everything that is kept of how a toss was tracked and scored."""
    track, record = row.tracks[toss], row.record.toss(toss)
    n = len(track.status)
    unknown = np.full(n, np.nan)
    score = next((s for s in (row.score.tosses if row.score else ()) if s.toss == toss), None)
    error_m, error_deg, phase = _errors(track, score)
    notes = find_notes(results, record.track, toss)
    fitting = notes is not None and len(notes.residual) == n
    residual, on_surface = (notes.residual, notes.on_surface) if notes is not None and fitting else (unknown, unknown)
    mask_px, confidence, at_edge = unknown.copy(), unknown, unknown.copy()
    masks = results.masks(row.record.name, row.record.scope, toss) if record.masks else []
    if masks and len(masks) == n:
        confidence = np.asarray(getattr(masks, "confidence", unknown), dtype=np.float64)
        for i, mask in enumerate(masks):
            mask_px[i] = mask.sum()
            at_edge[i] = mask[[0, -1]].any() or mask[:, [0, -1]].any()
    return TossDiagnostics(track, error_m, error_deg, residual, on_surface, mask_px, confidence, at_edge, phase)


def _errors(
    track: ObjectTrack, score: TossScore | None
) -> tuple[Float[Array, " n"], Float[Array, " n"], tuple[Phase, ...]]:
    """Errors and phases by frame, from a score that has those frames only whose true pose is known."""
    n = len(track.status)
    error_m, error_deg = np.full(n, np.nan), np.full(n, np.nan)
    if score is None:
        return error_m, error_deg, ()
    times_s = 1e-9 * (track.time_ns - track.time_ns[0])
    at = np.abs(times_s[:, None] - score.time_s[None]).argmin(axis=0)
    error_m[at], error_deg[at] = score.errors.translation_m, score.errors.rotation_deg
    phases: list[Phase] = ["held"] * n
    for k, phase in zip(at, score.phase):
        phases[int(k)] = phase
    return error_m, error_deg, tuple(phases) if score.phase else ()


def _severity(e: TossDiagnostics) -> Float[Array, " n"]:
    """Larger is worse; lost frames are not ranked here. Of an error in degrees, one counts as a millimetre."""
    known = np.isfinite(e.error_m).any()
    bad = 1e3 * e.error_m + e.error_deg if known else e.residual
    return np.where(e.track.lost, np.nan, bad)


def _lost(e: TossDiagnostics, first: int, after: int) -> Worst:
    """A run of lost frames, shown by its middle."""
    middle = (first + after - 1) // 2
    of = f"frame {first} is" if after - first == 1 else f"frames {first} to {after - 1} are"
    return Worst(e.track.toss, middle, f"{of} lost", reasons(e, middle))


def _what(e: TossDiagnostics, i: int) -> str:
    if np.isfinite(e.error_m[i]):
        return f"{1e3 * e.error_m[i]:.1f} mm and {e.error_deg[i]:.1f} deg off the truth"
    return f"fits worst: residual {e.residual[i]:.2f}"


def reasons(e: TossDiagnostics, i: int) -> tuple[str, ...]:
    """What is unusual about a frame, beside what is usual in its toss; never empty."""
    said = [*_of_the_mask(e, i), *_of_the_fit(e, i), *_of_the_motion(e, i)]
    if e.track.status[i] == "interpolated":
        said.insert(0, "its pose is not sure, or one between its neighbours")
    return tuple(said) or ("nothing that was measured is unusual in it",)


def _of_the_mask(e: TossDiagnostics, i: int) -> list[str]:
    usual, said = _usual(e.mask_px), []
    if e.mask_px[i] == 0:
        return ["nothing of the object was found in the image"]
    if e.mask_px[i] < LITTLE * usual:
        said.append(f"little of it is seen: {e.mask_px[i]:.0f} pixels, usually {usual:.0f}")
    if e.at_edge[i] == 1:
        said.append("the image's edge cuts it off")
    if e.mask_confidence[i] < SURE:
        said.append(f"its mask is unsure ({e.mask_confidence[i]:.2f} of 1)")
    return said


def _of_the_fit(e: TossDiagnostics, i: int) -> list[str]:
    said, usual, on = [], _usual(e.residual), _usual(e.on_surface)
    if e.residual[i] > max(BAD * usual, LEAST_RESIDUAL):
        said.append(
            f"it disagrees with frames that see the same side: residual {e.residual[i]:.2f}, usually {usual:.2f}"
        )
    if e.on_surface[i] < LITTLE * on:
        said.append(f"only {100 * e.on_surface[i]:.0f} % of its points lie on the surface, usually {100 * on:.0f} %")
    return said


def _of_the_motion(e: TossDiagnostics, i: int) -> list[str]:
    phase = e.phase[i] if e.phase else ""
    if phase == "impact":
        return ["it is at an impact: the motion changes between two frames"]
    speed = speeds_m_s(e.track)
    usual = _usual(speed[speed > MOVING_M_S]) if (speed > MOVING_M_S).any() else np.inf
    if speed[i] > MUCH * usual:
        return [f"it is fast, {speed[i]:.1f} m/s (usually {usual:.1f} in motion), so likely blurred"]
    return ["a hand holds it, and hides a part"] if phase == "held" else []


def speeds_m_s(track: ObjectTrack) -> Float[Array, " n"]:
    """Of the body's origin, from the frame before; NaN next to a lost pose, 0 for the first frame."""
    step_m = np.linalg.norm(np.diff(track.camera_from_object[:, :3, 3], axis=0), axis=1)
    return np.r_[0.0, step_m / np.maximum(1e-9 * np.diff(track.time_ns), 1e-9)]


def _usual(values: Float[Array, " n"]) -> float:
    """The median of what is known; NaN (with which no comparison holds) where nothing is."""
    known: Sequence[float] = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan
