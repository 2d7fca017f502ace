"""Whether the camera stood still and sees the same scene: the picture as a whole against that of another frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.records import RgbdFrame


def refuse_moving_camera(colors: Sequence[UInt8[Array, "h w 3"]], hidden: Sequence[Bool[Array, "h w"]] | None) -> None:
    """Raise BadInput where the picture as a whole shifts between frames.

    Corners of one frame are followed into the others; things that move are few against a room that stands still.
    """
    shifts = [s for s in picture_shifts(colors, hidden) if np.isfinite(s)]
    if not shifts or max(shifts) < MOVED_PX:
        return
    moved = sum(s >= MOVED_PX for s in shifts)
    raise BadInput(
        f"this camera seems to move: the picture as a whole shifts by up to {max(shifts):.1f} px within the session "
        f"(more than {MOVED_PX:g} px in {moved} of {len(shifts)} frames looked at). "
        "Masks need a camera that stands still: record from a fixed one; where it was bumped once, "
        "process the tosses before and after it apart, `--toss I-J`"
    )


MOVED_PX = 1.5
SAME_SCENE = 0.6
"""Another toss shows the same scene where so much of its depth agrees; object, hand and robot come and go."""
SAME_PICTURE = 0.5
"""Least correlation with a picture of the same scene, where no corners can be followed into it."""
CORNERS = 250
LEAST_CORNERS = 40
STILL_SHARE = 0.25
"""On so much of the picture at least the corners are on what stands still."""
CELLS, LEAST_CELLS = (9, 12), 20
"""The picture is looked at in so many rows and columns of cells, each of which counts once: the corners of a patterned
object before a plain room are many, but lie together. Where fewer cells are followed nothing can be told."""
ALIKE = 0.5
"""More than half of the cells shift alike, but for this share of the shift, or nothing can be told: what lies near a
camera shifts more than what lies far, but corners on stripes slide along them, each by another length."""
AROUND_PX, NOISE_LEVELS = 8.0, 4.0
"""Corners are followed by what differs from its neighbourhood (as wide as the window below), in units of its contrast,
which is noise below so many grey levels."""
FOLLOW: Mapping[str, Any] = {"winSize": (21, 21), "maxLevel": 3}


def picture_shifts(colors: Sequence[UInt8[Array, "h w 3"]], hidden: Sequence[Bool[Array, "h w"]] | None) -> list[float]:
    """How far the picture as a whole has shifted (px) from the middle frame; NaN where nothing can be told.

    It is the first quartile over the picture's cells of the followed corners' distances: before a plain room most
    corners lie on what really moves, an object, a hand, an arm; when the camera moves, all do.
    """
    middle = len(colors) // 2
    others = colors[:: max(1, len(colors) // 16)]
    reference, corners = _corners(colors[middle], None if hidden is None else hidden[middle])
    if corners is None:
        return [float("nan")] * len(others)
    return [_shift(reference, _even(_grey(other)), corners) for other in others]


def why_other_scene(
    reference: RgbdFrame, others: Sequence[RgbdFrame], hidden: Sequence[Bool[Array, "h w"]] | None
) -> str | None:
    """Why these frames do not show the scene of the reference frame; None where they do.

    `hidden`: where something known (the robot) may stand in the reference frame and in each other one.
    """
    if any(f.color_rgb.shape != reference.color_rgb.shape for f in others):
        return "its images have another size"
    even, corners = _corners(reference.color_rgb, None if hidden is None else hidden[0])
    shifts = [] if corners is None else [_shift(even, _even(_grey(f.color_rgb)), corners) for f in others]
    if shifts and np.isnan(shifts).all():
        grey = _grey(reference.color_rgb)
        if max(_correlation(grey, _grey(f.color_rgb)) for f in others) < SAME_PICTURE:
            return "its picture has nothing in common with theirs"
    elif shifts and np.nanmax(shifts) >= MOVED_PX / 2:
        return f"the camera was moved (its picture is shifted by {np.nanmax(shifts):.1f} px)"
    covered = [np.zeros(even.shape, dtype=bool)] * (len(others) + 1) if hidden is None else hidden
    alike = [_share_alike(reference, f, covered[0] | h) for f, h in zip(others, covered[1:], strict=True)]
    if np.median(alike) < SAME_SCENE:
        return f"its depth shows another scene ({100 * np.median(alike):.0f} % of it agree)"
    return None


def _correlation(one: UInt8[Array, "h w"], two: UInt8[Array, "h w"]) -> float:
    """Of two pictures without what is finer than noise, -1 to 1."""
    import cv2

    size = (one.shape[1] // 8, one.shape[0] // 8)
    small_one, small_two = (cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in (one, two))
    return float(cv2.matchTemplate(small_one, small_two, cv2.TM_CCOEFF_NORMED)[0, 0])


def _share_alike(reference: RgbdFrame, other: RgbdFrame, hidden: Bool[Array, "h w"]) -> float:
    """Share of the pixels seen in both frames that have the same depth; 0 where hardly any is seen in both."""
    one, two = reference.depth_m, other.depth_m
    both = (one > 0) & (two > 0) & ~hidden
    if both.sum() < 0.05 * ((one > 0) & ~hidden).sum() or not both.any():
        return 0.0
    return float((np.abs(one[both] - two[both]) < np.maximum(0.02, 0.03 * one[both] ** 2)).mean())


def _grey(color_rgb: UInt8[Array, "h w 3"]) -> UInt8[Array, "h w"]:
    import cv2

    return np.asarray(cv2.cvtColor(np.ascontiguousarray(color_rgb), cv2.COLOR_RGB2GRAY))


def _corners(
    color_rgb: UInt8[Array, "h w 3"], hidden: Bool[Array, "h w"] | None
) -> tuple[UInt8[Array, "h w"], Float32[Array, "n 1 2"] | None]:
    """The picture, even, and its corners; None where there are too few."""
    import cv2

    grey = _grey(color_rgb)
    free = None if hidden is None else np.where(hidden, 0, 255).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(grey, CORNERS, 0.01, 6, mask=free)
    return _even(grey), None if corners is None or len(corners) < LEAST_CORNERS else np.asarray(corners)


def _even(grey: UInt8[Array, "h w"]) -> UInt8[Array, "h w"]:
    """The picture without its brightness and contrast in the neighbourhood: a camera's gain changes from frame to
    frame, and brightness that differs makes corners leap by a period of a pattern that repeats (a table's holes)."""
    import cv2

    picture = grey.astype(np.float32)
    detail = picture - cv2.GaussianBlur(picture, (0, 0), AROUND_PX)
    contrast = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), AROUND_PX))
    return np.asarray(np.clip(128 + 48 * detail / (contrast + NOISE_LEVELS), 0, 255).astype(np.uint8))


def _cells(picture: UInt8[Array, "h w"], corners: Float32[Array, "n 1 2"]) -> Int[Array, " n"]:
    """The number of each corner's cell of the picture."""
    row, column = (corners[:, 0, ::-1] * CELLS / picture.shape).astype(np.int64).T
    return np.asarray(row * CELLS[1] + column)


def _shift(reference: UInt8[Array, "h w"], other: UInt8[Array, "h w"], corners: Float32[Array, "n 1 2"]) -> float:
    """NaN where too little is followed or where what shifts does not shift as one picture does.

    A camera's own motion moves the picture by a similarity, but for parallax (`ALIKE`).
    """
    import cv2

    before, after = _followed(reference, other, corners)
    if len(before) < LEAST_CELLS:
        return float("nan")
    shift = float(np.quantile(np.linalg.norm(after - before, axis=1), STILL_SHARE))
    near = max(MOVED_PX / 2, ALIKE * shift)
    cv2.setRNGSeed(0)
    similarity, alike = cv2.estimateAffinePartial2D(before, after, ransacReprojThreshold=near)
    as_one = similarity is not None and float(np.mean(alike)) > 0.5
    return shift if shift < MOVED_PX / 2 or as_one else float("nan")


def _followed(
    reference: UInt8[Array, "h w"], other: UInt8[Array, "h w"], corners: Float32[Array, "n 1 2"]
) -> tuple[Float32[Array, "k 2"], Float32[Array, "k 2"]]:
    """Where each cell's corners lie (px, their median) in both pictures; of those found there and back again."""
    import cv2

    there, found, _ = cv2.calcOpticalFlowPyrLK(reference, other, corners, corners.copy(), **FOLLOW)
    back, again, _ = cv2.calcOpticalFlowPyrLK(other, reference, there, there.copy(), **FOLLOW)
    followed = (np.asarray(found) > 0).ravel() & (np.asarray(again) > 0).ravel()
    good = followed & (np.linalg.norm(np.asarray(back) - corners, axis=-1).ravel() < 0.5)
    if good.sum() < LEAST_CORNERS:
        return np.zeros((0, 2), dtype=np.float32), np.zeros((0, 2), dtype=np.float32)
    cells, pair = _cells(reference, corners)[good], np.concatenate([corners, np.asarray(there)], axis=1)[good]
    medians = np.array([np.median(pair[cells == cell], axis=0) for cell in np.unique(cells)], dtype=np.float32)
    return np.ascontiguousarray(medians[:, 0]), np.ascontiguousarray(medians[:, 1])
