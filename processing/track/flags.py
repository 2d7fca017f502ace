"""What is reported of each frame: how well it fits, whether its pose may be trusted, how far it may be off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.motion.interpolate import between
from processing.sensor import noise
from processing.track.beam import Scene
from recordings.geometry import rotation_log, skew
from recordings.tracks import Status


@dataclass(frozen=True)
class FlagConfig:
    """When a frame is lost, and how far an interpolated pose may be off."""

    tracked_cost: float = 0.25
    """After refinement, a view that fits its neighbours worse on average is lost."""
    longest_gap_s: float = 0.2
    """Frames between tracked ones that are at most this far apart get an interpolated pose."""
    gap_sigma_rad: float = 0.15
    gap_sigma_m: float = 0.02
    """Standard deviation of an interpolated pose in the middle of the longest gap."""
    correlated: float = noise.TRACK_COVARIANCE_SCALE
    rival_cost: float = 0.0015
    """Another hypothesis of the same frames that costs more by this much counts half towards the uncertainty."""
    joining_cost: float = 0.15
    """Pairs of views that fit worse do not fix how one is rotated against the other."""
    joining_share: float = 0.5
    """Nor do pairs that see less of each other's surface."""
    unjoined_sigma_rad: float = 0.5
    """How far views may be turned against the first one where no chain of pairs joins them to it."""
    unsure_deg: float = 15.0
    """A pose whose rotation may be off by more than this (standard deviation) is a guess, marked as interpolated: a
    flip (45 degrees) lies within three of them."""


def per_view(pairs: Int[Array, "m 2"], figures: Float[Array, "m 3"], n: int) -> tuple[Array, Array]:
    """Median cost and share on the surface over the pairs that a view is in; NaN where it is in none."""
    cost, on = np.full(n, np.nan), np.full(n, np.nan)
    for i in np.unique(pairs):
        mine = (pairs == i).any(1)
        cost[i], on[i] = np.median(figures[mine, 0]), np.median(figures[mine, 1])
    return cost, on


def uncertainty(
    poses: Float[Array, "n 4 4"], rival: Float[Array, "n 4 4"], worse_by: float, config: FlagConfig
) -> Float[Array, "n 6 6"]:
    """Covariance (twist of the object frame, translation first) that another hypothesis of the same frames adds: the
    outer product of their difference, less the worse the other one fits. Zero where either has no pose."""
    out = np.zeros((len(poses), 6, 6))
    share = 1.0 / (1.0 + (worse_by / config.rival_cost) ** 2)
    for i in np.flatnonzero(np.isfinite(poses[:, 0, 0]) & np.isfinite(rival[:, 0, 0])):
        between_them = np.linalg.inv(poses[i]) @ rival[i]
        gap = np.concatenate([between_them[:3, 3], rotation_log(between_them[:3, :3])])
        out[i] = share * np.outer(gap, gap)
    return out


def unjoined(
    pairs: Int[Array, "m 2"], figures: Float[Array, "m 3"], roots: Sequence[int], use: Bool[Array, " n"],
    config: FlagConfig,
) -> Bool[Array, " n"]:  # fmt: skip
    """Used frames that no chain of well fitting pairs joins to one of the roots (the first frame, a model's views):
    each side of such a gap may fit in itself, and yet be turned against the other."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    fits = (figures[:, 0] < config.joining_cost) & (figures[:, 1] > config.joining_share)
    count = max(len(use), int(pairs.max(initial=-1)) + 1, max(roots) + 1)
    a, b = pairs[fits].T
    _, label = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(count, count)), directed=False)
    return np.asarray(use & ~np.isin(label[: len(use)], label[list(roots)]))


def unjoined_uncertainty(
    hanging: Bool[Array, " n"], center_m: Float[Array, "3"], config: FlagConfig
) -> Float[Array, "n 6 6"]:
    """Covariance (twist of the object frame, translation first) of a rotation about the body's center of mass, for
    these frames."""
    turn = np.vstack([skew(center_m), np.eye(3)])  # w about the point c moves the origin by -w x c = c x w
    return np.where(hanging[:, None, None], config.unjoined_sigma_rad**2 * turn @ turn.T, 0.0)


def flagged(
    poses: Float[Array, "n 4 4"], covariance: Float[Array, "n 6 6"], lost: Bool[Array, " n"], scene: Scene,
    config: FlagConfig,
) -> tuple[Float[Array, "n 4 4"], tuple[Status, ...], Float[Array, "n 6 6"]]:  # fmt: skip
    """NaN for lost frames, poses from the motion for short gaps between tracked ones, covariance in camera axes."""
    out, status = poses.copy(), ["tracked"] * len(poses)
    sigma = np.full((len(poses), 6, 6), np.nan)
    tracked = np.flatnonzero(~lost)
    for i in tracked:
        sigma[i] = camera_covariance(poses[i], covariance[i])
        if np.linalg.eigvalsh(sigma[i, :3, :3])[-1] > np.radians(config.unsure_deg) ** 2:
            status[i] = "interpolated"
    for i in np.flatnonzero(lost):
        out[i], status[i] = np.nan, "lost"
        before, after = tracked[tracked < i], tracked[tracked > i]
        if len(before) == 0 or len(after) == 0:
            continue
        gap_s = scene.times_s[after[0]] - scene.times_s[before[-1]]
        if gap_s <= config.longest_gap_s:
            out[i], status[i] = _in_gap(poses, before, after, int(i), scene), "interpolated"
            share = gap_s / config.longest_gap_s
            sigma[i] = np.diag([(config.gap_sigma_rad * share) ** 2] * 3 + [(config.gap_sigma_m * share) ** 2] * 3)
    return out, tuple(status), sigma  # type: ignore[arg-type]


def _in_gap(
    poses: Float[Array, "n 4 4"], before: Int[Array, " a"], after: Int[Array, " b"], i: int, scene: Scene
) -> Float[Array, "4 4"]:
    """Constant spin from the last tracked pose to the next, the centre on a parabola between them."""
    a, b = int(before[-1]), int(after[0])
    t = scene.times_s
    whole = t[b] - t[a]
    share = float((t[i] - t[a]) / whole)
    pose = between(poses[a], poses[b], share, scene.center_m)
    held = np.linalg.norm(poses[b][:3, 3] - poses[a][:3, 3]) < 0.002
    if not held:
        pose[:3, 3] -= 0.5 * scene.gravity_camera_m_s2 * whole**2 * share * (1 - share)
    return pose


def camera_covariance(pose: Float[Array, "4 4"], twist_covariance: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """From a twist of the object frame (translation, rotation) to (rotation vector, translation) in camera axes.

    camera_from_object <- camera_from_object exp(-twist): the rotation turns by -R w, the origin moves by -R v.
    """
    R = pose[:3, :3]
    J = np.zeros((6, 6))
    J[:3, 3:], J[3:, :3] = -R, -R
    return np.asarray(J @ twist_covariance @ J.T)
