"""Every device clock's map to the session clock, while a session is open.

The streams of one camera share its clock. One of them leads: its stamps feed the map, the others are put on it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from acquisition.devices import ArmSamples, Image
from acquisition.rig import DeviceEntry
from acquisition.streaming.clock import ClockLine, ClockMapper, SessionClock
from acquisition.streaming.sequence_check import Trouble
from acquisition.streaming.stream_queue import Item, Take

ClockKey = tuple[str, str]
"""Device and name of its counter."""


class DeviceClocks:
    """Maps stamps of devices to session time (ns). `report` is called with every step of a device's clock."""

    def __init__(
        self, entries: Mapping[str, DeviceEntry], session: SessionClock, report: Callable[[Trouble], None]
    ) -> None:
        self.session = session
        self._entries, self._report = entries, report
        self._mappers: dict[ClockKey, ClockMapper] = {}
        self._leads: dict[ClockKey, str] = {}

    def lead(self, key: ClockKey, topic: str) -> None:
        """The stream that feeds a clock's map, unless one does already."""
        self._leads.setdefault(key, topic)

    def image_item(self, key: ClockKey, topic: str, image: Image, unit_m: float | None) -> Item:
        """An image at its mid-exposure on the device's unwrapped clock; a leading stream's stamp feeds the map."""
        wrap_ns = None if image.stamp.wrap_ticks is None else image.stamp.wrap_ticks * image.stamp.tick_ns
        mapper = self._mappers.setdefault(key, ClockMapper(wrap_ns))
        if self._leads.setdefault(key, topic) == topic:
            stamp_ns = mapper.add(image.stamp.device_ns, image.host_ns, image.number)
            self._report_steps(key, mapper)
        else:
            stamp_ns = mapper.unwrap(image.stamp.device_ns)
        mid_ns = stamp_ns + image.mid_exposure_ns - image.stamp.device_ns
        return Item((image, unit_m), image.host_ns, 1, (*key, len(mapper.steps)), mid_ns)

    def states_item(self, key: ClockKey, states: ArmSamples) -> Item:
        """A batch of joint states; `device_ns` is what unwrapping adds to their stamps."""
        mapper = self._mappers.setdefault(key, ClockMapper())
        unwrapped = mapper.add(int(states.time_ns[-1]), int(states.host_ns[-1]), int(states.number[-1]))
        self._report_steps(key, mapper)
        clock = (*key, len(mapper.steps))
        return Item(states, int(states.host_ns[-1]), len(states.number), clock, unwrapped - int(states.time_ns[-1]))

    def lines(self) -> dict[tuple[str, str, int], ClockLine]:
        """The present map of every clock that has one."""
        found = {}
        for key, mapper in list(self._mappers.items()):
            line = mapper.line()
            if line is not None:
                found[*key, len(mapper.steps)] = line
        return found

    def now_ns(self, entry: DeviceEntry, item: Item) -> int:
        """The session time of an item by the present map."""
        host_ns = item.host_ns
        if item.clock is not None:
            line = self._mappers[item.clock[:2]].line()
            host_ns = line.host_ns(item.device_ns) if line is not None else host_ns
        return self.session.session_ns(host_ns - round(entry.latency_ms * 1e6))

    def time_ns(self, take: Take, entry: DeviceEntry, item: Item) -> int:
        """The session time of an item; within a take every clock keeps one map."""
        host_ns = item.host_ns
        if item.clock is not None:
            if item.clock not in take.lines:
                line = self._mappers[item.clock[:2]].line()
                assert line is not None
                take.lines[item.clock] = line
            host_ns = take.lines[item.clock].host_ns(item.device_ns)
        return self.session.session_ns(host_ns - round(entry.latency_ms * 1e6))

    def to_json(self) -> dict[str, dict[str, Any]]:
        """The map of every device clock, with its error."""
        found: dict[str, dict[str, Any]] = {}
        for (device, clock), mapper in list(self._mappers.items()):
            line = mapper.line()
            if line is not None:
                entry = self._entries[device]
                steps = [{"session_ns": self.session.session_ns(s.host_ns), "by_ns": s.by_ns} for s in mapper.steps]
                found[f"{device}: {clock}"] = {
                    **line.to_json(),
                    "reference_session_ns": self.session.session_ns(line.reference_host_ns),
                    "assumed_latency_s": entry.latency_ms * 1e-3,
                    "wraps": mapper.wraps,
                    "steps": steps,
                }
        return found

    def _report_steps(self, key: ClockKey, mapper: ClockMapper) -> None:
        for step in mapper.steps[mapper.reported :]:
            text = f"its clock {key[1]} was set by {step.by_ns / 1e9:+.4f} s"
            self._report(Trouble(step.host_ns, key[0], "clock step", text, "error"))
        mapper.reported = len(mapper.steps)
