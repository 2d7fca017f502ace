"""The simulated devices themselves: what they supervise, how faults are planned, that nobody outside reaches them."""

from __future__ import annotations

import os
import socket
import struct
import time

import numpy as np
import pytest

from acquisition.simulators import fci_wire, rtde_wire
from acquisition.simulators.child_process import ChildProcess, SimulatorFailed
from acquisition.simulators.faults import Faults
from acquisition.simulators.fci import FciServer
from acquisition.simulators.fci_body import TICK_S, FciBody
from acquisition.simulators.gige import FakeGvCamera
from acquisition.simulators.rtde import UrServer
from acquisition.simulators.rtde_body import UrBody
from acquisition.simulators.sockets import Pacer, receive
from recordings.errors import BadInput


def test_nothing_listens_where_others_could_reach_it() -> None:
    for make in (FciServer, UrServer, lambda host: FakeGvCamera(host, "X")):
        with pytest.raises(BadInput, match="loopback only"):
            make("0.0.0.0")


def test_a_fault_begins_when_planned_lasts_as_long_as_said_and_is_forgotten_when_taken() -> None:
    faults = Faults({"stop": "", "once": ""})
    faults.inject("stop", at_s=0.05, for_s=0.05, by=2.0)
    assert faults.active("stop") is None
    time.sleep(0.06)
    active = faults.active("stop")
    assert active is not None
    assert active.number("by", 0.0) == 2.0
    time.sleep(0.06)
    assert faults.active("stop") is None
    faults.inject("once")
    assert faults.take("once") is not None
    assert faults.take("once") is None
    faults.inject("stop")
    faults.clear("stop")
    assert faults.active("stop") is None
    with pytest.raises(BadInput, match="knows once, stop"):
        faults.inject("flood")


def test_the_wire_layouts_have_the_sizes_that_libfranka_packs() -> None:
    assert fci_wire.ROBOT_STATE.itemsize == 2373
    assert fci_wire.ROBOT_COMMAND.itemsize == 370


def ramp(acceleration: float, ticks: int, jerk: float = 3000.0) -> list[np.ndarray]:
    """Positions of joint 1 that speed up to this acceleration, from rest, as fast as the jerk allows."""
    q, dq, ddq, positions = 0.0, 0.0, 0.0, []
    for _ in range(ticks):
        ddq = min(acceleration, ddq + jerk * TICK_S)
        dq += ddq * TICK_S
        q += dq * TICK_S
        positions.append(FciBody().q_d + np.array([q, 0, 0, 0, 0, 0, 0]))
    return positions


@pytest.mark.parametrize(
    ("path", "error"),
    [
        (ramp(14.0, 100), None),
        (ramp(16.0, 100), "joint_motion_generator_velocity_discontinuity"),
        (ramp(14.0, 100, jerk=8000.0), "joint_motion_generator_acceleration_discontinuity"),
        (ramp(14.0, 400), "joint_motion_generator_velocity_limits_violation"),
        ([FciBody().q_d * np.nan], "joint_motion_generator_position_limits_violation"),
    ],
)
def test_the_panda_supervises_its_limits(path: list[np.ndarray], error: str | None) -> None:
    body = FciBody()
    found = next((e for e in (body.follow(q) for q in path) if e is not None), None)
    assert found == error


def test_the_panda_measures_what_it_desires_a_little_later_and_comes_to_rest() -> None:
    body = FciBody()
    for q in ramp(10.0, 100):
        body.follow(q)
    assert body.q_d[0] > body.q[0] > 0
    speed = body.dq_d[0]
    for _ in range(300):
        body.brake()
    assert body.resting
    assert body.q[0] == pytest.approx(body.q_d[0], abs=1e-4)
    assert speed == pytest.approx(0.98, abs=0.05)


def test_the_ur5e_stops_for_protection_when_its_target_jumps() -> None:
    body = UrBody()
    body.load_script()
    registers = {"input_int_register_0": 11.0, "input_double_register_9": 0.03, "input_double_register_0": 0.02}
    registers |= {f"input_double_register_{i}": float(body.q_target[i]) for i in range(1, 6)}
    for _ in range(100):
        body.step(registers)
    assert body.safety == rtde_wire.SafetyMode.NORMAL
    assert body.q[0] == pytest.approx(0.02, abs=1e-4)
    body.step(registers | {"input_double_register_0": 1.0})
    assert body.safety == rtde_wire.SafetyMode.PROTECTIVE_STOP
    assert not body.script_running
    assert np.abs(body.dq_target).max() == 0


def test_a_late_caller_stretches_time_and_never_bursts() -> None:
    pacer = Pacer(0.005)
    assert pacer.wait() == pytest.approx(0.0, abs=2e-3)
    time.sleep(0.03)
    stretched = pacer.wait()
    assert stretched > 0.02
    began = time.monotonic()
    for _ in range(4):
        pacer.wait()
    assert time.monotonic() - began > 4 * 0.0025


def test_a_simulator_apart_obeys_and_refuses_by_words() -> None:
    host = f"127.{20 + os.getpid() % 200}.251.1"
    with ChildProcess("rtde", host=host, serial="77") as robot:
        with pytest.raises(SimulatorFailed, match="no fault 'flood' here"):
            robot.inject("flood")
        with pytest.raises(SimulatorFailed, match="in use"):
            ChildProcess("rtde", host=host)
        with socket.create_connection((host, rtde_wire.DASHBOARD_PORT), timeout=2.0) as dashboard:
            lines = dashboard.makefile("rw")
            assert "Dashboard" in lines.readline()
            lines.write("get serial number\n")
            lines.flush()
            assert lines.readline() == "77\n"
        assert robot.snapshot()["safety"] == "NORMAL"


def test_a_motion_is_refused_while_the_panda_stands_in_reflex() -> None:
    host = f"127.{20 + os.getpid() % 200}.251.2"
    with (
        FciServer(host) as arm,
        socket.create_connection((host, fci_wire.ROBOT_PORT), 2.0, ("127.0.0.1", 0)) as control,
    ):
        states = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        states.bind(("127.0.0.1", 0))  # where connections within this machine come from
        states.settimeout(2.0)
        control.settimeout(2.0)
        control.sendall(struct.pack("<IIIHH", 0, 1, 16, 5, states.getsockname()[1]))
        assert struct.unpack("<IIIBH", receive(control, 15))[3] == 0
        first = np.frombuffer(states.recv(4096), fci_wire.ROBOT_STATE)[0]
        assert first["robot_mode"] == fci_wire.RobotMode.IDLE
        arm.inject("reflex", error="power_limit_violation")
        while True:
            state = np.frombuffer(states.recv(4096), fci_wire.ROBOT_STATE)[0]
            if state["robot_mode"] == fci_wire.RobotMode.REFLEX:
                break
        assert state["reflex_reason"].nonzero()[0].tolist() == [fci_wire.ERRORS["power_limit_violation"]]
        control.sendall(struct.pack("<III", 1, 2, 12 + 8 + 48) + struct.pack("<II", 0, 0) + bytes(48))
        assert receive(control, 13)[-1] == fci_wire.Answer.NOT_POSSIBLE
        states.close()
        with pytest.raises(BadInput, match="no error 'boredom' here"):
            arm.inject("reflex", error="boredom")
