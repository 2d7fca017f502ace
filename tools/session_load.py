"""The simulated load of a lab that bench_session.py writes and reads: pixels like real sensors', written by tosslab and
by a plain mcap loop, and the CPU seconds of work in a process of its own."""

from __future__ import annotations

import multiprocessing
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage  # noqa: E402
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates  # noqa: E402
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage  # noqa: E402
from mcap.writer import Writer as PlainWriter  # noqa: E402

from recordings.geometry import CameraModel  # noqa: E402
from recordings.mcap.codec import schema_descriptor  # noqa: E402
from recordings.mcap.toss_writer import TossWriter  # noqa: E402
from recordings.records import ArmStates, DepthImage, EncodedImage  # noqa: E402
from recordings.session_writer import SessionWriter  # noqa: E402
from recordings.tracks import RigCalibration  # noqa: E402

FPS, MONOS, MONO_SIZE, ARM_HZ = 30, ("mono0", "mono1", "mono2"), (1440, 1080), 1000
POOL = 12
JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95]
JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))


@dataclass(frozen=True)
class Pixels:
    """A few distinct frames of every camera, with the texture and noise of real sensors."""

    color: list[np.ndarray]
    depth: list[np.ndarray]
    mono: list[np.ndarray]

    @staticmethod
    def of(width: int, height: int) -> Pixels:
        rng = np.random.default_rng(0)
        frames = Pixels([], [], [])
        for _ in range(POOL):
            frames.color.append(textured(rng, width, height, 3))
            frames.mono.append(textured(rng, *MONO_SIZE, 1))
            distance_m = np.linspace(1.4, 0.6, height)[:, None] + np.zeros((1, width))
            depth = np.rint(1000 * (distance_m + rng.normal(0, 0.0015, (height, width)) * distance_m**2))
            depth[cv2.resize(rng.random((12, 16)), (width, height)) > 0.75] = 0
            frames.depth.append(depth.astype(np.uint16))
        return frames


def textured(rng: np.random.Generator, width: int, height: int, channels: int) -> np.ndarray:
    coarse = rng.integers(40, 200, (height // 40, width // 40, channels), dtype=np.uint8)
    image = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC).reshape(height, width, channels)
    noisy = image + rng.normal(0, 2.5, image.shape)
    return np.ascontiguousarray(noisy.clip(0, 255).astype(np.uint8).squeeze())


def raw_mb_per_s(width: int, height: int) -> float:
    return (FPS * (width * height * 5 + len(MONOS) * MONO_SIZE[0] * MONO_SIZE[1]) + ARM_HZ * 400) / 1e6


def arm_batch(frame: int) -> ArmStates:
    """What the arm said during one frame: 33 or 34 samples."""
    first, last = frame * ARM_HZ // FPS, (frame + 1) * ARM_HZ // FPS
    rng = np.random.default_rng(frame)
    n = last - first
    times_ns = np.arange(first, last, dtype=np.int64) * (10**9 // ARM_HZ)
    return ArmStates(times_ns, JOINTS, rng.normal(size=(n, 7)), rng.normal(size=(n, 7)), np.full(n, 0.04))


def write_frame(toss: TossWriter, pixels: Pixels, i: int, lossless: bool) -> None:
    """One frame of the whole lab, encoded and written."""
    time_ns, k = i * 10**9 // FPS, i % POOL
    height, width = pixels.depth[0].shape
    jpeg = cv2.imencode(".jpg", pixels.color[k], JPEG)[1].tobytes()
    toss.color(EncodedImage("d455", i, time_ns, time_ns, "jpeg", width, height, jpeg))
    toss.depth(DepthImage("d455", i, time_ns, time_ns, 0.001, pixels.depth[k]))
    for c, name in enumerate(MONOS):
        image = pixels.mono[(k + c) % POOL]
        if lossless:
            toss.mono(EncodedImage(name, i, time_ns, time_ns, "mono8", *MONO_SIZE, image.tobytes()))
        else:
            jpeg = cv2.imencode(".jpg", image, JPEG)[1].tobytes()
            toss.mono(EncodedImage(name, i, time_ns, time_ns, "jpeg", *MONO_SIZE, jpeg))
    toss.arm(arm_batch(i))


def calibration(width: int, height: int) -> RigCalibration:
    def camera(name: str, w: int, h: int) -> CameraModel:
        return CameraModel(name, w, h, np.array([[0.6 * w, 0, w / 2], [0, 0.6 * w, h / 2], [0, 0, 1.0]]))

    return RigCalibration({"d455": camera("d455", width, height), **{n: camera(n, *MONO_SIZE) for n in MONOS}})


def write_ours(folder: Path, pixels: Pixels, seconds: float, lossless: bool) -> None:
    height, width = pixels.depth[0].shape
    with SessionWriter(folder, {"object": {"name": "bench"}}, calibration(width, height)) as session:
        with session.toss(0) as toss:
            paced(seconds, lambda i: write_frame(toss, pixels, i, lossless))
        session.finish()


def write_plain(path: Path, pixels: Pixels, seconds: float) -> None:
    """What one writes without tosslab: JPEG images, depth as 16UC1, mcap.Writer with its own zstd chunks."""
    with open(path, "wb") as out:
        writer = PlainWriter(out)
        writer.start()
        schemas = {
            m: writer.register_schema(m.DESCRIPTOR.full_name, "protobuf", schema_descriptor(m))
            for m in (CompressedImage, RawImage, JointStates)
        }
        kinds = {"/d455/color": CompressedImage, "/d455/depth": RawImage, "/arm/joint_states": JointStates}
        kinds |= {f"/{n}/image": CompressedImage for n in MONOS}
        channels = {topic: writer.register_channel(topic, "protobuf", schemas[m]) for topic, m in kinds.items()}

        def frame(i: int) -> None:
            time_ns, k = i * 10**9 // FPS, i % POOL
            images = {f"/{n}/image": pixels.mono[(k + c) % POOL] for c, n in enumerate(MONOS)}
            images["/d455/color"] = pixels.color[k]
            for topic, image in images.items():
                box = CompressedImage(format="jpeg", data=cv2.imencode(".jpg", image, JPEG)[1].tobytes())
                writer.add_message(channels[topic], time_ns, box.SerializeToString(), time_ns, i)
            height, width = pixels.depth[k].shape
            raw = RawImage(width=width, height=height, encoding="16UC1", step=2 * width, data=pixels.depth[k].tobytes())
            writer.add_message(channels["/d455/depth"], time_ns, raw.SerializeToString(), time_ns, i)
            arm = arm_batch(i)
            for s, sample_ns in enumerate(arm.time_ns.tolist()):
                box = JointStates()
                for j, name in enumerate(JOINTS):
                    box.joints.add(name=name, position=arm.q_rad[s, j], velocity=arm.dq_rad_s[s, j])
                writer.add_message(channels["/arm/joint_states"], sample_ns, box.SerializeToString(), sample_ns, s)

        paced(seconds, frame)
        writer.finish()


def paced(seconds: float, frame: Callable[[int], None]) -> None:
    """Frames at the lab's pace (late ones follow at once), so that chunks close and files sync as they would there."""
    began = time.monotonic()
    for i in range(int(seconds * FPS)):
        time.sleep(max(0.0, began + i / FPS - time.monotonic()))
        frame(i)


def alone(work: Callable[..., None], *args: Any) -> tuple[float, float, float]:
    """CPU seconds, wall seconds and peak RSS in MB of `work` in a process of its own, without the making of frames."""
    receive, send = multiprocessing.get_context("fork").Pipe(False)

    def child() -> None:
        cpu, wall = time.process_time(), time.monotonic()
        work(*args)
        rss = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        send.send((time.process_time() - cpu, time.monotonic() - wall, rss))

    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    measured: tuple[float, float, float] = receive.recv()
    process.join()
    return measured
