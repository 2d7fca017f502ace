"""A rig with its devices made, ready to be opened."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from acquisition.arm.throw import Thrower
from acquisition.devices import Device, RgbdCamera
from acquisition.rig import Rig
from recordings.errors import BadInput
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


def with_factory_models(calibration: RigCalibration, devices: Iterable[Device]) -> RigCalibration:
    """The calibration, completed by what the RGBD cameras say of themselves once they stream: raw depth has a lens and
    a place of its own, and without them it would be taken for aligned to colour.

    What was calibrated stays. Raises BadInput where it is of pictures of another size than the camera's.
    """
    for camera in (d for d in devices if isinstance(d, RgbdCamera)):
        models = camera.cameras()
        if not models:
            continue
        place, wanted = camera.color_from_depth(), {camera.name: models["color"]}
        if place.source != place.target:
            wanted[f"{camera.name}_depth"] = models["depth"]
        for name, model in wanted.items():
            known = calibration.cameras.get(name, model)
            if (known.width, known.height) != (model.width, model.height):
                raise BadInput(
                    f"the calibration's {name} is {known.width}x{known.height}, the camera sends {model.width}x"
                    f"{model.height}; wanted one size: set the rig's settings back, or calibrate anew with "
                    "`toss-record --calibration board` and toss-calibrate"
                )
        calibration = replace(calibration, cameras={**wanted, **calibration.cameras})
        if calibration.find(place.target, place.source) is None:
            calibration = replace(calibration, transforms=(*calibration.transforms, place))
    return calibration
