"""The first thing a lab runs: is every device of the rig file there, at its rate, and does it stop? Nothing moves.

TOSSLAB_RIG=lab.toml pytest -m rig tests/acquisition/test_rig_devices.py

The very same test runs on the simulated lab, always.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import pytest

from acquisition.devices import Arm, ArmSamples, RgbdCapture
from acquisition.rig import DeviceEntry, find_rig, read_rig
from acquisition.setup import set_up
from recordings.errors import BadInput
from recordings.progress import Silent

GIVEN, SIMULATED = "TOSSLAB_RIG", "synthetic"
LISTENS_S = 3.0
SLOWEST_SHARE = 0.5
"""Of the rate that the rig file asks for; `toss-record`'s preflight judges finer."""
STOPS_WITHIN_S = 2.0


def of_rig(name: str, mark: Any = ()) -> list[Any]:
    """A parameter for every device of a rig; one that skips, saying why, where the rig cannot be read."""
    try:
        names = [entry.name for entry in read_rig(find_rig(name)).devices]
    except BadInput as wrong:
        return [pytest.param(name, "none", marks=[*mark, pytest.mark.skip(reason=str(wrong))])]
    return [pytest.param(name, device, marks=mark, id=f"{device} of {name}") for device in names]


def given() -> list[Any]:
    if GIVEN in os.environ:
        return of_rig(os.environ[GIVEN], [pytest.mark.rig])
    unset = pytest.mark.skip(reason=f"{GIVEN} names no rig file: {GIVEN}=lab.toml pytest -m rig {__name__}")
    return [pytest.param("none", "none", marks=[pytest.mark.rig, unset], id="no rig given")]


@pytest.fixture(scope="module")
def opened() -> dict[str, Any]:
    """Set-ups by the name of their rig, made once."""
    return {}


def without_rendering(folder: Path) -> str:
    """The simulated lab with ready-made pictures: its [simulation] is the last table of its file."""
    path = folder / "simulated.toml"
    path.write_text(find_rig(SIMULATED).read_text() + 'pictures = "pool"\n')
    return str(path)


def count(item: Any) -> int:
    """How many frames or states a read gave: the colour image stands for an RGBD pair."""
    if isinstance(item, ArmSamples):
        return len(item.number)
    return int(not isinstance(item, RgbdCapture) or item.color is not None)


@pytest.mark.parametrize("rig, name", [*given(), *of_rig(SIMULATED)])
def test_a_device_is_there_streams_at_its_rate_and_stops(
    rig: str, name: str, opened: dict[str, Any], tmp_path: Path
) -> None:
    if rig not in opened:
        opened[rig] = set_up(without_rendering(tmp_path) if rig == SIMULATED else rig)
        if opened[rig].lab is not None:
            opened[rig].thrower.prepare(0, 0, Silent())
    entry: DeviceEntry = next(e for e in opened[rig].rig.devices if e.name == name)
    with opened[rig].devices[name] as device:
        said = device.describe()
        json.dumps(said)
        assert said["model"], f"{name} does not say who it is"
        if entry.serial and entry.driver != SIMULATED:  # a simulated device takes no serial
            assert said["serial"] == entry.serial
        device.start()
        joints = None
        received, began = 0, time.monotonic()
        while time.monotonic() - began < LISTENS_S:
            item = device.read(0.5)
            received += count(item) if item is not None else 0
            if isinstance(item, ArmSamples):
                joints = item.q_rad[0] if joints is None else joints
                assert abs(item.q_rad - joints).max() < 0.01, "the arm moves, and nobody asked it to"
        health = device.health()
        stops = time.monotonic()
        device.stop()
        stopped_s = time.monotonic() - stops
    assert health.level != "error", f"{name}: {health.message}"
    assert received > SLOWEST_SHARE * entry.rate_hz * LISTENS_S, f"{name}: {received} in {LISTENS_S:g} s"
    assert stopped_s < STOPS_WITHIN_S
    if isinstance(device, Arm):
        assert device.motion().status == "none"
