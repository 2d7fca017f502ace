"""Whether a ground truth can be trusted, and why not: residuals by camera and tag, drift, times, gaps."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from groundtruth.session_detections import Detections
from groundtruth.session_solve import Corner, Solved
from recordings.tracks import RigCalibration

GOOD_PX = 0.5
"""Median corner error above this: something is wrong with the cameras, the tags or their sizes."""
GROSS_PX = 3.0
"""A tag that is off by more is not what it is taken for."""
TABLE_M = 0.005
"""Nor is a table tag that lies farther than this from its place."""
BUMPED_M, BUMPED_RAD = 0.0015, 0.002
DOUBTED = 0.05
"""Places are doubted that would be contradicted as much in no more than this share of sessions without a bump."""
OFF_FACTOR = 4.0
"""A tag or camera whose residual is this many times the others' is named."""


@dataclass(frozen=True)
class Verdict:
    """`faults` make the truth unfit for scores, `warnings` do not."""

    faults: tuple[str, ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    residual_px: Mapping[str, float]

    @property
    def good(self) -> bool:
        return not self.faults

    def document(self) -> dict[str, Any]:
        return {
            "good": self.good,
            "faults": list(self.faults),
            "warnings": list(self.warnings),
            "notes": list(self.notes),
            "median_residual_px": dict(self.residual_px),
        }


def judge(
    solved: Solved, detections: Detections, spread_ns: int, notes: Sequence[str], calibration: RigCalibration
) -> Verdict:
    by = _residuals(solved.corners)
    faults, warnings = [], []
    overall = float(np.median(np.concatenate([np.linalg.norm(c.left_px, axis=1) for c in solved.corners])))
    if overall > GOOD_PX:
        faults.append(
            f"corners are off by {overall:.2f} px (median; wanted at most {GOOD_PX}): intrinsics, the cameras' places "
            "or the tags' sizes are wrong; run `toss-calibrate cameras` again"
        )
    worst = _outstanding({n: v for n, v in by.items() if n.startswith("tag")}, overall)
    if worst is not None and by[worst] > GROSS_PX:
        number = worst.removeprefix("tag ")
        faults.append(
            f"{worst} is off by {by[worst]:.1f} px where others are by {overall:.2f}: it is on two bodies, or not "
            f"where calibration.json has it, and draws the cameras along; leave it out (`--ignore {number}`), or "
            "correct calibration.json"
        )
    elif worst is not None:
        warnings.append(
            f"{worst} is off by {by[worst]:.2f} px where others are by {overall:.2f}: is it bent, or loose?"
        )
    for tag, off_m in solved.table_off_m.items():
        if off_m > TABLE_M:
            faults.append(
                f"tag {tag} lies {1000 * off_m:.0f} mm from its place on the table in calibration.json, and draws the "
                f"cameras along; leave it out (`--ignore {tag}`), or correct calibration.json"
            )
    bumped = [(k, v) for k, v in solved.moved.items() if v[0] > BUMPED_RAD or v[1] > BUMPED_M]
    for (camera, toss), (turn, shift) in bumped:
        warnings.append(
            f"{camera} stood {1000 * shift:.1f} mm and {np.degrees(turn):.2f} deg elsewhere in toss {toss}: it was "
            "bumped; its place was estimated anew there. Run `toss-calibrate cameras` again before the next toss"
        )
    warnings += _displaced(solved) + _drift(solved, calibration)
    warnings += _gaps(solved, detections)
    if spread_ns > 100_000:
        warnings.append(
            f"the cameras' stamps of one trigger differ by up to {spread_ns / 1e6:.2f} ms: check the trigger"
        )
    if solved.unplaced:
        warnings.append(f"not connected to the rest and left out: {', '.join(solved.unplaced[:5])}")
    if detections.lost_images:
        warnings.append(f"the tag detector died on {detections.lost_images} images")
    return Verdict(tuple(faults), tuple(warnings), tuple(notes), {"all": overall, **by})


def _residuals(corners: Sequence[Corner]) -> dict[str, float]:
    """Median corner error by camera and by tag."""
    groups: dict[str, list[float]] = defaultdict(list)
    for c in corners:
        size = np.linalg.norm(c.left_px, axis=1).tolist()
        groups[c.camera] += size
        groups[f"tag {c.tag_id}"] += size
    return {name: float(np.median(values)) for name, values in sorted(groups.items())}


def _outstanding(values: Mapping[str, float], overall: float) -> str | None:
    worst = max(values, key=lambda n: values[n], default=None)
    return worst if worst is not None and values[worst] > max(OFF_FACTOR * overall, 0.4) else None


def _displaced(solved: Solved) -> list[str]:
    """Cameras bumped since their calibration, and a doubt that names none."""
    found = [
        f"{name} does not stand where calibration.json has it: it was bumped since; its place was estimated anew. Run "
        "`toss-calibrate cameras` again before the next toss"
        for name in solved.displaced
    ]
    if solved.by_chance < DOUBTED:
        found.append(
            f"the cameras' places in calibration.json are contradicted by {solved.tension:.1f} standard deviations: "
            f"one may have been bumped a little; deviations of poses are stated {solved.tension:.1f} times as wide"
        )
    return found


def _drift(solved: Solved, calibration: RigCalibration) -> list[str]:
    """Cameras that stand elsewhere than calibration.json says, or of which it says nothing."""
    found = []
    for name, pose in solved.cameras.items():
        known = calibration.find("world", calibration.camera(name).frame)
        if known is None:
            found.append(
                f"{name} has no place in calibration.json, tags placed it; `toss-calibrate cameras` does so far better"
            )
            continue
        difference = np.linalg.inv(known.matrix) @ pose
        shift = float(np.linalg.norm(difference[:3, 3]))
        turn = float(np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1)))
        if shift > 0.003 or turn > 0.005:
            found.append(
                f"{name} stands {1000 * shift:.1f} mm and {np.degrees(turn):.2f} deg from its place in "
                "calibration.json: run `toss-calibrate cameras` again"
            )
    return found


def _gaps(solved: Solved, detections: Detections) -> list[str]:
    """Frames without any tag of the body, and cameras that miss images."""
    found = []
    for toss, cameras in detections.frames.items():
        every = np.unique(np.concatenate(list(cameras.values()))) if cameras else np.zeros(0, np.int64)
        blind = len(every) - len(solved.tracks[toss].time_ns)
        if blind:
            found.append(f"toss {toss}: no camera saw a tag of the object in {blind} of {len(every)} instants")
        short = {name: len(every) - len(times) for name, times in cameras.items() if len(times) < len(every)}
        if short and len({len(t) for t in cameras.values()}) > 1:
            missing = ", ".join(f"{name} {n}" for name, n in short.items())
            found.append(f"toss {toss}: images are missing ({missing} of {len(every)})")
    return found
