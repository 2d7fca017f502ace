"""A pose at another time: between two frames, beyond the last one, or at depth's own exposure.

Which law holds differs by who asks: constant spin and a straight centre between two frames (`between`), a ballistic
centre ahead (`moved`), a change of motion that goes on (`carried_on`), a parabola through three frames of a finished
track (`pose_at`), straight ways through a dense series (`straight_between`), corrections that vary slowly (`blended`).
They stand side by side so that one can take over. `trajectory.resampled` is `straight_between` for a PoseSeries, by
other arithmetic: to the last bit the two differ.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.spatial.transform import Rotation, Slerp

from processing.motion.thresholds import EXTRAPOLATION_IMPACT_M_S, EXTRAPOLATION_IMPACT_RAD_S, FREE_M_S2
from recordings.geometry import rotation_exp, rotation_log
from recordings.tracks import ObjectTrack


def turn_between(after: Float[Array, "4 4"], before: Float[Array, "4 4"]) -> Float[Array, "3"]:
    """Rotation vector (camera frame) from one pose to a later one."""
    turn = after[:3, :3] @ before[:3, :3].T
    cosine = 0.5 * (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0)
    if cosine < -0.9:  # near half a turn the axis is not in the antisymmetric part
        return rotation_log(turn)
    axis = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine = math.sqrt(float(axis @ axis))
    return axis * (math.atan2(sine, cosine) / sine) if sine > 1e-9 else axis


def turns_between(after: Float[Array, "n 4 4"], before: Float[Array, "n 4 4"]) -> Float[Array, "n 3"]:
    """`turn_between` of many."""
    return np.asarray(Rotation.from_matrix(after[:, :3, :3] @ before[:, :3, :3].transpose(0, 2, 1)).as_rotvec())


def moved(
    before: Float[Array, "4 4"],
    now: Float[Array, "4 4"],
    step_s: float,
    next_s: float,
    center_m: Float[Array, "3"],
    gravity_camera_m_s2: Float[Array, "3"],
    spin_rad_s: Float[Array, "3"] | None = None,
) -> Float[Array, "4 4"]:
    """The pose `next_s` after `now`, `before` being `step_s` earlier: constant spin, ballistic centre.

    `center_m` is that of mass in the object frame; `spin_rad_s` (camera axes) replaces the spin between the two."""
    ratio = next_s / step_s
    out = np.eye(4)
    turn = turn_between(now, before) * ratio if spin_rad_s is None else spin_rad_s * next_s
    out[:3, :3] = rotation_exp(turn) @ now[:3, :3]
    x0, x1 = (p[:3, :3] @ center_m + p[:3, 3] for p in (before, now))
    center = x1 + (x1 - x0) * ratio + gravity_camera_m_s2 * (0.5 * next_s * (step_s + next_s))
    out[:3, 3] = center - out[:3, :3] @ center_m
    return out


def carried_on(
    poses: Float[Array, "3 4 4"], times_s: Float[Array, "3"], delay_s: float, center_m: Float[Array, "3"]
) -> Float[Array, "4 4"]:
    """The motion (camera axes) of the last of three poses over `delay_s`: spin and velocity go on changing as they
    did, but for an impact's jump."""
    steps_s = np.diff(times_s)
    spins = [turn_between(poses[j + 1], poses[j]) / steps_s[j] for j in (0, 1)]
    centers = [p[:3, :3] @ center_m + p[:3, 3] for p in poses]
    speeds = [(centers[j + 1] - centers[j]) / steps_s[j] for j in (0, 1)]
    ahead = (steps_s[1] + delay_s) / (steps_s[0] + steps_s[1])
    spin, speed = (
        last + ahead * (last - first) if np.linalg.norm(last - first) < impact else last
        for (first, last), impact in ((spins, EXTRAPOLATION_IMPACT_RAD_S), (speeds, EXTRAPOLATION_IMPACT_M_S))
    )
    out = np.eye(4)
    out[:3, :3] = rotation_exp(spin * delay_s)
    out[:3, 3] = centers[2] + speed * delay_s - out[:3, :3] @ centers[2]
    return out


def between(
    before: Float[Array, "4 4"], after: Float[Array, "4 4"], share: float, center_m: Float[Array, "3"]
) -> Float[Array, "4 4"]:
    """The pose at `share` (0..1) of the way: constant spin, straight centre."""
    out = np.eye(4)
    out[:3, :3] = rotation_exp(turn_between(after, before) * share) @ before[:3, :3]
    x0, x1 = (p[:3, :3] @ center_m + p[:3, 3] for p in (before, after))
    out[:3, 3] = x0 + share * (x1 - x0) - out[:3, :3] @ center_m
    return out


def straight_between(
    times_s: Float[Array, " n"], poses: Float[Array, "n 4 4"], at_s: Float[Array, " t"]
) -> Float[Array, "t 4 4"]:
    """The poses at times within those of a dense series: rotations along the geodesic, origins straight."""
    turns = Slerp(times_s, Rotation.from_matrix(poses[:, :3, :3]))
    out = np.tile(np.eye(4), (len(at_s), 1, 1))
    out[:, :3, :3] = turns(at_s).as_matrix()
    out[:, :3, 3] = np.stack([np.interp(at_s, times_s, poses[:, k, 3]) for k in range(3)], 1)
    return out


def pose_at(track: ObjectTrack, position: int, time_ns: int) -> Float[Array, "4 4"]:
    """`camera_from_object` at a time near a frame's: moved along the way to the neighbour on that side, if tracked; on
    a parabola through both neighbours where nothing hits the object (in 16 ms a falling one leaves the straight way by
    more than a millimetre). NaN where the frame itself is lost."""
    here = track.camera_from_object[position]
    side = 1 if time_ns > track.time_ns[position] else -1
    other = position + side
    if time_ns == track.time_ns[position] or not 0 <= other < len(track.status):
        return here
    if "lost" in (track.status[position], track.status[other]):
        return here
    there = track.camera_from_object[other]
    share = (time_ns - int(track.time_ns[position])) / int(track.time_ns[other] - track.time_ns[position])
    share = min(share, 1.0)
    out = np.eye(4)
    turns = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([here[:3, :3], there[:3, :3]])))
    out[:3, :3] = turns(share).as_matrix()
    step_s = float(track.time_ns[other] - track.time_ns[position]) * 1e-9
    bend = 0.5 * share * (share - 1) * step_s**2 * _acceleration(track, position)
    out[:3, 3] = (1 - share) * here[:3, 3] + share * there[:3, 3] + bend
    return out


def _acceleration(track: ObjectTrack, position: int) -> Float[Array, "3"]:
    """Of the object's origin over a frame and its two neighbours; zero where one is missing or something hits it."""
    around = [position - 1, position, position + 1]
    if around[0] < 0 or around[2] >= len(track.status) or any(track.status[i] == "lost" for i in around):
        return np.zeros(3)
    first_s, second_s = np.diff(track.time_ns[around]).astype(np.float64) * 1e-9
    x0, x1, x2 = track.camera_from_object[around, :3, 3]
    change = 2 * ((x2 - x1) / second_s - (x1 - x0) / first_s) / (first_s + second_s)
    return np.asarray(change) if float(np.linalg.norm(change)) < FREE_M_S2 else np.zeros(3)


def blended(corrections: Float[Array, "m 4 4"], frames: Int[Array, " m"], i: int) -> Float[Array, "4 4"]:
    """Correction at frame i: linear between the keyframes around it."""
    after = int(np.searchsorted(frames, i))
    if after == 0 or after == len(frames):
        return corrections[min(after, len(frames) - 1)]
    a, b = corrections[after - 1], corrections[after]
    share = (i - frames[after - 1]) / (frames[after] - frames[after - 1])
    out = np.eye(4)
    out[:3, :3] = a[:3, :3] @ rotation_exp(share * rotation_log(a[:3, :3].T @ b[:3, :3]))
    out[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    return out
