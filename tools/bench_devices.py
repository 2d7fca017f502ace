"""The drivers' figures against protocol-level devices on this machine: deadlines kept, frames lost, CPU.

    python tools/bench_devices.py                    # about a minute
    python tools/bench_devices.py --only panda --tosses 50

Counts are the vendor client's own. On a machine that others use too, missed deadlines are theirs as well.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from acquisition.devices import Arm, DeviceLost, JointTrajectory, MonoCamera, RgbdCapture
from acquisition.simulators.child_process import ChildProcess

SWING_S = 1.2
SWING_RAD = {7: [0.3, 0.5, 0.0, 0.7, 0.0, 0.4, 0.0], 6: [0.3, 0.4, 0.0, 0.6, 0.0, 0.3]}
CAMERAS, GRAB_S, FPS = 3, 5.0, 30.0
HOST = "127.88.0."


def cpu_s() -> float:
    """CPU of this process and of its children that have ended."""
    own, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def swing(q_rad: np.ndarray, sign: int) -> JointTrajectory:
    time_s = np.linspace(0, SWING_S, 121)
    u, way = time_s / SWING_S, sign * np.array(SWING_RAD[len(q_rad)])
    rise, slope = u**3 * (10 - 15 * u + 6 * u**2), 30 * u**2 * (1 - u) ** 2 / SWING_S
    return JointTrajectory(time_s, q_rad + rise[:, None] * way, slope[:, None] * way)


def tosses(arm: Arm, count: int) -> tuple[list[int], int, int]:
    """Missed deadlines of each, control cycles in all, states lost in all."""
    arm.start()
    missed, ticks = [], 0
    for number in range(count):
        states = arm.read(2.0)
        assert states is not None
        arm.move(swing(states.q_desired_rad[-1], 1 if number % 2 == 0 else -1))
        while arm.motion().status == "moving":
            time.sleep(0.02)
        motion = arm.motion()
        if motion.status != "done":
            raise SystemExit(f"toss {number} ended: {motion.reason}")
        missed.append(motion.missed)
        ticks += motion.ticks
        time.sleep(0.1)
    return missed, ticks, sum(arm.health().dropped.values())


def panda(count: int) -> None:
    from acquisition.drivers.franka import FrankaArm

    began = cpu_s()
    with ChildProcess("fci", host=f"{HOST}1") as simulator:
        with FrankaArm(host=f"{HOST}1", realtime="ignore") as arm:
            missed, ticks, lost = tosses(arm, count)
        server = simulator.snapshot()
    clean = sum(m == 0 for m in missed)
    print(
        f"panda: {count} tosses of {SWING_S:g} s at 1 kHz: {clean} without a missed deadline, {sum(missed)} of {ticks} "
        f"cycles missed, {lost} of {server['states']} states lost; the simulator stretched time by "
        f"{server['stretched_s']:.2f} s; {cpu_s() - began:.1f} CPU-s with simulator"
    )


def hand(count: int) -> None:
    from acquisition.drivers.franka_hand import FrankaHand

    late_ms = []
    with ChildProcess("fci", host=f"{HOST}2"), FrankaHand(host=f"{HOST}2") as gripper:
        gripper.start()
        time.sleep(1.0)  # it learns when states come
        for number in range(count):
            asked_ns = time.monotonic_ns()
            gripper.release(0.08 if number % 2 else 0.05, 0.4)
            time.sleep(0.3 + 0.013 * number)
            command = gripper.command()
            assert command is not None
            late_ms.append((command.sent_host_ns - asked_ns) * 1e-6)
    print(
        f"hand: {count} commands left {np.median(late_ms):.2f} ms (median), {max(late_ms):.2f} ms (most) after the call"
    )


def ur(count: int) -> None:
    from acquisition.drivers.ur import UrArm

    began = cpu_s()
    with ChildProcess("rtde", host=f"{HOST}3"), UrArm(host=f"{HOST}3") as arm:
        missed, ticks, lost = tosses(arm, count)
    print(
        f"ur: {count} trajectories of {SWING_S:g} s at 500 Hz: {sum(missed)} of {ticks + sum(missed)} cycles late, "
        f"{lost} states lost; {cpu_s() - began:.1f} CPU-s with simulator"
    )


def mono(count: int) -> None:
    from acquisition.drivers.genicam import GenicamCamera, GenicamSettings
    from acquisition.simulators.gige import FakeGvCamera
    from acquisition.simulators.network import own_network

    settings = GenicamSettings(width=1440, height=1080, rate_hz=FPS, packet_bytes=8000, chunks=False)
    addresses = [f"127.0.0.{i + 1}" for i in range(CAMERAS)]
    with own_network(addresses), ExitStack() as stack:
        for number, address in enumerate(addresses):
            stack.enter_context(FakeGvCamera(address, f"GV{number}"))
        cameras: list[MonoCamera] = [
            stack.enter_context(GenicamCamera(f"mono{i}", serial=f"GV{i}", settings=settings)) for i in range(CAMERAS)
        ]
        for camera in cameras:
            camera.start()
        began, end = cpu_s(), time.monotonic() + GRAB_S
        frames = 0
        while time.monotonic() < end:
            frames += sum(camera.read(0.005) is not None for camera in cameras)
        used = cpu_s() - began
        lost = sum(sum(camera.health().dropped.values()) for camera in cameras)
    print(
        f"mono: {CAMERAS} GigE cameras 1440x1080 at {FPS:g} Hz for {GRAB_S:g} s: {frames} frames, {lost} lost; "
        f"the driver takes {used / GRAB_S:.2f} CPU-s per second"
    )


def rgbd(count: int) -> None:
    from acquisition.drivers.d455 import D455Camera
    from acquisition.simulators.realsense_db3 import plain_frames, write_db3

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plain.db3"
        write_db3(path, plain_frames(90, size=(848, 480)))
        with D455Camera(file=path) as camera:
            camera.start()
            began = cpu_s()
            captures: list[RgbdCapture] = []
            try:
                while (capture := camera.read(2.0)) is not None:
                    captures.append(capture)
            except DeviceLost:
                pass
            used, dropped = cpu_s() - began, camera.health().dropped
    print(
        f"rgbd: 90 pairs of 848x480 played at 30 Hz: {len(captures)} came, dropped {dict(dropped)}; "
        f"{1e3 * used / max(len(captures), 1):.1f} ms CPU a pair, the playback's decoding included"
    )


PARTS: dict[str, Callable[[int], None]] = {"panda": panda, "hand": hand, "ur": ur, "mono": mono, "rgbd": rgbd}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=list(PARTS), help="one part")
    parser.add_argument("--tosses", type=int, default=10, help="tosses and commands (10)")
    options = parser.parse_args()
    for name, part in PARTS.items():
        if options.only in (None, name):
            part(options.tosses)


if __name__ == "__main__":
    main()
