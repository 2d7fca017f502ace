"""What a stream's queue writes: an item of a take, encoded, with its session time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy import ndarray as Array

from acquisition.devices import ArmSamples, GripperSample, Image
from acquisition.rig import DeviceEntry, RecordingConfig
from acquisition.streaming.device_clocks import DeviceClocks
from acquisition.streaming.stream_queue import Item, Take
from recordings.errors import TosslabError
from recordings.records import ArmStates, DepthImage, EncodedImage

DESIRED_TOPIC = "/arm/desired_joint_states"


class ItemWriter:
    """One method a kind of stream; each returns how many parts of the item it wrote.

    `widths` are the gripper's, written with the joint states; `invalid_states` is told how many states were NaN.
    """

    def __init__(
        self,
        recording: RecordingConfig,
        clocks: DeviceClocks,
        widths: deque[GripperSample],
        joint_names: Callable[[str], tuple[str, ...]],
        invalid_states: Callable[[int], None],
    ) -> None:
        self._recording, self._clocks, self._widths = recording, clocks, widths
        self._joint_names, self._invalid_states = joint_names, invalid_states

    def of_kind(self, kind: str) -> Callable[[Take, DeviceEntry, Item], int]:
        """The method for a kind of stream (`arm`, `depth`, `color`, else grey images)."""
        return {"arm": self.arm, "depth": self.depth, "color": self.color}.get(kind, self.mono)

    def color(self, take: Take, entry: DeviceEntry, item: Item) -> int:
        image: Image = item.value[0]
        quality = self._recording.color_jpeg_quality
        data = _jpeg(cv2.cvtColor(image.pixels, cv2.COLOR_RGB2BGR), quality)
        take.writer.color(self._encoded(take, entry, item, entry.name, "jpeg", data))
        return 1

    def mono(self, take: Take, entry: DeviceEntry, item: Item) -> int:
        image: Image = item.value[0]
        camera = entry.name if entry.kind == "mono" else f"{entry.name}_{image.stream}"
        if self._recording.mono_encoding == "lossless":
            data = image.pixels.tobytes()
            take.writer.mono(self._encoded(take, entry, item, camera, "mono8", data))
        else:
            data = _jpeg(image.pixels, self._recording.mono_jpeg_quality)
            take.writer.mono(self._encoded(take, entry, item, camera, "jpeg", data))
        return 1

    def depth(self, take: Take, entry: DeviceEntry, item: Item) -> int:
        image, unit_m = item.value
        time_ns = self._clocks.time_ns(take, entry, item)
        host_ns = self._clocks.session.session_ns(item.host_ns)
        take.writer.depth(DepthImage(entry.name, image.number, time_ns, host_ns, unit_m, image.pixels))
        return 1

    def _encoded(
        self, take: Take, entry: DeviceEntry, item: Item, camera: str, encoding: Any, data: bytes
    ) -> EncodedImage:
        image: Image = item.value[0]
        height, width = image.pixels.shape[:2]
        time_ns, host_ns = self._clocks.time_ns(take, entry, item), self._clocks.session.session_ns(item.host_ns)
        return EncodedImage(camera, image.number, time_ns, host_ns, encoding, width, height, data)

    def arm(self, take: Take, entry: DeviceEntry, item: Item) -> int:
        """Measured states on `/arm/joint_states`, desired ones beside them. States of NaN are counted and left out."""
        states: ArmSamples = item.value
        good = np.isfinite(states.q_rad).all(axis=1) & np.isfinite(states.dq_rad_s).all(axis=1)
        if not good.all():
            self._invalid_states(int((~good).sum()))
        if not good.any():
            return 0
        host_ns = states.host_ns[good]
        times_ns = np.array(
            [
                self._clocks.time_ns(take, entry, replace(item, device_ns=item.device_ns + t))
                for t in (int(states.time_ns[good][0]), int(states.time_ns[good][-1]))
            ]
        )
        span = states.time_ns[good] - states.time_ns[good][0]
        scale = (times_ns[1] - times_ns[0]) / max(int(span[-1]), 1)
        when = times_ns[0] + np.rint(span * scale).astype(np.int64)
        received = [self._clocks.session.session_ns(int(h)) for h in host_ns]
        names = self._joint_names(entry.name)
        widths = self._widths_at(host_ns)
        take.writer.arm(ArmStates(when, names, states.q_rad[good], states.dq_rad_s[good], widths), received)
        desired = states.q_desired_rad[good], states.dq_desired_rad_s[good]
        if np.isfinite(desired[0]).all() and np.isfinite(desired[1]).all():
            none = np.full(len(when), np.nan)
            take.writer.arm(ArmStates(when, names, *desired, none), received, DESIRED_TOPIC)
        return int(good.sum())

    def _widths_at(self, host_ns: Array) -> Array:
        """The fingers' distance between the gripper's samples; NaN before the first one."""
        samples = list(self._widths)
        if not samples:
            return np.full(len(host_ns), np.nan)
        times = np.array([s.host_ns for s in samples], dtype=np.float64)
        return np.interp(host_ns.astype(np.float64), times, np.array([s.width_m for s in samples]), left=np.nan)


def _jpeg(pixels: Array, quality: int) -> bytes:
    done, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise TosslabError("OpenCV could not encode a JPEG image")
    return data.tobytes()
