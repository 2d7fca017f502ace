"""A rig with its devices made, ready to be opened."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from acquisition.arm.throw import Thrower
from acquisition.devices import Device
from acquisition.rig import Rig
from recordings.tracks import RigCalibration

if TYPE_CHECKING:
    from acquisition.synthetic.lab_state import LabState


@dataclass(eq=False)
class Setup:
    """A rig ready to be opened. `lab` is the simulation, where there is one."""

    rig: Rig
    devices: dict[str, Device]
    thrower: Thrower
    calibration: RigCalibration
    lab: LabState | None = None
    live: bool = True
    """False: a recording, which has nothing to say before it is played."""

    @property
    def moves_arm(self) -> bool:
        """Whether tosses move a real arm."""
        rig = self.rig
        return self.lab is None and self.live and bool(rig.toss and rig.robot and rig.of_kind("arm"))
