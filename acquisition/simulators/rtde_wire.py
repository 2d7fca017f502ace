"""What goes over the wire between ur-rtde and a UR e-series controller: RTDE, protocol 2 (big-endian).

Facts from Universal Robots' RTDE guide and from what ur-rtde asks for.
"""

from __future__ import annotations

import struct
from enum import IntEnum

RTDE_PORT = 30004
SCRIPT_PORT = 30003
DASHBOARD_PORT = 29999
JOINTS = 6


class Package(IntEnum):
    PROTOCOL_VERSION = ord("V")
    CONTROLLER_VERSION = ord("v")
    SETUP_OUTPUTS = ord("O")
    SETUP_INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")
    DATA = ord("U")


class Command(IntEnum):
    """What ur-rtde's control script is told through its first integer register."""

    NONE = 0
    MOVE_J = 1
    SERVO_J = 11
    SERVO_STOP = 16
    SET_PAYLOAD = 17
    STOP_J = 34
    STOP_SCRIPT = 255


READY, DONE = 1, 2
"""What the control script answers through its first output register."""


class SafetyMode(IntEnum):
    NORMAL = 1
    PROTECTIVE_STOP = 3
    ROBOT_EMERGENCY_STOP = 7


SAFETY_BITS = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}
POWER_ON_BIT, PROGRAM_BIT = 1 << 0, 1 << 1
ROBOT_RUNNING = 7
STOPPED, PLAYING = 1, 2

_VECTORS = frozenset(
    [
        "target_q",
        "target_qd",
        "target_qdd",
        "target_current",
        "target_moment",
        "actual_q",
        "actual_qd",
        "actual_current",
        "joint_control_output",
        "actual_TCP_pose",
        "actual_TCP_speed",
        "actual_TCP_force",
        "target_TCP_pose",
        "target_TCP_speed",
        "joint_temperatures",
        "actual_joint_voltage",
        "ft_raw_wrench",
        "actual_current_as_torque",
        "external_force_torque",
        "payload_inertia",
    ]
)
_TRIPLES = frozenset(["actual_tool_accelerometer", "payload_cog", "elbow_position"])
_UNSIGNED = frozenset(["runtime_state", "robot_status_bits", "safety_status_bits"])
_FORMS = {
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR3D": "3d",
    "UINT64": "Q",
    "UINT32": "I",
    "INT32": "i",
    "DOUBLE": "d",
}


def type_of(name: str) -> str:
    """RTDE's type of a variable; DOUBLE where nothing else is known."""
    if name in _VECTORS:
        return "VECTOR6D"
    if name in _TRIPLES:
        return "VECTOR3D"
    if name == "joint_mode":
        return "VECTOR6INT32"
    if name.endswith("digital_input_bits") or name.endswith("digital_output_bits"):
        return "UINT64"
    if name in _UNSIGNED or "bit_registers" in name:
        return "UINT32"
    if name in ("robot_mode", "safety_mode") or "int_register" in name:
        return "INT32"
    return "DOUBLE"


def layout(names: list[str]) -> tuple[struct.Struct, list[int]]:
    """The packed form of these variables, and how many numbers each takes."""
    forms = [_FORMS[type_of(name)] for name in names]
    counts = [int(form[:-1] or 1) for form in forms]
    return struct.Struct(">" + "".join(forms)), counts


def package(kind: int, payload: bytes) -> bytes:
    return struct.pack(">HB", 3 + len(payload), kind) + payload
