"""Small sessions as a lab would write them, whole or spoilt on purpose."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from recordings.geometry import CameraModel, Transform
from recordings.mcap.toss_writer import TossWriter
from recordings.records import ArmStates, DepthImage, EncodedImage, HealthLine, StampedPose, TossCommand, TossEvent
from recordings.session_writer import SessionWriter
from recordings.tracks import RigCalibration

PERIOD_NS = 33_333_333
START_NS = 1_000_000_000


@dataclass(frozen=True)
class SmallRig:
    """A camera over a table, one mono camera and an arm, all small; `write` records one toss of it."""

    width: int = 64
    height: int = 48
    frames: int = 6
    unit_m: float = 0.001
    depth_scale: float = 1.0
    seed: int = 3
    lossless_mono: bool = True

    @property
    def camera(self) -> CameraModel:
        w, h = self.width, self.height
        K = np.array([[w * 0.95, 0, (w - 1) / 2], [0, w * 0.95, (h - 1) / 2], [0, 0, 1]])
        return CameraModel("d455", self.width, self.height, K)

    @property
    def calibration(self) -> RigCalibration:
        down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
        world_from_d455 = Transform("world", "d455", down, np.array([0.0, 0.0, 0.8]))
        mono = CameraModel("mono0", self.width, self.height, self.camera.K)
        cameras = {"d455": self.camera, "mono0": mono}
        return RigCalibration(cameras, (world_from_d455,), created_unix_s=1.7e9)

    def jpeg(self, i: int) -> bytes:
        rng = np.random.default_rng([self.seed, i])
        small = rng.integers(0, 255, (6, 8, 3), dtype=np.uint8)
        image = cv2.resize(small, (self.width, self.height), interpolation=cv2.INTER_LINEAR)
        return cv2.imencode(".jpg", image)[1].tobytes()

    def color(self, i: int, time_ns: int | None = None, index: int | None = None) -> EncodedImage:
        time_ns = START_NS + i * PERIOD_NS if time_ns is None else time_ns
        index = 100 + i if index is None else index
        return EncodedImage("d455", index, time_ns, time_ns + 7_000_000, "jpeg", self.width, self.height, self.jpeg(i))

    def depth(self, i: int, time_ns: int | None = None) -> DepthImage:
        time_ns = START_NS + i * PERIOD_NS + 5_000_000 if time_ns is None else time_ns
        noise = np.random.default_rng([self.seed, i, 1]).normal(0, 0.002, (self.height, self.width))
        raw = np.rint((0.8 + noise) * self.depth_scale / self.unit_m).astype(np.uint16)
        raw[:4] = 0
        return DepthImage("d455", 100 + i, time_ns, time_ns + 7_000_000, self.unit_m, raw)

    def mono(self, i: int) -> EncodedImage:
        time_ns = START_NS + i * PERIOD_NS + 6_100_000
        pixels = np.random.default_rng([self.seed, i, 2]).integers(0, 9, (self.height, self.width), dtype=np.uint8)
        encoding, data = "mono8", pixels.tobytes()
        if not self.lossless_mono:
            encoding, data = "jpeg", cv2.imencode(".jpg", pixels)[1].tobytes()
        return EncodedImage("mono0", 500 + i, time_ns, time_ns + 3_000_000, encoding, self.width, self.height, data)

    def arm(self, i: int, samples: int = 33) -> ArmStates:
        rng = np.random.default_rng([self.seed, i, 3])
        times_ns = START_NS + i * PERIOD_NS + np.arange(samples, dtype=np.int64) * 1_000_000
        names = tuple(f"panda_joint{j}" for j in range(1, 8))
        widths_m = np.full(samples, 0.08)
        return ArmStates(times_ns, names, rng.normal(size=(samples, 7)), rng.normal(size=(samples, 7)), widths_m)

    def write(self, toss: TossWriter) -> None:
        for i in range(self.frames):
            toss.color(self.color(i))
            toss.depth(self.depth(i))
            toss.mono(self.mono(i))
            toss.arm(self.arm(i))
        mask = np.zeros((self.height, self.width), dtype=bool)
        mask[10:20, 12:30] = True
        toss.mask(0, mask)
        toss.event(TossEvent(START_NS + 2 * PERIOD_NS, "release", "gripper", sigma_s=0.001))
        toss.event(TossEvent(START_NS + 5 * PERIOD_NS, "verdict", "recorder", "accept"))
        toss.health(HealthLine(START_NS, "info", "d455", "30 Hz"))
        toss.command(
            TossCommand(START_NS, START_NS + PERIOD_NS, np.eye(4), np.array([0, 1.0, 2]), np.array([3.0, 4, 5]))
        )
        toss.pose("/track/pose", StampedPose(START_NS, "world", "object", np.eye(4), "tracked", np.eye(6) * 1e-6))


@pytest.fixture(scope="session")
def small_rig() -> SmallRig:
    return SmallRig()


WriteSession = Callable[..., Path]


@pytest.fixture
def write_session(tmp_path: Path, small_rig: SmallRig) -> WriteSession:
    """`write_session("name", tosses=2, rig=...)` writes a complete session and gives its folder."""

    def write(name: str = "small", tosses: int = 1, rig: SmallRig = small_rig, **start: Any) -> Path:
        begun = {"object": {"name": "cube"}, "clock": {"source": "test"}, "created_unix_ns": 1_700_086_400 * 10**9}
        with SessionWriter(tmp_path / name, {**begun, **start}, rig.calibration) as session:
            for toss in range(tosses):
                with session.toss(toss, {"verdict": "accept"}) as writer:
                    rig.write(writer)
            session.finish()
        return tmp_path / name

    return write


@pytest.fixture(scope="session", params=["zstd chunks", "plain chunks"])
def small_file(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One toss of a very small rig, for tests that spoil it many times. Raw images make zstd chunks."""
    rig = SmallRig(width=32, height=24, frames=3, lossless_mono=request.param == "zstd chunks")
    folder = tmp_path_factory.mktemp("small") / "session"
    with SessionWriter(folder, {"object": {"name": "cube"}}, rig.calibration) as session:
        with session.toss(0) as writer:
            rig.write(writer)
        session.finish()
    return folder / "toss_00.mcap"


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Callable[[int], None]]:
    """`full_disk(n)`: no file of this process may grow beyond n bytes (RLIMIT_FSIZE), as when the disk is full."""
    import resource
    import signal

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    yield lambda n: resource.setrlimit(resource.RLIMIT_FSIZE, (n, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, ignored)
