"""What every driver promises (acquisition/devices.py), on every backend: the very same tests."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any

import pytest

from acquisition.devices import Arm, ArmSamples, DeviceLost, DeviceRefused, Gripper, MonoCamera, RgbdCamera, RgbdCapture
from recordings.errors import DeviceNotFound

PATIENCE_S = 5.0
SLACK_S = 0.1
"""A read may take this long beyond its timeout, in the time that this process had (conftest.OwnTime)."""


@dataclass
class Backend:
    """How to get a driver of this backend, and how to trouble its device."""

    make: Callable[..., Any]
    """Keyword `serial` reaches the driver."""
    protocol: Any
    lossy: Callable[[], tuple[Any, Callable[[], None]]]
    """A driver (not opened), and what makes its device lose something once it streams."""
    unplug: Callable[[], None]
    """Takes the device away, for the rest of the test."""
    items: int = 8


@contextmanager
def d455(ask: Callable[[str], Any]) -> Iterator[Backend]:
    from acquisition.drivers.d455 import D455Camera

    db3 = ask("db3")
    whole, gap = db3("plain"), db3("gap", leave_out=range(8, 11))
    yield Backend(
        make=lambda **given: D455Camera(file=whole, **given),
        protocol=RgbdCamera,
        lossy=lambda: (D455Camera(file=gap), lambda: None),
        unplug=lambda: None,  # the recording ends by itself
    )


@contextmanager
def genicam(ask: Callable[[str], Any]) -> Iterator[Backend]:
    from acquisition.drivers.genicam import GenicamCamera, GenicamSettings
    from acquisition.simulators.gige import FakeGvCamera

    settings = GenicamSettings(width=320, height=240, rate_hz=50.0, packet_bytes=1400)
    with (
        ask("aravis_network")() as addresses,
        FakeGvCamera(addresses[0], "GV01") as whole,
        FakeGvCamera(addresses[1], "GV02", lost_per_mille=20),
    ):
        yield Backend(
            make=lambda serial="GV01": GenicamCamera(serial=serial, settings=settings),
            protocol=MonoCamera,
            lossy=lambda: (GenicamCamera(serial="GV02", settings=settings), lambda: None),
            unplug=whole.close,
        )


@contextmanager
def franka(ask: Callable[[str], Any]) -> Iterator[Backend]:
    from acquisition.drivers.franka import FrankaArm

    address, simulator = ask("fci")

    def lossy() -> tuple[FrankaArm, Callable[[], None]]:
        return FrankaArm(host=address), lambda: simulator.inject("lost_packets", share=0.1)

    yield Backend(lambda **given: FrankaArm(host=address, **given), Arm, lossy, lambda: simulator.inject("unplug"))
    simulator.clear("unplug")
    simulator.clear("lost_packets")


@contextmanager
def franka_hand(ask: Callable[[str], Any]) -> Iterator[Backend]:
    from acquisition.drivers.franka_hand import FrankaHand

    address, simulator = ask("fci")

    def lossy() -> tuple[FrankaHand, Callable[[], None]]:
        return FrankaHand(host=address), lambda: simulator.inject("gripper_freeze", at_s=0.2, for_s=0.4)

    yield Backend(
        lambda **given: FrankaHand(host=address, **given), Gripper, lossy, lambda: simulator.inject("gripper_unplug")
    )
    simulator.clear("gripper_unplug")


@contextmanager
def ur(ask: Callable[[str], Any]) -> Iterator[Backend]:
    from acquisition.drivers.ur import UrArm

    address, simulator = ask("rtde")

    def lossy() -> tuple[UrArm, Callable[[], None]]:
        return UrArm(host=address), lambda: simulator.inject("freeze", at_s=0.1, for_s=0.2)

    yield Backend(lambda **given: UrArm(host=address, **given), Arm, lossy, lambda: simulator.inject("unplug"))
    simulator.clear("unplug")


@contextmanager
def synthetic(name: str, kind: str, protocol: Any, rate_hz: float = 30.0) -> Iterator[Backend]:
    """A device of the simulated lab, showing ready-made pictures."""
    from acquisition.drivers.synthetic import SyntheticLab, SyntheticThrower
    from acquisition.synthetic.lab_config import SyntheticConfig
    from recordings.progress import Silent

    lab = SyntheticLab(SyntheticConfig(pictures="pool", color_size=(64, 48), mono_size=(64, 48)))
    SyntheticThrower(lab).prepare(0, 0, Silent())

    def make(**given: Any) -> Any:
        if given:
            pytest.skip("a simulated device is what the rig calls it: it takes no serial")
        return lab.device(name, kind, rate_hz)

    def lossy() -> tuple[Any, Callable[[], None]]:
        if kind == "gripper":
            pytest.skip("the simulated fingers lose no state")
        fault = "silence" if kind == "arm" else "gap"
        return make(), lambda: lab.faults(name).inject(fault, at_s=0.2, for_s=0.2)

    yield Backend(make, protocol, lossy, lambda: lab.faults(name).inject("unplug"))


@contextmanager
def replay(name: str, protocol: Any, ask: Callable[[str], Any], of: str = "shipped_session") -> Iterator[Backend]:
    """A device of a session (the one that the repository ships, or one of an arm), played in real time."""
    from acquisition.drivers.replay import Player, ReplayArm, ReplayGripper, ReplayMono, ReplayRgbd
    from recordings.session import Session

    player = Player(Session.open(ask(of)))
    made = {RgbdCamera: ReplayRgbd, MonoCamera: ReplayMono, Arm: ReplayArm, Gripper: ReplayGripper}[protocol]

    def make(**given: Any) -> Any:
        if given:
            pytest.skip("a replayed device is what its session calls it: it takes no serial")
        player.play(player.session.tosses[0])
        return made(player, name)

    def nothing() -> Any:
        pytest.skip("a session keeps what it recorded: its replay loses nothing and stays")

    yield Backend(make, protocol, nothing, nothing)


BACKENDS: dict[str, Callable[[Callable[[str], Any]], AbstractContextManager[Backend]]] = {
    "d455": d455,
    "genicam": genicam,
    "franka": franka,
    "franka_hand": franka_hand,
    "ur": ur,
    "synthetic_rgbd": lambda ask: synthetic("d455", "rgbd", RgbdCamera),
    "synthetic_mono": lambda ask: synthetic("mono0", "mono", MonoCamera),
    "synthetic_arm": lambda ask: synthetic("arm", "arm", Arm, 1000.0),
    "synthetic_gripper": lambda ask: synthetic("gripper", "gripper", Gripper),
    "replay_rgbd": lambda ask: replay("d455", RgbdCamera, ask),
    "replay_mono": lambda ask: replay("mono0", MonoCamera, ask),
    "replay_arm": lambda ask: replay("arm", Arm, ask, "arm_session"),
    "replay_gripper": lambda ask: replay("gripper", Gripper, ask, "arm_session"),
}


@pytest.fixture(scope="module", params=list(BACKENDS))
def backend(request: pytest.FixtureRequest) -> Iterator[Backend]:
    with BACKENDS[request.param](request.getfixturevalue) as made:
        yield made


@pytest.fixture(scope="module")
def device(backend: Backend) -> Iterator[Any]:
    """A driver that is open and not started; stopped again by each test."""
    with backend.make() as opened:
        yield opened


def marks(item: Any) -> list[tuple[str, int, int, int]]:
    """(stream, number, device time, receipt) of everything that one read gave."""
    if isinstance(item, RgbdCapture):
        return [(i.stream, i.number, i.stamp.device_ns, i.host_ns) for i in item.images()]
    if isinstance(item, ArmSamples):
        rows = zip(item.number.tolist(), item.time_ns.tolist(), item.host_ns.tolist())
        return [("arm", *row) for row in rows]
    if hasattr(item, "stamp"):
        return [(item.stream, item.number, item.stamp.device_ns, item.host_ns)]
    return [("gripper", item.number, item.time_ns, item.host_ns)]


def gather(device: Any, items: int) -> list[Any]:
    """That many reads' worth, or fewer when the device ends."""
    found: list[Any] = []
    end = time.monotonic() + PATIENCE_S
    while len(found) < items and time.monotonic() < end:
        try:
            item = device.read(0.5)
        except DeviceLost:
            break
        if item is not None:
            found.append(item)
    return found


def read_on(device: Any, seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        device.read(0.2)


def test_it_streams_with_growing_numbers_and_stamps_and_says_who_it_is(backend: Backend, device: Any) -> None:
    assert isinstance(device, backend.protocol)
    device.start()
    found = [mark for item in gather(device, backend.items) for mark in marks(item)]
    described = json.loads(json.dumps(device.describe()))
    health = device.health()
    device.stop()
    assert len(found) >= backend.items
    for stream in {mark[0] for mark in found}:
        rows = [mark[1:] for mark in found if mark[0] == stream]
        for i, name in enumerate(("number", "stamp")):
            steps = [b[i] - a[i] for a, b in zip(rows, rows[1:])]
            assert all(step > 0 for step in steps), f"{stream}: {name}s {steps}"
        receipts = [row[2] for row in rows]
        assert receipts == sorted(receipts)
        assert 0 <= time.monotonic_ns() - receipts[-1] < 20e9
    assert {"kind", "model", "serial", "firmware", "driver", "settings", "warnings"} <= set(described)
    assert sum(health.received.values()) >= backend.items


def test_no_read_waits_longer_than_it_was_told(device: Any, own_time: Any) -> None:
    device.start()
    for timeout_s in (0.0, 0.01, 0.2, 0.0):
        with own_time() as spent:
            device.read(timeout_s)
        assert spent.seconds < timeout_s + SLACK_S
    device.stop()


def test_it_stops_within_two_seconds_and_starts_again(device: Any, own_time: Any) -> None:
    for _ in range(2):
        device.start()
        assert gather(device, 2)
        with own_time() as spent:
            device.stop()
        assert spent.seconds < 2.0


def test_stop_and_close_may_come_at_any_time_and_twice(backend: Backend, device: Any, own_time: Any) -> None:
    unopened = backend.make()
    unopened.stop()
    unopened.close()
    device.stop()
    device.start()
    for call in (device.stop, device.stop, device.close, device.close):
        with own_time() as spent:
            call()
        assert spent.seconds < 2.0


def test_another_serial_is_refused_by_name(backend: Backend) -> None:
    with pytest.raises((DeviceNotFound, DeviceRefused), match="NO-SUCH-SERIAL"):
        backend.make(serial="NO-SUCH-SERIAL").open()


def gaps(found: list[tuple[str, int, int, int]]) -> int:
    """Numbers that are missing between those that came."""
    lost = 0
    for stream in {mark[0] for mark in found}:
        numbers = [mark[1] for mark in found if mark[0] == stream]
        lost += numbers[-1] - numbers[0] + 1 - len(numbers)
    return lost


def test_what_is_lost_is_counted_or_shows_in_the_numbers(backend: Backend) -> None:
    found: list[tuple[str, int, int, int]] = []
    lossy, trouble = backend.lossy()
    with lossy as device:
        device.start()
        found += [mark for item in gather(device, 2) for mark in marks(item)]
        trouble()
        end = time.monotonic() + PATIENCE_S
        while not sum(device.health().dropped.values()) and not gaps(found) and time.monotonic() < end:
            try:
                item = device.read(0.2)
            except DeviceLost:
                break
            found += [] if item is None else marks(item)
        assert sum(device.health().dropped.values()) + gaps(found) > 0


def test_a_device_that_goes_away_is_reported_and_can_be_left(backend: Backend, own_time: Any) -> None:
    device = backend.make()
    device.open()
    device.start()
    assert gather(device, 2)
    backend.unplug()
    with pytest.raises(DeviceLost, match=device.name):
        read_on(device, 12.0)
    assert device.health().level == "error"
    for call in (device.stop, device.close):
        with own_time() as spent:
            call()
        assert spent.seconds < 2.0
