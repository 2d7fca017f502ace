# long because: one recorder, its pumps and what they write are told together
"""Devices to files: a thread per device that only reads, a lane per stream that encodes and writes, takes cut out of
what flows by.

    recorder = Recorder(rig, devices, SessionClock(...))
    with recorder:                                   # devices opened, frames flow, clocks are followed
        recorder.begin(writer, host_ns)              # what came since then (the ring) and from now on
        recorder.end(host_ns)
        while not recorder.ended(): ...              # the lanes work off what belongs to the take
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt16
from numpy import ndarray as Array

from acquisition.devices import (
    Arm,
    ArmMode,
    ArmSamples,
    Device,
    DeviceLost,
    Gripper,
    GripperSample,
    Image,
    MonoCamera,
    RgbdCamera,
    RgbdCapture,
)
from acquisition.rig import DeviceEntry, Rig
from acquisition.streaming.clock import ClockMapper, SessionClock
from acquisition.streaming.sequence_check import Gate, Trouble
from acquisition.streaming.stream_queue import Item, Lane, Take, Write
from acquisition.streaming.streams import READS, Tally, go_first
from recordings.errors import DeviceNotFound, TosslabError
from recordings.mcap import arm_codec
from recordings.records import ArmStates, DepthImage, EncodedImage
from recordings.session_writer import TossWriter

READ_S = 0.1
REOPEN_EVERY_S = 0.5
LATE_S = 0.06
"""How long after a take's end its last frames may still come in from the pumps."""
ARM_HOLD_S = 0.15
"""Joint states wait for the gripper's next width before they are written."""
ARM_QUEUE_S = 10.0
"""Joint states are small: a slow disk shall not cost any."""
LOOK_WIDTH = 212
DESIRED_TOPIC = "/arm/desired_joint_states"
STOPPED_MODES: tuple[ArmMode, ...] = ("reflex", "user_stopped", "error")


@dataclass(frozen=True, eq=False)
class Look:
    """A thumbnail of a depth image, for watching the toss: about LOOK_WIDTH wide."""

    host_ns: int
    time_ns: int
    number: int
    raw: UInt16[Array, "h w"]
    unit_m: float


class Recorder:
    """Everything that flows while a session is open. Thread-safe where the session's loop calls it."""

    def __init__(self, rig: Rig, devices: Mapping[str, Device], clock: SessionClock) -> None:
        self.rig, self.clock = rig, clock
        self.devices = dict(devices)
        self.lanes: dict[str, Lane] = {}
        self.looks: deque[Look] = deque(maxlen=150)
        self.arm_tail: deque[ArmSamples] = deque(maxlen=500)
        self.widths: deque[GripperSample] = deque(maxlen=4000)
        self.latest: dict[str, Image] = {}
        self._troubles: deque[Trouble] = deque(maxlen=1000)
        self._mappers: dict[tuple[str, str], ClockMapper] = {}
        self._leads: dict[tuple[str, str], str] = {}
        self._gates: dict[str, Gate] = {}
        self._not_put_away: dict[str, str] = {}
        self._stop = threading.Event()
        self._take: Take | None = None
        self._ended_at_ns = 0
        self._entries = {d.name: d for d in rig.devices}
        self._pumps = [_Pump(self, self._entries[name], device) for name, device in self.devices.items()]
        for entry in rig.devices:
            self._make_lanes(entry)

    def __enter__(self) -> Recorder:
        opened: list[Device] = []
        try:
            for device in self.devices.values():
                device.open()
                opened.append(device)
            for device in self.devices.values():
                device.start()
        except BaseException:
            for device in opened:
                device.close()
            raise
        for lane in self.lanes.values():
            lane.start()
        for pump in self._pumps:
            pump.start()
        return self

    def __exit__(self, *exc: object) -> None:
        """Stop reading, work off the lanes, close the devices: none of it waits for a device that hangs."""
        self._stop.set()
        for device in self.devices.values():
            self._put_away(device.name, device.stop)
        for pump in self._pumps:
            pump.join(1.0)
        for lane in self.lanes.values():
            lane.stop(1.0)
        for device in self.devices.values():
            self._put_away(device.name, device.close)

    def begin(self, writer: TossWriter, host_ns: int) -> None:
        """Write what came since `host_ns`, as far as the ring reaches back, and everything from now on."""
        take = Take(writer, host_ns)
        for key, mapper in list(self._mappers.items()):
            line = mapper.line()
            if line is not None:
                take.lines[*key, len(mapper.steps)] = line
        self._take = take
        for lane in self.lanes.values():
            lane.take = take

    def end(self, host_ns: int | None = None) -> None:
        """The take ends with what was received until `host_ns` (now). Returns at once: ask `ended`."""
        take = self._take
        if take is None or take.end_host_ns is not None:
            return
        take.end_host_ns = host_ns if host_ns is not None else time.monotonic_ns()
        self._ended_at_ns = max(time.monotonic_ns(), take.end_host_ns)

    def ended(self) -> bool:
        """Whether everything of the ended take has been written; then the writer is the caller's again."""
        take = self._take
        if take is None:
            return True
        if take.end_host_ns is None or time.monotonic_ns() < self._ended_at_ns + LATE_S * 1e9:
            return False
        if not take.marks:
            take.marks = [lane.mark() for lane in self.lanes.values()]
        if not all(mark.is_set() for mark in take.marks):
            return False
        self._take = None
        return True

    @property
    def take(self) -> Take | None:
        return self._take

    def tallies(self) -> dict[str, Tally]:
        """Counts by topic since the start."""
        return {topic: lane.counter.tally() for topic, lane in self.lanes.items()}

    def troubles(self) -> list[Trouble]:
        """What happened since the last call."""
        found = []
        while self._troubles:
            found.append(self._troubles.popleft())
        return found

    def tell(self, trouble: Trouble) -> None:
        self._troubles.append(trouble)

    def _put_away(self, name: str, call: Callable[[], object]) -> None:
        """Stop or close a device, whatever its driver does: the others come next, and what went wrong is told."""
        try:
            call()
        except Exception as fault:
            text = f"{getattr(call, '__name__', 'put away')} failed: {type(fault).__name__}: {fault}"
            if self._not_put_away.get(name) != text:  # a lost device is closed again and again
                self._not_put_away[name] = text
                self.tell(Trouble(time.monotonic_ns(), name, "not put away", text, "warning"))

    def clocks(self) -> dict[str, dict[str, Any]]:
        """The mapping of every device clock, with its error, as JSON."""
        found: dict[str, dict[str, Any]] = {}
        for (device, clock), mapper in list(self._mappers.items()):
            line = mapper.line()
            if line is not None:
                entry = self._entries[device]
                steps = [{"session_ns": self.clock.session_ns(s.host_ns), "by_ns": s.by_ns} for s in mapper.steps]
                found[f"{device}: {clock}"] = {
                    **line.to_json(),
                    "reference_session_ns": self.clock.session_ns(line.reference_host_ns),
                    "assumed_latency_s": entry.latency_ms * 1e-3,
                    "wraps": mapper.wraps,
                    "steps": steps,
                }
        return found

    def silent_since_s(self) -> dict[str, float]:
        """Seconds since each stream's last frame."""
        now = time.monotonic_ns()
        return {topic: (now - lane.last_host_ns) / 1e9 for topic, lane in self.lanes.items()}

    def arm_mode(self) -> ArmMode | None:
        return self.arm_tail[-1].modes[-1] if self.arm_tail else None

    def joints_at(self, host_ns: int) -> Array | None:
        """Joint angles at a host time, from the batches near it; None where the arm says nothing."""
        tail = list(self.arm_tail)[-100:]
        near = min(tail, key=lambda s: abs(int(s.host_ns[-1]) - host_ns), default=None)
        if near is None or abs(int(near.host_ns[-1]) - host_ns) > 200_000_000:
            return None
        k = int(np.abs(near.host_ns - host_ns).argmin())
        return near.q_rad[k] if np.isfinite(near.q_rad[k]).all() else None

    # what the pumps call

    def take_capture(self, entry: DeviceEntry, capture: RgbdCapture) -> None:
        """Colour and depth come together when the later one is there: its stamps are what the receipt follows."""
        images = capture.images()
        latest = max(images, key=lambda image: image.mid_exposure_ns, default=None)
        if latest is not None:
            self._leads.setdefault((entry.name, latest.stamp.clock), _topic(entry, latest.stream))
        for image in images:
            self.take_image(entry, image, capture.unit_m if image.stream == "depth" else None)

    def take_image(self, entry: DeviceEntry, image: Image, unit_m: float | None = None) -> None:
        topic = _topic(entry, image.stream)
        gate = self._gates[topic]
        passes = gate.passes(image)
        self._troubles.extend(gate.told())
        if not passes:
            return
        key = (entry.name, image.stamp.clock)
        item = Item((image, unit_m), image.host_ns)
        if image.stamp.instant != "arrival":
            item = self._clocked(key, topic, image, unit_m)
        self.latest[topic] = image
        if unit_m is not None and image.stream == "depth":
            stride = look_stride(image.pixels.shape[1])
            small = np.ascontiguousarray(image.pixels[::stride, ::stride])
            self.looks.append(Look(image.host_ns, self._now_ns(entry, item), image.number, small, unit_m))
        self.lanes[topic].offer(item)

    def take_states(self, entry: DeviceEntry, states: ArmSamples) -> None:
        if len(states.number) == 0:
            return
        key = (entry.name, states.clock)
        mapper = self._mappers.setdefault(key, ClockMapper())
        unwrapped = mapper.add(int(states.time_ns[-1]), int(states.host_ns[-1]), int(states.number[-1]))
        self._tell_steps(key, mapper)
        clock = (*key, len(mapper.steps))
        self.arm_tail.append(states)
        self.lanes[arm_codec.TOPIC].offer(
            Item(states, int(states.host_ns[-1]), len(states.number), clock, unwrapped - int(states.time_ns[-1]))
        )

    def restarted(self, entry: DeviceEntry, away_s: float) -> None:
        """A device came back: its numbers begin anew, what it would have sent meanwhile is missing."""
        for topic in _topics(entry):
            self.lanes[topic].counter.missed(round(away_s * entry.rate_hz))
            if topic in self._gates:
                self._gates[topic].restart()

    def _clocked(self, key: tuple[str, str], topic: str, image: Image, unit_m: float | None) -> Item:
        """One stream of a device feeds its clock's map; the others are put on it."""
        wrap_ns = None if image.stamp.wrap_ticks is None else image.stamp.wrap_ticks * image.stamp.tick_ns
        mapper = self._mappers.setdefault(key, ClockMapper(wrap_ns))
        if self._leads.setdefault(key, topic) == topic:
            stamp_ns = mapper.add(image.stamp.device_ns, image.host_ns, image.number)
            self._tell_steps(key, mapper)
        else:
            stamp_ns = mapper.unwrap(image.stamp.device_ns)
        mid_ns = stamp_ns + image.mid_exposure_ns - image.stamp.device_ns
        return Item((image, unit_m), image.host_ns, 1, (*key, len(mapper.steps)), mid_ns)

    def _tell_steps(self, key: tuple[str, str], mapper: ClockMapper) -> None:
        for step in mapper.steps[mapper.told :]:
            text = f"its clock {key[1]} was set by {step.by_ns / 1e9:+.4f} s"
            self.tell(Trouble(step.host_ns, key[0], "clock step", text, "error"))
        mapper.told = len(mapper.steps)

    def _now_ns(self, entry: DeviceEntry, item: Item) -> int:
        """The session time of an item by the present mapping."""
        host_ns = item.host_ns
        if item.clock is not None:
            line = self._mappers[item.clock[:2]].line()
            host_ns = line.host_ns(item.device_ns) if line is not None else host_ns
        return self.clock.session_ns(host_ns - round(entry.latency_ms * 1e6))

    def _time_ns(self, take: Take, entry: DeviceEntry, item: Item) -> int:
        """The session time of an item; within a take every clock keeps one mapping."""
        host_ns = item.host_ns
        if item.clock is not None:
            if item.clock not in take.lines:
                line = self._mappers[item.clock[:2]].line()
                assert line is not None
                take.lines[item.clock] = line
            host_ns = take.lines[item.clock].host_ns(item.device_ns)
        return self.clock.session_ns(host_ns - round(entry.latency_ms * 1e6))

    # what the lanes write

    def _make_lanes(self, entry: DeviceEntry) -> None:
        r = self.rig.recording
        if entry.kind == "gripper":
            return
        for topic in _topics(entry):
            writes = {"arm": self._write_arm, "depth": self._write_depth, "color": self._write_color}
            kind = "arm" if entry.kind == "arm" else topic.rsplit("/", 1)[1]
            write = writes.get(kind, self._write_mono)
            hold_s = ARM_HOLD_S if entry.kind == "arm" and self.rig.of_kind("gripper") else 0.0
            rate, queue_s = entry.rate_hz, r.queue_s
            if entry.kind == "arm":
                rate, queue_s = 100.0, max(r.queue_s, ARM_QUEUE_S)
            self.lanes[topic] = Lane(topic, rate, queue_s, r.pre_trigger_s + hold_s, _bound(write, entry), hold_s)
            if entry.kind != "arm":
                self._gates[topic] = Gate(topic, self.lanes[topic].counter, period_ns=1e9 / entry.rate_hz)

    def _write_color(self, take: Take, entry: DeviceEntry, item: Item) -> int:
        image: Image = item.value[0]
        quality = self.rig.recording.color_jpeg_quality
        data = _jpeg(cv2.cvtColor(image.pixels, cv2.COLOR_RGB2BGR), quality)
        take.writer.color(self._encoded(take, entry, item, entry.name, "jpeg", data))
        return 1

    def _write_mono(self, take: Take, entry: DeviceEntry, item: Item) -> int:
        image: Image = item.value[0]
        camera = entry.name if entry.kind == "mono" else f"{entry.name}_{image.stream}"
        if self.rig.recording.mono_encoding == "lossless":
            data = image.pixels.tobytes()
            take.writer.mono(self._encoded(take, entry, item, camera, "mono8", data))
        else:
            data = _jpeg(image.pixels, self.rig.recording.mono_jpeg_quality)
            take.writer.mono(self._encoded(take, entry, item, camera, "jpeg", data))
        return 1

    def _write_depth(self, take: Take, entry: DeviceEntry, item: Item) -> int:
        image, unit_m = item.value
        time_ns = self._time_ns(take, entry, item)
        host_ns = self.clock.session_ns(item.host_ns)
        take.writer.depth(DepthImage(entry.name, image.number, time_ns, host_ns, unit_m, image.pixels))
        return 1

    def _encoded(
        self, take: Take, entry: DeviceEntry, item: Item, camera: str, encoding: Any, data: bytes
    ) -> EncodedImage:
        image: Image = item.value[0]
        height, width = image.pixels.shape[:2]
        time_ns, host_ns = self._time_ns(take, entry, item), self.clock.session_ns(item.host_ns)
        return EncodedImage(camera, image.number, time_ns, host_ns, encoding, width, height, data)

    def _write_arm(self, take: Take, entry: DeviceEntry, item: Item) -> int:
        """Measured states on `/arm/joint_states`, desired ones beside them. States of NaN are counted and left out."""
        states: ArmSamples = item.value
        good = np.isfinite(states.q_rad).all(axis=1) & np.isfinite(states.dq_rad_s).all(axis=1)
        lane = self.lanes[arm_codec.TOPIC]
        lane.counter.dropped("invalid", int((~good).sum())) if not good.all() else None
        if not good.any():
            return 0
        host_ns = states.host_ns[good]
        times_ns = np.array(
            [
                self._time_ns(take, entry, replace(item, device_ns=item.device_ns + t))
                for t in (int(states.time_ns[good][0]), int(states.time_ns[good][-1]))
            ]
        )
        span = states.time_ns[good] - states.time_ns[good][0]
        scale = (times_ns[1] - times_ns[0]) / max(int(span[-1]), 1)
        when = times_ns[0] + np.rint(span * scale).astype(np.int64)
        received = [self.clock.session_ns(int(h)) for h in host_ns]
        names = getattr(self.devices[entry.name], "joint_names", tuple(f"joint{i}" for i in range(1, 8)))
        widths = self._widths_at(host_ns)
        take.writer.arm(ArmStates(when, names, states.q_rad[good], states.dq_rad_s[good], widths), received)
        desired = states.q_desired_rad[good], states.dq_desired_rad_s[good]
        if np.isfinite(desired[0]).all() and np.isfinite(desired[1]).all():
            none = np.full(len(when), np.nan)
            take.writer.arm(ArmStates(when, names, *desired, none), received, DESIRED_TOPIC)
        return int(good.sum())

    def _widths_at(self, host_ns: Array) -> Array:
        """The fingers' distance between the gripper's samples; NaN before the first one."""
        samples = list(self.widths)
        if not samples:
            return np.full(len(host_ns), np.nan)
        times = np.array([s.host_ns for s in samples], dtype=np.float64)
        return np.interp(host_ns.astype(np.float64), times, np.array([s.width_m for s in samples]), left=np.nan)


class _Pump(threading.Thread):
    """Reads one device and hands everything on; brings it back when it was lost."""

    def __init__(self, recorder: Recorder, entry: DeviceEntry, device: Device) -> None:
        super().__init__(name=f"pump {entry.name}", daemon=True)
        self._recorder, self._entry, self._device = recorder, entry, device

    def run(self) -> None:
        go_first(READS)
        stop = self._recorder._stop
        while not stop.is_set():
            try:
                self._read()
            except (DeviceLost, DeviceNotFound) as lost:
                self._bring_back(str(lost), stop)
            except Exception as fault:
                self._tell("fault", f"{type(fault).__name__}: {fault}", "error")
                stop.wait(READ_S)

    def _read(self) -> None:
        device, recorder, entry = self._device, self._recorder, self._entry
        if entry.kind == "rgbd" and isinstance(device, RgbdCamera):
            capture = device.read(READ_S)
            if isinstance(capture, RgbdCapture):
                recorder.take_capture(entry, capture)
        elif entry.kind == "mono" and isinstance(device, MonoCamera):
            picture = device.read(READ_S)
            if picture is not None:
                recorder.take_image(entry, picture)
        elif entry.kind == "arm" and isinstance(device, Arm):
            states = device.read(READ_S)
            if states is not None:
                self._watch_modes(states)
                recorder.take_states(entry, states)
        elif isinstance(device, Gripper):
            sample = device.read(READ_S)
            if sample is not None:
                recorder.widths.append(sample)

    def _watch_modes(self, states: ArmSamples) -> None:
        before = self._recorder.arm_mode()
        mode = next((m for m in states.modes if m in STOPPED_MODES), None)
        if mode is not None and before != mode:
            self._tell(mode, f"the arm stands in {mode}", "error")

    def _bring_back(self, why: str, stop: threading.Event) -> None:
        gone_ns = time.monotonic_ns()
        self._tell("lost", why, "error")
        while not stop.wait(REOPEN_EVERY_S):
            self._recorder._put_away(self._entry.name, self._device.close)
            try:
                self._device.open()
                self._device.start()
            except TosslabError:
                continue
            away_s = (time.monotonic_ns() - gone_ns) / 1e9
            self._recorder.restarted(self._entry, away_s)
            self._tell("back", f"is back after {away_s:.1f} s", "info")
            return

    def _tell(self, kind: str, text: str, level: Any) -> None:
        self._recorder.tell(Trouble(time.monotonic_ns(), self._entry.name, kind, text, level))


def look_stride(width: int) -> int:
    """Every how many pixels of an image a thumbnail takes one."""
    return max(1, round(width / LOOK_WIDTH))


def _bound(write: Callable[[Take, DeviceEntry, Item], int], entry: DeviceEntry) -> Write:
    return lambda take, item: write(take, entry, item)


def _topic(entry: DeviceEntry, stream: str) -> str:
    if entry.kind == "mono":
        return f"/{entry.name}/image"
    return f"/{entry.name}/{stream}" if stream in ("color", "depth") else f"/{entry.name}_{stream}/image"


def _topics(entry: DeviceEntry) -> list[str]:
    """The streams of a device that are written."""
    if entry.kind == "arm":
        return [arm_codec.TOPIC]
    if entry.kind == "gripper":
        return []
    streams = ["image"] if entry.kind == "mono" else ["color", "depth", *_infrared(entry)]
    return [_topic(entry, s) for s in streams]


def _infrared(entry: DeviceEntry) -> list[str]:
    return ["infrared1", "infrared2"] if entry.settings.get("infrared") else []


def _jpeg(pixels: Array, quality: int) -> bytes:
    done, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise TosslabError("OpenCV could not encode a JPEG image")
    return data.tobytes()
