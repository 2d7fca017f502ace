"""A network of one's own: a loopback interface with several addresses, which nothing outside can reach or see.

GigE Vision finds its cameras by broadcasting, and each simulated one needs an address that the interface really has:
both belong into a network namespace (Linux, root or an unprivileged user namespace).
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import socket
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from acquisition.simulators.sockets import loopback
from recordings.errors import TosslabError

CLONE_NEWNET = 0x40000000
SIOCSIFFLAGS, SIOCSIFADDR = 0x8914, 0x8916
IFF_UP = 1


class NotPermitted(TosslabError):
    """This process may not make a network namespace."""


@contextmanager
def own_network(addresses: Sequence[str] = ("127.0.0.1",)) -> Iterator[None]:
    """Inside, this thread, and every thread and process it starts, lives in a new network with these addresses.

    Raises NotPermitted where the kernel says no (as another user than root, run under `unshare -rn`).
    """
    libc = ctypes.CDLL(None, use_errno=True)
    before = os.open("/proc/self/ns/net", os.O_RDONLY)
    try:
        if libc.unshare(CLONE_NEWNET) != 0:
            raise NotPermitted(f"no new network namespace: {os.strerror(ctypes.get_errno())}")
        try:
            _bring_up(addresses)
            yield
        finally:
            if libc.setns(before, CLONE_NEWNET) != 0:
                raise NotPermitted(f"no way back to the old network: {os.strerror(ctypes.get_errno())}")
    finally:
        os.close(before)


def _bring_up(addresses: Sequence[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        request = struct.pack("16sh", b"lo", IFF_UP)
        fcntl.ioctl(control, SIOCSIFFLAGS, request)
        for number, address in enumerate(addresses[1:], 1):
            label = f"lo:{number}".encode()
            place = struct.pack("HH4s8x", socket.AF_INET, 0, socket.inet_aton(loopback(address)))
            fcntl.ioctl(control, SIOCSIFADDR, struct.pack("16s16s", label, place))
