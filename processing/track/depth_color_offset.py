"""Depth that is exposed at another time than colour: every view made again with the motion between the two."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.motion import se3_kernels as se3
from processing.motion.interpolate import between, turn_between
from processing.motion.thresholds import LATE_DEPTH_IMPACT_M_S
from processing.track.beam import LEAST_DELAY_S, Scene


def put_at_color_times(scene: Scene, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"]) -> Bool[Array, " n"]:
    """Make every view again with the motion between its two exposures, by neighbouring poses. Which are usable."""
    index = np.flatnonzero(use)
    out = use.copy()
    for a, i in enumerate(index):
        crop = scene.store.crops[i]
        if crop is None or abs(crop.depth_delay_s) < LEAST_DELAY_S or len(index) < 2:
            continue
        at_depth = _at_depth_time(scene, poses, index, a, crop.depth_delay_s)
        out[i] = scene.store.fill(int(i), poses[i] @ se3.inverse(at_depth))
    return out


def _at_depth_time(
    scene: Scene, poses: Float[Array, "n 4 4"], index: Int[Array, " m"], a: int, delay_s: float
) -> Float[Array, "4 4"]:
    """Pose at depth's exposure of the view index[a]. The motion is that over both neighbours, because errors of single
    poses would move the depth that they rest on; only an impact's jump is taken from the nearer side."""
    i, t = index[a], scene.times_s
    before, after = index[max(a - 1, 0)], index[min(a + 1, len(index) - 1)]
    side = (i, after) if delay_s > 0 else (before, i)
    if side[0] == side[1] or scene.store.stands_still(int(side[0]), int(side[1])):
        return poses[i]
    speeds = []
    for x, y in ((before, after), side):
        centers = [poses[z][:3, :3] @ scene.center_m + poses[z][:3, 3] for z in (x, y)]
        speeds.append((centers[1] - centers[0]) / (t[y] - t[x]))
    hit = bool(np.linalg.norm(speeds[0] - speeds[1]) > LATE_DEPTH_IMPACT_M_S) or before == i or after == i
    x, y = side if hit else (before, after)
    share = delay_s / (t[y] - t[x])
    step = between(poses[x], poses[y], abs(float(share)), scene.center_m) @ se3.inverse(poses[x])  # camera axes
    turn = step if share > 0 else se3.inverse(step)
    out = _carried(poses[i], turn, poses[x], poses[y], float(share), scene.center_m)
    if not hit and _falls(scene, poses, (int(before), int(i), int(after))):
        out[:3, 3] += 0.5 * scene.gravity_camera_m_s2 * delay_s**2
    return out


def unknown_motion(
    scene: Scene, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"]
) -> Float[Array, "n 6 6"]:  # fmt: skip
    """Covariance (twist of the object frame, translation first) of depth that was exposed on the other side of an
    impact, or may have been: half of the jump of velocity and spin, over the delay."""
    out, index, t = np.zeros((len(poses), 6, 6)), np.flatnonzero(use), scene.times_s
    for before, i, after in zip(index, index[1:], index[2:]):
        crop = scene.store.crops[i]
        if crop is None or abs(crop.depth_delay_s) < LEAST_DELAY_S:
            continue
        centers = [poses[z][:3, :3] @ scene.center_m + poses[z][:3, 3] for z in (before, i, after)]
        speed = (centers[2] - centers[1]) / (t[after] - t[i]) - (centers[1] - centers[0]) / (t[i] - t[before])
        if np.linalg.norm(speed) < 2 * LATE_DEPTH_IMPACT_M_S:
            continue
        spin = turn_between(poses[after], poses[i]) / (t[after] - t[i])
        spin = spin - turn_between(poses[i], poses[before]) / (t[i] - t[before])
        half_s = 0.5 * crop.depth_delay_s
        moved = (float(np.linalg.norm(speed * half_s)), float(np.linalg.norm(spin * half_s)))
        out[i] = np.diag([moved[0] ** 2 / 3] * 3 + [moved[1] ** 2 / 3] * 3)
    return out


def _falls(scene: Scene, poses: Float[Array, "n 4 4"], three: tuple[int, int, int]) -> bool:
    """Whether the body's center of mass accelerates by most of gravity over three views."""
    x0, x1, x2 = (poses[z][:3, :3] @ scene.center_m + poses[z][:3, 3] for z in three)
    first_s, second_s = np.diff(scene.times_s[list(three)])
    change = 2 * ((x2 - x1) / second_s - (x1 - x0) / first_s) / (first_s + second_s)
    gravity = scene.gravity_camera_m_s2
    return bool(change @ gravity > 0.6 * float(gravity @ gravity) > 0)


def _carried(
    pose: Float[Array, "4 4"], turn: Float[Array, "4 4"], start: Float[Array, "4 4"], end: Float[Array, "4 4"],
    share: float, center_m: Float[Array, "3"],
) -> Float[Array, "4 4"]:  # fmt: skip
    """`pose` turned as `turn` turns, its center of mass moved by `share` of the way from `start`'s to `end`'s."""
    out = np.eye(4)
    out[:3, :3] = turn[:3, :3] @ pose[:3, :3]
    way = (end[:3, :3] @ center_m + end[:3, 3]) - (start[:3, :3] @ center_m + start[:3, 3])
    out[:3, 3] = pose[:3, :3] @ center_m + pose[:3, 3] + share * way - out[:3, :3] @ center_m
    return out
