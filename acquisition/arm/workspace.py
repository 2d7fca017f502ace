"""The space an arm may move in: table, box, posts and cameras, checked on every path that it is sent along.

A path is checked at poses so dense that no point of the arm goes farther than STEP_M from one to the next (bounded by
the joints' turns times the arm's length beyond them): between two of them nothing comes nearer than half of that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.arm.kinematics import Batch, segment_distance
from acquisition.arm.limits import ArmModel
from acquisition.rig import Rig
from recordings.errors import BadInput, TosslabError
from recordings.geometry import Transform
from recordings.tracks import RigCalibration

STEP_M = 0.005
SELF_CLEARANCE_M = 0.01
TABLE_CLEARANCE_M = 0.015
THING_CLEARANCE_M = 0.02
"""From posts and cameras; the box is kept to its face."""
TOSS_SPARE_M = 0.002
"""Tosses keep this much more, so that an arm that stands at the end of one may be moved again."""
FACES = tuple(f"the box's {side} {axis} face" for side in ("lower", "upper") for axis in "xyz")


class PathRefused(TosslabError):
    """A path that the arm must not take."""


@dataclass(frozen=True)
class Contact:
    """Where a path is worst: `clearance_m` is negative inside the thing; `share` is how much of the way is done."""

    part: str
    thing: str
    share: float
    clearance_m: float
    wanted_m: float

    what = "distance"

    def __str__(self) -> str:
        found = f"{100 * abs(self.clearance_m):.1f} cm" + (" inside" if self.clearance_m < 0 else "")
        return (
            f"distance of {self.part} to {self.thing} at {100 * self.share:.0f} % of the way: {found}, "
            f"at least {100 * self.wanted_m:.1f} cm is wanted"
        )


@dataclass(frozen=True, eq=False)
class Space:
    """The arm's place, the box and the things in it, in the world (m). Things are capsules from `a_m` to `b_m`."""

    world_from_base: Transform
    lower_m: Float[Array, "3"]
    upper_m: Float[Array, "3"]
    things: tuple[str, ...]
    a_m: Float[Array, "k 3"]
    b_m: Float[Array, "k 3"]
    radius_m: Float[Array, " k"]

    @staticmethod
    def of_table(world_from_base: Transform) -> Space:
        """The table alone (the world's z = 0), for plans that move nothing."""
        none = np.zeros((0, 3))
        return Space(world_from_base, np.full(3, -np.inf), np.full(3, np.inf), (), none, none, np.zeros(0))

    @staticmethod
    def of_rig(rig: Rig, world_from_base: Transform, calibration: RigCalibration) -> Space:
        """What the rig file's [workspace] says, with the cameras at their calibrated places.

        Raises BadInput where there is no [workspace], or where nobody says the place of a camera.
        """
        given = rig.workspace
        if given is None:
            raise BadInput(
                f"{rig.source}: no [workspace]; an arm moves only in a box that the rig file gives: measure, and add\n"
                "[workspace]              # metres, in the world (on the table, z up)\n"
                "lower_m = [x, y, z]      # no part of the arm leaves this box\n"
                "upper_m = [x, y, z]\n"
                "posts = [{ name = '...', from_m = [x, y, z], to_m = [x, y, z], radius_m = r }]   # [] for none"
            )
        if not all(low < high for low, high in zip(given.lower_m, given.upper_m)):
            raise BadInput(f"{rig.source}: [workspace] lower_m {given.lower_m} is not below upper_m {given.upper_m}")
        cameras = _cameras(rig, calibration)
        names = [f"post '{p.name}'" for p in given.posts] + [f"camera '{name}'" for name in cameras]
        a = [p.from_m for p in given.posts] + [tuple(at) for at in cameras.values()]
        b = [p.to_m for p in given.posts] + [tuple(at) for at in cameras.values()]
        radius = [p.radius_m for p in given.posts] + [given.camera_radius_m] * len(cameras)
        return Space(
            world_from_base,
            np.array(given.lower_m),
            np.array(given.upper_m),
            tuple(names),
            np.array(a, dtype=float).reshape(-1, 3),
            np.array(b, dtype=float).reshape(-1, 3),
            np.array(radius, dtype=float),
        )

    def contact(self, model: ArmModel, path_rad: Float[Array, "n j"], spare_m: float = 0.0) -> Contact | None:
        """The worst place of a path (straight lines between joint poses), or None where it keeps all distances."""
        q, share = dense(model, path_rad)
        batch = Batch(model)
        a, b = (self.world_from_base.points(ends.reshape(-1, 3)).reshape(ends.shape) for ends in batch.segments(q))
        radius = np.array([c.radius_m for c in model.capsules])
        found: list[Contact] = []

        def worst(gaps: Float[Array, "n c"], thing: str, wanted_m: float) -> None:
            row, part = np.unravel_index(int(gaps.argmin()), gaps.shape)
            gap = float(gaps[row, part])
            if gap < wanted_m + spare_m:
                found.append(Contact(model.capsules[int(part)].link, thing, float(share[row]), gap, wanted_m + spare_m))

        moving = np.array([c.link != model.robot.root for c in model.capsules])
        fixed = np.where(moving, 0.0, np.inf)  # the foot stands on the table, and may stand on the box's face
        worst(np.minimum(a[..., 2], b[..., 2]) - radius + fixed, "the table", TABLE_CLEARANCE_M)
        for axis in range(3):
            low = np.minimum(a[..., axis], b[..., axis]) - radius - self.lower_m[axis] + fixed
            high = self.upper_m[axis] - np.maximum(a[..., axis], b[..., axis]) - radius + fixed
            worst(low, FACES[axis], 0.0)
            worst(high, FACES[3 + axis], 0.0)
        for thing, c, d, r in zip(self.things, self.a_m, self.b_m, self.radius_m):
            worst(_to_segment(a, b, c, d) - radius - r + fixed, thing, THING_CLEARANCE_M)
        gaps, which = batch.clearances(q)
        k = int(gaps.argmin())
        if gaps[k] < SELF_CLEARANCE_M + spare_m:
            one, other = (model.capsules[i].link for i in which[k])
            found.append(Contact(one, other, float(share[k]), float(gaps[k]), SELF_CLEARANCE_M + spare_m))
        return max(found, key=lambda c: c.wanted_m - c.clearance_m, default=None)


def dense(model: ArmModel, path_rad: Float[Array, "n j"]) -> tuple[Float[Array, "m j"], Float[Array, " m"]]:
    """Poses along a path between which no point of the arm moves by more than STEP_M, and their shares of the way."""
    steps = np.abs(np.diff(path_rad, axis=0)) @ reaches_m(model)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    if way[-1] == 0.0:
        return path_rad[:1], np.zeros(1)
    at = np.linspace(0.0, way[-1], int(np.ceil(way[-1] / STEP_M)) + 1)
    return np.stack([np.interp(at, way, column) for column in path_rad.T], axis=1), at / way[-1]


def reaches_m(model: ArmModel) -> Float[Array, " j"]:
    """For each joint a length that no point of the arm beyond it is farther away than."""
    longest: dict[str, float] = {}
    for c in model.capsules:
        ends = max(float(np.linalg.norm(c.a_m)), float(np.linalg.norm(c.b_m))) + c.radius_m
        longest[c.link] = max(longest.get(c.link, 0.0), ends)
    for joint in reversed(model.robot.joints):
        beyond = float(np.linalg.norm(joint.origin.translation_m)) + longest.get(joint.child, 0.0)
        longest[joint.parent] = max(longest.get(joint.parent, 0.0), beyond)
    return np.array([longest.get(joint.child, 0.0) for joint in model.robot.arm_joints])


def _cameras(rig: Rig, calibration: RigCalibration) -> dict[str, Float[Array, "3"]]:
    """Where every camera of the rig is: as calibrated, or as [workspace.cameras] says."""
    assert rig.workspace is not None
    found: dict[str, Float[Array, "3"]] = {}
    for name, at in rig.workspace.cameras.items():
        if not isinstance(at, list | tuple) or len(at) != 3:
            raise BadInput(f"{rig.source}: [workspace.cameras] {name} = {at!r}; wanted [x, y, z] in metres")
        found[name] = np.array(at, dtype=float)
    for device in rig.devices:
        if device.kind not in ("rgbd", "mono"):
            continue
        placed = calibration.find("world", device.name)
        if placed is not None:
            found[device.name] = placed.translation_m
        elif device.name not in found:
            raise BadInput(
                f"{rig.source}: nobody says where camera '{device.name}' stands, and the arm must stay clear of it: "
                f"calibrate it, or add to [workspace]: cameras = {{ {device.name} = [x, y, z] }}"
            )
    return found


def _to_segment(
    a: Float[Array, "n c 3"], b: Float[Array, "n c 3"], c: Float[Array, "3"], d: Float[Array, "3"]
) -> Float[Array, "n c"]:
    flat = a.reshape(-1, 3)
    ends = (np.broadcast_to(end, flat.shape) for end in (c, d))
    return segment_distance(flat, b.reshape(-1, 3), *ends).reshape(a.shape[:2])
