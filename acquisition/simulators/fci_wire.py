"""What goes over the wire between libfranka 0.9 and a Panda: layouts and codes of FCI server version 5.

Facts from libfranka-common (Apache-2.0) at the commit that libfranka 0.9.2 pins: research_interface/robot and gripper.
All numbers are little-endian and packed. TCP carries requests and their answers, UDP the states and the commands.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

ROBOT_PORT = 1337
ROBOT_VERSION = 5
GRIPPER_PORT = 1338
GRIPPER_VERSION = 3
JOINTS = 7


class Request(IntEnum):
    CONNECT = 0
    MOVE = 1
    STOP_MOVE = 2
    SET_COLLISION_BEHAVIOR = 4
    SET_LOAD = 10
    AUTOMATIC_ERROR_RECOVERY = 12
    LOAD_MODEL_LIBRARY = 13


SETTER_NUMBERS = {Request.SET_COLLISION_BEHAVIOR: 52, Request.SET_LOAD: 13}
"""Doubles of a request: eight rows of thresholds (four of joints, four of forces); mass, centre, inertia."""
SETTER_DONE, SETTER_NOT_POSSIBLE = 0, 1


class Answer(IntEnum):
    """Status of a Move."""

    SUCCESS = 0
    MOTION_STARTED = 1
    PREEMPTED = 2
    NOT_POSSIBLE = 3
    REFLEX_ABORTED = 6
    EMERGENCY_ABORTED = 7


class RecoveryAnswer(IntEnum):
    SUCCESS = 0
    NOT_POSSIBLE = 1
    EMERGENCY_ABORTED = 4


class RobotMode(IntEnum):
    OTHER = 0
    IDLE = 1
    MOVE = 2
    GUIDING = 3
    REFLEX = 4
    USER_STOPPED = 5
    RECOVERY = 6


class Generator(IntEnum):
    """Motion generator mode in the state; a Move's request counts from 0 at JOINT_POSITION."""

    IDLE = 0
    JOINT_POSITION = 1
    JOINT_VELOCITY = 2


CONTROLLER_OTHER = 3

ERRORS = {
    "joint_reflex": 6,
    "cartesian_reflex": 7,
    "joint_motion_generator_position_limits_violation": 12,
    "joint_motion_generator_velocity_limits_violation": 13,
    "joint_motion_generator_velocity_discontinuity": 14,
    "joint_motion_generator_acceleration_discontinuity": 15,
    "communication_constraints_violation": 25,
    "power_limit_violation": 26,
}
"""Place of an error in the state's flags."""
ERROR_FLAGS = 41

_POSES = ("O_T_EE", "O_T_EE_d", "F_T_EE", "EE_T_K", "F_T_NE", "NE_T_EE")
_STATE_NUMBERS: tuple[tuple[str, int], ...] = (
    *((name, 16) for name in _POSES),
    *(("m_ee", 1), ("I_ee", 9), ("F_x_Cee", 3), ("m_load", 1), ("I_load", 9), ("F_x_Cload", 3)),
    *(("elbow", 2), ("elbow_d", 2), ("tau_J", 7), ("tau_J_d", 7), ("dtau_J", 7)),
    *(("q", 7), ("q_d", 7), ("dq", 7), ("dq_d", 7), ("ddq_d", 7)),
    *(("joint_contact", 7), ("cartesian_contact", 6), ("joint_collision", 7), ("cartesian_collision", 6)),
    *(("tau_ext_hat_filtered", 7), ("O_F_ext_hat_K", 6), ("K_F_ext_hat_K", 6), ("O_dP_EE_d", 6), ("O_ddP_O", 3)),
    *(("elbow_c", 2), ("delbow_c", 2), ("ddelbow_c", 2), ("O_T_EE_c", 16), ("O_dP_EE_c", 6), ("O_ddP_EE_c", 6)),
    *(("theta", 7), ("dtheta", 7)),
)
IDENTITY_POSES = (*_POSES, "O_T_EE_c")

ROBOT_STATE = np.dtype(
    [
        ("message_id", "<u8"),
        *((name, "<f8", (count,)) for name, count in _STATE_NUMBERS),
        ("motion_generator_mode", "u1"),
        ("controller_mode", "u1"),
        ("errors", "u1", (ERROR_FLAGS,)),
        ("reflex_reason", "u1", (ERROR_FLAGS,)),
        ("robot_mode", "u1"),
        ("control_command_success_rate", "<f8"),
    ]
)
ROBOT_COMMAND = np.dtype(
    [
        ("message_id", "<u8"),
        ("q_c", "<f8", (7,)),
        ("dq_c", "<f8", (7,)),
        ("O_T_EE_c", "<f8", (16,)),
        ("O_dP_EE_c", "<f8", (6,)),
        ("elbow_c", "<f8", (2,)),
        ("valid_elbow", "u1"),
        ("finished", "u1"),
        ("tau_J_d", "<f8", (7,)),
    ]
)

# The Panda's joint limits (FER): rad, rad/s, rad/s^2, rad/s^3
Q_MIN = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
Q_MAX = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
DQ_MAX = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])
DDQ_MAX = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])
DDDQ_MAX = np.array([7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0])


class GripperRequest(IntEnum):
    CONNECT = 0
    HOMING = 1
    GRASP = 2
    MOVE = 3
    STOP = 4


class GripperAnswer(IntEnum):
    SUCCESS = 0
    FAIL = 1
    UNSUCCESSFUL = 2
    ABORTED = 3
