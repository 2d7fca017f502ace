"""What a motion asks of an arm's motors: inverse dynamics (pinocchio) with hand and object, without friction."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.arm.limits import ArmModel, Held, arm_model


def torques(
    model: ArmModel, q_rad: Float[Array, "n j"], dq_rad_s: Float[Array, "n j"], ddq_rad_s2: Float[Array, "n j"]
) -> Float[Array, "n j"]:
    """Joint torques in Nm, by the recursive Newton-Euler algorithm; the base stands upright."""
    import pinocchio as pin

    dynamics, data = _dynamics(model.name, model.held)
    pad = np.zeros(dynamics.nv - model.joints)
    rows = (tuple(np.append(part, pad) for part in row) for row in zip(q_rad, dq_rad_s, ddq_rad_s2))
    return np.array([pin.rnea(dynamics, data, *row)[: model.joints] for row in rows])


@cache
def _dynamics(name: str, held: Held) -> tuple[Any, Any]:
    model = arm_model(name)
    dynamics = _from_bodies(model, held) if model.bodies else _from_urdf(held)
    return dynamics, dynamics.createData()


def _payload(held: Held) -> Any:
    """A full ball about the object's centre of mass."""
    import pinocchio as pin

    ball = pin.Inertia.FromSphere(held.mass_kg, held.radius_m)
    return pin.Inertia(ball.mass, np.array(held.centre_m), ball.inertia)


def _from_urdf(held: Held) -> Any:
    import pinocchio as pin

    from recordings.robot.arm import PANDA_TOOL, panda_urdf

    dynamics = pin.buildModelFromUrdf(str(panda_urdf()))
    hand = dynamics.frames[dynamics.getFrameId(PANDA_TOOL)]
    dynamics.appendBodyToJoint(hand.parentJoint, _payload(held), hand.placement)
    return dynamics


def _from_bodies(model: ArmModel, held: Held) -> Any:
    """The same chain of joints as `model.robot`, each link with its mass."""
    import pinocchio as pin

    dynamics = pin.Model()
    bodies = {body.link: body for body in model.bodies}
    carried = {model.robot.root: (0, pin.SE3.Identity())}  # link -> the joint that moves it, and its place there
    for joint in model.robot.joints:
        number, place = carried[joint.parent]
        place = place * pin.SE3(joint.origin.rotation, joint.origin.translation_m)
        if joint.kind == "revolute":
            turning = pin.JointModelRevoluteUnaligned(*joint.axis.tolist())
            number, place = dynamics.addJoint(number, turning, place, joint.name), pin.SE3.Identity()
        carried[joint.child] = number, place
        if joint.child in bodies:
            body = bodies[joint.child]
            xx, yy, zz, xy, xz, yz = body.inertia_kgm2
            inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            dynamics.appendBodyToJoint(number, pin.Inertia(body.mass_kg, np.array(body.centre_m), inertia), place)
    dynamics.appendBodyToJoint(carried[model.tool][0], _payload(held), carried[model.tool][1])
    return dynamics
