"""How well poses alone show a plane that is not where it was said to be: planes moved on purpose.

python tools/bench_plane.py [touch] [forecast]      # both by default

Needs the real cube tosses as tools/bench_contact.py does. One thread; `touch` takes 200 CPU seconds, `forecast` 400.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
from bench_contact import CUBE, block, l_mesh, line, noisy, prism, recorded_once, run_cases, simulated, there, toss

from processing.contact.learn import data_checks as checks
from processing.contact.learn.learn import ContactConfig, learn_contact
from processing.contact.learn.prior import prior_from_size
from processing.contact.learn.touch import TouchedPlane, plane_by_touch
from processing.contact.physics.geometry import CORNERS
from processing.contact.physics.inertia import uniform_physics
from processing.motion.phases import find_phases
from processing.motion.trajectory import PoseSeries
from recordings.errors import BadInput
from recordings.tracks import ObjectShape

SHIFTS_M = (-0.012, -0.008, -0.006, 0.0, 0.006, 0.008, 0.012)


def touched() -> None:
    """How far the plane seems to be off where tosses are moved up by SHIFTS_M, and what is said of it: by touches of
    real tosses (0-199 chose the limits, 200-399 did not; no recording is in both) and of simulated bodies (seed 11
    chose, 29 did not), by forecasts at 30 Hz: `forecast`."""
    for start in (0, 200):
        groups = [recorded_once(range(i, i + 16)) for i in range(start, start + 200, 16)]
        _said(f"real {start}-{start + 199}", [[toss(n) for n in g] for g in groups if len(g) >= 8])
    for seed, settings in (
        (11, ((0.002, 1.0, 0.25), (0.006, 1.0, 0.15), (0.002, 0.3, 0.4))),
        (29, ((0.003, 1.0, 0.3), (0.005, 0.6, 0.18), (0.0015, 0.4, 0.5))),
    ):
        for kind in ("sharp", "rounded by 4 mm"):
            made = []
            for pieces, truth in _plane_bodies(kind):
                shape = ObjectShape("object", "truth", np.asarray(truth.vertices), np.asarray(truth.faces, np.int64))
                physics = uniform_physics(shape, 0.37)
                for soft_s, damping, mu in settings:
                    tracks = simulated(pieces, physics, mu, 16, seed, soft_s, damping)
                    made.append([t.about(physics.center_of_mass_m) for t in tracks])
            _said(f"{kind}, seed {seed}", made)


def _plane_bodies(kind: str) -> list[tuple[list[object], object]]:
    """Boxes, a prism, a half cylinder and an L; or a cube with rounded edges."""
    import trimesh

    if kind != "sharp":
        ball = trimesh.creation.icosphere(subdivisions=2, radius=0.004).vertices
        made = trimesh.convex.convex_hull(np.concatenate([ball + 0.0484 * c for c in CORNERS]))
        return [([made], made)]
    angle = np.linspace(0, np.pi, 17)
    triangle = np.array([[-0.036, 0.0], [0.036, 0.0], [0.0, 0.0716]])
    whole = [block(-np.array(h), h) for h in ((0.05, 0.05, 0.05), (0.03, 0.045, 0.065), (0.02, 0.05, 0.06))]
    whole += [prism(triangle, 0.1), prism(0.04 * np.stack([np.cos(angle), np.sin(angle)], 1), 0.1)]
    ell = [block((0, 0, 0), (0.12, 0.04, 0.05)), block((0, 0.04, 0), (0.04, 0.1, 0.05))]
    return [([w], w) for w in whole] + [(ell, l_mesh())]


def _said(case: str, groups: Sequence[Sequence[PoseSeries]]) -> None:
    """Readings at no shift, and counts of what is said at each shift."""
    right = []
    for shift_m in SHIFTS_M:
        counts = dict.fromkeys(("refused", "below", "above", "nothing", "unknown"), 0)
        for tracks in groups:
            moved = [t.turned(np.eye(3), -shift_m) for t in tracks]
            releases = [find_phases(t, CUBE.inertia_kgm2).release or 0 for t in moved]
            found = plane_by_touch(moved, releases)
            counts[_verdict(found)] += 1
            if shift_m == 0 and found is not None:
                right.append(1e3 * found.height_m)
        line("touch", f"{case}, moved {1e3 * shift_m:+.0f} mm: " + ", ".join(f"{n} {w}" for w, n in counts.items()))
    line("touch", f"{case}, not moved: reads {np.mean(right):.1f} +- {np.std(right):.1f} mm, {np.round(right, 1)}")


def _verdict(found: TouchedPlane | None) -> str:
    if found is None:
        return "unknown"
    said = checks.plane_warning(found.height_m, found.std_m)
    try:
        checks.check_touched_plane(found.height_m, found.std_m)
    except BadInput:
        return "refused"
    return "nothing" if said is None else "below" if "mm below" in said else "above"


def forecast() -> None:
    """The same at 30 Hz with noise of 1 mm and .5 deg, of boxes, by forecasts: real tosses and simulated ones."""
    cases = [(f"real {g}..", [toss(n) for n in there(range(g, g + 10))], CUBE) for g in (0, 100, 200, 300)]
    for half in ((0.04, 0.04, 0.04), (0.035, 0.04, 0.055)):
        body = block(-np.array(half), half)
        shape = ObjectShape("object", "truth", np.asarray(body.vertices), np.asarray(body.faces, np.int64))
        physics = uniform_physics(shape, 0.37)
        cases.append((f"box {half}", simulated([body], physics, 0.3, 10, 29, 0.003), physics))
    for name, tracks, physics in cases:
        for shift_m in (-0.008, 0.0, 0.008):
            made = [noisy(t, 5, 1e-3, np.radians(0.5), 0).turned(np.eye(3), -shift_m) for t in tracks]
            config = ContactConfig(bootstrap_repeats=2)
            try:
                found = learn_contact(made, prior_from_size("box", 0.05), physics, config=config).checks
            except BadInput as wrong:
                line("forecast", f"{name}, moved {1e3 * shift_m:+.0f} mm: refused: {wrong}")
                continue
            height_m, std_m = found["plane_by_touch_m"], found["plane_by_touch_std_m"]
            said = checks.plane_warning(height_m, std_m)
            where = "nothing" if said is None else "below" if "mm below" in said else "above"
            line(
                "forecast",
                f"{name}, moved {1e3 * shift_m:+.0f} mm: {1e3 * (height_m or np.nan):.1f} +- "
                f"{1e3 * (std_m or np.nan):.1f} mm, said: {where}",
            )


CASES = {"touch": touched, "forecast": forecast}


if __name__ == "__main__":
    sys.exit(run_cases(CASES))
