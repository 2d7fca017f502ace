"""The motion of one toss: drawn again until the camera sees all of it and it ends at rest on the table."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from acquisition.synthetic.arm import FORWARD_S, Arm, Swing
from acquisition.synthetic.config import SceneConfig
from acquisition.synthetic.motion import Instants, Release, Trajectory, unseen_hand
from acquisition.synthetic.objects.shapes import MassProperties
from acquisition.synthetic.objects.solids import Solid
from acquisition.synthetic.physics import Table
from acquisition.synthetic.random_draws import TOSS, draw_release, generator
from acquisition.synthetic.render.optics import View
from acquisition.synthetic.render.rays import Body
from acquisition.synthetic.render.room import TABLE_HALF_M
from recordings.errors import BadInput

TRIES = 300
NEAREST_OBJECT_M = 0.3
LOWEST_POINT_M = -0.01
"""An impact may press the object so deep into the table, a hand may not."""
HELD_STEP_S = 0.004
ROLL_RAD = 0.5
SAMPLED_INSTANTS = 40
"""At how many instants it is checked that the object is in view."""


@dataclass(frozen=True, eq=False)
class Motion:
    """One toss, before anything is rendered. `free_s`: the fingers have let go (the release, where there is no arm)."""

    toss: int
    object: Trajectory
    instants: Instants
    free_s: float
    swing: Swing | None = None


class Planner:
    """Plans the tosses of a session. `view` is the colour camera, which must see the object all the time."""

    def __init__(
        self, config: SceneConfig, solid: Solid, mass: MassProperties, body: Body, view: View, arm: Arm | None
    ) -> None:
        self._config, self._body, self._view, self._arm = config, body, view, arm
        self._solid, self._mass = solid, mass

    @cached_property
    def _table(self) -> Table:
        return Table(self._solid, self._mass, self._config.contact)

    def plan(self, toss: int) -> Motion:
        """The motion of toss number `toss`; the same number, the same motion."""
        rng = generator(self._config.seed, TOSS, toss)
        for _ in range(TRIES):
            motion = self._attempt(toss, rng)
            if motion is not None:
                return motion
        raise BadInput(
            f"seed {self._config.seed}, toss {toss}: none of {TRIES} tosses stays in the camera's view and comes to "
            "rest on the table; lower the speeds, shorten hold and lead-in, or move the camera away"
        )

    def follow(self, toss: int, swing: Swing) -> Motion:
        """What happens when the arm does `swing`, wherever that leads. Raises BadInput where the object never rests."""
        assert self._arm is not None
        config = self._config.motion
        free_s = swing.release_s + swing.open_s
        before, release = self._carry(swing, free_s, generator(self._config.seed, TOSS, toss, 1))
        after, impact_s, rest_s = self._table.drop(release, free_s, config.longest_free_s, config.rest_s)
        if not (np.isfinite(impact_s) and np.isfinite(rest_s)):
            raise BadInput(
                f"toss {toss}: the object does not come to rest on the table within {config.longest_free_s} s"
            )
        instants = Instants(0.0, swing.release_s, impact_s, rest_s, rest_s + config.rest_s)
        return Motion(toss, before.joined(after), instants, free_s, swing)

    def _attempt(self, toss: int, rng: np.random.Generator) -> Motion | None:
        config = self._config.motion
        release = draw_release(self._config, self._body.radius_m, rng)
        if self._arm is None:
            free_s = release_s = config.hold_s + config.lead_in_s
            before, swing = unseen_hand(release, config.hold_s, config.lead_in_s, 0.001), None
        else:
            release_s = config.hold_s + self._arm.config.wind_up_s + FORWARD_S
            free_s = release_s + self._arm.config.finger_open_s
            swing = self._arm.plan(release, rng.uniform(-ROLL_RAD, ROLL_RAD), release_s)
            if swing is None:
                return None
            before, release = self._carry(swing, free_s, rng)
        if not self._all_seen(before):
            return None
        return self._fall(toss, before, release, release_s, free_s, swing)

    def _carry(self, swing: Swing, free_s: float, rng: np.random.Generator) -> tuple[Trajectory, Release]:
        """In the gripper; it may slide in the plane of the pads."""
        assert self._arm is not None
        sideways = rng.uniform(0, 2 * np.pi)
        slip = self._arm.config.slip_m * np.array([np.cos(sideways), 0.0, np.sin(sideways)])
        return self._arm.carry(swing, slip, free_s, HELD_STEP_S)

    def _fall(
        self, toss: int, before: Trajectory, release: Release, release_s: float, free_s: float, swing: Swing | None
    ) -> Motion | None:
        config = self._config.motion
        after, impact_s, rest_s = self._table.drop(release, free_s, config.longest_free_s, config.rest_s)
        if not (np.isfinite(impact_s) and np.isfinite(rest_s) and self._all_seen(after)):
            return None
        instants = Instants(config.hold_s, release_s, impact_s, rest_s, rest_s + config.rest_s)
        return Motion(toss, before.joined(after), instants, free_s, swing)

    def _all_seen(self, part: Trajectory) -> bool:
        """Whether the object is inside the image, not too near to the camera, and over the table, all the time."""
        camera = self._view.camera
        for time_s in part.times_s[:: max(1, len(part.times_s) // SAMPLED_INSTANTS)]:
            points = part.at(time_s).points(self._solid.vertices_m)
            local = self._view.camera_from_world.points(points)
            if local[:, 2].min() < NEAREST_OBJECT_M or not camera.sees(camera.project(local)).all():
                return False
            if points[:, 2].min() < LOWEST_POINT_M or (np.abs(points[:, :2]) > TABLE_HALF_M).any():
                return False
        return True
