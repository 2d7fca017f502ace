"""What is reported of each frame: how well it fits, whether its pose may be trusted, how far it may be off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.motion.interpolate import between
from processing.sensor import noise
from processing.sensor import view_layout as lay
from processing.sensor.view_store import ViewStore
from processing.track.beam import Scene
from recordings.geometry import rotation_log, skew
from recordings.tracks import ObjectTrack, Status


@dataclass(frozen=True)
class FlagConfig:
    """When a frame is lost, and how far an interpolated pose may be off."""

    tracked_cost: float = 0.25
    """After refinement, a view that fits its neighbours worse on average is lost."""
    unfit_cost: float = 0.15
    """A view that costs more no pose explains: one rigid body fits better, however it looks."""
    longest_gap_s: float = 0.2
    """Frames between tracked ones that are at most this far apart get an interpolated pose."""
    gap_sigma_rad: float = 0.75
    gap_sigma_m: float = 0.02
    """Standard deviation of an interpolated pose in the middle of the longest gap. Most gaps are impacts, which change
    the spin: single frames of three sessions, .07 s between tracked ones, are 20, 30 and 32 degrees off."""
    correlated: float = noise.TRACK_COVARIANCE_SCALE
    rival_cost: float = 0.0015
    """Another hypothesis of the same frames that costs more by this much counts half towards the uncertainty."""
    joining_cost: float = 0.15
    """Pairs of views that fit worse do not fix how one is rotated against the other."""
    joining_share: float = 0.5
    """Nor do pairs that see less of each other's surface."""
    unjoined_sigma_rad: float = 0.5
    """How far views may be turned against the first one where no chain of pairs joins them to it."""
    outside_px: float = 3.0
    """What one view saw lies inside the outline of every other one, but for what a stereo matcher adds to the rim: half
    the window of 7 pixels over which it sums (`noise.PUBLISHED`)."""
    outside_share: float = 0.1
    """Views of which more lies outside the other's outline contradict each other ..."""
    contradicting: int = 3
    """... as poses, where so many in a row do: a mask may be wrong for a frame or two."""
    unsure_deg: float = 15.0
    """A pose whose rotation may be off by more than this (standard deviation) is a guess, marked as interpolated: a
    flip (45 degrees) lies within three of them."""


def unfit(store: ViewStore, cost: Float[Array, " n"], config: FlagConfig) -> int:
    """Frames that no pose explains (those that show nothing do not count): where they are many, the masks do not show
    one rigid body."""
    seen = np.array([store.usable(i) for i in range(len(cost))], dtype=bool)
    return int(np.sum(seen & ~(cost < config.unfit_cost)))


def per_view(pairs: Int[Array, "m 2"], figures: Float[Array, "m 3"], n: int) -> tuple[Array, Array]:
    """Median cost and share on the surface over the pairs that a view is in; NaN where it is in none."""
    cost, on = np.full(n, np.nan), np.full(n, np.nan)
    ends = pairs.T.ravel()
    order = np.argsort(ends, kind="stable")
    views, first = np.unique(ends[order], return_index=True)
    for i, mine in zip(views, np.split(order % max(len(pairs), 1), first[1:])):
        cost[i], on[i] = np.median(figures[mine, :2], axis=0)
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


def contradicting(
    store: ViewStore, poses: Float[Array, "n 4 4"], first: int, use: Bool[Array, " n"], pairs: Int[Array, "m 2"],
    figures: Float[Array, "m 3"], config: FlagConfig,
) -> Bool[Array, " n"]:  # fmt: skip
    """Used frames whose outlines contradict the first one's, whichever side of the body they show, and those between
    them and the nearest frame that a fitting pair joins to the first one: somewhere there a chain of pairs, each of
    which fits, has slipped."""
    index = np.flatnonzero(use)
    off = [_contradict(store, poses, int(i), first, config) for i in index]
    fits = (figures[:, 0] < config.joining_cost) & (figures[:, 1] > config.joining_share)
    near = np.union1d(pairs[fits & (pairs == first).any(1)], [first])
    near = near[near < len(use)]  # not the views of a known shape
    out, start = np.zeros(len(use), dtype=bool), 0
    for lasting, run in groupby(off):
        end = start + len(list(run))
        low, high = index[start], index[end - 1]
        if lasting and end - start >= config.contradicting:
            if low > first:
                low = near[near < low].max() + 1
            elif high < first:
                high = near[near > high].min() - 1
            out[low : high + 1] = True
        start = end
    return out & use


def _contradict(store: ViewStore, poses: Float[Array, "n 4 4"], one: int, other: int, config: FlagConfig) -> bool:
    shares = [_outside_share(store, poses, i, j, config) for i, j in ((one, other), (other, one))]
    return max(shares) > config.outside_share


def _outside_share(store: ViewStore, poses: Float[Array, "n 4 4"], one: int, other: int, config: FlagConfig) -> float:
    """Share of what one view saw that lies outside another's outline (what may be hidden there does not count)."""
    first, count = (int(store.table[one, c]) for c in (lay.FIRST, lay.COUNT))
    points = store.samples[first : first + count, :3].astype(np.float64)
    relative = poses[other] @ np.linalg.inv(poses[one])
    points = points @ relative[:3, :3].T + relative[:3, 3]
    offset, u0, v0, w, h = (int(c) for c in store.table[other, : lay.HEIGHT + 1])
    pixels = points[:, :2] / points[:, 2:] * store.rectified.focal + store.rectified.center - (u0, v0)
    u, v = np.round(pixels).astype(int).T
    seen = (u >= 0) & (v >= 0) & (u < w) & (v < h)
    outside = np.full(count, np.inf)
    outside[seen] = store.maps[offset + v[seen] * w + u[seen], lay.OUTSIDE]
    return float(np.mean(outside[outside >= 0] > config.outside_px)) if (outside >= 0).any() else 0.0


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
        status[i] = _status(sigma[i], config)
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


def _status(covariance: Float[Array, "6 6"], config: FlagConfig) -> Status:
    """What a pose is called within a run, by its covariance in camera axes."""
    unsure = np.linalg.eigvalsh(covariance[:3, :3])[-1] > np.radians(config.unsure_deg) ** 2
    return "interpolated" if unsure else "tracked"


def reflagged(
    track: ObjectTrack, poses: Float[Array, "n 4 4"], twists: Float[Array, "n 6 6"], cost: Float[Array, " n"],
    held: Bool[Array, " n"], azimuth: Float[Array, "n 6 6"], config: FlagConfig,
) -> ObjectTrack:  # fmt: skip
    """The track at poses that were solved for anew, with their covariances (twist of the object frame) and what each
    view costs there. Frames that took no part (NaN) or fit nothing are as unsure as they were. So are unsure ones that
    no other toss's frames have `held`: one solution knows nothing of the others that left them open. What is left open
    of a round body's `azimuth` (its covariance) no single frame tells: all have it.
    """
    status, covariance = list(track.status), track.covariance.copy()
    sure = np.array([s == "tracked" for s in status])
    for i in np.flatnonzero((sure | held) & (cost <= config.tracked_cost)):
        covariance[i] = camera_covariance(poses[i], config.correlated * twists[i] + azimuth[i])
        status[i] = _status(covariance[i], config)
    return replace(track, camera_from_object=poses, covariance=covariance, status=tuple(status))


def fit_of_sure(tracks: Sequence[ObjectTrack], costs: Sequence[Float[Array, " n"]]) -> float:
    """What the worst of all tosses' sure frames costs (-1: none is sure): others that fit as well lie where they say.
    At an impact, where a pose is but put between its neighbours, a frame costs several times as much."""
    sure = [cost[[s == "tracked" for s in track.status]] for track, cost in zip(tracks, costs, strict=True)]
    return float(np.nanmax(np.concatenate([*sure, [-1.0]])))


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


SURE_DEG, SURE_M = 5.0, 0.02
"""What a published `tracked` promises: root mean squares of the angle and of the distance by which a pose is off, over
all three axes, below these, of which the first is the field's limit of a right pose (5 degrees, 5 cm). Inside, surer
than `FlagConfig.unsure_deg` will do."""


HELD_SHAPE_DEG = 3.0
"""So far tosses lie turned to each other that one shape explains (root mean square over seven generated sessions: 2.6).
docs/decisions/tracked.md has the curve."""


def with_shape_error(track: ObjectTrack, alone: ObjectTrack, held: bool) -> ObjectTrack:
    """The track of a toss on a shape, its covariances with the error of that shape.

    The shape was fused from the tosses' first passes (`alone`: this toss's) and repeats their errors, so that no
    alignment to it takes them away. Nor does the mean of several tosses: where each view's depth is taken for the
    surface, all err alike. Frames that were lost alone are as unsure as its others in the mean. Of a toss that others
    hold no more than `HELD_SHAPE_DEG` (of the axis that is known least) is added: which of its hypotheses is right, by
    which a toss alone may be unsure by any angle, their frames have decided.
    """
    posed = ~track.lost
    known = posed & ~alone.lost & np.isfinite(alone.covariance).all(axis=(1, 2))
    if not known.any():
        return track
    to = np.tile(np.eye(6), (int(known.sum()), 1, 1))  # both frames' origins are fixed to the body
    lever = track.camera_from_object[known, :3, 3] - alone.camera_from_object[known, :3, 3]
    to[:, 3:, :3] = [-skew(arm) for arm in lever]
    own = alone.covariance[known]
    if held:
        worst = np.linalg.eigvalsh(own[:, :3, :3])[:, -1, None, None]
        own = own * np.minimum(1.0, np.radians(HELD_SHAPE_DEG) ** 2 / np.maximum(worst, 1e-12))
    errors = np.empty_like(track.covariance)
    errors[known] = to @ own @ to.transpose(0, 2, 1)
    errors[~known] = errors[known].mean(axis=0)
    covariance = track.covariance.copy()
    covariance[posed] += errors[posed]
    return replace(track, covariance=covariance)


HELD_DRIFT = 1 / 3
"""Power of the drift that other tosses leave: docs/decisions/tracked.md has the curve."""


def with_drift(track: ObjectTrack, coarseness: float, held: bool) -> ObjectTrack:
    """The track, its covariances as many times as large as means over the session's depth vary more than over fine
    depth (`DepthNoise.coarseness`); by its cube root where other tosses' frames hold it.

    The joint refinement knows how depth errs. But where it is coarse, chains of views slip, each pair of which still
    fits, and no covariance about one solution shows it. What other tosses show of the object ends most such chains.
    """
    return replace(track, covariance=track.covariance * max(1.0, coarseness) ** (HELD_DRIFT if held else 1.0))


def published(track: ObjectTrack) -> ObjectTrack:
    """The track, `tracked` only where it is as sure as that promises; what is not known of a covariance is no doubt."""
    status = list(track.status)
    for i, covariance in enumerate(track.covariance):
        if status[i] == "tracked" and np.isfinite(covariance).all():
            turn, place = (np.trace(covariance[a : a + 3, a : a + 3]) for a in (0, 3))
            if turn > np.radians(SURE_DEG) ** 2 or place > SURE_M**2:
                status[i] = "interpolated"
    return replace(track, status=tuple(status))


def camera_covariance(pose: Float[Array, "4 4"], twist_covariance: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """From a twist of the object frame (translation, rotation) to (rotation vector, translation) in camera axes.

    camera_from_object <- camera_from_object exp(-twist): the rotation turns by -R w, the origin moves by -R v.
    """
    R = pose[:3, :3]
    J = np.zeros((6, 6))
    J[:3, 3:], J[3:, :3] = -R, -R
    return np.asarray(J @ twist_covariance @ J.T)
