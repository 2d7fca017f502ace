"""How often a camera bumped since its calibration is said, how often one that was not: simulated sessions of one toss.

python tools/bench_bumps.py SESSIONS.jsonl --first 0 --count 100     # simulates, a line a session; appends
python tools/bench_bumps.py SESSIONS.jsonl                           # the table

Every session has another toss, other noise, and cameras and table tags that stand off their calibration by what
SolveConfig states; in two of three one camera is shifted (1 to 6 mm) and turned (up to 2 mrad) besides, any way.
Nothing is chosen on these sessions: SolveConfig.false_alarm and DOUBTED are levels of a test whose distribution is
known, and the table says in how many sessions without a bump the test came out below each (a calibrated one: in just
as many).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "groundtruth"))

from conftest import TossLab, lab

from groundtruth.session_detections import assign_roles, shared_times
from groundtruth.session_solve import SolveConfig, Solved, solve_session
from groundtruth.verdict import DOUBTED
from recordings.geometry import Transform

CAMERAS = ("mono0", "mono1", "mono2")
BUMP_MM, TURN_RAD = (1.0, 6.0), 0.002
LEVELS = (0.5, 0.2, 0.1, 0.05, 0.02)


@dataclass(frozen=True)
class Outcome:
    """A solved session: the largest contradiction that remains, in standard deviations (`tension`), how likely it is by
    chance, and who was given up; root mean square error of the body's positions in the world, and what is stated for it
    (tension included)."""

    tension: float
    by_chance: float
    displaced: tuple[str, ...]
    off_mm: float
    stated_mm: float


def random_motion(chance: np.random.Generator, sigma: tuple[float, float]) -> Transform:
    """A small motion with these standard deviations an axis, rad and m."""
    turn = Rotation.from_rotvec(sigma[0] * chance.normal(size=3)).as_matrix()
    return Transform("camera", "camera", turn, sigma[1] * chance.normal(size=3))


def nudged(known: Transform, motion: Transform) -> Transform:
    """The place that a calibration states where the thing stands a small motion off it."""
    moved_m = known.translation_m + motion.translation_m
    return replace(known, rotation=known.rotation @ motion.rotation, translation_m=moved_m)


def session(number: int) -> tuple[TossLab, str | None, float]:
    """The simulated session of this number, its bumped camera and by how many millimetres it was shifted."""
    chance, config = np.random.default_rng(10_000 + number), SolveConfig()
    shift_mm, camera, bumped = 0.0, None, None
    if (number // 2) % 3:
        camera, shift_mm = str(chance.choice(CAMERAS)), float(chance.uniform(*BUMP_MM))
        direction, axis = (v / np.linalg.norm(v) for v in chance.normal(size=(2, 3)))
        turn = Rotation.from_rotvec(chance.uniform(0, TURN_RAD) * axis).as_matrix()
        bumped = (camera, 0, Transform("camera", "camera", turn, 1e-3 * shift_mm * direction))
    made = lab(tosses=1, seed=1 + number, bumped=bumped)
    cameras = tuple(nudged(p, random_motion(chance, config.camera_sigma)) for p in made.calibration.transforms)
    tags = tuple(
        replace(t, world_from_tag=nudged(t.world_from_tag, random_motion(chance, config.table_sigma)))
        for t in made.calibration.table_tags
    )
    calibration = replace(made.calibration, transforms=cameras, table_tags=tags)
    return replace(made, calibration=calibration), camera, shift_mm


def outcome(made: TossLab) -> Outcome:
    """The session solved as `toss-truth` does."""
    detections, _ = shared_times(made.detections, 500_000)
    roles = assign_roles(detections, made.calibration, frozenset(), None)
    sizes = dict.fromkeys(roles.body | roles.still, 0.07)
    found = solve_session(detections, roles, sizes, made.calibration)
    return Outcome(found.tension, found.by_chance, found.displaced, *errors_mm(found, made))


def errors_mm(found: Solved, made: TossLab) -> tuple[float, float]:
    """Root mean square over the toss of the error of the object's place, and of the stated deviation of the body's: in
    the world, nothing aligned."""
    track = found.tracks[0]
    centroid_m = np.mean([(T @ np.linalg.inv(made.layout[i]))[:3, 3] for i, T in found.layout.items()], axis=0)
    placed: Float[Array, "n 3"] = track.world_from_tagged[:, :3, :3] @ centroid_m + track.world_from_tagged[:, :3, 3]
    off = placed - made.truth[0][:, :3, 3]
    stated = np.einsum("nii->n", track.covariance[:, 3:, 3:]).mean()
    return 1e3 * float(np.sqrt((off**2).sum(axis=1).mean())), 1e3 * float(np.sqrt(stated))


def simulate(path: Path, first: int, count: int) -> None:
    """Append a line a session."""
    for number in range(first, first + count):
        made, camera, shift_mm = session(number)
        line: dict[str, Any] = {"number": number, "bumped": camera, "shift_mm": shift_mm}
        line |= asdict(outcome(made))
        with path.open("a") as file:
            file.write(json.dumps(line) + "\n")


def table(lines: Sequence[dict[str, Any]]) -> str:
    """How likely the contradiction is by chance where there was no bump, and how sessions fare by the bump's size."""
    calm = [line for line in lines if line["bumped"] is None]
    chance = np.array([0.0 if line["displaced"] else line["by_chance"] for line in calm])
    shares = ", ".join(f"{level:g}: {(chance <= level).mean():.3f}" for level in LEVELS)
    rows = [f"{len(calm)} sessions without a bump; by chance at most {shares}"]
    for low, high in ((0.0, 0.5), (1.0, 2.0), (2.0, 3.0), (3.0, 4.0), (4.0, 6.0)):
        group = [line for line in lines if low <= line["shift_mm"] < high]
        if not group:
            continue
        named = np.mean([bool(got["displaced"]) for got in group])
        right = np.mean([tuple(got["displaced"]) == (got["bumped"],) for got in group])
        said = np.mean([bool(got["displaced"]) or got["by_chance"] < DOUBTED for got in group])
        held = np.mean([got["off_mm"] < 2 * got["stated_mm"] for got in group])
        off = np.quantile([got["off_mm"] for got in group], 0.95)
        rows.append(
            f"{low:g} to {high:g} mm: {len(group)} sessions; named {named:.2f} (the right one {right:.2f}), said "
            f"{said:.2f}; error within 2 stated deviations {held:.2f}, below {off:.2f} mm in 95 %"
        )
    return "\n".join(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sessions", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=0)
    args = parser.parse_args()
    simulate(args.sessions, args.first, args.count)
    if not args.count:
        print(table([json.loads(line) for line in args.sessions.read_text().splitlines()]))
