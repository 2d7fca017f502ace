"""Aravis' own GigE Vision camera, as a process: it streams a moving ramp over the real protocol.

    with own_network(["127.0.0.1", "127.0.0.2"]):
        with FakeGvCamera("127.0.0.2", "GV02", lost_per_mille=5): ...

Debian: aravis-tools. It knows neither lines nor chunk data (acquisition.simulators.gige_camera does).
"""

from __future__ import annotations

import shutil
import subprocess
import time

from acquisition.simulators.sockets import loopback
from recordings.errors import DeviceNotFound

PROGRAM = "arv-fake-gv-camera-0.8"
STARTUP_S = 0.3


class FakeGvCamera:
    """One camera, until closed. `lost_per_mille` of its packets never arrive."""

    def __init__(self, address: str, serial: str, lost_per_mille: int = 0) -> None:
        host, program = loopback(address), shutil.which(PROGRAM)
        if program is None:
            raise DeviceNotFound(
                f"no {PROGRAM}; as root, run `apt-get install -y --no-install-recommends aravis-tools`"
            )
        command = [program, "-i", host, "-s", serial, "-r", str(lost_per_mille)]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(STARTUP_S)

    def __enter__(self) -> FakeGvCamera:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Pull the plug."""
        self._process.kill()
        self._process.wait()
