"""Forward kinematics, Jacobians and inverse kinematics of many arm configurations at once (plain numpy)."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from acquisition.arm.limits import ArmModel
from recordings.geometry import Transform, rotation_log

IK_STEPS = 60
IK_TOLERANCE = 1e-6
DAMPING = 1e-4
LONGEST_STEP_RAD = 0.35


class Batch:
    """An arm, computed for `n` joint vectors in one go. Everything is in the base frame."""

    def __init__(self, model: ArmModel) -> None:
        self.model = model
        self._numbers = {joint.name: k for k, joint in enumerate(model.robot.arm_joints)}

    def links(self, q_rad: Float[Array, "n j"]) -> dict[str, tuple[Float[Array, "n 3 3"], Float[Array, "n 3"]]]:
        """Rotation and position of every link."""
        n = len(q_rad)
        root = self.model.robot.root
        found = {root: (np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3)))}
        for joint in self.model.robot.joints:
            R, p = found[joint.parent]
            here = p + R @ joint.origin.translation_m
            turned = R @ joint.origin.rotation
            if joint.name in self._numbers:
                turned = turned @ _turns(joint.axis, q_rad[:, self._numbers[joint.name]])
            found[joint.child] = (turned, here)
        return found

    def tool(self, q_rad: Float[Array, "n j"]) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3"]]:
        return self.links(q_rad)[self.model.tool]

    def jacobian(self, q_rad: Float[Array, "n j"]) -> Float[Array, "n 6 j"]:
        """Velocity and angular velocity of the tool's origin per joint speed."""
        links = self.links(q_rad)
        end = links[self.model.tool][1]
        columns = []
        for joint in self.model.robot.arm_joints:
            R, p = links[joint.child]
            axis = R @ joint.axis
            columns.append(np.concatenate([np.cross(axis, end - p), axis], axis=1))
        return np.stack(columns, axis=2)

    def segments(self, q_rad: Float[Array, "n j"]) -> tuple[Float[Array, "n c 3"], Float[Array, "n c 3"]]:
        """Ends of all capsules."""
        links = self.links(q_rad)
        a, b = (
            np.stack([links[c.link][1] + links[c.link][0] @ np.array(end) for c, end in ends], axis=1)
            for ends in ([(c, c.a_m) for c in self.model.capsules], [(c, c.b_m) for c in self.model.capsules])
        )
        return a, b

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """Capsules that could meet: not on one link, nor on links within two joints of each other."""
        depth = {link: self._depth(link) for link in {c.link for c in self.model.capsules}}
        capsules = self.model.capsules
        return [
            (i, k)
            for i in range(len(capsules))
            for k in range(i + 1, len(capsules))
            if abs(depth[capsules[i].link] - depth[capsules[k].link]) > 2
        ]

    def _depth(self, link: str) -> int:
        """How many joints turn before a link."""
        above = {j.child: j for j in self.model.robot.joints}
        count = 0
        while link in above:
            count += above[link].name in self._numbers
            link = above[link].parent
        return count

    def clearances(self, q_rad: Float[Array, "n j"]) -> tuple[Float[Array, " n"], list[tuple[int, int]]]:
        """The smallest distance between two parts of the arm at each configuration, and which two."""
        a, b = self.segments(q_rad)
        radius = np.array([c.radius_m for c in self.model.capsules])
        gaps = np.stack(
            [segment_distance(a[:, i], b[:, i], a[:, k], b[:, k]) - radius[i] - radius[k] for i, k in self.pairs],
            axis=1,
        )
        nearest = gaps.argmin(axis=1)
        return gaps[np.arange(len(gaps)), nearest], [self.pairs[k] for k in nearest]

    def solve(
        self, base_from_tool: Transform, seeds_rad: Float[Array, "n j"]
    ) -> tuple[Float[Array, "n j"], Bool[Array, " n"]]:
        """Joint angles that bring the tool there, from each seed (damped least squares), and which of them did."""
        model = self.model
        q = seeds_rad.copy()
        low, high = joint_bounds(model)
        wanted = base_from_tool.rotation
        for _ in range(IK_STEPS):
            R, p = self.tool(q)
            turn = np.array([r @ rotation_log(r.T @ wanted) for r in R])
            error = np.concatenate([base_from_tool.translation_m - p, turn], axis=1)
            if np.abs(error).max(axis=1).min() < IK_TOLERANCE and np.abs(error).max() < 10 * IK_TOLERANCE:
                break
            J = self.jacobian(q)
            Jt = J.transpose(0, 2, 1)
            step = (Jt @ np.linalg.solve(J @ Jt + DAMPING * np.eye(6), error[:, :, None]))[:, :, 0]
            q = np.clip(q + np.clip(step, -LONGEST_STEP_RAD, LONGEST_STEP_RAD), low, high)
        R, p = self.tool(q)
        off = np.linalg.norm(p - base_from_tool.translation_m, axis=1)
        turned = np.array([np.linalg.norm(rotation_log(r.T @ wanted)) for r in R])
        return q, (off < 1e-4) & (turned < 1e-3)


def joint_bounds(model: ArmModel) -> tuple[Float[Array, " j"], Float[Array, " j"]]:
    """Position limits with the share that plans may use: 0.9 of the range, about its middle."""
    from acquisition.arm.limits import SHARE

    middle, half = (model.lower_rad + model.upper_rad) / 2, (model.upper_rad - model.lower_rad) / 2
    return middle - SHARE * half, middle + SHARE * half


def segment_distance(
    a: Float[Array, "n 3"], b: Float[Array, "n 3"], c: Float[Array, "n 3"], d: Float[Array, "n 3"]
) -> Float[Array, " n"]:
    """Distance between the segments a-b and c-d, row by row."""
    u, v, w = b - a, d - c, a - c
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    uw, vw = (u * w).sum(1), (v * w).sum(1)
    det = uu * vv - uv * uv
    s = np.clip(np.where(det > 1e-12, (uv * vw - vv * uw) / np.maximum(det, 1e-12), 0.0), 0, 1)
    t = np.clip((uv * s + vw) / np.maximum(vv, 1e-12), 0, 1)
    s = np.clip((uv * t - uw) / np.maximum(uu, 1e-12), 0, 1)
    return np.linalg.norm(a + s[:, None] * u - c - t[:, None] * v, axis=1)


def _turns(axis: Float[Array, "3"], angle: Float[Array, " n"]) -> Float[Array, "n 3 3"]:
    """Rodrigues' formula for one axis and many angles."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle)[:, None, None] * K + (1 - np.cos(angle))[:, None, None] * (K @ K)
