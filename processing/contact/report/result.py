"""The result of contact learning as JSON and as lines to read."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from processing.contact.friction.estimate import RESTITUTION_ASSUMED
from processing.contact.learn.data_checks import plane_warning
from processing.contact.learn.learn import ContactLearning
from processing.contact.report.rollout_errors import Evaluation
from recordings.notices import Notice, in_order

PLANE_NOTE = (
    "the height of the plane and the size of the object are nearly one: of poses alone only those that the plane "
    "carries tell them apart, at 100 Hz and more, and rounded edges read as a plane that is higher by their radius "
    "(checks.plane_by_touch_m); with a measured shape the resting object's lowest point shows it"
)


def result_document(learning: ContactLearning, evaluation: Evaluation | None) -> dict[str, Any]:
    """What `--json` prints (without the seconds of the whole command, which the command adds)."""
    sizes = learning.extents
    document: dict[str, Any] = {
        "geometry": learning.geometry,
        "friction": learning.friction.to_json(),
        "restitution": None if learning.restitution is None else learning.restitution.to_json(),
        "extents_m": [s.to_json() for s in sizes],
        "intervals_by": learning.spread.method,
        "ground_plane_sensitivity": dict(learning.plane_sensitivity),
        "ground_plane_note": PLANE_NOTE,
        "transitions": learning.transitions,
        "solver_failures": learning.solver_failures,
        "untouched_vertices": list(learning.untouched_vertices),
        "tosses": list(learning.tosses),
        "left_out": {str(t): why for t, why in learning.left_out.items()},
        "duplicates": [list(g) for g in learning.duplicates],
        "unexplained_impacts": {
            "transitions": sum(len(f) for f in learning.unexplained.values()),
            "frames": {str(t): list(f) for t, f in learning.unexplained.items()},
        },
        "weights": dataclasses.asdict(learning.weights),
        "weights_tried": [] if learning.sweep is None else learning.sweep.table(),
        "physics": {
            "source": learning.model.physics_source,
            "mass_kg": learning.model.mass_kg,
            "inertia_kgm2": learning.model.inertia_kgm2.tolist(),
            "center_of_mass_m": learning.model.center_of_mass_m.tolist(),
            "note": "mass is not observable from tosses: it was given or assumed, not learned",
        },
        "checks": dict(learning.checks),
        "pose_noise": _noise(learning),
        "cpu_seconds": learning.cpu_seconds,
    }
    if learning.geometry == "box":
        document["edges_m"] = [s.value for s in sizes]
    else:
        document["vertices_m"] = learning.model.support_vertices_m.tolist()
        if learning.spread.points_m is not None:
            document["vertices_half_width_m"] = learning.spread.points_m.tolist()
    if evaluation is not None:
        document["rollout"] = evaluation.to_json()
    return document


def _noise(learning: ContactLearning) -> dict[str, float]:
    values = np.array(list(learning.noise.values()))
    return {"position_m": float(np.median(values[:, 0])), "rotation_rad": float(np.median(values[:, 1]))}


def warnings_of(learning: ContactLearning) -> list[Notice]:
    """What a reader must know before the numbers."""
    found = [left_out_notice(t, why) for t, why in learning.left_out.items()]
    if learning.unexplained:
        count = sum(len(f) for f in learning.unexplained.values())
        seen = f"{count} moments of contact were not learned from: the plane cannot explain their impacts"
        do = "most often the track is off there, else something other than the table was hit"
        found.append(Notice("contact", "medium", seen, do))
    if not learning.spread.friction_seen:
        seen = "no toss is seen to fly and to hit the plane: nothing is known of friction, a usual one stands there"
        do = "look at the frames after the release with `toss-view RESULTS`; most often they are unsure, or too few"
        found.append(Notice("contact", "high", seen, do))
    if learning.solver_failures:
        seen = f"{learning.solver_failures} moments of contact could not be solved for their forces at the end"
        found.append(Notice("contact", "medium", seen, "friction and shape are less sure than their intervals"))
    if learning.untouched_vertices:
        count, of = len(learning.untouched_vertices), len(learning.touched)
        seen = f"{count} of {of} points were never touched: the shape from before stands there"
        found.append(Notice("contact", "low", seen))
    if (plane := plane_warning(*(learning.checks.get(f"plane_by_touch{n}_m") for n in ("", "_std")))) is not None:
        found.append(Notice("contact", "high", plane, sure="likely"))
    if len(learning.tosses) == 1:
        seen = "contact was learned from one toss only: its intervals are wide"
        found.append(Notice("contact", "low", seen, "record more tosses"))
    return found


def left_out_notice(toss: int, why: str) -> Notice:
    """Of a toss that contact was not learned from."""
    return Notice("contact", "medium", f"contact was not learned from toss {toss}: {why}")


def result_text(learning: ContactLearning, evaluation: Evaluation | None, warnings: Sequence[str] = ()) -> str:
    """A few lines for the terminal; `warnings` are those that the command adds."""
    f, e = learning.friction, learning.restitution
    edges = " x ".join(f"{s.value * 1e3:.1f}" for s in learning.extents)
    half = ", ".join(f"{(s.high - s.low) / 2e-3:.1f}" for s in learning.extents)
    lines = [f"warning: {w}" for w in (*(n.text for n in in_order(warnings_of(learning))), *warnings)]
    rebound = []
    if e is not None:
        rebound = [f"rebound   restitution {e.value:.2f} (95 %: {e.low:.2f} .. {e.high:.2f}; {RESTITUTION_ASSUMED})"]
    lines += [
        f"learned from {len(learning.tosses)} tosses, {learning.transitions} transitions ({learning.geometry})",
        f"size      {edges} mm (95 %: +- {half})",
        f"friction  {f.value:.3f} (95 %: {f.low:.3f} .. {f.high:.3f}; {learning.spread.method})",
        *rebound,
        f"plane     1 mm higher makes the size {learning.plane_sensitivity['mean_extent_m_per_m']:+.2f} mm",
        f"physics   {learning.model.physics_source}; weight of dissipation {learning.weights.dissipation:g}",
        f"fit       {learning.cpu_seconds:.1f} CPU-s, {learning.solver_failures} unsolved inner problems",
    ]
    if evaluation is not None:
        p, r = evaluation.position, evaluation.rotation
        steps, n = evaluation.errors.position_m.shape[1], len(evaluation.errors.tosses)
        lines.append(
            f"rollouts  {p.mean * 1e3:.1f} mm ({p.low * 1e3:.1f} .. {p.high * 1e3:.1f}), {np.degrees(r.mean):.1f} deg "
            f"({np.degrees(r.low):.1f} .. {np.degrees(r.high):.1f}) over {steps} steps, {n} tosses"
        )
    return "\n".join(lines)
