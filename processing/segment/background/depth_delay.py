"""How much later than colour depth is exposed: the object stands elsewhere in depth than in colour.

In every frame the object's outline in depth is laid onto what does not look like the scene in colour. The way between
the two grows with the object's speed in the image,

    way = offset - speed * delay,

while the offset (shadows of the projector, fattened edges) is there at rest, too. A line through all frames of all
tosses tells the delay and how sure it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int64
from numpy import ndarray as Array
from scipy.special import expit

from processing.segment.background.foreground import (
    ForegroundSettings,
    grown,
    largest_component,
    nearer_than_scene,
    window_around,
)
from processing.segment.background.late_depth import LateDepthSettings, unlike_scene
from processing.segment.background.static_scene import StaticScene
from recordings.constants import MAD_TO_SIGMA
from recordings.estimation.robust import TUKEY_95, tukey_weight
from recordings.records import RgbdFrame
from recordings.session import RgbdFrames


@dataclass(frozen=True)
class DepthDelaySettings:
    """When a delay is believed, and how the way between depth and colour is sought."""

    least_s: float = 0.002
    """A smaller delay moves nothing by more than depth's own noise."""
    right: float = 0.95
    right_if_same: float = 0.5
    """Of all recordings, those whose stamps are right: most where depth has stamps of its own, half of those where they
    are colour's, which often only says that nobody measured. In the others stamps are off by ..."""
    off_s: float = 0.01
    """... this much (standard deviation): up to half a frame's interval at 30 Hz."""
    longest_s: float = 0.033
    """Depth later than a frame's interval belongs to another frame."""
    least_frames: int = 6
    """So many frames must show the object moving ..."""
    moving_px_s: float = 60.0
    """... faster than this."""
    steady: float = 0.35
    """An impact's frame, whose speeds before and after differ by more than this share, tells nothing."""
    fast_frames: int = 12
    slow_frames: int = 4
    """Of each toss so many of the fastest frames are looked at, and of the slowest."""
    least_px: float = 0.1
    """A way between two outlines errs by no less."""
    blur_px: float = 1.0
    border_px: int = 4
    """Around the mask that is sought in, beside the way that the longest delay makes."""
    late: LateDepthSettings = field(default_factory=LateDepthSettings)
    foreground: ForegroundSettings = field(default_factory=ForegroundSettings)
    """What differs from the scene, in colour and in depth."""


@dataclass(frozen=True, eq=False)
class OutlineShifts:
    """What the frames of one toss tell: how far (x, y; pixels) colour shows the object from where depth does, and how
    fast it moves (pixels a second)."""

    way_px: Float[Array, "n 2"]
    speed_px_s: Float[Array, "n 2"]

    @staticmethod
    def joined(parts: Sequence[OutlineShifts]) -> OutlineShifts:
        return OutlineShifts(*(np.concatenate([getattr(p, k) for p in parts]) for k in ("way_px", "speed_px_s")))


@dataclass(frozen=True)
class DepthDelay:
    """Depth's exposure after colour's (seconds), its standard deviation, and the frames that told it."""

    delay_s: float
    sigma_s: float
    frames: int


def outline_shifts(
    frames: RgbdFrames, masks: Sequence[Bool[Array, "h w"]], scene: StaticScene, s: DepthDelaySettings
) -> OutlineShifts:
    """Of the frames of one toss in which the object moves steadily or not at all; `masks`: where it is, roughly."""
    speeds = _steady_speeds(frames.times_ns, masks, s)
    ways, speeds_there = [], []
    for i in _chosen(np.linalg.norm(speeds, axis=1), s):
        way = _way(frames[i], masks[i], scene, float(np.linalg.norm(speeds[i])), s)
        if way is not None:
            ways.append(way)
            speeds_there.append(speeds[i])
    return OutlineShifts(np.array(ways).reshape(-1, 2), np.array(speeds_there).reshape(-1, 2))


def _steady_speeds(
    times_ns: Int64[Array, " n"], masks: Sequence[Bool[Array, "h w"]], s: DepthDelaySettings
) -> Float[Array, "n 2"]:
    """Speed of the object in the image (pixels a second) at each frame; NaN where it is not seen whole or is hit."""
    centers = np.array([_center(m) for m in masks])
    steps = np.diff(centers, axis=0) / (np.diff(times_ns) * 1e-9)[:, None]
    mean = 0.5 * (steps[1:] + steps[:-1])
    jump = np.linalg.norm(steps[1:] - steps[:-1], axis=1)
    steady = jump < s.steady * np.linalg.norm(mean, axis=1) + s.moving_px_s
    out = np.full((len(masks), 2), np.nan)
    out[1:-1] = np.where(steady[:, None], mean, np.nan)
    return out


def _chosen(speed_px_s: Float[Array, " n"], s: DepthDelaySettings) -> list[int]:
    """The fastest frames of a toss, and some of the slowest."""
    order = np.argsort(speed_px_s)
    order = order[np.isfinite(speed_px_s[order])]
    return [int(i) for i in np.unique(np.concatenate([order[: s.slow_frames], order[-s.fast_frames :]]))]


def delay_of(seen: OutlineShifts, s: DepthDelaySettings) -> DepthDelay | None:
    """The delay that all frames together tell; None where too few move. One that may be chance is told as it is: see
    `posterior_delay`."""
    moving = int((np.linalg.norm(seen.speed_px_s, axis=1) > s.moving_px_s).sum())
    if moving < s.least_frames:
        return None
    n = len(seen.way_px)
    A = np.zeros((2 * n, 3))
    A[:n, 0], A[n:, 1] = 1.0, 1.0
    A[:, 2] = -seen.speed_px_s.T.ravel()
    b, weight = seen.way_px.T.ravel(), np.ones(2 * n)
    for step in range(30):
        fit = np.linalg.lstsq(A * np.sqrt(weight)[:, None], b * np.sqrt(weight), rcond=None)[0]
        rest = b - A @ fit
        sigma = max(MAD_TO_SIGMA * float(np.median(np.abs(rest))), s.least_px)
        # first the least absolute deviations, which mistaken frames pull little: Tukey's kernel needs a good start
        weight = 1 / np.maximum(np.abs(rest), sigma) if step < 20 else tukey_weight(rest / (TUKEY_95 * sigma))
    information = A.T @ (weight[:, None] * A)
    return DepthDelay(float(fit[2]), float(sigma * np.sqrt(np.linalg.pinv(information)[2, 2])), moving)


def posterior_delay(found: DepthDelay | None, stamped_s: float, s: DepthDelaySettings) -> float:
    """What (seconds) is added to depth's stamps, which have it exposed `stamped_s` after colour: the mean of the
    posterior between stamps that are right and stamps that are off by any amount (a spike and a slab: Mitchell and
    Beauchamp 1988). Nothing where that is little, or where the images tell more than can be."""
    if found is None or abs(found.delay_s) > s.longest_s:
        return 0.0
    more_s, chance = found.delay_s - stamped_s, max(found.sigma_s, 1e-6) ** 2
    kept = s.off_s**2 / (s.off_s**2 + chance)
    right = s.right if stamped_s != 0 else s.right_if_same
    log_odds = 0.5 * (np.log1p(-kept) + kept * more_s**2 / chance) + np.log((1 - right) / right)
    added_s = more_s * kept * float(expit(log_odds))
    return added_s if abs(added_s) > s.least_s else 0.0


def _center(mask: Bool[Array, "h w"]) -> Float[Array, "2"]:
    """Center (x, y) of a mask that touches no border; NaN of another one."""
    v, u = np.nonzero(mask)
    if len(u) < 30 or u.min() == 0 or v.min() == 0 or u.max() == mask.shape[1] - 1 or v.max() == mask.shape[0] - 1:
        return np.full(2, np.nan)
    return np.array([u.mean(), v.mean()])


def _way(
    frame: RgbdFrame, mask: Bool[Array, "h w"], scene: StaticScene, speed_px_s: float, s: DepthDelaySettings
) -> Float[Array, "2"] | None:
    """From where depth shows the object to where colour does (x, y; pixels); None where either does not show it."""
    reach = int(np.ceil(speed_px_s * s.longest_s)) + s.border_px
    around = window_around(mask, 2 * (reach + s.border_px))
    if around is None:
        return None
    mask, frame = mask[around], replace(frame, depth_m=frame.depth_m[around], color_rgb=frame.color_rgb[around])
    scene = replace(scene, **{name: whole[around] for name, whole in vars(scene).items()})
    body = largest_component(nearer_than_scene(frame.depth_m, scene, s.foreground) & grown(mask, reach))
    part, at = window_around(body, s.border_px), window_around(body, s.border_px + reach)
    if part is None or at is None or int(body.sum()) < 30 or int((body & mask).sum()) < 0.2 * int(mask.sum()):
        return None
    inside = (at[0].stop <= mask.shape[0], at[1].stop <= mask.shape[1], part[0].start - at[0].start == reach,
              part[1].start - at[1].start == reach)  # fmt: skip
    if not all(inside):
        return None
    sought = unlike_scene(frame, scene, at, s.late, s.foreground)
    template = body[part].astype(np.float32)
    soft = [cv2.GaussianBlur(x, (0, 0), s.blur_px) for x in (sought, template)]
    return _peak(cv2.matchTemplate(soft[0], soft[1], cv2.TM_CCOEFF_NORMED).astype(np.float32), reach)


def _peak(score: Float32[Array, "a b"], reach: int) -> Float[Array, "2"] | None:
    """Where the score is largest, to parts of a pixel, from its middle; None at the border."""
    v, u = np.unravel_index(int(score.argmax()), score.shape)
    if not (0 < v < score.shape[0] - 1 and 0 < u < score.shape[1] - 1):
        return None
    parts = [_vertex(line) for line in (score[v, u - 1 : u + 2], score[v - 1 : v + 2, u])]
    return np.array([u - reach + parts[0], v - reach + parts[1]])


def _vertex(three: Float32[Array, "3"]) -> float:
    """Where the parabola through three values in a row, the middle one not the least, has its top (-0.5 .. 0.5)."""
    before, here, after = (float(x) for x in three)
    bend = 2 * here - before - after
    return 0.5 * (after - before) / bend if bend > 1e-9 else 0.0
