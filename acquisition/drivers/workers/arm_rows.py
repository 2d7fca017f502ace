"""An arm's states on their way from its process to the driver: one packed row each."""

from __future__ import annotations

import struct

import numpy as np

from acquisition.devices import ArmMode, ArmSamples

BATCH = 10
MODES: dict[int, ArmMode] = {
    0: "error",
    1: "idle",
    2: "moving",
    3: "guiding",
    4: "reflex",
    5: "user_stopped",
    6: "recovering",
}
MODE_NUMBERS = {mode: number for number, mode in MODES.items()}


def row(joints: int) -> struct.Struct:
    """State number, arm time in ns, host time in ns, q, dq, q desired, dq desired, torque, share in time, mode."""
    return struct.Struct(f"<Qqq{5 * joints + 1}dB")


def row_dtype(joints: int) -> np.dtype:
    return np.dtype(
        [
            ("number", "<u8"),
            ("time", "<i8"),
            ("host", "<i8"),
            ("joints", "<f8", (5, joints)),
            ("rate", "<f8"),
            ("mode", "u1"),
        ]
    )


def samples(clock: str, joints: int, data: bytes) -> ArmSamples:
    rows = np.frombuffer(data, dtype=row_dtype(joints))
    q, dq, q_desired, dq_desired, torque = (rows["joints"][:, i] for i in range(5))
    return ArmSamples(
        clock=clock,
        number=rows["number"].astype(np.int64),
        time_ns=rows["time"].astype(np.int64),
        host_ns=rows["host"].astype(np.int64),
        q_rad=q,
        dq_rad_s=dq,
        q_desired_rad=q_desired,
        dq_desired_rad_s=dq_desired,
        torque_nm=torque,
        success_rate=rows["rate"].copy(),
        modes=tuple(MODES.get(int(mode), "error") for mode in rows["mode"]),
    )
