"""A GigE Vision camera of our own, for what Aravis' fake lacks: chunk data, trigger lines, and faults.

    with own_network(["127.0.0.1"]), GigeCamera("127.0.0.1", "SIM1") as camera:
        camera.pulse()                      # a rising edge on Line0
        camera.inject("lost_trigger", for_s=1.0)

GVCP (control, port 3956) and GVSP (images) over UDP. Its clock starts at `clock_ns` and counts nanoseconds. Chunk
timestamps mark the exposure's start; the leader's is `readout_s` after its end, as on cameras that stamp the transfer.
"""

from __future__ import annotations

import queue
import random
import socket
import struct
import threading
import time
from typing import Any

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray as Array

from acquisition.simulators import gige_xml as registers
from acquisition.simulators.faults import Faults, Faulty
from acquisition.simulators.sockets import loopback

FAULTS = {
    "lost_trigger": "triggers are not seen: no image, no number",
    "frozen": "the same picture under new numbers",
    "gap": "images are made and never sent: numbers jump",
    "lost_packets": "each packet of an image is lost with probability share=0.02",
    "clock_step": "the camera's clock jumps by by_s=1",
    "unplug": "nothing is answered, nothing is sent",
}
GVCP_PORT = 3956
DISCOVERY, READ_REGISTER, WRITE_REGISTER, READ_MEMORY, WRITE_MEMORY = 0x02, 0x80, 0x82, 0x84, 0x86
STREAM_PORT, STREAM_PACKET, STREAM_HOST = 0x0D00, 0x0D04, 0x0D18
CONTROL_PRIVILEGE, HEARTBEAT_MS = 0x0A00, 0x0938
LEADER, TRAILER, PAYLOAD = 1, 2, 3
IMAGE, IMAGE_WITH_CHUNKS = 0x0001, 0x4001
OVERHEAD = 36


class GigeCamera(Faulty):
    """One camera at a loopback address, until closed. Made inside the network that it is to be found in."""

    def __init__(self, address: str, serial: str, clock_ns: int = 0, readout_s: float = 0.005) -> None:
        self._address, self._faults, self._random = loopback(address), Faults(FAULTS), random.Random(serial)
        self._memory = bytearray(registers.XML_ADDRESS) + bytearray(registers.description())
        self._clock_ns = clock_ns - time.monotonic_ns()
        self._readout_ns = round(readout_s * 1e9)
        self._counts = {"triggers": 0, "images": 0, "sent": 0}
        self._number = 0
        self._closed = threading.Event()
        self._triggers: queue.Queue[int] = queue.Queue()
        self._describe(serial)
        self._own = self._bound(address)
        self._controls = [self._own, self._bound("255.255.255.255"), self._bound("127.255.255.255")]
        self._images = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._images.bind((address, 0))
        threads = [threading.Thread(target=self._control, args=(s,), daemon=True) for s in self._controls]
        threads.append(threading.Thread(target=self._expose, daemon=True))
        for thread in threads:
            thread.start()
        self._threads = threads

    def pulse(self) -> None:
        """A rising edge on Line0."""
        if self._get(registers.TRIGGER_SOURCE) == registers.LINE0:
            self._trigger()

    def snapshot(self) -> dict[str, Any]:
        strobe = self._get(registers.LINE_MODE) == 1 and self._get(registers.LINE_SOURCE) == 1
        return dict(self._counts) | {"strobe_line": self._get(registers.LINE_SELECTOR) if strobe else None}

    def close(self) -> None:
        self._closed.set()
        for thread in self._threads:
            thread.join(0.5)
        for open_socket in (*self._controls, self._images):
            open_socket.close()

    # --- registers ---------------------------------------------------------------------------------------------

    def _describe(self, serial: str) -> None:
        self._put_text(0x48, "tosslab")
        self._put_text(0x68, "SimCam")
        self._put_text(0x88, "1.0")
        self._put_text(0xD8, serial)
        xml = len(self._memory) - registers.XML_ADDRESS
        self._put_text(0x200, f"Local:simcam.xml;{registers.XML_ADDRESS:x};{xml:x}")
        self._set(0x00, 0x00010002)
        self._set(0x04, 0x80000000)  # big-endian, UTF-8
        self._memory[0x0A:0x10] = b"\x02\x00" + socket.inet_aton(self._address)  # a MAC address of its own
        self._memory[0x24:0x28] = socket.inet_aton(self._address)
        self._memory[0x34:0x38] = socket.inet_aton("255.0.0.0")
        self._set(0x904, 1)
        self._set(0x934, 1 << 30 | 1 << 1)
        self._set(HEARTBEAT_MS, 3000)
        self._set(0x0940, 1_000_000_000)
        self._set(STREAM_PACKET, 1400)
        self._set(registers.WIDTH, 640)
        self._set(registers.HEIGHT, 480)
        self._set(registers.PIXEL_FORMAT, registers.MONO8)
        for address, value in ((registers.FRAME_RATE, 30.0), (registers.EXPOSURE_US, 1000.0), (registers.GAIN, 0.0)):
            struct.pack_into(">d", self._memory, address, value)
        self._size_payload()

    def _put_text(self, address: int, text: str) -> None:
        self._memory[address : address + len(text)] = text.encode()

    def _get(self, address: int) -> int:
        return int(struct.unpack_from(">I", self._memory, address)[0])

    def _set(self, address: int, value: int) -> None:
        struct.pack_into(">I", self._memory, address, value)

    def _get_float(self, address: int) -> float:
        return float(struct.unpack_from(">d", self._memory, address)[0])

    def _size_payload(self) -> None:
        chunks = 4 * 8 + 3 * 8 if self._get(registers.CHUNK_MODE) else 0
        self._set(registers.PAYLOAD_SIZE, self._get(registers.WIDTH) * self._get(registers.HEIGHT) + chunks)

    # --- control -----------------------------------------------------------------------------------------------

    def _bound(self, address: str) -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        made.bind((address, GVCP_PORT))
        made.settimeout(0.1)
        return made

    def _control(self, listening: socket.socket) -> None:
        while not self._closed.is_set():
            try:
                data, client = listening.recvfrom(2048)
            except TimeoutError:
                continue
            except OSError:
                return
            if self._faults.active("unplug") or len(data) < 8 or data[0] != 0x42:
                continue
            command, _, packet = struct.unpack(">HHH", data[2:8])
            answer = self._answer(command, data[8:])
            if answer is not None:
                # always from the camera's own address, also where the question was a broadcast
                self._own.sendto(struct.pack(">BBHHH", 0, 0, command + 1, len(answer), packet) + answer, client)

    def _answer(self, command: int, data: bytes) -> bytes | None:
        if command == DISCOVERY:
            return bytes(self._memory[:0xF8])
        if command == READ_REGISTER:
            addresses = struct.unpack(f">{len(data) // 4}I", data)
            return b"".join(self._memory[a : a + 4] for a in addresses)
        if command == READ_MEMORY:
            address, _, count = struct.unpack(">IHH", data[:8])
            return data[:4] + bytes(self._memory[address : address + count])
        if command == WRITE_REGISTER:
            for address, value in struct.iter_unpack(">II", data):
                self._write(address, struct.pack(">I", value))
            return struct.pack(">HH", 0, len(data) // 8)
        if command == WRITE_MEMORY:
            address = struct.unpack(">I", data[:4])[0]
            self._write(address, data[4:])
            return struct.pack(">HH", 0, len(data) - 4)
        return None

    def _write(self, address: int, data: bytes) -> None:
        self._memory[address : address + len(data)] = data
        if address == registers.TRIGGER_SOFTWARE and self._get(registers.TRIGGER_SOURCE) == registers.SOFTWARE:
            self._trigger()
        elif address in (registers.WIDTH, registers.HEIGHT, registers.CHUNK_MODE):
            self._size_payload()
        elif address == registers.ACQUISITION and self._get(address):
            self._number = 0

    # --- images ------------------------------------------------------------------------------------------------

    def _now_ns(self) -> int:
        step = self._faults.active("clock_step")
        return time.monotonic_ns() + self._clock_ns + (round(step.number("by_s", 1.0) * 1e9) if step else 0)

    def _trigger(self) -> None:
        self._counts["triggers"] += 1
        if self._get(registers.TRIGGER_MODE) == 1 and not self._faults.active("lost_trigger"):
            self._triggers.put(self._now_ns())

    def _expose(self) -> None:
        due = time.monotonic()
        while not self._closed.is_set():
            if self._running() and self._get(registers.TRIGGER_MODE) == 0:
                due = max(due + 1 / self._get_float(registers.FRAME_RATE), time.monotonic())
                time.sleep(max(0.0, due - time.monotonic()))
                self._send_image(self._now_ns())
                continue
            try:
                at_ns = self._triggers.get(timeout=0.05)
            except queue.Empty:
                continue
            if self._running():
                self._send_image(at_ns)

    def _running(self) -> bool:
        return self._get(registers.ACQUISITION) == 1 and self._get(CONTROL_PRIVILEGE) != 0

    def _send_image(self, at_ns: int) -> None:
        self._number = self._number % 0xFFFF + 1
        self._counts["images"] += 1
        if self._faults.active("gap") or self._faults.active("unplug"):
            return
        pixels = self._picture()
        with_chunks = self._get(registers.CHUNK_MODE) == 1
        data = pixels.tobytes() + (self._chunks(at_ns, pixels.size) if with_chunks else b"")
        height, width = pixels.shape
        sent_ns = at_ns + round(self._get_float(registers.EXPOSURE_US) * 1e3) + self._readout_ns
        kind = IMAGE_WITH_CHUNKS if with_chunks else IMAGE
        leader = struct.pack(">HHQ5IHH", 0, kind, sent_ns, registers.MONO8, width, height, 0, 0, 0, 0)
        block = (self._get(STREAM_PACKET) & 0xFFFF) - OVERHEAD
        parts = [data[i : i + block] for i in range(0, len(data), block)]
        self._packet(LEADER, 0, leader)
        for place, part in enumerate(parts, 1):
            self._packet(PAYLOAD, place, part)
        self._packet(TRAILER, len(parts) + 1, struct.pack(">II", kind, height))
        self._counts["sent"] += 1

    def _picture(self) -> UInt8[Array, "h w"]:
        """A ramp that moves with the image's number."""
        shift = 0 if self._faults.active("frozen") else self._number
        columns = np.arange(self._get(registers.WIDTH)) + shift
        return np.broadcast_to(columns.astype(np.uint8), (self._get(registers.HEIGHT), len(columns)))

    def _chunks(self, at_ns: int, image_size: int) -> bytes:
        values = (
            struct.pack(">II", registers.CHUNK_IMAGE, image_size),
            struct.pack(">QII", at_ns, registers.CHUNK_TIMESTAMP, 8),
            struct.pack(">dII", self._get_float(registers.EXPOSURE_US), registers.CHUNK_EXPOSURE, 8),
            struct.pack(">dII", self._get_float(registers.GAIN), registers.CHUNK_GAIN, 8),
        )
        return b"".join(values)

    def _packet(self, content: int, place: int, data: bytes) -> None:
        lossy = self._faults.active("lost_packets")
        if lossy is not None and self._random.random() < lossy.number("share", 0.02):
            return
        client = (socket.inet_ntoa(self._memory[STREAM_HOST : STREAM_HOST + 4]), self._get(STREAM_PORT) & 0xFFFF)
        self._images.sendto(struct.pack(">HHI", 0, self._number, content << 24 | place) + data, client)
