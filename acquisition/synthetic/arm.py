"""The Panda that tosses: a release pose by inverse kinematics, joint speeds that give the release velocity, a wind-up.

Time 0 is the release (the fingers start to open). Joints move along q(t) = q_release + dq_release * s(t) + retreat,
so at the release they move as planned; all speeds stay below 0.9 of the URDF's limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.synthetic.config import ArmConfig
from acquisition.synthetic.motion import Release, Trajectory
from acquisition.synthetic.objects.grasp import Grasp
from acquisition.synthetic.objects.paint import Gloss, PaintedMesh
from acquisition.synthetic.objects.solids import corner_normals
from acquisition.synthetic.render.rays import Body, Placed
from recordings.geometry import Transform, quaternion_from_rotation, rotation_exp, rotation_log
from recordings.robot.arm import PANDA_TOOL, Robot, panda
from recordings.robot.collada import ColoredMesh, read_collada

READY_RAD = np.array([0.0, -0.3, 0.0, -2.1, 0.0, 2.1, 0.785])
SPEED_SHARE = 0.85
FORWARD_S = 0.45
BRAKE_S = 0.4
RETREAT_M = 0.09
OPEN_M = 0.08
REACHES_M = (0.32, 0.72)
"""Horizontal distances of the object from the base at which tosses are tried."""
TILT_BY_REACH = ((0.3, 0.7), (5.0, 50.0))
"""Reach (m) and the approach direction's tilt from straight down (deg)."""
JOINT_MARGIN_RAD = 0.05
STATES_HZ = 1000.0
STATE_NOISE = (2e-5, 1.5e-3, 2e-5)
"""Standard deviations of recorded angle (rad), speed (rad/s) and finger width (m)."""


@dataclass(frozen=True, eq=False)
class Swing:
    """A toss of the arm: joint angles at any time before, at and after the release at `release_s`."""

    release_s: float
    q_release_rad: Float[Array, "7"]
    dq_release_rad_s: Float[Array, "7"]
    retreat_rad: Float[Array, "7"]
    """Joint change that takes the open hand away from the object."""
    wind_up_s: float
    open_s: float
    width_m: float

    def q_rad(self, time_s: float) -> Float[Array, "7"]:
        t = time_s - self.release_s
        away = _smooth((t - self.open_s) / BRAKE_S)
        return self.q_release_rad + self._travel_s(t) * self.dq_release_rad_s + away * self.retreat_rad

    def _travel_s(self, t: float) -> float:
        """s(t): slope 0, back to the start of the swing, forward to slope 1 at t = 0, slope 0 again; in seconds."""
        if t < -FORWARD_S:
            # the hand waits at the release pose, then winds up to where the forward swing begins
            return -0.5 * FORWARD_S * _smooth((t + FORWARD_S + self.wind_up_s) / self.wind_up_s)
        if t < 0:
            share = t / FORWARD_S + 1
            return -0.5 * FORWARD_S + FORWARD_S * (share**3 - 0.5 * share**4)
        coast = min(t, self.open_s)
        brake = float(np.clip((t - self.open_s) / BRAKE_S, 0, 1))
        return coast + BRAKE_S * (brake - brake**3 + 0.5 * brake**4)

    def dq_rad_s(self, time_s: float) -> Float[Array, "7"]:
        step = 1e-4
        return (self.q_rad(time_s + step) - self.q_rad(time_s - step)) / (2 * step)

    def finger_width_m(self, time_s: float) -> float:
        opened = _smooth((time_s - self.release_s) / self.open_s)
        return float(self.width_m + (OPEN_M - self.width_m) * opened)


class Arm:
    """The robot in the lab: where it stands, its links as bodies."""

    def __init__(self, config: ArmConfig, held: Grasp) -> None:
        self.config, self.held = config, held
        self.robot: Robot = panda()
        yaw = np.deg2rad(config.base_yaw_deg)
        turn = rotation_exp(np.array([0.0, 0.0, yaw]))
        self.world_from_base = Transform("world", self.robot.root, turn, np.array([*config.base_m, 0.0]))
        self.bodies = [
            (m.link, m.link_from_mesh, Body("robot", _painted(read_collada(m.path)))) for m in self.robot.meshes
        ]

    def world_from_tool(self, q_rad: Float[Array, "7"]) -> Transform:
        tool = self.robot.links(q_rad)[PANDA_TOOL]
        return self.world_from_base @ Transform(tool.target, "tool", tool.rotation, tool.translation_m)

    def placed(self, swing: Swing, time_s: float) -> list[Placed]:
        """All links at an instant."""
        links = self.robot.links(swing.q_rad(time_s), swing.finger_width_m(time_s))
        return [
            Placed(body, replace(self.world_from_base @ links[link] @ link_from_mesh, source="body"))
            for link, link_from_mesh, body in self.bodies
        ]

    def plan(self, wanted: Release, grasp_roll_rad: float, release_s: float) -> Swing | None:
        """A swing whose tool is at the grasp of the wanted release, with its velocity and as much of its spin as the
        joints can give. The object's orientation of `wanted` is not used: the arm chooses one, turned by
        `grasp_roll_rad` about the approach direction. None where it cannot be reached.
        """
        base_from_world = self.world_from_base.inverse()
        center = base_from_world.points(wanted.world_from_object.translation_m)
        velocity = base_from_world.vectors(wanted.velocity_world_m_s)
        spin = base_from_world.vectors(wanted.angular_velocity_world_rad_s)
        if not REACHES_M[0] < np.linalg.norm(center[:2]) < REACHES_M[1]:
            return None
        base_from_tool = self._tool_at(center, grasp_roll_rad)
        q = self._solve(base_from_tool)
        if q is None:
            return None
        dq = self._speeds(q, center, velocity, spin)
        if dq is None:
            return None
        jacobian = self.robot.jacobian(q, PANDA_TOOL, base_from_tool.translation_m)
        back = np.linalg.pinv(jacobian) @ np.append(-RETREAT_M * base_from_tool.rotation[:, 2], np.zeros(3))
        swing = Swing(release_s, q, dq, back, self.config.wind_up_s, self.config.finger_open_s, self.held.width_m)
        return swing if self._within_limits(swing) else None

    def _tool_at(self, center: Array, roll_rad: float) -> Transform:
        """Fingers reach outwards and down from the base, turned about the approach direction."""
        out = np.array([center[0], center[1], 0.0])
        reach = float(np.linalg.norm(out))
        out /= reach
        tilt = np.deg2rad(np.interp(reach, *TILT_BY_REACH))
        approach = np.sin(tilt) * out - np.cos(tilt) * np.array([0.0, 0.0, 1.0])
        side = np.cross(approach, out)
        side /= np.linalg.norm(side)
        closing = rotation_exp(roll_rad * approach) @ side
        rotation = np.stack([np.cross(closing, approach), closing, approach], 1)
        tool_from_object = self.held.object_from_tool.inverse()
        return Transform(self.robot.root, "tool", rotation, center - rotation @ tool_from_object.translation_m)

    def _solve(self, base_from_tool: Transform) -> Array | None:
        """Inverse kinematics by damped least squares from the ready pose."""
        q = READY_RAD.copy()
        q[0] = np.arctan2(base_from_tool.translation_m[1], base_from_tool.translation_m[0])
        lower, upper = self._bounds()
        for _ in range(40):
            tool = self.robot.links(q)[PANDA_TOOL]
            error = np.concatenate(
                [
                    base_from_tool.translation_m - tool.translation_m,
                    tool.rotation @ rotation_log(tool.rotation.T @ base_from_tool.rotation),
                ]
            )
            if np.abs(error).max() < 1e-6:
                return q
            jacobian = self.robot.jacobian(q, PANDA_TOOL, tool.translation_m)
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-4 * np.eye(6), error)
            q = np.clip(q + np.clip(step, -0.3, 0.3), lower, upper)
        return None

    def _speeds(self, q: Array, center: Array, velocity: Array, spin: Array) -> Array | None:
        """Joint speeds with exactly the velocity at the object's centre, and the spin as far as the limits allow."""
        jacobian = self.robot.jacobian(q, PANDA_TOOL, center)
        linear, angular = jacobian[:3], jacobian[3:]
        limit = SPEED_SHARE * np.array([j.fastest for j in self.robot.arm_joints])
        inverse = np.diag(limit) @ np.linalg.pinv(linear * limit)  # the least share of each joint's limit
        least = inverse @ velocity
        free = np.eye(7) - inverse @ linear
        extra = free @ np.linalg.pinv(angular @ free, rcond=0.05) @ (spin - angular @ least)
        if (np.abs(least) > limit).any():
            return None
        for share in np.linspace(1, 0, 21):
            if (np.abs(least + share * extra) <= limit).all():
                return least + share * extra
        return least

    def _bounds(self) -> tuple[Array, Array]:
        joints = self.robot.arm_joints
        lower, upper = np.array([j.lower for j in joints]), np.array([j.upper for j in joints])
        return lower + JOINT_MARGIN_RAD, upper - JOINT_MARGIN_RAD

    def _within_limits(self, swing: Swing) -> bool:
        lower, upper = self._bounds()
        limit = 0.9 * np.array([j.fastest for j in self.robot.arm_joints])
        for t in np.linspace(swing.release_s - FORWARD_S - swing.wind_up_s, swing.release_s + 0.5, 60):
            q = swing.q_rad(t)
            if (q < lower).any() or (q > upper).any() or (np.abs(swing.dq_rad_s(t)) > limit).any():
                return False
            if self.world_from_tool(q).translation_m[2] < 0.08:
                return False
        return True

    def carry(
        self, swing: Swing, slip_m: Float[Array, "3"], until_s: float, step_s: float
    ) -> tuple[Trajectory, Release]:
        """The held object's path up to `until_s`, and its state there.

        `slip_m`: how far the object has slid in the tool's axes at the end (it slides during the forward swing).
        """
        times = np.append(np.arange(0.0, until_s - 1e-9, step_s), until_s)
        poses = [self._held_at(swing, slip_m, t) for t in times]
        h = 0.001
        early, late = (self._held_at(swing, slip_m, until_s + d) for d in (-h, h))
        velocity = (late.translation_m - early.translation_m) / (2 * h)
        spin = early.rotation @ rotation_log(early.rotation.T @ late.rotation) / (2 * h)
        position = np.array([p.translation_m for p in poses])
        spins = [rotation_log(a.rotation.T @ b.rotation) / (tb - ta) for a, b, ta, tb in _steps(poses, times)]
        path = Trajectory(
            times,
            position,
            np.array([quaternion_from_rotation(p.rotation) for p in poses]),
            np.gradient(position, times, axis=0),
            np.array([*spins, spins[-1]]),
        )
        return path, Release(poses[-1], velocity, spin)

    def _held_at(self, swing: Swing, slip_m: Array, time_s: float) -> Transform:
        tool_from_object = self.held.object_from_tool.inverse()
        slid = _smooth((time_s - swing.release_s + FORWARD_S) / FORWARD_S) * slip_m
        moved = Transform("tool", "object", tool_from_object.rotation, tool_from_object.translation_m + slid)
        return self.world_from_tool(swing.q_rad(time_s)) @ moved

    def states(self, swing: Swing, end_s: float, rng: np.random.Generator) -> Float[Array, "n 16"]:
        """Rows time_s, q1..q7, dq1..dq7, finger_width_m at 1 kHz from 0, with the encoders' noise."""
        times = np.arange(0.0, end_s, 1 / STATES_HZ)
        q = np.array([swing.q_rad(t) for t in times])
        dq = np.array([swing.dq_rad_s(t) for t in times])
        width = np.array([swing.finger_width_m(t) for t in times])[:, None]
        noisy = [v + s * rng.standard_normal(v.shape) for v, s in zip((q, dq, width), STATE_NOISE)]
        return np.hstack([times[:, None] + self.config.clock_offset_s, *noisy])


def _steps(poses: Sequence[Transform], times: Array) -> list[tuple[Transform, Transform, float, float]]:
    return list(zip(poses[:-1], poses[1:], times[:-1], times[1:]))


def _smooth(share: float) -> float:
    """0 to 1 with zero speed and acceleration at both ends."""
    x = float(np.clip(share, 0, 1))
    return x**3 * (10 - 15 * x + 6 * x * x)


def _painted(mesh: ColoredMesh) -> PaintedMesh:
    """Plain colours as an atlas of single texels (2x2 blocks, so that bilinear look-ups stay inside)."""
    palette, which = np.unique(np.round(mesh.face_rgb, 4), axis=0, return_inverse=True)
    linear = np.clip(0.85 * palette**2.2, 0.02, 0.8).astype(np.float32)
    atlas = np.repeat(np.repeat(linear[None], 4, axis=0), 4, axis=1)
    uv = np.stack([4.0 * which.reshape(-1) + 1.5, np.full(len(mesh.faces), 1.5)], -1).astype(np.float32)
    return PaintedMesh(
        mesh.vertices_m,
        mesh.faces,
        np.repeat(uv[:, None], 3, axis=1),
        corner_normals(mesh.vertices_m, mesh.faces).astype(np.float32),
        atlas,
        1.0,
        Gloss(0.04, 60.0, 0.5),
    )
