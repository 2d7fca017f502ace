"""Devices to files: a thread per device that only reads (device_reader.py), a queue per stream that encodes and writes
(stream_queue.py, item_writer.py), takes cut out of what flows by.

    recorder = Recorder(rig, devices, SessionClock(...))
    with recorder:                                   # devices opened, frames flow, clocks are followed
        recorder.begin(writer, host_ns)              # what came since then (the ring) and from now on
        recorder.end(host_ns)
        while not recorder.ended(): ...              # the queues work off what belongs to the take
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt16
from numpy import ndarray as Array

from acquisition.devices import ArmMode, ArmSamples, Device, GripperSample, Image, RgbdCapture
from acquisition.rig import DeviceEntry, Rig
from acquisition.streaming.clock import SessionClock
from acquisition.streaming.device_clocks import DeviceClocks
from acquisition.streaming.device_reader import DeviceReader
from acquisition.streaming.item_writer import ItemWriter
from acquisition.streaming.sequence_check import SequenceCheck, Trouble
from acquisition.streaming.stream_queue import Item, StreamQueue, Take, Write
from acquisition.streaming.streams import Tally
from recordings.mcap import arm_codec
from recordings.mcap.toss_writer import TossWriter

LATE_S = 0.06
"""How long after a take's end its last frames may still come in from the readers."""
ARM_HOLD_S = 0.15
"""Joint states wait for the gripper's next width before they are written."""
ARM_QUEUE_S = 10.0
"""Joint states are small: a slow disk shall not cost any."""
THUMBNAIL_WIDTH = 212


@dataclass(frozen=True, eq=False)
class DepthThumbnail:
    """A thumbnail of a depth image, for watching the toss: about THUMBNAIL_WIDTH wide."""

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
        self.queues: dict[str, StreamQueue] = {}
        self.thumbnails: deque[DepthThumbnail] = deque(maxlen=150)
        self.arm_tail: deque[ArmSamples] = deque(maxlen=500)
        self.widths: deque[GripperSample] = deque(maxlen=4000)
        self.latest: dict[str, Image] = {}
        self._troubles: deque[Trouble] = deque(maxlen=1000)
        self._checks: dict[str, SequenceCheck] = {}
        self._not_put_away: dict[str, str] = {}
        self._stop = threading.Event()
        self._take: Take | None = None
        self._ended_at_ns = 0
        entries = {d.name: d for d in rig.devices}
        self._clocks = DeviceClocks(entries, clock, self.report)
        self._writer = ItemWriter(rig.recording, self._clocks, self.widths, self._joint_names, self._invalid_states)
        self._readers = [DeviceReader(self, entries[name], device, self._stop) for name, device in self.devices.items()]
        for entry in rig.devices:
            self._make_queues(entry)

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
        for queue in self.queues.values():
            queue.start()
        for reader in self._readers:
            reader.start()
        return self

    def __exit__(self, *exc: object) -> None:
        """Stop reading, work off the queues, close the devices: none of it waits for a device that hangs."""
        self._stop.set()
        for device in self.devices.values():
            self.put_away(device.name, device.stop)
        for reader in self._readers:
            reader.join(1.0)
        for queue in self.queues.values():
            queue.stop(1.0)
        for device in self.devices.values():
            self.put_away(device.name, device.close)

    def begin(self, writer: TossWriter, host_ns: int) -> None:
        """Write what came since `host_ns`, as far as the ring reaches back, and everything from now on."""
        take = Take(writer, host_ns)
        take.lines.update(self._clocks.lines())
        self._take = take
        for queue in self.queues.values():
            queue.take = take

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
            take.marks = [queue.mark() for queue in self.queues.values()]
        if not all(mark.is_set() for mark in take.marks):
            return False
        self._take = None
        return True

    def most_waiting(self) -> tuple[str, int]:
        """The stream for which most is still to be written, and how much."""
        return max(((topic, queue.waiting) for topic, queue in self.queues.items()), key=lambda found: found[1])

    @property
    def take(self) -> Take | None:
        return self._take

    def tallies(self) -> dict[str, Tally]:
        """Counts by topic since the start."""
        return {topic: queue.counter.tally() for topic, queue in self.queues.items()}

    def troubles(self) -> list[Trouble]:
        """What happened since the last call."""
        found = []
        while self._troubles:
            found.append(self._troubles.popleft())
        return found

    def report(self, trouble: Trouble) -> None:
        self._troubles.append(trouble)

    def put_away(self, name: str, call: Callable[[], object]) -> None:
        """Stop or close a device, whatever its driver does: the others come next, and what went wrong is reported."""
        try:
            call()
        except Exception as fault:
            text = f"{getattr(call, '__name__', 'put away')} failed: {type(fault).__name__}: {fault}"
            if self._not_put_away.get(name) != text:  # a lost device is closed again and again
                self._not_put_away[name] = text
                self.report(Trouble(time.monotonic_ns(), name, "not put away", text, "warning"))

    def clocks(self) -> dict[str, dict[str, Any]]:
        """The map of every device clock, with its error, as JSON."""
        return self._clocks.to_json()

    def silent_since_s(self) -> dict[str, float]:
        """Seconds since each stream's last frame."""
        now = time.monotonic_ns()
        return {topic: (now - queue.last_host_ns) / 1e9 for topic, queue in self.queues.items()}

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

    # what the readers call

    def take_capture(self, entry: DeviceEntry, capture: RgbdCapture) -> None:
        """Colour and depth come together when the later one is there: its stamps are what the receipt follows."""
        images = capture.images()
        latest = max(images, key=lambda image: image.mid_exposure_ns, default=None)
        if latest is not None:
            self._clocks.lead((entry.name, latest.stamp.clock), _topic(entry, latest.stream))
        for image in images:
            self.take_image(entry, image, capture.unit_m if image.stream == "depth" else None)

    def take_image(self, entry: DeviceEntry, image: Image, unit_m: float | None = None) -> None:
        topic = _topic(entry, image.stream)
        check = self._checks[topic]
        passes = check.passes(image)
        self._troubles.extend(check.new_troubles())
        if not passes:
            return
        key = (entry.name, image.stamp.clock)
        item = Item((image, unit_m), image.host_ns)
        if image.stamp.instant != "arrival":
            item = self._clocks.image_item(key, topic, image, unit_m)
        self.latest[topic] = image
        if unit_m is not None and image.stream == "depth":
            stride = thumbnail_stride(image.pixels.shape[1])
            small = np.ascontiguousarray(image.pixels[::stride, ::stride])
            time_ns = self._clocks.now_ns(entry, item)
            self.thumbnails.append(DepthThumbnail(image.host_ns, time_ns, image.number, small, unit_m))
        self.queues[topic].offer(item)

    def take_states(self, entry: DeviceEntry, states: ArmSamples) -> None:
        if len(states.number) == 0:
            return
        self.arm_tail.append(states)
        self.queues[arm_codec.TOPIC].offer(self._clocks.states_item((entry.name, states.clock), states))

    def take_width(self, sample: GripperSample) -> None:
        self.widths.append(sample)

    def restarted(self, entry: DeviceEntry, away_s: float) -> None:
        """A device came back: its numbers begin anew, what it would have sent meanwhile is missing."""
        for topic in _topics(entry):
            self.queues[topic].counter.missed(round(away_s * entry.rate_hz))
            if topic in self._checks:
                self._checks[topic].restart()

    def _make_queues(self, entry: DeviceEntry) -> None:
        r = self.rig.recording
        if entry.kind == "gripper":
            return
        for topic in _topics(entry):
            kind = "arm" if entry.kind == "arm" else topic.rsplit("/", 1)[1]
            write = _bound(self._writer.of_kind(kind), entry)
            hold_s = ARM_HOLD_S if entry.kind == "arm" and self.rig.of_kind("gripper") else 0.0
            rate, queue_s = entry.rate_hz, r.queue_s
            if entry.kind == "arm":
                rate, queue_s = 100.0, max(r.queue_s, ARM_QUEUE_S)
            self.queues[topic] = StreamQueue(topic, rate, queue_s, r.pre_trigger_s + hold_s, write, hold_s)
            if entry.kind != "arm":
                counter = self.queues[topic].counter
                # a recording's lost triggers are in its numbers; its pauses between tosses are none
                period_ns = 0.0 if entry.driver == "replay" else 1e9 / entry.rate_hz
                self._checks[topic] = SequenceCheck(topic, counter, period_ns=period_ns)

    def _joint_names(self, device: str) -> tuple[str, ...]:
        return getattr(self.devices[device], "joint_names", tuple(f"joint{i}" for i in range(1, 8)))

    def _invalid_states(self, count: int) -> None:
        self.queues[arm_codec.TOPIC].counter.dropped("invalid", count)


def thumbnail_stride(width: int) -> int:
    """Every how many pixels of an image a thumbnail takes one."""
    return max(1, round(width / THUMBNAIL_WIDTH))


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
    infrared = ["infrared1", "infrared2"] if entry.settings.get("infrared") else []
    streams = ["image"] if entry.kind == "mono" else ["color", "depth", *infrared]
    return [_topic(entry, s) for s in streams]
