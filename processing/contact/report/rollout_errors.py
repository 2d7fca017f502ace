"""Rollouts of a learned model on tosses, and their summary: means with 95 % intervals over tosses, curves per step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.special import stdtrit

from processing.contact.learn.learn import ContactLearning
from processing.contact.learn.prepared import Prepared, prepare, starts
from processing.contact.physics.plane import Plane
from processing.contact.physics.rollout import (
    Rollout,
    RolloutErrors,
    Start,
    fine_steps,
    rollout_errors,
    simulate,
    simulate_law,
)
from processing.motion.smoother import Smoothed
from processing.motion.trajectory import PoseSeries

FIGURE_4_STEPS = 99
HELD_S = 0.1


@dataclass(frozen=True, eq=False)
class Summary:
    """Mean over tosses of the mean over steps, its 95 % interval over tosses, one number per toss, one per step."""

    mean: float
    low: float
    high: float
    per_toss: Float[Array, " n"]
    curve: Float[Array, " t"]
    curve_low: Float[Array, " t"]
    curve_high: Float[Array, " t"]
    count: Float[Array, " t"]

    def to_json(self) -> dict[str, Any]:
        curves = {name: getattr(self, name).tolist() for name in ("per_toss", "curve", "curve_low", "curve_high")}
        return {"mean": self.mean, "low": self.low, "high": self.high, **curves}


def summarise(errors: Float[Array, "n t"]) -> Summary:
    """Summary of errors per toss and step; NaN where a toss has ended."""
    per_toss = np.nanmean(errors, axis=1)
    mean, half = float(per_toss.mean()), _half_width(per_toss)
    columns = [c[np.isfinite(c)] for c in errors.T]
    curve = np.array([c.mean() if len(c) else np.nan for c in columns])
    width = np.array([_half_width(c) for c in columns])
    count = np.array([float(len(c)) for c in columns])
    return Summary(mean, mean - half, mean + half, per_toss, curve, curve - width, curve + width, count)


def _half_width(values: Float[Array, " n"]) -> float:
    """Half the 95 % interval of a mean (Student's t); 0 for a single value."""
    n = len(values)
    return float(stdtrit(n - 1, 0.975) * values.std(ddof=1) / n**0.5) if n > 1 else 0.0


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Rollouts of some tosses: errors against the tracks, and what could not be rolled out."""

    errors: RolloutErrors
    position: Summary
    rotation: Summary
    left_out: dict[int, str]
    rolled: Rollout
    start: Start
    start_time_s: tuple[float, ...]
    """Of the frame that each toss is rolled out from, since the toss's first frame."""

    def to_json(self) -> dict[str, Any]:
        return {
            "steps": int(self.errors.position_m.shape[1]),
            "dt_s": self.errors.step_s,
            "n_tosses": len(self.errors.tosses),
            "tosses": list(self.errors.tosses),
            "position_m": self.position.to_json(),
            "rotation_rad": self.rotation.to_json(),
            "start_time_s": list(self.start_time_s),
            "tosses_per_step": self.position.count.astype(int).tolist(),
            "solver_failures": self.errors.failures,
            "left_out": {str(t): why for t, why in self.left_out.items()},
        }


def evaluate(
    learning: ContactLearning,
    tracks: Sequence[PoseSeries],
    plane: Plane | None = None,
    steps: int = 80,
    step_s: float = 1 / 148,
    begin: Literal["first", "thrown", "release"] = "first",
    ready: Prepared | None = None,
) -> Evaluation:
    """Roll the learned model out from each toss's first frame (or its release), for steps of step_s or for finer ones
    where it has a law of contact, and compare with its track.

    `thrown`: from the first frame, unless a hand holds the object for HELD_S or longer: then from the release.
    `ready`: the tracks as they were prepared before.
    """
    inertia = learning.fitted.inertia_kgm2
    prepared = prepare(tracks, learning.frame, plane or Plane(), inertia) if ready is None else ready
    first = None if begin == "release" else [0 if begin == "first" else _thrown(s) for s in prepared.smoothed]
    fine_s = step_s if learning.law is None else step_s / fine_steps(step_s)
    start, frames = starts(prepared, fine_s, inertia, first)
    body, contacts = learning.body(), learning.fitted.geometry.contacts
    if learning.law is None:
        rolled = simulate(body, contacts, start, steps, step_s)
    else:
        rolled = simulate_law(body, contacts, learning.law, start, steps, step_s)
    errors = rollout_errors(rolled, prepared.tracks, list(frames), step_s)
    begun = tuple(float(t.time_s[b]) for t, b in zip(prepared.tracks, frames))
    position, rotation = summarise(errors.position_m), summarise(errors.rotation_rad)
    return Evaluation(errors, position, rotation, dict(prepared.left_out), rolled, start, begun)


def _thrown(smoothed: Smoothed) -> int:
    release = smoothed.phases.release or 0
    held_s = float(smoothed.states.time_s[release] - smoothed.states.time_s[0])
    return release if held_s >= HELD_S else 0


def world_poses(learning: ContactLearning, done: Evaluation, plane: Plane) -> dict[int, Float[Array, "t 4 4"]]:
    """`world_from_object` of every rollout: its start, then the pose after each step; as ghosts beside the tracks."""
    world_from_level, frame = plane.level_from_world().T, learning.frame
    found = {}
    for i, toss in enumerate(done.errors.tosses):
        rotation = np.concatenate([done.start.rotation[i : i + 1], done.rolled.rotation[i]])
        position = np.concatenate([done.start.position_m[i : i + 1], done.rolled.position_m[i]])
        poses = np.tile(np.eye(4), (len(rotation), 1, 1))
        poses[:, :3, :3] = world_from_level @ rotation @ frame.axes.T
        centers = (position + [0.0, 0.0, plane.offset_m]) @ world_from_level.T
        poses[:, :3, 3] = centers - poses[:, :3, :3] @ frame.origin_object_m
        found[toss] = poses
    return found
