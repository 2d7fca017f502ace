"""PointGrey/FLIR and any other GigE Vision or USB3 Vision camera, through Aravis.

Spinnaker (PySpin, or rotpy from PyPI) is an alternative for FLIR cameras that this project does not need: Aravis
speaks the open standards with any vendor's camera, and can be tested without one.
A free-running camera keeps its own rate; "software" exposes at each `trigger()`; any other trigger names the input
line ("Line0"), with `strobe_line` the output line that tells the next camera when this one exposes.
"""

from __future__ import annotations

import ctypes
import math
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray as Array

from acquisition.devices import DeviceLost, DeviceRefused, Health, Image, Stamp
from acquisition.drivers import usb
from acquisition.drivers.aravis import STATUS, Aravis, AravisError, Found
from acquisition.drivers.genicam_setup import GenicamSettings, apply
from acquisition.drivers.inbox import Inbox
from acquisition.drivers.lifecycle import OpenedByContext
from recordings.errors import DeviceNotFound

POP_US = 100_000
LEAVE_S = 0.8
HEARTBEAT_S = 12.0
"""How long a camera is waited for that obeys a program which died (GigE Vision: 3 s without a word free it, or what
the camera was set to), or that this process still leaves."""
LOOK_S = 0.2
_LEAVING: dict[str, threading.Thread] = {}
"""By Aravis' id, what still talks to a camera that this process has left: whoever opens it again waits for that."""
FRAME_ID_BITS = 16
"""GigE Vision 1 counts frames from 1 to 65535 and starts over at 1."""


class GenicamCamera(OpenedByContext):
    """One grey camera, Mono8. `serial` or `address` (both, to be sure) choose it."""

    def __init__(
        self,
        name: str = "mono0",
        serial: str | None = None,
        address: str | None = None,
        settings: GenicamSettings | None = None,
    ) -> None:
        self.name = name
        self._serial, self._address = serial, address
        self._settings = settings or GenicamSettings()
        self._aravis: Aravis | None = None
        self._camera: int | None = None
        self._grabber: _Grabber | None = None
        self._keep: Any = None
        self._found: Found | None = None
        self._granted: dict[str, Any] = {}
        self._warnings: list[str] = []
        self._inbox: Inbox[Image] = Inbox(self._settings.buffers)
        self._lock = threading.RLock()
        self._counts: tuple[dict[str, int], dict[str, int]] = ({}, {})

    def open(self) -> None:
        """Find it and apply the settings. Raises DeviceNotFound (with what was found) or DeviceRefused."""
        self.close()
        self._aravis = Aravis.get()
        self._found = self._choose(self._aravis.found())
        self._camera = self._take_control(self._aravis, self._found)
        self._inbox = Inbox(self._settings.buffers)
        self._warnings = []
        inbox, what = self._inbox, f"{self.name}: {self._found}"
        self._keep = self._aravis.on_lost(self._camera, lambda: inbox.lose(f"{what} no longer answers; replug, reopen"))
        try:
            self._aravis.call("arv_camera_stop_acquisition", self._camera)  # what a program that died had started
            self._granted = apply(self._aravis, self._camera, self._settings, self._warnings)
        except AravisError as error:
            self.close()
            raise DeviceRefused(f"{what} refuses its settings: {error}") from error
        except DeviceRefused:
            self.close()
            raise

    def _take_control(self, aravis: Aravis, found: Found) -> int:
        """Aravis' camera, obeying us. One whose last program has died obeys nobody until its heartbeat runs out."""
        if (left := _LEAVING.get(found.id)) is not None:
            left.join(HEARTBEAT_S)
        until = time.monotonic() + HEARTBEAT_S
        while True:
            try:
                camera: int = aravis.call("arv_camera_new", found.id)
            except AravisError as error:
                raise DeviceNotFound(f"{self.name}: {found} does not open: {error}") from error
            if aravis.controls(camera):
                return camera
            aravis.call("g_object_unref", camera)
            if time.monotonic() > until:
                raise DeviceRefused(f"{self.name}: {found} is controlled by another program; close that one first")
            time.sleep(LOOK_S)

    def start(self) -> None:
        camera = self._opened()
        assert self._aravis is not None
        with self._lock:
            if self._grabber is None:
                self._inbox.clear()
                self._grabber = _Grabber(self._aravis, camera, self.name, self._settings, self._granted, self._inbox)

    def stop(self) -> None:
        with self._lock:
            grabber, self._grabber = self._grabber, None
        if grabber is not None:
            grabber.stop()
            self._counts = grabber.counts()
            self._leave(grabber.release)

    def close(self) -> None:
        self.stop()
        with self._lock:
            camera, self._camera = self._camera, None
        if camera is not None and self._aravis is not None:
            aravis = self._aravis
            self._leave(lambda: aravis.call("g_object_unref", camera))

    def read(self, timeout_s: float) -> Image | None:
        return self._inbox.take(timeout_s)

    def trigger(self) -> None:
        camera = self._opened()
        if self._settings.trigger != "software":
            raise DeviceRefused(
                f"{self.name} has trigger '{self._settings.trigger}'; set trigger = \"software\" in the rig to do this"
            )
        if self._inbox.lost is not None:
            raise DeviceLost(self._inbox.lost)
        assert self._aravis is not None
        self._aravis.call("arv_camera_software_trigger", camera)

    def describe(self) -> dict[str, Any]:
        assert self._found is not None, "describe() comes after open()"
        return {
            "kind": "mono",
            "model": f"{self._found.vendor} {self._found.model}",
            "serial": self._found.serial,
            "firmware": self._granted.get("firmware", ""),
            "driver": "Aravis 0.8",
            "address": self._found.address,
            "protocol": self._found.protocol,
            "rate_hz": self._granted.get("rate_hz"),
            "settings": asdict(self._settings) | self._granted,
            "warnings": list(self._warnings),
        }

    def health(self) -> Health:
        received, dropped = self._grabber.counts() if self._grabber else self._counts
        lost = sum(dropped.values())
        if self._inbox.lost is not None:
            return Health("error", self._inbox.lost, received, dropped)
        return Health("warning" if lost else "ok", f"{lost} frames lost" if lost else "", received, dropped)

    def _leave(self, act: Callable[[], Any]) -> None:
        """Do what talks to the camera once more, but do not wait: a camera that is gone takes Aravis 5 s to give up."""
        assert self._found is not None
        before = _LEAVING.get(self._found.id)

        def run() -> None:
            if before is not None:
                before.join()
            act()

        leaving = _LEAVING[self._found.id] = threading.Thread(target=run, daemon=True)
        leaving.start()
        leaving.join(LEAVE_S)

    def _opened(self) -> int:
        if self._camera is None:
            raise DeviceRefused(f"{self.name} is not open; call open() first")
        return self._camera

    def _choose(self, found: list[Found]) -> Found:
        fits = [
            device
            for device in found
            if self._serial in (None, device.serial) and self._address in (None, device.address)
        ]
        if len(fits) == 1:
            return fits[0]
        wanted = " and ".join(
            f"{key} {value}" for key, value in (("serial", self._serial), ("address", self._address)) if value
        )
        seen = "; ".join(str(device) for device in found) or "no camera at all"
        if fits:
            raise DeviceNotFound(f"{self.name}: found {seen}; wanted one: name its `serial` in the rig")
        raise DeviceNotFound(
            f"{self.name}: found {seen}; wanted {wanted or 'a camera'}{usb.hint(usb.GREY_CAMERAS)}; check the cable "
            "and the serial in the rig"
        )


class _Grabber:
    """The thread that takes finished buffers from Aravis, copies the image and gives the buffer back."""

    def __init__(
        self,
        aravis: Aravis,
        camera: int,
        name: str,
        settings: GenicamSettings,
        granted: dict[str, Any],
        inbox: Inbox[Image],
    ) -> None:
        self._aravis, self._camera, self._name, self._inbox = aravis, camera, name, inbox
        self._marks, self._granted = settings.timestamp_marks, granted
        self._received = self._incomplete = self._gaps = 0
        self._overflowed_before = inbox.overflowed
        self._number: int | None = None
        self._ending = threading.Event()
        self._stream = aravis.call("arv_camera_create_stream", camera, None, None)
        payload = aravis.call("arv_camera_get_payload", camera)
        for _ in range(settings.buffers):
            aravis.call("arv_stream_push_buffer", self._stream, aravis.call("arv_buffer_new_allocate", payload))
        self._chunks = aravis.call("arv_camera_create_chunk_parser", camera) if granted["chunks"] else None
        aravis.call("arv_camera_start_acquisition", camera)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Take no more images."""
        self._ending.set()
        self._thread.join(1.0)

    def release(self) -> None:
        """Tell the camera to stop, and free the buffers. Slow where the camera is gone."""
        if self._inbox.lost is None:
            try:
                self._aravis.call("arv_camera_stop_acquisition", self._camera)
            except AravisError as error:  # it went away in this very moment
                self._inbox.lose(f"{self._name} did not stop: {error}; replug, reopen")
        for held in (self._chunks, self._stream):
            if held:
                self._aravis.call("g_object_unref", held)

    def counts(self) -> tuple[dict[str, int], dict[str, int]]:
        """Images received whole; images lost as incomplete, in gaps of the frame number, or for want of a reader."""
        dropped = {
            f"{self._name}:incomplete": self._incomplete,
            f"{self._name}:gap": max(0, self._gaps - self._incomplete),  # incomplete ones leave a gap too
            f"{self._name}:overflow": self._inbox.overflowed - self._overflowed_before,
        }
        return {self._name: self._received}, {key: count for key, count in dropped.items() if count}

    def _run(self) -> None:
        while not self._ending.is_set():
            buffer = self._aravis.call("arv_stream_timeout_pop_buffer", self._stream, POP_US)
            if buffer is None:
                continue
            host_ns = time.monotonic_ns()
            try:
                self._take(buffer, host_ns)
            finally:
                self._aravis.call("arv_stream_push_buffer", self._stream, buffer)

    def _take(self, buffer: int, host_ns: int) -> None:
        status = STATUS.get(self._aravis.call("arv_buffer_get_status", buffer), "unknown")
        if status in ("cleared", "aborted"):
            return
        if status != "success":
            self._incomplete += 1  # its number may be another frame's: the leader can be what is missing
            return
        number = self._unwrapped(self._aravis.call("arv_buffer_get_frame_id", buffer))
        self._received += 1
        stamp_ns, exposure_s, gain = self._measured(buffer)
        stamp = Stamp(f"{self._name}/camera", stamp_ns, instant=self._marks)
        self._inbox.put(Image("mono", number, stamp, host_ns, self._pixels(buffer), exposure_s, gain))

    def _unwrapped(self, frame_id: int) -> int:
        """The frame number without the 16-bit counter's restarts; gaps are counted."""
        if self._number is None:
            self._number = frame_id
            return frame_id
        period = (1 << FRAME_ID_BITS) - 1
        step = frame_id - self._number if frame_id > 1 << FRAME_ID_BITS else (frame_id - self._number) % period
        if step > period // 2:  # out of order: what looked like a gap came late, whole or not
            self._gaps = max(0, self._gaps - 1)
            return self._number + step - period
        self._gaps += max(0, step - 1)
        self._number += step
        return self._number

    def _measured(self, buffer: int) -> tuple[int, float, float]:
        """Stamp in ns, exposure in s and gain: of the image itself where it carries them."""
        stamp_ns = self._aravis.call("arv_buffer_get_timestamp", buffer)
        exposure_s, gain = self._granted["exposure_s"], math.nan
        if self._chunks and self._aravis.call("arv_buffer_has_chunks", buffer):
            chunk = (self._chunks, buffer)
            stamp_ns = self._aravis.call("arv_chunk_parser_get_integer_value", *chunk, "ChunkTimestamp")
            exposure_s = self._aravis.call("arv_chunk_parser_get_float_value", *chunk, "ChunkExposureTime") * 1e-6
            gain = self._aravis.call("arv_chunk_parser_get_float_value", *chunk, "ChunkGain")
        return stamp_ns, exposure_s, gain

    def _pixels(self, buffer: int) -> UInt8[Array, "h w"]:
        width = self._aravis.call("arv_buffer_get_image_width", buffer)
        height = self._aravis.call("arv_buffer_get_image_height", buffer)
        size = ctypes.c_size_t()
        address = self._aravis.call("arv_buffer_get_data", buffer, ctypes.byref(size))
        data = (ctypes.c_uint8 * (width * height)).from_address(address)
        return np.frombuffer(data, dtype=np.uint8).reshape(height, width).copy()
