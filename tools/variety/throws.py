"""What happens in a toss: held, swung, let go, fallen, at rest; good ones and bad ones; who else moves meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.synthetic.arm import Swing
from acquisition.synthetic.motion import Instants, Release, Trajectory, unseen_hand
from recordings.errors import BadInput
from recordings.geometry import Transform, quaternion_from_rotation, rotation_exp, rotation_log
from variety import arms
from variety.furniture import PATCH_HALF_M, Item
from variety.physics import Engine, Fall, Ground, Thrown
from variety.physics_mujoco import MuJoCo
from variety.physics_rigid import RigidImpulses
from variety.scene import MOTION, Scene, generator
from variety.spec import Spec

ENGINES: dict[str, type[Engine]] = {"mujoco": MuJoCo, "rigid": RigidImpulses}
GRAVITY_M_S2 = 9.81
TRIES = 120
LOOKS = 30
STEP_S = 0.001
LONGEST_FREE_S = 1.8
NEAREST_M = 0.28
LOWEST_HELD_M = 0.015
SEEN_FREE_S = 0.25
"""At least so long an object that rolls out of view is seen after its release."""

Place = Callable[[float], Transform | None]
"""world_from_item at a time; None: not there."""


@dataclass(frozen=True, eq=False)
class Throw:
    """One toss. `others`: by name, where what else moves is. `released_s`: the (last) release."""

    number: int
    kind: str
    object: Trajectory
    instants: Instants
    others: dict[str, Place]
    swing: Swing | None = None
    """Of the arm, where one tosses."""


def ground_of(spec: Spec) -> Ground:
    """The table's contact; a mat takes most of the bounce, a towel or mat never slides easily."""
    soft = spec.table in ("mat", "towel")
    rng = generator(spec, MOTION, 1000)
    turn = rng.uniform(0, 2 * np.pi)
    tilt = np.deg2rad(spec.wrong.gravity_deg)
    down = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])
    friction = max(spec.friction, 0.3) if soft else spec.friction
    restitution = spec.restitution * (0.35 if soft else 1.0)
    wave = spec.wrong.table_wave_m if spec.engine == "rigid" else 0.0
    return Ground(friction, restitution, float(rng.uniform(0.0002, 0.001)), GRAVITY_M_S2 * down, wave)


class Thrower:
    """Draws tosses until the camera sees what it must. Raises BadInput by name where no draw does."""

    def __init__(self, spec: Spec, scene: Scene) -> None:
        self.spec, self.scene, self.ground = spec, scene, ground_of(spec)
        extent = np.ptp(scene.tossed.hull_m, axis=0)
        area = float(np.sort(extent)[1] * np.sort(extent)[2])
        self.body = Thrown(scene.tossed.hull_m, scene.tossed.mass, spec.drag_coefficient * area)
        self.engine = ENGINES[spec.engine]()
        self.half_m = 0.5 * float(np.linalg.norm(extent))

    def throw(self, number: int) -> Throw:
        kind = "good" if self.scene.arm is not None else self.spec.tosses[number]
        rng = generator(self.spec, MOTION, number)
        for attempt in range(TRIES):
            calm = 1 - 0.75 * attempt / TRIES
            found = self._twice(number, calm, rng) if kind == "twice" else self._once(number, kind, calm, rng)
            if found is not None:
                return found
        raise BadInput(
            f"{self.spec.name}, toss {number} ({kind}): in none of {TRIES} draws the object stays in the view of "
            f"{self.spec.camera.width}x{self.spec.camera.height} px at f {self.spec.camera.focal_px:.0f} px"
        )

    def _once(self, number: int, kind: str, calm: float, rng: np.random.Generator) -> Throw | None:
        release = self._release(kind, calm, rng)
        hold_s, lead_s, after_s = rng.uniform(0.2, 0.35), rng.uniform(0.14, 0.26), rng.uniform(0.15, 0.35)
        if self.scene.arm is not None:
            return self._by_arm(number, release, hold_s, after_s, rng)
        before = unseen_hand(release, hold_s, lead_s, STEP_S)
        if not self._held_well(before):
            return None
        fall = self.engine.drop(self.body, self.ground, release, hold_s + lead_s, LONGEST_FREE_S, after_s)
        return self._accepted(number, kind, before, fall, (hold_s, hold_s + lead_s), after_s, rng)

    def _by_arm(
        self, number: int, wanted: Release, hold_s: float, after_s: float, rng: np.random.Generator
    ) -> Throw | None:
        assert self.scene.arm is not None
        found = arms.carried(self.scene.arm, wanted, hold_s, rng)
        if found is None or not self._held_well(found[0]):
            return None
        before, release, swing, free_s = found
        fall = self.engine.drop(self.body, self.ground, release, free_s, LONGEST_FREE_S, after_s)
        thrown = self._accepted(number, "good", before, fall, (hold_s, swing.release_s), after_s, rng)
        if thrown is None:
            return None
        links = arms.Links(self.scene.arm, swing)
        by_arm = {arms.name_of(k): partial(links.place, k) for k in range(len(self.scene.arm.bodies))}
        return replace(thrown, others=thrown.others | by_arm, swing=swing)

    def _accepted(
        self, number: int, kind: str, before: Trajectory, fall: Fall, told: tuple[float, float], after_s: float,
        rng: np.random.Generator,
    ) -> Throw | None:  # fmt: skip
        seen = self._seen(fall.path)
        if not np.isfinite(fall.impact_s):
            return None
        end = float(fall.path.times_s[-1])
        if kind == "rolls out":
            gone = float(np.linspace(told[1], end, LOOKS)[int(np.argmin(seen))])
            if seen.all() or gone < told[1] + SEEN_FREE_S:
                return None
            end = min(end, gone + after_s)
        elif not seen.all() or not self._on_table(fall.path):
            return None
        rest = min(fall.rest_s, end)
        instants = Instants(told[0], told[1], fall.impact_s, rest, min(end, rest + after_s))
        path = before.joined(fall.path)
        return Throw(number, kind, path, instants, self._others(path, instants, kind, rng))

    def _twice(self, number: int, calm: float, rng: np.random.Generator) -> Throw | None:
        """It slips and drops, lies, is lifted, and then tossed."""
        turn = rotation_exp(rng.uniform(0, np.pi) * _unit(rng.standard_normal(3)))
        low = np.array([*rng.uniform(-0.06, 0.06, 2), self._lowest(turn) + rng.uniform(0.02, 0.1)])
        slip = Release(Transform("world", "object", turn, low), np.zeros(3), 0.5 * rng.standard_normal(3))
        first = unseen_hand(slip, 0.15, 0.02, STEP_S)
        fallen = self.engine.drop(self.body, self.ground, slip, 0.17, 1.0, 0.15)
        release = self._release("good", calm, rng)
        lead_s, after_s = rng.uniform(0.14, 0.26), 0.2
        second = unseen_hand(release, 0.1, lead_s, STEP_S)
        if not (self._held_well(second) and self._seen(fallen.path).all() and np.isfinite(fallen.rest_s)):
            return None
        lift = _moved(fallen.path, second.at(0.0), 0.5)
        start_s = float(lift.times_s[-1]) + STEP_S
        begun = first.joined(fallen.path).joined(lift).joined(_later(second, start_s))
        fall = self.engine.drop(self.body, self.ground, release, start_s + 0.1 + lead_s, 1.5, after_s)
        return self._accepted(number, "twice", begun, fall, (start_s + 0.1, start_s + 0.1 + lead_s), after_s, rng)

    def _release(self, kind: str, calm: float, rng: np.random.Generator) -> Release:
        """A release that should end near the table's middle, or far from it; slower and lower the smaller `calm`."""
        rolls = kind == "rolls out"
        forward = rng.uniform(1.0, 2.2) if rolls else calm * rng.uniform(0.05, 0.9)
        upward = rng.uniform(0, 0.5) if rolls else calm * rng.uniform(-0.2, 1.2)
        height, heading = calm * rng.uniform(0.12, 0.36) + self.half_m, rng.uniform(0, 2 * np.pi)
        direction = np.array([np.cos(heading), np.sin(heading), 0.0])
        flight_s = (upward + np.sqrt(upward**2 + 2 * GRAVITY_M_S2 * (height - 0.6 * self.half_m))) / GRAVITY_M_S2
        slide_m = 0.4 * forward**2 / (2 * GRAVITY_M_S2 * max(self.ground.friction, 0.1))
        target = np.array([*rng.normal(0, 0.05, 2), height])
        start = target - direction * (0.15 if rolls else forward * flight_s + slide_m)
        spin = self.spec.spin_rad_s * rng.uniform(0.6, 1.2) * _unit(rng.standard_normal(3))
        turn = rotation_exp(rng.uniform(0, np.pi) * _unit(rng.standard_normal(3)))
        return Release(Transform("world", "object", turn, start), forward * direction + [0, 0, upward], spin)

    def _lowest(self, rotation: Float[Array, "3 3"]) -> float:
        return -float((self.scene.tossed.hull_m @ rotation.T)[:, 2].min())

    def _seen(self, path: Trajectory) -> Array:
        """Whether all of the object is in view, at LOOKS instants."""
        camera, from_world = self.scene.camera, self.scene.world_from_camera.inverse()
        found = []
        for time_s in np.linspace(path.times_s[0], path.times_s[-1], LOOKS):
            local = from_world.points(path.at(float(time_s)).points(self.scene.tossed.hull_m))
            found.append(bool(local[:, 2].min() > NEAREST_M and camera.sees(camera.project(local)).all()))
        return np.array(found)

    def _held_well(self, path: Trajectory) -> bool:
        low = min(
            float(path.at(t).points(self.scene.tossed.hull_m)[:, 2].min())
            for t in np.linspace(path.times_s[0], path.times_s[-1], 8).tolist()
        )
        return low > LOWEST_HELD_M and bool(self._seen(path).all())

    def _on_table(self, path: Trajectory) -> bool:
        low = path.position_m[:, 2] < self.half_m + 0.05
        return bool((np.abs(path.position_m[low, :2]) < np.array(PATCH_HALF_M) - 0.02).all())

    def _others(self, path: Trajectory, instants: Instants, kind: str, rng: np.random.Generator) -> dict[str, Place]:
        found: dict[str, Place] = {}
        eye = self.scene.world_from_camera.translation_m
        if self.scene.holder is not None and (self.spec.holder != "none" or kind == "hand stays"):
            found["hand"] = _holding(path, instants.release_s, self._reach(rng, eye), kind == "hand stays")
        if self.scene.holder is not None and self.spec.occluder == "passing":
            found["passer"] = _passing(eye, 0.5 * (instants.release_s + instants.first_impact_s), rng)
        if self.scene.person is not None:
            found["person"] = _walking(eye, rng)
        return found

    def _reach(self, rng: np.random.Generator, eye_m: Float[Array, "3"]) -> Transform:
        """world_from_hand for an object at the origin: from the side or behind, a little from above."""
        away = np.arctan2(-eye_m[1], -eye_m[0]) + rng.uniform(-1.7, 1.7)
        towards = -_unit(np.array([np.cos(away), np.sin(away), rng.uniform(0.2, 1.2)]))
        closes = _unit(np.cross(towards, [0.0, 0.0, 1.0]))
        axes = np.stack([closes, np.cross(towards, closes), towards], 1)
        return Transform("world", "hand", axes, -0.35 * self.half_m * towards)


def _unit(vector: Float[Array, "3"]) -> Float[Array, "3"]:
    return vector / np.linalg.norm(vector)


def _later(path: Trajectory, by_s: float) -> Trajectory:
    return Trajectory(
        path.times_s + by_s, path.position_m, path.quaternion_wxyz, path.velocity_world_m_s,
        path.angular_velocity_object_rad_s,
    )  # fmt: skip


def _moved(path: Trajectory, to: Transform, within_s: float) -> Trajectory:
    """From the end of a path to a pose, smoothly, by a hand."""
    begin, start_s = path.at(float(path.times_s[-1])), float(path.times_s[-1]) + STEP_S
    times = np.arange(0, within_s, STEP_S)
    share = (times / within_s) ** 2 * (3 - 2 * times / within_s)
    turn = rotation_log(begin.rotation.T @ to.rotation)
    rotations = [begin.rotation @ rotation_exp(s * turn) for s in share]
    position = begin.translation_m + share[:, None] * (to.translation_m - begin.translation_m)
    velocity = np.gradient(position, STEP_S, axis=0)
    spin = np.gradient(share, STEP_S)[:, None] * turn
    return Trajectory(
        start_s + times, position, np.array([quaternion_from_rotation(r) for r in rotations]), velocity, spin
    )


def _holding(path: Trajectory, release_s: float, reach: Transform, stays: bool) -> Place:
    """With the object until the release, then on by its own way and back (or hardly back, where it stays)."""
    at_release, row = path.at(release_s).translation_m, int(np.searchsorted(path.times_s, release_s))
    velocity = path.velocity_world_m_s[min(row, len(path.times_s) - 1)]
    back = -reach.rotation[:, 2] * (0.09 if stays else 0.6)

    def place(time_s: float) -> Transform:
        center = path.at(time_s).translation_m
        if time_s > release_s:
            after = time_s - release_s
            share = min(after / 0.45, 1.0)
            center = at_release + velocity * 0.06 * (1 - np.exp(-after / 0.06)) + back * share**1.3
        return Transform("world", "hand", reach.rotation, reach.translation_m + center)

    return place


def _passing(eye_m: Float[Array, "3"], middle_s: float, rng: np.random.Generator) -> Place:
    """Something crosses the line of sight in mid-flight."""
    side = _unit(np.cross(eye_m, [0.0, 0.0, 1.0])) * rng.choice([-1, 1])
    middle = rng.uniform(0.35, 0.5) * eye_m + [0, 0, 0.05]
    axes = np.stack([np.cross([0.0, 0.0, 1.0], side), [0.0, 0.0, 1.0], side], 1)
    speed = rng.uniform(0.8, 1.6)

    def place(time_s: float) -> Transform | None:
        after = time_s - middle_s
        if abs(after) > 0.3:
            return None
        return Transform("world", "passer", axes, middle + speed * after * side)

    return place


def _walking(eye_m: Float[Array, "3"], rng: np.random.Generator) -> Place:
    """Behind the table, from one side to the other."""
    into = _unit(np.array([-eye_m[0], -eye_m[1], 0.0]))
    side = np.cross(into, [0.0, 0.0, 1.0]) * rng.choice([-1, 1])
    begin = into * rng.uniform(0.95, 1.3) - side * rng.uniform(0.1, 0.7)
    axes = np.stack([side, into, [0.0, 0.0, 1.0]], 1)
    axes = axes if np.linalg.det(axes) > 0 else axes * [1, -1, 1]
    speed = rng.uniform(0.2, 1.1)
    return lambda time_s: Transform("world", "person", axes, begin + speed * time_s * side)


def moving_items(scene: Scene) -> dict[str, Item]:
    """By name: what may be found in `others`, and the object."""
    found = {"object": scene.tossed.item}
    if scene.holder is not None:
        found |= {"hand": scene.holder, "passer": scene.holder}
    if scene.person is not None:
        found["person"] = scene.person
    return found if scene.arm is None else found | arms.items(scene.arm)
