"""The devices that the drivers' tests talk to: simulators on loopback, recordings made on the spot."""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from acquisition.simulators.child_process import ChildProcess
from acquisition.simulators.gige import PROGRAM
from acquisition.simulators.network import NotPermitted, own_network
from recordings.records import ArmStates
from recordings.session_writer import SessionWriter

_COUNT = itertools.count(1)


def host() -> str:
    """A loopback address that no other test run on this machine uses: libfranka's and RTDE's ports are fixed."""
    return f"127.{20 + os.getpid() % 200}.{os.getpid() // 200 % 250}.{next(_COUNT)}"


@pytest.fixture(scope="module")
def fci() -> Iterator[tuple[str, ChildProcess]]:
    """A Panda with its gripper: (address, simulator)."""
    pytest.importorskip("panda_py", reason="panda-python is not installed (rig-franka)")
    address = host()
    with ChildProcess("fci", host=address) as simulator:
        yield address, simulator


@pytest.fixture(scope="module")
def rtde() -> Iterator[tuple[str, ChildProcess]]:
    """A UR5e controller: (address, simulator)."""
    pytest.importorskip("rtde_control", reason="ur-rtde is not installed (rig-ur)")
    address = host()
    with ChildProcess("rtde", host=address) as simulator:
        yield address, simulator


ADDRESSES = [f"127.0.0.{i}" for i in range(1, 5)]


@contextmanager
def _network(needs: str | None) -> Iterator[list[str]]:
    """A network namespace with these addresses, for GigE Vision's broadcasts; skips where it cannot be had."""
    if needs is not None and shutil.which(needs) is None:
        pytest.skip(f"no {needs}: apt-get install aravis-tools")
    with ExitStack() as stack:
        try:
            stack.enter_context(own_network(ADDRESSES))
        except NotPermitted as refused:
            pytest.skip(f"GigE Vision needs a network namespace: {refused}")
        yield ADDRESSES


@pytest.fixture(scope="session")
def aravis_network() -> Callable[[], AbstractContextManager[list[str]]]:
    """`with aravis_network() as addresses:` a network for simulated GigE cameras, where Aravis' fake is installed."""
    return lambda: _network(PROGRAM)


@pytest.fixture(scope="module")
def loopback_network() -> Iterator[list[str]]:
    """Four loopback addresses in a network of this test module's own."""
    with _network(None) as addresses:
        yield addresses


@pytest.fixture(scope="module")
def aravis(loopback_network: list[str]) -> list[str]:
    """The same, where Aravis' fake camera is installed."""
    if shutil.which(PROGRAM) is None:
        pytest.skip(f"no {PROGRAM}: apt-get install aravis-tools")
    return loopback_network


@pytest.fixture(scope="session")
def db3(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """`db3(name, **kind)` is a recording of a software D455 (see plain_frames), made once."""
    pytest.importorskip("pyrealsense2", reason="pyrealsense2 is not installed (rig-realsense)")
    from acquisition.simulators.realsense_db3 import plain_frames, write_db3

    folder = tmp_path_factory.mktemp("db3")

    def make(name: str, leave_out: range = range(0), count: int = 20, **kind: object) -> Path:
        path = folder / f"{name}.db3"
        if not path.exists():
            frames = list(plain_frames(count, **kind))  # type: ignore[arg-type]
            write_db3(path, [frame for k, frame in enumerate(frames) if k not in leave_out])
        return path

    return make


@pytest.fixture
def free_host() -> str:
    """A loopback address where nobody listens."""
    return host()


@pytest.fixture(scope="session")
def shipped_session() -> Path:
    """The session that the repository ships."""
    import recordings

    return Path(recordings.__file__).parent / "samples" / "box_toss"


@pytest.fixture(scope="session")
def arm_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a minute of an arm that sways, its fingers opening and closing."""
    folder = tmp_path_factory.mktemp("arm") / "session"
    time_s = np.arange(0, 30, 0.01)
    q = np.sin(time_s)[:, None] * np.linspace(0.1, 0.4, 7)
    width_m = 0.04 + 0.03 * np.sin(2 * time_s)
    states = ArmStates(
        np.rint(1e9 * (1 + time_s)).astype(np.int64),
        tuple(f"panda_joint{k}" for k in range(1, 8)),
        q,
        np.gradient(q, time_s, axis=0),
        width_m,
    )
    with SessionWriter(folder, {"rig": {"arm": "franka_panda"}}) as session:
        with session.toss(0) as toss:
            toss.arm(states)
        session.finish()
    return folder
