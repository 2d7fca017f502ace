"""Is the calibration still true? Its age, and whether tags that stand still are where it says, in every toss."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from calibration.cameras.targets import Tags, TargetView, tag_view
from calibration.report import Finding, Level
from calibration.tags.detect import TagDetection
from recordings.tracks import RigCalibration

OLD_S = 3600.0
MOVED_PX = 0.5
FAR_MOVED_PX = 2.0
LEAST_CORNERS = 4


def age_findings(calibration: RigCalibration, recorded_unix_s: float) -> list[Finding]:
    """How old the calibration was when a toss was recorded (DROID asks again after an hour)."""
    if calibration.created_unix_s is None:
        return [Finding("note", "the calibration does not say when it was made")]
    age = recorded_unix_s - calibration.created_unix_s
    if age > OLD_S:
        text = f"the calibration was {age / 3600:.1f} h old at the recording, wanted at most {OLD_S / 3600:.0f}"
        return [Finding("note", f"{text}: look at the drift, or calibrate again")]
    return []


def drift_px(
    calibration: RigCalibration, camera: str, table: Tags, images: Sequence[Sequence[TagDetection]]
) -> Float[Array, "n 2"]:
    """By how much the table's tags are seen away from where the calibration says, per image (median over corners);
    NaN where an image shows none."""
    camera_from_world = calibration.find(camera, "world")
    out = np.full((len(images), 2), np.nan)
    if camera_from_world is None or camera not in calibration.cameras:
        return out
    for k, tags in enumerate(images):
        view = tag_view(table, tags)
        if len(view) >= LEAST_CORNERS:
            seen = calibration.camera(camera).project(camera_from_world.points(view.points_m))
            out[k] = np.nanmedian(view.pixels - seen, axis=0)
    return out


def drift_findings(
    calibration: RigCalibration, table: Tags, tags: Mapping[str, Sequence[Sequence[TagDetection]]]
) -> list[Finding]:
    """`camera moved` where a toss's static tags are off by more than half a pixel in the median image."""
    findings = []
    for camera, images in tags.items():
        off = drift_px(calibration, camera, table, images)
        off = off[np.isfinite(off).all(axis=1)]
        if not len(off):
            continue
        length = float(np.linalg.norm(np.median(off, axis=0)))
        if length > MOVED_PX:
            level: Level = "refused" if length > FAR_MOVED_PX else "warning"
            text = f"{camera} moved: the table's tags are {length:.2f} px from where the calibration has them"
            findings.append(Finding(level, f"{text}, wanted at most {MOVED_PX:g}; run `toss-calibrate cameras` again"))
    return findings


def bumps(views: Mapping[str, Sequence[TargetView]]) -> list[Finding]:
    """Cameras that moved between two views, by tags that stand still in all of them."""
    findings = []
    for camera, board_views in views.items():
        place = _places(board_views)
        known = np.flatnonzero(np.isfinite(place).all(axis=1))
        if len(known) < 3:
            continue
        path_px = place[known]
        jumps = [
            np.linalg.norm(np.median(path_px[:k], axis=0) - np.median(path_px[k:], axis=0))
            for k in range(1, len(known))
        ]
        worst = int(np.argmax(jumps))
        if jumps[worst] > MOVED_PX:
            before, after = known[worst], known[worst + 1]
            text = f"{camera} was bumped between view {before} and view {after}: what stands still moved by"
            level: Level = "refused" if jumps[worst] > FAR_MOVED_PX else "warning"
            findings.append(Finding(level, f"{text} {jumps[worst]:.2f} px; record the views again"))
    return findings


def _places(board_views: Sequence[TargetView]) -> Float[Array, "v 2"]:
    """Mean displacement of each view's corners from their medians over all views; NaN where a view shows none."""
    ids = np.unique(np.concatenate([v.ids for v in board_views])) if board_views else np.zeros(0, dtype=np.int64)
    middle = {
        i: np.median([v.pixels[v.ids == i][0] for v in board_views if (v.ids == i).any()], axis=0) for i in ids.tolist()
    }
    out = np.full((len(board_views), 2), np.nan)
    for k, view in enumerate(board_views):
        if len(view) >= LEAST_CORNERS:
            out[k] = np.median([view.pixels[n] - middle[i] for n, i in enumerate(view.ids.tolist())], axis=0)
    return out
