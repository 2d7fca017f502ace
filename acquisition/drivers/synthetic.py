"""The whole lab simulated: devices behind the protocols, with clocks that drift, latencies, lost frames and faults.

    lab = SyntheticLab(SyntheticConfig(seed=3))
    lab.prepare(0)                        # plans and renders toss 0
    with lab.device("d455", "rgbd") as camera: ...

The scene is that of `acquisition.synthetic`; what is true (poses, exposure times) is written beside a session by
`acquisition.synthetic.truth_sidecar`, never into it.
"""

from __future__ import annotations

from acquisition.arm.throw import ByHand
from acquisition.arm.toss import TossPlan
from acquisition.drivers.synthetic_arm import SyntheticArm, SyntheticGripper
from acquisition.drivers.synthetic_cameras import SyntheticMono, SyntheticRgbd
from acquisition.synthetic.lab_config import SyntheticConfig
from acquisition.synthetic.lab_state import LabState
from recordings.errors import BadInput
from recordings.progress import Progress


class SyntheticLab(LabState):
    """The simulated lab and its devices."""

    def __init__(self, config: SyntheticConfig) -> None:
        super().__init__(config)
        self._opened: set[str] = set()

    def device(
        self, name: str, kind: str, rate_hz: float = 30.0
    ) -> SyntheticRgbd | SyntheticMono | SyntheticArm | SyntheticGripper:
        """A device of this lab under the rig's name for it."""
        if kind == "rgbd":
            return SyntheticRgbd(self, name)
        if kind == "mono":
            number = sum(1 for n in self._opened if n != name)
            self._opened.add(name)
            if number >= self.config.mono_cameras:
                raise BadInput(f"the simulated lab has {self.config.mono_cameras} grey cameras; '{name}' is one more")
            return SyntheticMono(self, name, f"mono{number}", number)
        return SyntheticArm(self, name, rate_hz) if kind == "arm" else SyntheticGripper(self, name, rate_hz)


class SyntheticThrower(ByHand):
    """Tosses of the simulated lab: planned by its own planner, rendered before they are played."""

    def __init__(self, lab: SyntheticLab) -> None:
        self._lab = lab
        self._ready: tuple[int, TossPlan] | None = None

    def prepare(self, toss: int, attempt: int, progress: Progress) -> TossPlan:
        number = toss + 1000 * attempt
        if self._ready is None or self._ready[0] != number or self._lab.stage.ready is None:
            plan = self._lab.show.plan(number)
            self._lab.stage.set_up(self._lab.show.perform(number, plan, progress))
            self._ready = number, plan
        return self._ready[1]
