"""What is wrong with one toss, in words that say what to do otherwise next time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from processing.contact.learn.shape_comparison import series_of
from processing.live.config import LiveConfig
from processing.motion.phases import find_phases
from recordings.constants import LUMA
from recordings.geometry import Transform
from recordings.records import RgbdFrame, TossWindow
from recordings.tracks import ObjectTrack

LEAST_FRAMES = 5
"""Of a track, to be cut into phases."""


@dataclass(frozen=True)
class Seen:
    """What each frame shows of the object: pixels of its mask, whether the image's edge cuts it, the mask's center in
    pixels (NaN without a mask), whether its motion blurs it."""

    pixels: Array
    cut: Bool[Array, " n"]
    center_px: Float[Array, "n 2"]
    blurred: Bool[Array, " n"]

    @property
    def frames(self) -> int:
        """How many frames show it."""
        return int((self.pixels > 0).sum())


@dataclass(frozen=True)
class Instants:
    """First frames of flight, of impact, of the rest at the end; None where there is none."""

    release: int | None = None
    impact: int | None = None
    rest: int | None = None


def what_is_seen(frames: Sequence[RgbdFrame], masks: Sequence[Bool[Array, "h w"]], config: LiveConfig) -> Seen:
    """Looks through all frames of one toss."""
    n = len(masks)
    pixels, cut, center = np.zeros(n, dtype=int), np.zeros(n, dtype=bool), np.full((n, 2), np.nan)
    for i in range(n):
        rows, columns = np.nonzero(masks[i])
        pixels[i] = len(rows)
        if len(rows):
            height, width = masks[i].shape
            margin = config.left_view_px
            cut[i] = bool(
                rows.min() < margin
                or columns.min() < margin
                or rows.max() >= height - margin
                or columns.max() >= width - margin
            )
            center[i] = columns.mean(), rows.mean()
    motion = np.zeros((n, 2))
    motion[1:] = np.nan_to_num(np.diff(center, axis=0))
    fast = np.linalg.norm(motion, axis=1) > config.blur_px
    blurred = np.array(
        [bool(fast[i]) and _sharpness(frames[i], masks[i], motion[i]) < config.blurred for i in range(n)], dtype=bool
    )
    return Seen(pixels, cut, center, blurred)


def _sharpness(frame: RgbdFrame, mask: Bool[Array, "h w"], motion_px: Float[Array, "2"]) -> float:
    """Squared gradients along the motion to those across it, inside the outline: 1 where neither is blurred."""
    rows, columns = np.nonzero(mask)
    area = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    inner = cv2.erode(np.ascontiguousarray(mask[area]).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    if inner.sum() < 50:
        return 1.0
    gray = np.ascontiguousarray(frame.color_rgb[area].astype(np.float32) @ np.array(LUMA, dtype=np.float32))
    dx, dy = cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1)
    u, v = motion_px / np.linalg.norm(motion_px)
    along, across = (u * dx + v * dy)[inner], (-v * dx + u * dy)[inner]
    return float((along**2).mean() / max(float((across**2).mean()), 1e-6))


def instants_of(
    track: ObjectTrack, world_from_camera: Transform | None, center_m: Float[Array, "3"], inertia: Float[Array, "3 3"],
    recorded: TossWindow,
) -> Instants:  # fmt: skip
    """Flight, impact and rest of a track; nothing where the table is not calibrated or too little was tracked. A rest
    that the recorder saw is one, where the few frames of it that were looked at do not prove it."""
    kept = [i for i, s in enumerate(track.status) if s == "tracked"]
    if world_from_camera is None or len(kept) < LEAST_FRAMES:
        return Instants()
    series = series_of({track.toss: track}, world_from_camera)[0].about(center_m)
    phases = find_phases(series, inertia)
    found = (phases.release, phases.first_impact, phases.rest)
    release, impact, rest = (None if i is None else kept[min(i, len(kept) - 1)] for i in found)
    if rest is None and recorded.rest_time_ns is not None:
        seen = int(np.searchsorted(track.time_ns, recorded.rest_time_ns))
        rest = seen if seen < len(track.time_ns) else None
    return Instants(release, impact, rest)


def verdict(
    track: ObjectTrack, seen: Seen, instants: Instants, judged: bool, ambiguous: bool, joined: bool, config: LiveConfig
) -> tuple[str, ...]:
    """Everything that is wrong; nothing where the toss is good. `judged`: the table is known, so that rest can be."""
    said = [_out_of_view(seen), _blur(seen, config), _flags(track, seen, config)]
    if judged and instants.release is None:
        said.append("no free flight was found: it was carried, or is too short")
    elif judged and instants.rest is None:
        said.append("never at rest: record longer, or throw lower")
    if not joined:
        said.append("no place among the other tosses was found: is it the same object?")
    elif ambiguous:
        said.append("twin not decided: it looks alike from several sides; show a side that differs")
    return tuple(text for text in said if text)


def _out_of_view(seen: Seen) -> str:
    there = np.flatnonzero(seen.pixels > 0)
    if len(there) == 0:
        return "the object was not found in any frame"
    last = int(there[-1])
    gone = len(seen.pixels) - 1 - last
    if gone and seen.cut[last]:
        return f"the object left the view in frame {last}, and is not seen in the {gone} frames after it"
    if gone > 2:
        return f"the object is not seen in the last {gone} frames"
    cut = int(seen.cut.sum())
    return f"the image's edge cuts the object in {cut} frames" if cut > 2 else ""


def _blur(seen: Seen, config: LiveConfig) -> str:
    blurred = int(seen.blurred.sum())
    if blurred <= config.most_blurred * max(seen.frames, 1):
        return ""
    moved = np.linalg.norm(np.diff(seen.center_px, axis=0), axis=1)
    return (
        f"blurred in {blurred} frames (up to {np.nanmax(moved):.0f} pixels from frame to frame): a shorter exposure, "
        "or a slower throw"
    )


def _flags(track: ObjectTrack, seen: Seen, config: LiveConfig) -> str:
    flagged, lost = track.status.count("interpolated"), track.status.count("lost")
    if not seen.frames or flagged + lost <= config.most_flagged * len(track.status):
        return ""
    return f"{flagged} frames have no sure pose and {lost} none, of {len(track.status)}"
