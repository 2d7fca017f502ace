"""Approaches: slow motions between two poses at rest, straight in the joints or a way round what stands between.

No point of the arm's links (the ends of their axes) is faster than FASTEST_M_S; the joints use SHARE_OF_SPEED of their
limits at most; what space and limits forbid is refused with the place.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.arm.kinematics import Batch, joint_bounds
from acquisition.arm.limits import ArmModel
from acquisition.arm.toss import Samples, check_limits, limited_motion
from acquisition.arm.workspace import PathRefused, Space
from acquisition.devices import JointTrajectory
from recordings.geometry import Transform

FASTEST_M_S = 0.25
SHARE_OF_SPEED = 0.3
GENTLE = 0.1
LIFTS_M = (0.15, 0.3)
"""How far the tool is raised on a way round."""
SAMPLES = 300
REACH_RAD = 0.6
"""The sampled tree grows by steps of this length at most."""
SHORTCUTS = 40
STANDING_RAD, STAND_S = 1e-6, 0.1
"""Where the arm is at its goal already, the motion is to stand there for this long."""
Pose = Float[Array, " j"]


@dataclass(frozen=True, eq=False)
class Approach:
    """A motion that may be sent, and what a person is told of it: the tool's way, the fastest point, stops between."""

    trajectory: JointTrajectory
    tool_way_m: float
    fastest_m_s: float
    stops: int

    def text(self) -> str:
        q = self.trajectory.q_rad
        round_about = f", by {self.stops} poses round what stands between" if self.stops else ""
        return (
            f"joints from {_degrees(q[0])} to {_degrees(q[-1])} deg{round_about}; the tool goes "
            f"{100 * self.tool_way_m:.0f} cm, no part faster than {self.fastest_m_s:.3f} m/s, "
            f"in {self.trajectory.duration_s:.1f} s"
        )


def plan_approach(model: ArmModel, space: Space, from_rad: Pose, to_rad: Pose, speed: float = 1.0) -> Approach:
    """A calm motion from pose to pose at `speed` times the usual one, clear of the space. Raises PathRefused."""
    poses = find_way(model, space, from_rad, to_rad)
    legs = [_leg(model, a, b) for a, b in zip(poses, poses[1:])]
    samples = _one_after_the_other(legs)
    stretch = max(1.0, fastest_m_s(model, samples) / FASTEST_M_S) / speed
    slow = Samples(samples.time_s * stretch, samples.q, samples.dq / stretch, samples.ddq / stretch**2)
    breach = check_limits(model, slow)
    if breach is not None:
        raise PathRefused(f"the way to the start is refused: {breach}; move the arm by hand first")
    tool = Batch(model).tool(slow.q)[1]
    return Approach(
        JointTrajectory(slow.time_s, slow.q, slow.dq),
        float(np.linalg.norm(np.diff(tool, axis=0), axis=1).sum()),
        fastest_m_s(model, slow),
        len(poses) - 2,
    )


def find_way(model: ArmModel, space: Space, from_rad: Pose, to_rad: Pose) -> list[Pose]:
    """Poses whose straight joint lines are clear: none between, raised or ready ones, or a sampled tree's.

    Raises PathRefused with the link, the thing, the place and the depth: where the arm stands wrongly, where its goal
    is wrong, or what is wrong on the direct way where no other was found.
    """
    for pose, which in ((from_rad, "the arm stands too near to something"), (to_rad, "the goal is too near")):
        contact = space.contact(model, pose[None])
        if contact is not None:
            raise PathRefused(f"{which}: {contact}; move the arm by hand, or mend [workspace] or the toss")
    direct = space.contact(model, np.stack([from_rad, to_rad]))
    if direct is None:
        return [from_rad, to_rad]
    for between in _raised(model, from_rad, to_rad):
        way = [from_rad, *between, to_rad]
        if all(_clear(model, space, a, b) for a, b in zip(way, way[1:])):
            return way
    found = _sampled(model, space, from_rad, to_rad)
    if found is None:
        raise PathRefused(
            f"the way to the start is refused: {direct}; no way round it was found; move the arm by hand first"
        )
    return _shortened(model, space, found)


def fastest_m_s(model: ArmModel, samples: Samples) -> float:
    """The speed of the fastest end of a link's axis, the tool's point among them."""
    batch = Batch(model)
    points = np.concatenate([*batch.segments(samples.q), batch.tool(samples.q)[1][:, None]], axis=1)
    speeds = np.linalg.norm(np.diff(points, axis=0), axis=2) / np.diff(samples.time_s)[:, None]
    return float(speeds.max())


def _clear(model: ArmModel, space: Space, a: Pose, b: Pose) -> bool:
    return space.contact(model, np.stack([a, b])) is None


def _raised(model: ArmModel, start: Pose, goal: Pose) -> Iterator[list[Pose]]:
    """Ways over the things: the tool raised at one end or both, or by the ready pose."""
    ready = model.ready_rad
    for lift_m in LIFTS_M:
        up, down = (_lifted(model, pose, lift_m) for pose in (start, goal))
        yield from ([p] for p in (up, down) if p is not None)
        if up is not None and down is not None:
            yield [up, down]
            yield [up, ready, down]
    yield [ready]


def _lifted(model: ArmModel, pose: Pose, lift_m: float) -> Pose | None:
    """The pose with its tool higher by `lift_m`, as near as inverse kinematics leads."""
    here = model.base_from_tool(pose)
    higher = Transform("base", "tool", here.rotation, here.translation_m + np.array([0.0, 0.0, lift_m]))
    found, solved = Batch(model).solve(higher, pose[None].copy())
    return found[0] if solved[0] else None


def _sampled(model: ArmModel, space: Space, start: Pose, goal: Pose) -> list[Pose] | None:
    """RRT-Connect (Kuffner and LaValle 2000) in the joints, with a fixed seed: the same question, the same way."""
    rng = np.random.default_rng(11)
    low, high = joint_bounds(model)
    trees: list[tuple[list[Pose], list[int]]] = [([start], [-1]), ([goal], [-1])]
    for k in range(SAMPLES):
        one, other = trees[k % 2], trees[1 - k % 2]
        new = _extend(model, space, one, rng.uniform(low, high))
        if new is None:
            continue
        while (near := _extend(model, space, other, one[0][new])) is not None:
            if np.array_equal(other[0][near], one[0][new]):
                halves = [_branch(*one, new), _branch(*other, near)]
                first, second = halves if k % 2 == 0 else halves[::-1]
                return [*first[::-1], *second[1:]]
    return None


def _extend(model: ArmModel, space: Space, tree: tuple[list[Pose], list[int]], towards: Pose) -> int | None:
    """A step from the tree's nearest pose; the new pose's number, or None where it is not clear."""
    poses, parents = tree
    nearest = int(np.linalg.norm(np.array(poses) - towards, axis=1).argmin())
    way = towards - poses[nearest]
    length = float(np.linalg.norm(way))
    step = towards if length <= REACH_RAD else poses[nearest] + way * (REACH_RAD / length)
    if not _clear(model, space, poses[nearest], step):
        return None
    poses.append(step)
    parents.append(nearest)
    return len(poses) - 1


def _branch(poses: list[Pose], parents: list[int], leaf: int) -> list[Pose]:
    """From a leaf to the tree's root."""
    found = []
    while leaf >= 0:
        found.append(poses[leaf])
        leaf = parents[leaf]
    return found


def _shortened(model: ArmModel, space: Space, way: list[Pose]) -> list[Pose]:
    """The way without poses that a straight line may leave out."""
    rng = np.random.default_rng(12)
    for _ in range(SHORTCUTS):
        if len(way) < 3:
            break
        i, k = sorted(rng.choice(len(way), 2, replace=False))
        if k - i > 1 and _clear(model, space, way[i], way[k]):
            way = [*way[: i + 1], *way[k:]]
    return way


def _leg(model: ArmModel, a: Pose, b: Pose) -> Samples:
    still = np.zeros(model.joints)
    if np.abs(b - a).max() < STANDING_RAD:
        return Samples(np.array([0.0, STAND_S]), np.stack([a, b]), np.stack([still, still]), np.stack([still, still]))
    part = limited_motion(model, (a, still), (b, still), SHARE_OF_SPEED, GENTLE)
    if part is None:
        raise PathRefused(f"no motion of the {model.name} to the start of the toss; move it there by hand")
    return part


def _one_after_the_other(legs: Sequence[Samples]) -> Samples:
    """Legs that begin and end at rest, joined."""
    time_s, parts = [legs[0].time_s], [legs[0]]
    for leg in legs[1:]:
        time_s.append(time_s[-1][-1] + leg.time_s[1:])
        parts.append(Samples(leg.time_s[1:], leg.q[1:], leg.dq[1:], leg.ddq[1:]))
    q, dq, ddq = (np.concatenate([getattr(p, name) for p in parts]) for name in ("q", "dq", "ddq"))
    return Samples(np.concatenate(time_s), q, dq, ddq)


def _degrees(q: Pose) -> str:
    return "(" + " ".join(f"{v:.0f}" for v in np.rad2deg(q)) + ")"
