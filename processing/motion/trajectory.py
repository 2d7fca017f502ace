"""Poses of one toss as arrays, and the states and transitions made of them.

Convention of the step (implicit Euler on the configuration, as ContactNets and dair_pll have it):
p[t+1] = p[t] + dt v[t+1],  R[t+1] = R[t] exp(dt w[t+1]).
Linear velocity is in world axes, angular velocity in object axes; both belong to the later frame of a pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, Int64
from numpy import ndarray as Array
from scipy.spatial.transform import Rotation

from recordings.constants import GRAVITY_M_S2
from recordings.errors import BadInput
from recordings.records import StampedPose
from recordings.tracks import ObjectTrack, RigCalibration


@dataclass(frozen=True, eq=False)
class PoseSeries:
    """`world_from_object` of one toss, frame by frame; lost frames are left out, so `time_s` may have gaps.

    `velocity_world_m_s` and `spin_object_rad_s` are what the recording claims, where it claims any (only for checks).
    """

    toss: int
    time_s: Float[Array, " n"]
    rotation: Float[Array, "n 3 3"]
    position_m: Float[Array, "n 3"]
    velocity_world_m_s: Float[Array, "n 3"] | None = None
    spin_object_rad_s: Float[Array, "n 3"] | None = None

    def __len__(self) -> int:
        return len(self.time_s)

    def part(self, chosen: slice) -> PoseSeries:
        """The frames of a slice."""
        speeds = [None if a is None else a[chosen] for a in (self.velocity_world_m_s, self.spin_object_rad_s)]
        return PoseSeries(
            self.toss, self.time_s[chosen], self.rotation[chosen], self.position_m[chosen], speeds[0], speeds[1]
        )

    def about(self, point_object_m: Float[Array, "3"]) -> PoseSeries:
        """The same motion with the object's origin moved to a point of it (claimed velocities are dropped)."""
        moved = self.position_m + self.rotation @ point_object_m
        return replace(self, position_m=moved, velocity_world_m_s=None, spin_object_rad_s=None)

    def turned(self, new_from_world: Float[Array, "3 3"], offset_m: float) -> PoseSeries:
        """The same motion in a world turned by a rotation and lowered by an offset along its new z."""
        position = self.position_m @ new_from_world.T - np.array([0.0, 0.0, offset_m])
        speed = self.velocity_world_m_s
        return replace(
            self,
            rotation=new_from_world @ self.rotation,
            position_m=position,
            velocity_world_m_s=None if speed is None else speed @ new_from_world.T,
        )

    @property
    def step_s(self) -> float:
        """The usual time between frames."""
        return float(np.median(np.diff(self.time_s)))

    @staticmethod
    def from_quaternions(
        toss: int,
        step_s: float,
        quaternion_wxyz: Float[Array, "n 4"],
        position_m: Float[Array, "n 3"],
        velocity_world_m_s: Float[Array, "n 3"] | None = None,
        spin_object_rad_s: Float[Array, "n 3"] | None = None,
    ) -> PoseSeries:
        """Evenly timed poses; quaternions of any length. Raises BadInput for NaN or a zero quaternion."""
        q = np.asarray(quaternion_wxyz, dtype=np.float64)
        length = np.linalg.norm(q, axis=1)
        good = np.isfinite(q).all(1) & (length > 1e-9) & np.isfinite(position_m).all(1)
        if not good.all():
            raise BadInput(
                f"toss {toss}: the pose of frame {int(np.argmin(good))} ({int((~good).sum())} of {len(good)}) is NaN "
                "or has a zero quaternion; wanted finite poses, leave lost frames out"
            )
        rotation = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix()
        times = step_s * np.arange(len(q))
        position = np.array(position_m, dtype=np.float64)
        return PoseSeries(toss, times, rotation, position, velocity_world_m_s, spin_object_rad_s)

    @staticmethod
    def from_poses(toss: int, poses: Sequence[StampedPose]) -> PoseSeries:
        """From `/track/pose` or truth in `world`; lost poses are left out. Raises BadInput for another frame or NaN."""
        kept = [p for p in poses if p.status != "lost"]
        other = {p.target for p in kept} - {"world"}
        if other:
            raise BadInput(f"toss {toss}: poses in {sorted(other)}; wanted world_from_object (see calibration.json)")
        matrices = np.array([p.matrix for p in kept], dtype=np.float64).reshape(-1, 4, 4)
        return _from_matrices(toss, np.array([p.time_ns for p in kept], dtype=np.int64), matrices)

    @staticmethod
    def from_track(track: ObjectTrack, calibration: RigCalibration) -> PoseSeries:
        """A track in its camera moved to the world. Raises BadInput where the calibration does not know the camera."""
        return PoseSeries.from_camera(track.toss, track.time_ns, track.camera_from_object, track.camera, calibration)

    @staticmethod
    def from_camera(
        toss: int,
        time_ns: Int64[Array, " n"],
        camera_from_object: Float[Array, "n 4 4"],
        camera: str,
        calibration: RigCalibration,
    ) -> PoseSeries:
        """Poses in a camera, NaN where there is none; times count from the first frame, with a pose or without."""
        world_from_camera = calibration.transform("world", camera).matrix
        kept = np.isfinite(camera_from_object).all(axis=(1, 2))
        start = int(time_ns[0]) if len(time_ns) else 0
        return _from_matrices(toss, time_ns[kept], world_from_camera @ camera_from_object[kept], start)


def _from_matrices(
    toss: int, time_ns: Int64[Array, " n"], matrices: Float[Array, "n 4 4"], start_ns: int | None = None
) -> PoseSeries:
    if not np.isfinite(matrices).all():
        bad = int(np.argmin(np.isfinite(matrices).all((1, 2))))
        raise BadInput(f"toss {toss}: the pose of frame {bad} is NaN but not marked lost; run the tracker again")
    if start_ns is None:
        start_ns = int(time_ns[0]) if len(time_ns) else 0
    return PoseSeries(toss, (time_ns - start_ns) * 1e-9, matrices[:, :3, :3].copy(), matrices[:, :3, 3].copy())


def rotation_vectors(rotations: Float[Array, "*n 3 3"]) -> Float[Array, "*n 3"]:
    """Rotation vectors (log) of a stack of rotation matrices, radians."""
    flat = rotations.reshape(-1, 3, 3)
    return Rotation.from_matrix(flat).as_rotvec().reshape(*rotations.shape[:-2], 3)


def rotation_matrices(vectors_rad: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """Rotation matrices (exp) of a stack of rotation vectors."""
    return Rotation.from_rotvec(vectors_rad.reshape(-1, 3)).as_matrix().reshape(*vectors_rad.shape[:-1], 3, 3)


@dataclass(frozen=True, eq=False)
class States:
    """Poses with velocities, frame by frame; `covariance` is of (rotation in object axes, position, spin, velocity)."""

    toss: int
    time_s: Float[Array, " n"]
    rotation: Float[Array, "n 3 3"]
    position_m: Float[Array, "n 3"]
    spin_object_rad_s: Float[Array, "n 3"]
    velocity_world_m_s: Float[Array, "n 3"]
    covariance: Float[Array, "n 12 12"] | None = None

    def __len__(self) -> int:
        return len(self.time_s)


def differences(series: PoseSeries) -> States:
    """Backward differences; the first frame takes its velocity from flight: v[0] = v[1] - dt g, w[0] = w[1]."""
    dt = np.diff(series.time_s)[:, None]
    velocity = np.diff(series.position_m, axis=0) / dt
    turns = np.swapaxes(series.rotation[:-1], 1, 2) @ series.rotation[1:]
    spin = rotation_vectors(turns) / dt
    before = velocity[:1] + [[0.0, 0.0, GRAVITY_M_S2 * float(dt[0, 0])]]
    return States(
        series.toss,
        series.time_s,
        series.rotation,
        series.position_m,
        np.concatenate([spin[:1], spin]),
        np.concatenate([before, velocity]),
    )


@dataclass(frozen=True, eq=False)
class Steps:
    """Transitions of several tosses, one row each: where the body is after the step, velocities before and after."""

    toss: Int[Array, " n"]
    frame: Int[Array, " n"]
    step_s: Float[Array, " n"]
    rotation: Float[Array, "n 3 3"]
    position_m: Float[Array, "n 3"]
    spin_object_rad_s: Float[Array, "n 3"]
    velocity_world_m_s: Float[Array, "n 3"]
    spin_before_object_rad_s: Float[Array, "n 3"]
    velocity_before_world_m_s: Float[Array, "n 3"]

    def __len__(self) -> int:
        return len(self.toss)

    def only(self, keep: Bool[Array, " n"]) -> Steps:
        return Steps(**{name: value[keep] for name, value in vars(self).items()})


def steps_of(states: Sequence[States], longest_gap: float = 1.5) -> Steps:
    """All transitions whose two velocities are known: from frame 1 on, and not across a gap of lost frames.

    `longest_gap` is in usual steps. The first frame's velocity is an extrapolation, so no transition begins there.
    """
    parts = [_steps_of_one(s, longest_gap) for s in states]
    names = Steps.__dataclass_fields__
    return Steps(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


def _steps_of_one(states: States, longest_gap: float) -> Steps:
    dt = np.diff(states.time_s)
    usual = float(np.median(dt)) if len(dt) else 0.0
    whole = dt <= longest_gap * usual
    later = np.flatnonzero(whole[1:] & whole[:-1]) + 2
    return Steps(
        np.full(len(later), states.toss),
        later,
        dt[later - 1],
        states.rotation[later],
        states.position_m[later],
        states.spin_object_rad_s[later],
        states.velocity_world_m_s[later],
        states.spin_object_rad_s[later - 1],
        states.velocity_world_m_s[later - 1],
    )
