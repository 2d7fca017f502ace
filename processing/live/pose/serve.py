"""Live poses to whoever listens: JSON lines on a loopback socket, and `/live/pose` in an MCAP file.

A client connects to 127.0.0.1 at the port in results/live/pose.json and reads lines until it has enough; it sends
nothing. One line a frame (docs/live_pose.md). A client that does not read in time is disconnected: nobody waits for it.
"""

from __future__ import annotations

import contextlib
import json
import socket
from pathlib import Path

import numpy as np

from processing.live.pose.front import LivePose
from recordings.mcap.toss_writer import TossWriter
from recordings.records import StampedPose
from recordings.tracks import RigCalibration
from recordings.whole_file import write_json

LOOPBACK = "127.0.0.1"
TOPIC = "/live/pose"
BUFFER_BYTES = 1 << 16
FORMAT = 1


class PoseServer:
    """Listens on a port of its own. As a context."""

    def __init__(self, about: Path) -> None:
        self._about = about
        self._listening = socket.create_server((LOOPBACK, 0))
        self._listening.setblocking(False)
        self._clients: list[socket.socket] = []
        self.port = int(self._listening.getsockname()[1])

    def __enter__(self) -> PoseServer:
        write_json(self._about, {"format": FORMAT, "host": LOOPBACK, "port": self.port, "topic": TOPIC})
        return self

    def __exit__(self, *exc: object) -> None:
        for client in self._clients:
            client.close()
        self._listening.close()
        self._about.unlink(missing_ok=True)

    def send(self, line: str) -> int:
        """To every client that keeps up; how many did."""
        with contextlib.suppress(BlockingIOError):
            while True:
                client, _ = self._listening.accept()
                client.setblocking(False)
                client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
                self._clients.append(client)
        data, kept = line.encode() + b"\n", []
        for client in self._clients:
            try:
                whole = client.send(data) == len(data)
            except OSError:
                whole = False
            if whole:
                kept.append(client)
            else:
                client.close()
        self._clients = kept
        return len(kept)


def pose_line(pose: LivePose, camera: str, latency_ms: float) -> str:
    """One JSON object: what docs/live_pose.md says."""
    other = pose.other
    return json.dumps(
        {
            "frame": pose.frame,
            "time_ns": pose.time_ns,
            "frame_id": camera,
            "status": pose.status,
            "position_m": None if pose.camera_from_object is None else pose.camera_from_object[:3, 3].tolist(),
            "rotation": None if pose.camera_from_object is None else pose.camera_from_object[:3, :3].tolist(),
            "covariance": pose.covariance.tolist() if np.isfinite(pose.covariance).all() else None,
            "cost": pose.cost if np.isfinite(pose.cost) else None,
            "other_rotation": None if other is None else other[:3, :3].tolist(),
            "latency_ms": round(latency_ms, 2),
        }
    )


class PoseFile:
    """`/live/pose` (foxglove.PoseInFrame) and `/live/pose_quality`, as `/track/pose` has them. As a context."""

    def __init__(self, path: Path, calibration: RigCalibration, camera: str) -> None:
        path.unlink(missing_ok=True)
        self._writer = TossWriter(path, {}, calibration, "live pose", {})
        self._camera = camera
        self._count = 0

    def __enter__(self) -> PoseFile:
        return self

    def __exit__(self, *exc: object) -> None:
        self._writer.__exit__(None, None, None)

    def write(self, pose: LivePose) -> None:
        """A lost frame has no pose."""
        if pose.camera_from_object is None:
            return
        stamped = StampedPose(
            pose.time_ns, self._camera, "object", pose.camera_from_object, pose.status, pose.covariance
        )
        self._writer.pose(TOPIC, stamped, self._count)
        self._count += 1
