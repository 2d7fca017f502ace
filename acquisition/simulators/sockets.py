"""What the simulators' sockets share: loopback only, whole messages, threads that end."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable

from recordings.errors import BadInput

ACCEPT_S = 0.1


def loopback(host: str) -> str:
    """The address itself; BadInput for one that other machines could reach."""
    if not host.startswith("127."):
        raise BadInput(f"a simulator listens on loopback only, found host '{host}'; wanted 127.x.x.x")
    return host


def receive(connection: socket.socket, count: int) -> bytes:
    """Exactly `count` bytes. Raises ConnectionError when the other side is gone."""
    parts = bytearray()
    while len(parts) < count:
        part = connection.recv(count - len(parts))
        if not part:
            raise ConnectionError("closed by the other side")
        parts += part
    return bytes(parts)


class Listener:
    """Accepts connections on host:port, each served in a thread of its own, until closed.

    While `refusing()` is true, new connections are closed at once; `drop` cuts those that are open.
    """

    def __init__(
        self,
        host: str,
        port: int,
        serve: Callable[[socket.socket], None],
        refusing: Callable[[], object] = lambda: False,
    ) -> None:
        self._serve, self._refusing = serve, refusing
        self._open: set[socket.socket] = set()
        self._closed = threading.Event()
        self._socket = socket.create_server((loopback(host), port))
        self._socket.settimeout(ACCEPT_S)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def drop(self) -> None:
        for connection in tuple(self._open):
            try:
                connection.shutdown(socket.SHUT_RDWR)
            except OSError:  # already gone
                pass

    def close(self) -> None:
        self._closed.set()
        self._thread.join(1.0)
        self._socket.close()
        self.drop()

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                connection, _ = self._socket.accept()
            except TimeoutError:
                continue
            except OSError:
                return
            connection.settimeout(None)
            if self._refusing():
                connection.close()
                continue
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=self._guard, args=(connection,), daemon=True).start()

    def _guard(self, connection: socket.socket) -> None:
        self._open.add(connection)
        try:
            self._serve(connection)
        except OSError:  # the client left, or the connection was dropped
            pass
        finally:
            self._open.discard(connection)
            connection.close()


class Pacer:
    """Calls at a steady rate. A late caller stretches time instead of bursting."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._next = time.monotonic()

    def wait(self) -> float:
        """Sleep until the next call is due; by how many seconds time was stretched."""
        self._next += self._period_s
        now = time.monotonic()
        earliest = now + 0.5 * self._period_s  # the other side always has half a period to answer
        stretched_s = max(0.0, earliest - self._next)
        self._next += stretched_s
        time.sleep(self._next - now)
        return stretched_s
