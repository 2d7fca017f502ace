"""A Panda that tosses: the quick generator's arm with any object that its hand can close on."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.synthetic.arm import FORWARD_S, Arm, Swing
from acquisition.synthetic.config import ArmConfig
from acquisition.synthetic.motion import Release, Trajectory
from acquisition.synthetic.objects.grasp import PAD_OVERLAP_M, WIDEST_M, Grasp
from acquisition.synthetic.render.rays import Placed
from recordings.geometry import Transform
from variety.appearance import Finish
from variety.furniture import Item

BASE_REACH_M = (0.48, 0.6)
SLIP_M = 0.003
STEP_S = 0.004
FINISH = Finish(0.35, 0.0, 0.0, 1.0, 0.2)


def grasp_of(hull_m: Float[Array, "n 3"]) -> Grasp | None:
    """Closing across the narrowest side, reaching along the longest; None where the hand is too small."""
    low, high = hull_m.min(axis=0), hull_m.max(axis=0)
    size = high - low
    closing = int(size.argmin())
    if size[closing] > WIDEST_M - 0.002:
        return None
    along = int(np.argsort(size)[2]) if int(size.argmax()) != closing else (closing + 1) % 3
    axes = np.eye(3)
    approach = -axes[along]
    at = 0.5 * (low + high)
    at[along] = high[along] - min(PAD_OVERLAP_M, 0.5 * size[along])
    rotation = np.stack([np.cross(axes[closing], approach), axes[closing], approach], 1)
    return Grasp(Transform("object", "tool", rotation, at), float(size[closing]))


def arm_of(
    hull_m: Float[Array, "n 3"], away: Float[Array, "2"], clock_s: float, rng: np.random.Generator
) -> Arm | None:
    """The arm on the far side of the table (`away` from the camera), turned to its middle; None: too thick to hold."""
    grasp = grasp_of(hull_m)
    if grasp is None:
        return None
    angle = float(np.arctan2(away[1], away[0]) + rng.uniform(-1.0, 1.0))
    reach = rng.uniform(*BASE_REACH_M)
    base = (float(reach * np.cos(angle)), float(reach * np.sin(angle)))
    config = ArmConfig(base_m=base, base_yaw_deg=float(np.degrees(angle) + 180.0), clock_offset_s=clock_s)
    return Arm(config, grasp)


def items(arm: Arm) -> dict[str, Item]:
    """Its links, by name."""
    return {name_of(k): Item(name_of(k), body.mesh, FINISH) for k, (_, _, body) in enumerate(arm.bodies)}


def name_of(number: int) -> str:
    return f"link{number:02d}"


def carried(
    arm: Arm, wanted: Release, hold_s: float, rng: np.random.Generator
) -> tuple[Trajectory, Release, Swing, float] | None:
    """The object's path in the hand, its state when it is free, the swing, and that time; None: out of reach."""
    release_s = hold_s + arm.config.wind_up_s + FORWARD_S
    swing = arm.plan(wanted, float(rng.uniform(-0.5, 0.5)), release_s)
    if swing is None:
        return None
    turn = rng.uniform(0, 2 * np.pi)
    slip = rng.uniform(0, SLIP_M) * np.array([np.cos(turn), 0.0, np.sin(turn)])
    free_s = release_s + arm.config.finger_open_s
    path, release = arm.carry(swing, slip, free_s, STEP_S)
    return path, release, swing, free_s


class Links:
    """Where the links are in one toss."""

    def __init__(self, arm: Arm, swing: Swing) -> None:
        self.arm, self.swing = arm, swing
        self._placed = lru_cache(maxsize=256)(self._at)

    def _at(self, time_s: float) -> list[Placed]:
        return self.arm.placed(self.swing, time_s)

    def place(self, number: int, time_s: float) -> Transform:
        return self._placed(time_s)[number].world_from_body
