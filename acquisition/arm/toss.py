"""A toss: from the release that is wanted to a trajectory that the arm can do, proven before anything moves.

The tool reaches the release at constant joint speeds, held for as long as the gripper's delay is uncertain, so that
an early or a late opening shifts the release along the path and leaves its velocity as it is. Run-up and braking are
jerk-limited (ruckig), all joints in step. What breaks a limit is refused with the joint, the time and the value.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.arm.dynamics import torques
from acquisition.arm.kinematics import Batch, joint_bounds
from acquisition.arm.limits import SHARE, ArmModel
from acquisition.arm.workspace import TOSS_SPARE_M, Contact, Space
from acquisition.devices import JointTrajectory
from acquisition.rig import TossConfig
from recordings.errors import TosslabError
from recordings.geometry import Transform, rotation_exp

STEP_S = 0.001
RUN_UPS_S = (0.35, 0.5, 0.7, 0.9)
"""Half of such a time at release speed is the length of the run-up."""
GENTLENESS = (1.0, 0.4, 0.16, 0.07, 0.03)
"""Shares of the jerk limit that are tried until the torques change slowly enough."""
OPENING_S = 0.06
"""The fingers need this long until the object is free."""
RETREAT_M = 0.08
WINDOW_SIGMAS = 4.0
SHORTEST_WINDOW_S = 0.03
STAND_S = 0.05
SEEDS = 12
NUMERIC_SLACK = 1e-6


class TossRefused(TosslabError):
    """A toss that the arm cannot do, or must not."""


@dataclass(frozen=True, eq=False)
class TossTarget:
    """The release that is wanted: the tool's pose and velocity in the world."""

    world_from_tool: Transform
    linear_velocity_world_m_s: Float[Array, "3"]
    angular_velocity_world_rad_s: Float[Array, "3"]


@dataclass(frozen=True)
class ReleaseDelay:
    """From the command to the fingers' first movement; `samples` openings were measured (0: assumed)."""

    mean_s: float
    sigma_s: float
    samples: int = 0


@dataclass(frozen=True, eq=False)
class TossPlan:
    """A toss that the arm can do. Times count from the trajectory's start.

    `release_s` is when the fingers are to begin to open, `command_s` when the gripper has to be told so that they do.
    The velocities are those of the tool at `release_s`, in the world. The joints' speeds stay constant for `window_s`
    around the release.
    """

    trajectory: JointTrajectory
    release_s: float
    command_s: float
    world_from_tool: Transform
    linear_velocity_world_m_s: Float[Array, "3"]
    angular_velocity_world_rad_s: Float[Array, "3"]
    window_s: float = 0.0


@dataclass(frozen=True, eq=False)
class Samples:
    """A trajectory every millisecond with its derivatives. Rows are instants, columns joints."""

    time_s: Float[Array, " n"]
    q: Float[Array, "n j"]
    dq: Float[Array, "n j"]
    ddq: Float[Array, "n j"]


@dataclass(frozen=True)
class Breach:
    """A limit that a trajectory breaks."""

    what: str
    part: str
    time_s: float
    value: float
    limit: float
    unit: str

    def __str__(self) -> str:
        where = f"{self.what} of {self.part} at {self.time_s:.3f} s: {self.value:.4g} {self.unit}"
        return f"{where}, allowed are {self.limit:.4g} ({SHARE:g} of the limit)"


def draw_target(config: TossConfig, toss: int, attempt: int = 0) -> TossTarget:
    """The release of toss number `toss`, varied as the rig file says."""
    rng = np.random.default_rng(np.random.SeedSequence((config.seed, toss, attempt)))
    vary = rng.uniform(-1, 1, (3, 3)) * np.array(
        [[config.position_spread_m], [config.velocity_spread_m_s], [config.spin_spread_rad_s]]
    )
    approach = np.array(config.approach) / np.linalg.norm(config.approach)
    side = np.cross(approach, [0.0, 0.0, 1.0] if abs(approach[2]) < 0.99 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    closing = rotation_exp(np.deg2rad(config.roll_deg) * approach) @ side
    rotation = np.stack([np.cross(closing, approach), closing, approach], 1)
    return TossTarget(
        Transform("world", "tool", rotation, np.array(config.position_m) + vary[0]),
        np.array(config.velocity_m_s) + vary[1],
        np.array(config.spin_rad_s) + vary[2],
    )


def plan_toss(model: ArmModel, space: Space, target: TossTarget, delay: ReleaseDelay) -> TossPlan:
    """A trajectory through the wanted release, within SHARE of every limit and clear of all that is in the space.

    Raises TossRefused with the joint, the time and the value of what stood in the way of the best attempt.
    """
    base_from_world = space.world_from_base.inverse()
    base_from_tool = base_from_world @ target.world_from_tool
    twist = np.concatenate(
        [
            base_from_world.vectors(target.linear_velocity_world_m_s[None])[0],
            base_from_world.vectors(target.angular_velocity_world_rad_s[None])[0],
        ]
    )
    best: Breach | Contact | None = None
    for q, dq in _releases(model, base_from_tool, twist):
        speed = np.abs(dq)[None]
        breach: Breach | Contact | None = _breach(model, "velocity", "rad/s", np.zeros(1), speed, model.velocity)
        run_ups_s = RUN_UPS_S if breach is None else ()
        for run_up_s in run_ups_s:
            plan, wrong = _attempt(model, q, dq, run_up_s, delay, space)
            breach = breach or wrong
            if plan is not None:
                trajectory, release_s, window_s = plan
                return TossPlan(
                    trajectory,
                    release_s,
                    release_s - delay.mean_s,
                    target.world_from_tool,
                    target.linear_velocity_world_m_s,
                    target.angular_velocity_world_rad_s,
                    window_s,
                )
        best = best or breach
    if best is None:
        at = base_from_tool.translation_m
        raise TossRefused(
            f"no joint angles of the {model.name} reach the release pose ({at[0]:.3f}, {at[1]:.3f}, {at[2]:.3f} m from "
            "its base); move the release nearer, or turn approach and roll_deg"
        )
    raise TossRefused(f"the toss is refused: {best}; ask for a slower release or another place of it")


def slowed(plan: TossPlan, speed: float) -> TossPlan:
    """The same path at `speed` (0 to 1) times its speed: a rehearsal, at which the object falls more than it flies."""
    t = plan.trajectory
    release_s = plan.release_s / speed
    return replace(
        plan,
        trajectory=JointTrajectory(t.time_s / speed, t.q_rad, t.dq_rad_s * speed),
        release_s=release_s,
        command_s=release_s - (plan.release_s - plan.command_s),
        linear_velocity_world_m_s=plan.linear_velocity_world_m_s * speed,
        angular_velocity_world_rad_s=plan.angular_velocity_world_rad_s * speed,
        window_s=plan.window_s / speed,
    )


def check_limits(model: ArmModel, samples: Samples) -> Breach | None:
    """The first limit that a trajectory breaks: position, velocity, acceleration, jerk, torque and its rate."""
    low, high = joint_bounds(model)
    jerk = np.diff(samples.ddq, axis=0) / np.diff(samples.time_s)[:, None]
    rows = [
        ("position", "rad", np.abs(samples.q - (low + high) / 2), (high - low) / 2 / SHARE),
        ("velocity", "rad/s", np.abs(samples.dq), model.velocity),
        ("acceleration", "rad/s2", np.abs(samples.ddq), model.acceleration),
        ("jerk", "rad/s3", np.abs(jerk), model.jerk),
    ]
    torque = torques(model, samples.q, samples.dq, samples.ddq)
    rate = np.diff(torque, axis=0) / np.diff(samples.time_s)[:, None]
    rows += [
        ("torque", "Nm", np.abs(torque), model.torque_nm),
        ("torque rate", "Nm/s", np.abs(rate), model.torque_rate_nm_s),
    ]
    for what, unit, values, limits in rows:
        breach = _breach(model, what, unit, samples.time_s, values, limits)
        if breach is not None:
            return breach
    return None


def _releases(
    model: ArmModel, base_from_tool: Transform, twist: Float[Array, "6"]
) -> list[tuple[Float[Array, " j"], Float[Array, " j"]]]:
    """Joint angles at the release and the speeds that give the tool its velocity, the least strained first."""
    batch = Batch(model)
    rng = np.random.default_rng(5)
    low, high = joint_bounds(model)
    seeds = np.clip(model.ready_rad + rng.normal(0, 0.6, (SEEDS, model.joints)), low, high)
    seeds[0] = model.ready_rad
    seeds[: SEEDS // 2, 0] = np.clip(
        np.arctan2(base_from_tool.translation_m[1], base_from_tool.translation_m[0]), low[0], high[0]
    )
    q, solved = batch.solve(base_from_tool, seeds)
    found = []
    for one in q[solved]:
        J = batch.jacobian(one[None])[0]
        weighted = J * model.velocity
        dq = model.velocity * (np.linalg.pinv(weighted, rcond=1e-4) @ twist)
        if np.abs(J @ dq - twist).max() < 1e-6:
            found.append((float(np.abs(dq / model.velocity).max()), one, dq))
    found.sort(key=lambda row: row[0])
    return [(one, dq) for _, one, dq in found]


def _attempt(
    model: ArmModel,
    q: Float[Array, " j"],
    dq: Float[Array, " j"],
    run_up_s: float,
    delay: ReleaseDelay,
    space: Space,
) -> tuple[tuple[JointTrajectory, float, float] | None, Breach | Contact | None]:
    """Run-up, window, braking with retreat; the first gentleness that keeps all limits."""
    window_s = max(WINDOW_SIGMAS * delay.sigma_s, SHORTEST_WINDOW_S)
    enters, leaves = q - 0.5 * window_s * dq, q + (0.5 * window_s + OPENING_S) * dq
    starts = enters - 0.5 * run_up_s * dq
    J = Batch(model).jacobian(q[None])[0]
    approach = model.base_from_tool(q).rotation[:, 2]
    back = np.linalg.pinv(J, rcond=1e-3) @ np.append(-RETREAT_M * approach, np.zeros(3))
    ends = leaves + 0.5 * run_up_s * dq + back
    still = np.zeros(model.joints)
    breach: Breach | Contact | None = None
    for share in GENTLENESS:
        up = limited_motion(model, (starts, still), (enters, dq), SHARE, share)
        down = limited_motion(model, (leaves, dq), (ends, still), SHARE, share)
        if up is None or down is None:
            continue
        samples = _joined(up, dq, window_s + OPENING_S, down)
        breach = check_limits(model, samples) or space.contact(model, samples.q, TOSS_SPARE_M)
        if breach is None:
            release_s = STAND_S + float(up.time_s[-1]) + 0.5 * window_s
            return (JointTrajectory(samples.time_s, samples.q, samples.dq), release_s, window_s), None
        if breach.what not in ("torque rate", "jerk", "torque"):
            break
    return None, breach


def limited_motion(
    model: ArmModel,
    start: tuple[Float[Array, " j"], Float[Array, " j"]],
    end: tuple[Float[Array, " j"], Float[Array, " j"]],
    share: float,
    jerk_share: float,
) -> Samples | None:
    """The fastest motion between two states of no acceleration within `share` of speed and acceleration."""
    import ruckig

    if np.abs(end[1]).max() > share * model.velocity.max() * 1.2:
        return None
    given = ruckig.InputParameter(model.joints)
    given.current_position, given.current_velocity = start[0].tolist(), start[1].tolist()
    given.target_position, given.target_velocity = end[0].tolist(), end[1].tolist()
    given.current_acceleration = given.target_acceleration = [0.0] * model.joints
    given.max_velocity = (share * model.velocity).tolist()
    given.max_acceleration = (share * model.acceleration * min(1.0, 3 * jerk_share + 0.2)).tolist()
    given.max_jerk = (share * jerk_share * model.jerk).tolist()
    given.synchronization = ruckig.Synchronization.Phase
    trajectory = ruckig.Trajectory(model.joints)
    result = ruckig.Ruckig(model.joints).calculate(given, trajectory)
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        return None
    times = np.append(np.arange(0.0, trajectory.duration, STEP_S), trajectory.duration)
    rows = [trajectory.at_time(float(t)) for t in times]
    q, dq, ddq = (np.array([row[k] for row in rows]) for k in range(3))
    return Samples(times, q, dq, ddq)


def _joined(up: Samples, dq: Float[Array, " j"], window_s: float, down: Samples) -> Samples:
    """Stand, run up, keep the speed, brake, stand; on one even grid, so that numeric derivatives are clean."""
    first_s = STAND_S + float(up.time_s[-1])
    second_s = first_s + window_s
    total_s = second_s + float(down.time_s[-1]) + STAND_S
    t = np.arange(0.0, total_s, STEP_S)
    still = np.zeros_like(dq)
    q, v, a = (np.empty((len(t), len(dq))) for _ in range(3))
    stands, runs = t < STAND_S, (t >= STAND_S) & (t < first_s)
    keeps, brakes = (t >= first_s) & (t < second_s), t >= second_s
    q[stands], v[stands], a[stands] = up.q[0], still, still
    for rows, part, offset in ((runs, up, STAND_S), (brakes, down, second_s)):
        for out, values in ((q, part.q), (v, part.dq), (a, part.ddq)):
            out[rows] = np.array([np.interp(t[rows] - offset, part.time_s, c) for c in values.T]).T
    q[keeps] = up.q[-1] + np.outer(t[keeps] - first_s, dq)
    v[keeps], a[keeps] = dq, still
    past = t >= second_s + float(down.time_s[-1])
    q[past], v[past], a[past] = down.q[-1], still, still
    return Samples(t, q, v, a)


def _breach(
    model: ArmModel,
    what: str,
    unit: str,
    time_s: Float[Array, " n"],
    values: Float[Array, "m j"],
    limits: Float[Array, " j"],
) -> Breach | None:
    over = values / limits
    row, joint = np.unravel_index(int(over.argmax()), over.shape)
    if over[row, joint] <= SHARE * (1 + NUMERIC_SLACK):
        return None
    name = model.robot.arm_joints[int(joint)].name
    what = "distance from the middle of the range" if what == "position" else what
    return Breach(what, name, float(time_s[row]), float(values[row, joint]), SHARE * float(limits[joint]), unit)
