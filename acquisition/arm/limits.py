"""The arms that toss: kinematics, the limits that their makers state, the space that their links fill."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.geometry import Transform, rotation_exp
from recordings.robot.arm import PANDA_TOOL, Joint, Robot, panda

SHARE = 0.9
"""Of every limit is the most that a plan may use."""


@dataclass(frozen=True, eq=False)
class Capsule:
    """A cylinder with round ends, fixed to a link: from `a_m` to `b_m` in the link's frame."""

    link: str
    a_m: tuple[float, float, float]
    b_m: tuple[float, float, float]
    radius_m: float


@dataclass(frozen=True)
class Body:
    """Mass of a link, its centre in the link's frame, its inertia about the centre: xx, yy, zz, xy, xz, yz."""

    link: str
    mass_kg: float
    centre_m: tuple[float, float, float]
    inertia_kgm2: tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Held:
    """What the hand holds: mass, centre of mass in the tool's frame, and the ball about the tool that it is within."""

    mass_kg: float = 0.3
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius_m: float = 0.04


@dataclass(frozen=True, eq=False)
class ArmModel:
    """An arm as the planner sees it. Limits per joint, from the base on; `tool` is the link that holds the object.

    `bodies` are the masses that torques are computed from (acquisition/arm/dynamics.py); none: they are the URDF's.
    """

    name: str
    robot: Robot
    tool: str
    ready_rad: Float[Array, " j"]
    lower_rad: Float[Array, " j"]
    upper_rad: Float[Array, " j"]
    velocity: Float[Array, " j"]
    acceleration: Float[Array, " j"]
    jerk: Float[Array, " j"]
    torque_nm: Float[Array, " j"]
    torque_rate_nm_s: Float[Array, " j"]
    capsules: tuple[Capsule, ...]
    source: str
    bodies: tuple[Body, ...] = ()
    held: Held = Held()
    flange: str = ""
    """The link that the hand is fixed to."""

    def holding(self, held: Held) -> ArmModel:
        """The same arm with this in its hand: its weight is carried, its ball is kept clear like a link."""
        ball = Capsule(self.tool, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), held.radius_m)
        return replace(self, held=held, capsules=(*self.capsules, ball))

    @property
    def joints(self) -> int:
        return len(self.lower_rad)

    def base_from_tool(self, q_rad: Float[Array, " j"]) -> Transform:
        found = self.robot.links(q_rad)[self.tool]
        return Transform("base", "tool", found.rotation, found.translation_m)

    def tool_in_flange(self, point_tool_m: Float[Array, "3"]) -> Float[Array, "3"]:
        """A point of the tool's frame in the flange's."""
        links = self.robot.links(self.ready_rad)
        return (links[self.flange].inverse() @ links[self.tool]).points(point_tool_m[None])[0]

    def jacobian(self, q_rad: Float[Array, " j"], point_base_m: Float[Array, "3"]) -> Float[Array, "6 j"]:
        """Velocity and angular velocity, in base axes, of a point fixed to the tool, per joint speed."""
        return self.robot.jacobian(q_rad, self.tool, point_base_m)

    def segments(
        self, q_rad: Float[Array, " j"]
    ) -> tuple[Float[Array, "c 3"], Float[Array, "c 3"], Float[Array, " c"]]:
        """Ends and radii of all capsules in the base frame."""
        links = self.robot.links(q_rad)
        a = np.array([links[c.link].points(np.array([c.a_m]))[0] for c in self.capsules])
        b = np.array([links[c.link].points(np.array([c.b_m]))[0] for c in self.capsules])
        return a, b, np.array([c.radius_m for c in self.capsules])


def arm_model(name: str) -> ArmModel:
    """The model of a rig's `robot`."""
    models = {"panda": panda_model, "ur5e": ur5e_model}
    if name not in models:
        raise BadInput(f"no arm model '{name}'; there are {', '.join(models)}")
    return models[name]()


@cache
def panda_model() -> ArmModel:
    """Franka Panda (FER): limits of libfranka 0.9's rate_limiting.h, capsules after Franka's own self-collision set."""
    return ArmModel(
        name="panda",
        robot=panda(),
        tool=PANDA_TOOL,
        ready_rad=np.array([0.0, -0.3, 0.0, -2.1, 0.0, 2.1, 0.785]),
        lower_rad=np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]),
        upper_rad=np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]),
        velocity=np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61]),
        acceleration=np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]),
        jerk=np.array([7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0]),
        torque_nm=np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0]),
        torque_rate_nm_s=np.full(7, 1000.0),
        capsules=(
            Capsule("panda_link0", (-0.09, 0.0, 0.06), (-0.06, 0.0, 0.06), 0.09),
            Capsule("panda_link1", (0.0, 0.0, -0.19), (0.0, 0.0, -0.05), 0.09),
            Capsule("panda_link2", (0.0, 0.0, -0.06), (0.0, 0.0, 0.06), 0.09),
            Capsule("panda_link3", (0.0, 0.0, -0.22), (0.0, 0.0, -0.07), 0.09),
            Capsule("panda_link4", (0.0, 0.0, -0.06), (0.0, 0.0, 0.06), 0.09),
            Capsule("panda_link5", (0.0, 0.0, -0.31), (0.0, 0.0, -0.21), 0.09),
            Capsule("panda_link5", (0.0, 0.08, -0.2), (0.0, 0.08, -0.06), 0.055),
            Capsule("panda_link6", (0.0, 0.0, -0.07), (0.0, 0.0, 0.01), 0.08),
            Capsule("panda_link7", (0.0, 0.0, -0.06), (0.0, 0.0, 0.08), 0.07),
            Capsule("panda_hand", (0.0, -0.05, 0.04), (0.0, 0.05, 0.04), 0.04),
            Capsule("panda_hand", (0.0, -0.04, 0.085), (0.0, 0.04, 0.085), 0.02),
        ),
        source="libfranka 0.9 rate_limiting.h; Franka control parameters of the Panda (FER)",
        flange="panda_link8",
    )


UR5E_DH = (
    (0.1625, 0.0, np.pi / 2),
    (0.0, -0.425, 0.0),
    (0.0, -0.3922, 0.0),
    (0.1333, 0.0, np.pi / 2),
    (0.0997, 0.0, -np.pi / 2),
    (0.0996, 0.0, 0.0),
)
"""d (m), a (m), alpha (rad) of each joint, as Universal Robots publishes them for the UR5e."""
UR5E_BODIES = (
    Body("link1", 3.761, (0.0, -0.02561, 0.00193), (0.00700, 0.00648, 0.00657, 0.0, -0.00001, 0.00050)),
    Body("link2", 8.058, (0.2125, 0.0, 0.11336), (0.01506, 0.33388, 0.33247, -0.00005, 0.00001, 0.0)),
    Body("link3", 2.846, (0.15, 0.0, 0.0265), (0.00400, 0.07879, 0.07849, -0.00001, 0.00137, -0.00001)),
    Body("link4", 1.37, (0.0, -0.0018, 0.01634), (0.00165, 0.00136, 0.00126, 0.0, 0.0, 0.00010)),
    Body("link5", 1.3, (0.0, 0.0018, 0.01634), (0.00136, 0.00128, 0.00097, 0.0, 0.0, -0.00005)),
    Body("link6", 0.365, (0.0, 0.0, -0.001159), (0.00019, 0.00019, 0.00026, 0.0, 0.0, 0.0)),
    Body("tool", 1.0, (0.0, 0.0, -0.09), (0.0018, 0.0018, 0.0008, 0.0, 0.0, 0.0)),
)
"""The links as Universal Robots publishes them (frames of UR5E_DH), and a usual gripper of 1 kg."""
UR_TOOL_M = 0.15
"""From the flange to between the fingers of a usual gripper (Robotiq 2F-85, Hand-E: 0.13 to 0.17)."""


@cache
def ur5e_model() -> ArmModel:
    """Universal Robots UR5e. The maker states positions and speeds; acceleration and jerk are chosen here: gentle."""
    return ArmModel(
        name="ur5e",
        robot=_ur5e_robot(),
        tool="tool",
        ready_rad=np.array([0.0, -1.9, 2.1, -1.77, -1.57, 0.0]),
        lower_rad=np.array([-6.283, -6.283, -3.1416, -6.283, -6.283, -6.283]),
        upper_rad=np.array([6.283, 6.283, 3.1416, 6.283, 6.283, 6.283]),
        velocity=np.full(6, np.pi),
        acceleration=np.full(6, 14.0),
        jerk=np.full(6, 500.0),
        torque_nm=np.array([150.0, 150.0, 150.0, 28.0, 28.0, 28.0]),
        torque_rate_nm_s=np.full(6, np.inf),
        capsules=(
            Capsule("base", (0.0, 0.0, 0.05), (0.0, 0.0, 0.1), 0.08),
            Capsule("link1", (0.0, 0.0, 0.0), (0.0, 0.0, 0.13), 0.07),
            Capsule("link2", (0.425, 0.0, 0.137), (0.0, 0.0, 0.137), 0.06),
            Capsule("link3", (0.3922, 0.0, 0.007), (0.0, 0.0, 0.007), 0.055),
            Capsule("link4", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.05),
            Capsule("link5", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.05),
            Capsule("link6", (0.0, 0.0, 0.0), (0.0, 0.0, UR_TOOL_M - 0.04), 0.06),
        ),
        source="Universal Robots' data sheet and its page of DH parameters; acceleration and jerk chosen here",
        bodies=UR5E_BODIES,
        flange="link6",
    )


def _ur5e_robot() -> Robot:
    """base -> link1 .. link6 -> tool; each joint turns about z, then its DH shift to the next frame follows."""
    joints = []
    fixed = Transform("base", "link1_at", np.eye(3), np.zeros(3))
    parent = "base"
    for k, (d, a, alpha) in enumerate(UR5E_DH, 1):
        turning = f"turn{k}"
        origin = Transform(parent, turning, fixed.rotation, fixed.translation_m)
        axis = np.array([0.0, 0.0, 1.0])
        limit = np.pi if k == 3 else 2 * np.pi
        joints.append(Joint(f"joint{k}", "revolute", parent, turning, origin, axis, -limit, limit, np.pi))
        shift = Transform(turning, f"link{k}", rotation_exp(np.array([alpha, 0.0, 0.0])), np.array([a, 0.0, d]))
        joints.append(Joint(f"shift{k}", "fixed", turning, f"link{k}", shift, axis, 0.0, 0.0, 0.0))
        parent, fixed = f"link{k}", Transform.identity("a", "a")
    tool = Transform("link6", "tool", np.eye(3), np.array([0.0, 0.0, UR_TOOL_M]))
    joints.append(Joint("flange", "fixed", "link6", "tool", tool, np.array([0.0, 0.0, 1.0]), 0.0, 0.0, 0.0))
    return Robot("base", tuple(joints), ())
