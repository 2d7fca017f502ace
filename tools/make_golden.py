"""Writes the tiny session that every later tosslab must still open: once per format_version, never again.

python tools/make_golden.py tests/recordings/golden/format_1

What it holds is written down in expected.json beside it; tests/recordings/test_golden.py reads both.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from recordings.geometry import CameraModel, Transform, rotation_exp  # noqa: E402
from recordings.mcap.codec import decode_image  # noqa: E402
from recordings.mcap.toss_writer import TossWriter  # noqa: E402
from recordings.records import (  # noqa: E402
    ArmStates,
    DepthImage,
    EncodedImage,
    HealthLine,
    StampedPose,
    TossCommand,
    TossEvent,
)
from recordings.session import Session  # noqa: E402
from recordings.session_writer import SessionWriter, write_truth  # noqa: E402
from recordings.tracks import RigCalibration, TagPlacement  # noqa: E402

WIDTH, HEIGHT, FRAMES, STEP_NS = 32, 24, 2, 33_333_333


def calibration() -> RigCalibration:
    K = np.array([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]])
    cameras = {
        "d455": CameraModel("d455", WIDTH, HEIGHT, K, "brown-conrady", (-0.05, 0.06, 0.001, -0.0005, -0.02)),
        "d455_depth": CameraModel("d455_depth", WIDTH, HEIGHT, K),
        "mono0": CameraModel("mono0", WIDTH, HEIGHT, K, "fisheye", (0.01, 0.002, 0.0, 0.0)),
    }
    d455_from_depth = Transform("d455", "d455_depth", np.eye(3), np.array([0.015, 0.0, 0.0]))
    world_from_d455 = Transform("world", "d455", rotation_exp(np.array([2.5, 0.0, 0.0])), np.array([0.0, -0.5, 0.6]))
    tag = TagPlacement(30, 0.08, Transform("world", "tag_30", np.eye(3), np.zeros(3)))
    return RigCalibration(
        cameras, (world_from_d455, d455_from_depth), (tag,), created_unix_s=1.7e9, residuals={"px": 0.2}
    )


def write(toss: TossWriter) -> None:
    for i in range(FRAMES):
        time_ns = 10**9 + i * STEP_NS
        ramp = np.add.outer(np.arange(HEIGHT), np.arange(WIDTH)) + 40 * i
        bgr = np.stack([ramp, ramp[::-1], ramp[:, ::-1]], -1).astype(np.uint8)
        jpeg = cv2.imencode(".jpg", bgr)[1].tobytes()
        toss.color(EncodedImage("d455", 7 + i, time_ns, time_ns + 9_000_000, "jpeg", WIDTH, HEIGHT, jpeg))
        raw = (600 + 3 * ramp).astype(np.uint16)
        raw[0] = 0
        toss.depth(DepthImage("d455", 7 + i, time_ns + 4_000_000, time_ns + 9_000_000, 0.001, raw))
        grey = ramp.astype(np.uint8).tobytes()
        toss.mono(EncodedImage("mono0", 70 + i, time_ns + 6_000_000, time_ns + 8_000_000, "mono8", WIDTH, HEIGHT, grey))
    times_ns = 10**9 + np.arange(3, dtype=np.int64) * 1_000_000
    angles = np.arange(6.0).reshape(3, 2) / 10
    toss.arm(ArmStates(times_ns, ("joint1", "joint2"), angles, -angles, np.array([0.08, 0.07, 0.06])))
    toss.event(TossEvent(10**9 + STEP_NS, "release", "gripper", "opened", 0.001))
    toss.command(TossCommand(10**9, 10**9 + STEP_NS, np.eye(4), np.array([0.0, 1.5, 1.0]), np.array([3.0, 0.0, 0.0])))
    toss.health(HealthLine(10**9, "warning", "d455", "late frame"))
    matrix = np.eye(4)
    matrix[:3, 3] = 0.1, 0.2, 0.3
    toss.pose("/track/pose", StampedPose(10**9, "world", "object", matrix, "interpolated", np.eye(6) * 1e-6))
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[5:9, 6:12] = True
    toss.mask(0, mask)
    toss.dropped("/mono0/image", 2)


def expected(folder: Path) -> dict[str, object]:
    """What a reader must find, as hashes of decoded bytes and as numbers."""
    with Session.open(folder) as session:
        toss = session.toss(4)
        arm, command = toss.arm_states(), toss.command()
        assert arm is not None
        assert command is not None
        return {
            "jpeg_sha256": [hashlib.sha256(f.data).hexdigest() for f in toss.color()],
            "depth_sha256": [hashlib.sha256(f.raw.astype("<u2").tobytes()).hexdigest() for f in toss.depth()],
            "mono_sha256": [hashlib.sha256(decode_image(f).tobytes()).hexdigest() for f in toss.mono("mono0")],
            "color_times_ns": toss.color().times_ns.tolist(),
            "depth_times_ns": toss.rgbd().depth_times_ns.tolist(),
            "host_times_ns": [f.host_time_ns for f in toss.color()],
            "frame_numbers": [f.index for f in toss.color()],
            "q_rad": arm.q_rad.tolist(),
            "finger_width_m": arm.finger_width_m.tolist(),
            "linear_velocity_world_m_s": command.linear_velocity_world_m_s.tolist(),
            "mask_pixels": int(toss.masks()[0].sum()),
        }


def main() -> int:
    folder = Path(sys.argv[1])
    start = {
        "name": "golden",
        "who": "tools/make_golden.py",
        "created_unix_ns": 17 * 10**17,
        "object": {"name": "cube"},
    }
    with SessionWriter(folder, start, calibration()) as session:
        with session.toss(4, {"verdict": "accept"}) as toss:
            write(toss)
        session.finish()
    truth = [StampedPose(10**9, "world", "object", np.eye(4), "tracked", np.eye(6) * 1e-8)]
    write_truth(folder, {4: truth}, {"source": "made up", "accuracy": {"mm": 0.5}})
    (folder / "expected.json").write_text(json.dumps(expected(folder), indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
