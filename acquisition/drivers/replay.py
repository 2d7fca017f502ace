"""A recorded session played back as devices, at its own pace.

    setup = replay_setup(Path("sessions/first"))            # what `--rig replay:SESSION` opens
    player = Player(Session.open(path))                     # or device by device
    player.play(0)
    with player.camera("d455") as camera: frame = camera.read(0.1)

Frames carry the session's own times as stamps of a clock named "session" and are received when they were, counted
from the moment of `play`. Between two tosses the clock goes on by the time that passed since, and frame numbers go on
by one: what was not recorded between them is no loss.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Int64
from numpy import ndarray as Array

from acquisition.arm.toss import TossPlan
from acquisition.devices import (
    ArmMode,
    ArmSamples,
    Device,
    DeviceRefused,
    GripperCommand,
    GripperSample,
    Health,
    Image,
    JointTrajectory,
    Motion,
    RgbdCapture,
    Stamp,
)
from acquisition.drivers.lifecycle import OpenedByContext
from acquisition.ready_rig import Setup
from acquisition.rig import DeviceEntry, RecordingConfig, Rig
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform
from recordings.mcap.codec import decode_image
from recordings.progress import Progress
from recordings.records import ArmStates, DepthImage, EncodedImage
from recordings.session import Session, Toss
from recordings.sync import frame_period_ns

LEAD_S = 0.4
"""Playing begins this long after `play`, so that a take is open by then."""
AFTER_S = 0.3
BATCH_NS = 10_000_000
WIDTH_EVERY = 20
CLOCK = "session"
IDLE: ArmMode = "idle"


@dataclass(frozen=True)
class _Cue:
    """Something to be delivered, `at_ns` after the toss's first message."""

    at_ns: int
    load: Callable[[int], Any]
    """Given the host time of delivery."""


@dataclass
class _Track:
    """What one device has to deliver of the toss that is played."""

    cues: list[_Cue] = field(default_factory=list)
    position: int = 0


class Player:
    """Plays one toss after another to all devices of a session."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self._lock = threading.Lock()
        self._tracks: dict[str, _Track] = {}
        self._starts_ns = 0
        self._ends_ns = 0
        self._next_number: dict[str, int] = {}
        self._clock: tuple[int, int] | None = None
        """When the first toss was begun (host), and what its session clock said then."""
        self._played_ns = 0
        """On that clock since then: of a toss that was ended early, more than passed."""
        self.later_ns = 0
        """Added to the times of the toss that is played."""
        first = session.toss(session.tosses[0])
        self.cameras = first.cameras()
        arm = first.arm_states()
        self.has_arm = arm is not None
        self.has_widths = arm is not None and bool(np.isfinite(arm.finger_width_m).any())
        self.joint_names = arm.joint_names if arm is not None else ()

    def play(self, toss: int) -> None:
        """Begin a toss; the one before is over."""
        opened = self.session.toss(toss)
        tracks = {name: _Track(self._images(opened, name)) for name in self.cameras}
        arm = opened.arm_states()
        if arm is not None:
            tracks["arm"], tracks["gripper"] = self._states(arm)
        first_ns = min((t.cues[0].at_ns for t in tracks.values() if t.cues), default=0)
        last_ns = max((t.cues[-1].at_ns for t in tracks.values() if t.cues), default=0)
        shifted = {n: _Track([replace(c, at_ns=c.at_ns - first_ns) for c in track.cues]) for n, track in tracks.items()}
        with self._lock:
            self._tracks = shifted
            self._starts_ns = time.monotonic_ns() + round(LEAD_S * 1e9)
            self._clock = self._clock or (self._starts_ns, first_ns)
            passed_ns = max(self._starts_ns - self._clock[0], self._played_ns)
            self.later_ns = passed_ns - (first_ns - self._clock[1])
            self._played_ns = passed_ns + last_ns - first_ns + round(LEAD_S * 1e9)
            self._ends_ns = self._starts_ns + last_ns - first_ns

    def lacks(self, device: str) -> bool:
        """Whether the toss that is played holds nothing of a device."""
        with self._lock:
            return bool(self._tracks) and not self._tracks.get(device, _Track()).cues

    def over(self) -> bool:
        """Whether everything of the toss has been delivered, for a moment."""
        with self._lock:
            done = all(t.position >= len(t.cues) for t in self._tracks.values())
            return bool(self._tracks) and done and time.monotonic_ns() > self._ends_ns + AFTER_S * 1e9

    def next(self, device: str, timeout_s: float, stop: threading.Event) -> Any:
        """What a device delivers next; None where nothing is due within the timeout."""
        ends_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        with self._lock:
            track = self._tracks.get(device)
            cue = track.cues[track.position] if track is not None and track.position < len(track.cues) else None
            due_ns = ends_ns if cue is None else self._starts_ns + cue.at_ns
        stop.wait(max(min(due_ns, ends_ns) - time.monotonic_ns(), 0) / 1e9)
        if cue is None or time.monotonic_ns() < due_ns or stop.is_set():
            return None
        with self._lock:
            if track is not self._tracks.get(device) or track is None:
                return None  # another toss has begun meanwhile
            track.position += 1
        return cue.load(time.monotonic_ns())

    def camera(self, name: str, kind: str = "rgbd") -> ReplayRgbd | ReplayMono:
        if name not in self.cameras:
            raise BadInput(f"the session has no camera '{name}'; it has {', '.join(self.cameras)}")
        return ReplayRgbd(self, name) if kind == "rgbd" else ReplayMono(self, name)

    def _images(self, toss: Toss, name: str) -> list[_Cue]:
        base = self._next_number.get(name, 0)
        rgbd = f"/{name}/color" in toss.file.channels
        topic = f"/{name}/color" if rgbd else f"/{name}/image"
        if topic not in toss.file.channels:
            return []  # another toss has it
        frames = toss.color(name) if rgbd else toss.mono(name)
        log_ns = toss.file.topic_index(topic).log_time_ns
        depth_topic = f"/{name}/depth"
        depths = {int(t): k for k, t in enumerate(toss.file.topic_index(depth_topic).log_time_ns)} if rgbd else {}
        first = frames[0].index if len(frames) else 0
        shift = base - first if name in self._next_number else 0
        cues = []
        for k, at_ns in enumerate(log_ns.tolist()):
            partner = depths.pop(at_ns, None)
            cues.append(_Cue(at_ns, partial(self._capture, toss, name, k, partner, shift)))
        for at_ns, k in depths.items():
            cues.append(_Cue(at_ns, partial(self._capture, toss, name, None, k, shift)))
        if len(frames):
            self._next_number[name] = frames[len(frames) - 1].index + shift + 1
        return sorted(cues, key=lambda c: c.at_ns)

    def _capture(self, toss: Toss, name: str, color: int | None, depth: int | None, shift: int, now: int) -> Any:
        if f"/{name}/color" not in toss.file.channels:
            assert color is not None
            return _image("image", toss.mono(name)[color], shift, self.later_ns, now)
        picture = None if color is None else _image("color", toss.color(name)[color], shift, self.later_ns, now)
        if depth is None:
            return RgbdCapture(picture, None, 0.001, self.aligned(name))
        raw = toss.depth(name)[depth]
        return RgbdCapture(picture, _depth(raw, shift, self.later_ns, now), raw.unit_m, self.aligned(name))

    def aligned(self, name: str) -> bool:
        return f"{name}_depth" not in self.session.calibration.cameras

    def _states(self, arm: ArmStates) -> tuple[_Track, _Track]:
        """Batches of 10 ms, and widths at a fiftieth of the rate."""
        base = self._next_number.get("arm", 0)
        times = arm.time_ns
        cuts = np.flatnonzero(np.diff((times - times[0]) // BATCH_NS)) + 1
        batches = np.split(np.arange(len(times)), cuts)
        states, widths = [], []
        for rows in batches:
            states.append(_Cue(int(times[rows[-1]]), partial(self._samples, arm, rows, base)))
        for k in np.flatnonzero(np.isfinite(arm.finger_width_m))[::WIDTH_EVERY].tolist():
            widths.append(_Cue(int(times[k]), partial(self._width, arm, k, base)))
        self._next_number["arm"] = base + len(times)
        return _Track(states), _Track(widths)

    def _samples(self, arm: ArmStates, rows: Int64[Array, " n"], base: int, now: int) -> ArmSamples:
        return _samples(arm, rows, base, self.later_ns, now)

    def _width(self, arm: ArmStates, k: int, base: int, now: int) -> GripperSample:
        time_ns = int(arm.time_ns[k]) + self.later_ns
        return GripperSample(base + k, CLOCK, time_ns, now, float(arm.finger_width_m[k]), 0.08, False)


def _image(stream: str, frame: EncodedImage, shift: int, later_ns: int, now: int) -> Image:
    return Image(stream, frame.index + shift, Stamp(CLOCK, frame.time_ns + later_ns), now, decode_image(frame))


def _depth(frame: DepthImage, shift: int, later_ns: int, now: int) -> Image:
    return Image("depth", frame.index + shift, Stamp(CLOCK, frame.time_ns + later_ns), now, frame.raw)


def _samples(arm: ArmStates, rows: Int64[Array, " n"], base: int, later_ns: int, now: int) -> ArmSamples:
    q, dq = arm.q_rad[rows], arm.dq_rad_s[rows]
    received = now - (arm.time_ns[rows[-1]] - arm.time_ns[rows])
    none = np.full_like(q, np.nan)
    numbers, ones = base + rows.astype(np.int64), np.ones(len(rows))
    modes: tuple[ArmMode, ...] = tuple(IDLE for _ in rows)
    return ArmSamples(CLOCK, numbers, arm.time_ns[rows] + later_ns, received, q, dq, none, none, none, ones, modes)


class _Replayed(OpenedByContext):
    """Life of a replayed device."""

    kind = "replay"

    def __init__(self, player: Player, name: str) -> None:
        self.name = name
        self._player = player
        self._stop = threading.Event()
        self._running = False
        self._received = 0

    def open(self) -> None:
        pass

    def start(self) -> None:
        self._stop.clear()
        self._running, self._received = True, 0

    def stop(self) -> None:
        self._running = False
        self._stop.set()

    def close(self) -> None:
        self.stop()

    def health(self) -> Health:
        return Health(received={self.name: self._received}, absent=self._player.lacks(self.name))

    def describe(self) -> dict[str, Any]:
        recorded_rig = self._player.session.start.get("rig", {})
        before = recorded_rig.get("devices", {}).get(self.name, {}) if isinstance(recorded_rig, Mapping) else {}
        return {
            "kind": "replay",
            "model": f"recorded {before.get('model', self.name)}",
            "serial": str(before.get("serial", "")),
            "firmware": str(before.get("firmware", "")),
            "driver": "replay",
            "settings": {"session": self._player.session.name, "pace": "real_time"},
            "warnings": [],
        }

    def _next(self, timeout_s: float) -> Any:
        if not self._running:
            self._stop.wait(min(timeout_s, 0.02))
            return None
        found = self._player.next(self.name, timeout_s, self._stop)
        self._received += found is not None
        return found


class ReplayRgbd(_Replayed):
    def read(self, timeout_s: float) -> RgbdCapture | None:
        found: RgbdCapture | None = self._next(timeout_s)
        return found

    def set_emitter(self, on: bool) -> None:
        pass  # what was recorded was recorded

    def cameras(self) -> Mapping[str, CameraModel]:
        cameras = self._player.session.calibration.cameras
        color = cameras.get(self.name)
        return {} if color is None else {"color": color, "depth": cameras.get(f"{self.name}_depth", color)}

    def color_from_depth(self) -> Transform:
        if self._player.aligned(self.name):
            return Transform.identity(self.name, self.name)
        return self._player.session.calibration.transform(self.name, f"{self.name}_depth")


class ReplayMono(_Replayed):
    def read(self, timeout_s: float) -> Image | None:
        found: Image | None = self._next(timeout_s)
        return found

    def trigger(self) -> None:
        raise DeviceRefused(f"{self.name} is a recording: it cannot be triggered")


class ReplayArm(_Replayed):
    rate_hz = 1000.0

    @property
    def joint_names(self) -> tuple[str, ...]:
        return self._player.joint_names

    def read(self, timeout_s: float) -> ArmSamples | None:
        found: ArmSamples | None = self._next(timeout_s)
        return found

    def move(self, trajectory: JointTrajectory) -> None:
        raise DeviceRefused(f"{self.name} is a recording: it does not move")

    def may_move(self) -> None:
        raise DeviceRefused(f"{self.name} is a recording: it does not move")

    def motion(self) -> Motion:
        return Motion("none")

    def halt(self) -> None:
        pass

    def recover(self) -> None:
        pass


class ReplayGripper(_Replayed):
    def read(self, timeout_s: float) -> GripperSample | None:
        found: GripperSample | None = self._next(timeout_s)
        return found

    def grasp(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        raise DeviceRefused(f"{self.name} is a recording: it does not move")

    def release(self, width_m: float, speed_m_s: float) -> None:
        raise DeviceRefused(f"{self.name} is a recording: it does not move")

    def command(self) -> GripperCommand | None:
        return None


class ReplayThrower:
    """The tosses of a recorded session, in their order."""

    def __init__(self, player: Player) -> None:
        self._player = player

    def prepare(self, toss: int, attempt: int, progress: Progress) -> TossPlan | None:
        tosses = self._player.session.tosses
        if toss >= len(tosses):
            raise BadInput(f"the session has {len(tosses)} tosses; toss number {toss} cannot be played")
        self._player.play(tosses[toss])
        return None

    def over(self) -> bool:
        return self._player.over()

    def learn(self, delay_s: float) -> None:
        pass

    def get_ready(self) -> dict[str, Any]:
        return {}


def replay_setup(path: Path) -> Setup:
    """A rig whose devices play a session."""
    session = Session.open(path)
    if not session.tosses:
        raise BadInput(f"{path} has no tosses to play")
    player = Player(session)
    toss = session.toss(session.tosses[0])
    entries: list[DeviceEntry] = []
    devices: dict[str, Device] = {}
    for name in player.cameras:
        rgbd = f"/{name}/color" in toss.file.channels
        frames = toss.color(name) if rgbd else toss.mono(name)
        rate_hz = 1e9 / (frame_period_ns(frames.times_ns) or 33_333_333)
        kind: Literal["rgbd", "mono"] = "rgbd" if rgbd else "mono"
        entries.append(DeviceEntry(name, kind, "replay", rate_hz=rate_hz))
        devices[name] = player.camera(name, kind)
    if player.has_arm:
        entries.append(DeviceEntry("arm", "arm", "replay", rate_hz=1000.0))
        devices["arm"] = ReplayArm(player, "arm")
    if player.has_widths:
        entries.append(DeviceEntry("gripper", "gripper", "replay", rate_hz=50.0))
        devices["gripper"] = ReplayGripper(player, "gripper")
    arm = session.start.get("rig", {})
    robot: Literal["panda"] | None = "panda" if player.has_arm and "panda" in str(arm) else None
    config = RecordingConfig(countdown_s=0.0, queue_s=5.0, longest_gap_s=60.0)
    rig = Rig(f"replay of {session.name}", tuple(entries), path, robot, recording=config)
    return Setup(rig, devices, ReplayThrower(player), session.calibration, live=False)
