"""From a rig file to devices: the driver of each is imported when it is chosen, its settings are checked by name."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acquisition.arm.throw import ByHand
from acquisition.devices import Device
from acquisition.ready_rig import Setup
from acquisition.rig import DeviceEntry, Rig, find_rig, from_table, read_rig
from recordings.errors import BadInput
from recordings.tracks import RigCalibration

if TYPE_CHECKING:
    pass

REPLAY = "replay:"
CLASSES: Mapping[str, tuple[str, str, str]] = {
    "d455": ("acquisition.drivers.d455", "D455Camera", "D455Settings"),
    "genicam": ("acquisition.drivers.genicam", "GenicamCamera", "GenicamSettings"),
    "franka": ("acquisition.drivers.franka", "FrankaArm", ""),
    "franka_hand": ("acquisition.drivers.franka_hand", "FrankaHand", ""),
    "ur": ("acquisition.drivers.ur", "UrArm", ""),
}
"""Driver -> module, class, dataclass of its settings."""
NO_CALIBRATION = RigCalibration(cameras={})


def set_up(name: str) -> Setup:
    """The rig of `--rig`: a shipped name, a TOML file, or `replay:SESSION`."""
    if name.startswith(REPLAY):
        from acquisition.drivers.replay import replay_setup

        return replay_setup(Path(name.removeprefix(REPLAY)))
    rig = read_rig(find_rig(name))
    simulated = {d.name for d in rig.devices if d.driver == "synthetic"}
    if simulated and len(simulated) != len(rig.devices):
        raise BadInput(f"{rig.source}: simulated and real devices in one rig; wanted one or the other")
    return _synthetic(rig) if simulated else _real(rig)


def _synthetic(rig: Rig) -> Setup:
    from acquisition.drivers.synthetic import SyntheticLab, SyntheticThrower
    from acquisition.synthetic.lab_config import SyntheticConfig

    config = from_table(SyntheticConfig, rig.simulation, f"{rig.source}: [simulation]")
    lab = SyntheticLab(config)
    devices: dict[str, Device] = {d.name: lab.device(d.name, d.kind, d.rate_hz) for d in rig.devices}
    return Setup(rig, devices, SyntheticThrower(lab), lab.show.calibration(), lab)


def _real(rig: Rig) -> Setup:
    devices = {d.name: make_device(d, rig.source) for d in rig.devices}
    calibration = (
        NO_CALIBRATION if rig.calibration is None else RigCalibration.read(rig.source.parent / rig.calibration)
    )
    return Setup(rig, devices, ByHand(), calibration)


def make_device(entry: DeviceEntry, source: Path) -> Device:
    """A driver for one entry of a rig file, not opened yet."""
    if entry.driver not in CLASSES:
        raise BadInput(
            f"{source}: [devices.{entry.name}] driver '{entry.driver}'; wanted one of {', '.join(CLASSES)}, synthetic"
        )
    module_name, class_name, settings_name = CLASSES[entry.driver]
    module = importlib.import_module(module_name)
    where = f"{source}: [devices.{entry.name}] settings"
    arguments: dict[str, Any] = {"name": entry.name}
    if entry.serial:
        arguments["serial"] = entry.serial
    if settings_name:
        kind = getattr(module, settings_name)
        table = {"rate_hz": _rate_as(kind, entry.rate_hz), **entry.settings}
        arguments["settings"] = from_table(kind, table, where)
        if entry.address:
            arguments["address"] = entry.address
    else:
        arguments |= {"host": entry.address} if entry.address else {}
        arguments |= dict(entry.settings)
    try:
        made: Device = getattr(module, class_name)(**arguments)
    except TypeError as wrong:
        raise BadInput(f"{where}: {wrong}") from wrong
    return made


def _rate_as(kind: Any, rate_hz: float) -> float | int:
    """Whole numbers where the driver's settings want them."""
    whole = kind.__dataclass_fields__["rate_hz"].type in ("int", int)
    return int(rate_hz) if whole else rate_hz
