"""Forecasts of tosses under laws of contact, and how far off they are by a proper score.

A single rollout from the release ends in chaos, and the horizon up to which it is compared decides the friction found.
So it is not one: the state before the first impact (a sigma-point Kalman filter on SE(3) through the flight: Julier and
Uhlmann 1997) becomes an ensemble of 24 states, all of which are rolled on in steps of STEP_S to the rest. What rigid
bodies, Coulomb's and Newton's laws leave unexplained is a Law's `unexplained`: after each frame every member is kicked
at random by that share of its speed change by contact. A frame's forecast x_1 .. x_s of what is seen, y, is judged by
the energy score (Gneiting and Raftery 2007):

    ES = mean_i |x_i - y| - 1/2 mean_ij |x_i - x_j|

in metres of surface displacement. Its expectation is least for the true distribution, so a forecast gains nothing by
being smooth, and late frames, in which everything is possible, tell little under any law: no horizon is chosen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from processing.contact.physics.loss import REFERENCE_MASS_KG
from processing.engine.parts import in_parts
from processing.motion.phases import Noise
from processing.motion.smoother import FLIGHT_CHANGE_M_S, FLIGHT_CHANGE_RAD_S
from processing.motion.trajectory import rotation_matrices, rotation_vectors
from recordings.constants import GRAVITY_M_S2

STEP_S = 1 / 592
"""Of the rollouts: in steps of 1/148 s friction comes out a tenth lower."""
ROTATION, POSITION, SPIN, VELOCITY = (slice(i, i + 3) for i in range(0, 12, 3))
"""Places in a state's error: turn (object axes), position, spin, velocity."""


@dataclass(frozen=True)
class Law:
    """Coulomb's friction, Newton's restitution, and the share of an impulse that they leave unexplained."""

    friction: float
    restitution: float
    unexplained: float


@dataclass(frozen=True, eq=False)
class ObservedTrajectory:
    """The poses of one toss from the release on (of the centre of mass, the plane at z = 0); `flight` counts those
    before the first impact."""

    time_s: Float[Array, " k"]
    rotation: Float[Array, "k 3 3"]
    position_m: Float[Array, "k 3"]
    flight: int


@dataclass(frozen=True, eq=False)
class RigidBody:
    """Points about the centre of mass, how many of them may touch at once, the inertia at the reference mass."""

    points_m: Float[Array, "v 3"]
    contacts: int
    inertia_kgm2: Float[Array, "3 3"]

    @property
    def reach_m(self) -> float:
        """Half the mean extent: the lever of a typical contact."""
        return 0.5 * float(np.ptp(self.points_m, axis=0).mean())


@dataclass(frozen=True, eq=False)
class _States:
    """Means and covariance of the states of m laws and a tosses."""

    rotation: Float[Array, "m a 3 3"]
    position: Float[Array, "m a 3"]
    spin: Float[Array, "m a 3"]
    velocity: Float[Array, "m a 3"]
    covariance: Float[Array, "m a 12 12"]


def _sigma_points() -> Float[Array, "s 12"]:
    """Twice 12 points with mean 0 and covariance 1, in directions that lie along no axis: along the axes they would be
    3.5 standard deviations out, where another corner touches."""
    directions, _ = np.linalg.qr(np.random.default_rng(3).standard_normal((12, 12)))
    return np.concatenate([directions.T, -directions.T]) * 12**0.5


SIGMA_POINTS = _sigma_points()
MEMBERS = len(SIGMA_POINTS)
PART = 48
"""States that are rolled on in one part of the work."""
LONGEST = 400
_half = np.random.default_rng(5).standard_normal((LONGEST, MEMBERS // 2, 12))
DRAWN = np.concatenate([_half, -_half], 1)
"""The same random numbers for every law and toss, in pairs of opposite sign: only the laws make a difference."""


class Forecasts:
    """Tosses ready to be forecast under one law after another."""

    def __init__(
        self, trajectories: Sequence[ObservedTrajectory], body: RigidBody, noise: Noise, reach_m: float | None = None
    ) -> None:
        """`reach_m`: the lever of turns in scores, where bodies of several sizes are to be compared by them."""
        self.body, self.noise = body, noise
        self.reach_m = body.reach_m if reach_m is None else reach_m
        before = [self._before_impact(c) for c in trajectories]
        self._start = [np.concatenate([p[i] for p in before]) for i in range(4)]
        first = [max(c.flight - 1, 1) for c in trajectories]
        self.trajectories = [
            ObservedTrajectory(c.time_s[f:LONGEST], c.rotation[f:LONGEST], c.position_m[f:LONGEST], 0)
            for c, f in zip(trajectories, first)
        ]
        self._scale_m: Float[Array, "n k"] | None = None
        self._known: dict[Law, Float[Array, " n"]] = {}

    def _before_impact(self, trajectory: ObservedTrajectory) -> list[Float[Array, "1 s ..."]]:
        """Members of the state at the last frame of the flight, from all frames up to it."""
        last, body = max(trajectory.flight - 1, 1), self.body
        sigma = np.array([[self.noise.rotation_rad, self.noise.position_m]])
        states = _first_states([trajectory], body, sigma)
        none = np.zeros((1, 2))
        for k in range(2, last + 1):
            dt = np.diff(trajectory.time_s[k - 1 : k + 1])
            ahead = _predicted(states, dt, body, none)
            _disturb(ahead.covariance, dt)
            states = _corrected(ahead, trajectory.rotation[k : k + 1], trajectory.position_m[k : k + 1], sigma)
        return [p[0] for p in _members(states)]

    def scores(self, laws: Sequence[Law]) -> Float[Array, "m n"]:
        """The energy score of every law and toss: the sum over frames, each in units of how far off forecasts of it
        are on average (over the laws that were asked for first, for all the same). A law is rolled out once."""
        new = [law for law in dict.fromkeys(laws) if law not in self._known]
        if new:
            energy, off = self.energies(new)
            if self._scale_m is None:
                self._scale_m = np.maximum(off.mean(0), self.noise.position_m)
            self._known |= dict(zip(new, (energy / self._scale_m).sum(2)))
        return np.array([self._known[law] for law in laws])

    def energies(self, wanted: Sequence[Law]) -> tuple[Float[Array, "m n k"], Float[Array, "m n k"]]:
        """Energy score and mean distance in metres, per law, toss and frame; 0 where a toss has ended."""
        laws = np.array([[w.friction, w.restitution] for w in wanted])
        unexplained = np.array([w.unexplained for w in wanted])[:, None, None]
        parts = [np.repeat(p[None], len(laws), 0) for p in self._start]
        longest = max(len(c.time_s) for c in self.trajectories)
        energy, off = (np.zeros((len(laws), len(self.trajectories), longest)) for _ in range(2))
        for k in range(1, longest):
            going = [j for j, c in enumerate(self.trajectories) if k < len(c.time_s)]
            dt = np.array([self.trajectories[j].time_s[k] - self.trajectories[j].time_s[k - 1] for j in going])
            moved, push = _rolled([p[:, going] for p in parts], dt, self.body, laws)
            self._kick(moved, unexplained * push, dt, k)
            for whole, part in zip(parts, moved):
                whole[:, going] = part
            seen = [self.trajectories[j] for j in going]
            energy[:, going, k], off[:, going, k] = self._judged(moved, seen, k)
        return energy, off

    def _kick(self, parts: Sequence[Array], speed_m_s: Float[Array, "m a s"], dt: Float[Array, " a"], k: int) -> None:
        """A random change of velocity of this size in the middle of dt, and of spin by the same push at a lever."""
        kick = speed_m_s[..., None] * DRAWN[k, :, :6]
        parts[1][...] += 0.5 * dt[:, None, None] * kick[..., :3]
        parts[2][...] += kick[..., 3:] / self.reach_m
        parts[3][...] += kick[..., :3]

    def _judged(
        self, parts: Sequence[Array], seen: Sequence[ObservedTrajectory], k: int
    ) -> tuple[Float[Array, "m a"], Float[Array, "m a"]]:
        """Energy score and mean distance of members (seen with the poses' noise) from what was seen."""
        turned = rotation_matrices(self.noise.rotation_rad * DRAWN[k, :, 6:9])
        members = self._placed(parts[0] @ turned, parts[1] + self.noise.position_m * DRAWN[k, :, 9:])
        here = self._placed(np.stack([c.rotation[k] for c in seen]), np.stack([c.position_m[k] for c in seen]))
        off = np.linalg.norm(members - here[:, None], axis=-1).mean(-1)
        inner = members - members.mean(2, keepdims=True)
        product = np.matmul(inner, np.swapaxes(inner, -1, -2))
        square = np.einsum("mass->mas", product)
        apart = np.sqrt(np.maximum(square[..., :, None] + square[..., None, :] - 2 * product, 0.0))
        return off - 0.5 * apart.sum((-1, -2)) / (MEMBERS * (MEMBERS - 1)), off

    def _placed(self, rotation: Float[Array, "*n 3 3"], position_m: Float[Array, "*n 3"]) -> Float[Array, "*n 12"]:
        """Poses as vectors whose distance is about that of points on the surface (the chord of R, at the reach)."""
        chord = self.reach_m / 2**0.5 * rotation.reshape(*rotation.shape[:-2], 9)
        return np.concatenate([position_m, chord], -1)


def _members(states: _States) -> list[Array]:
    """The sigma points of states: rotation, position, spin, velocity."""
    moved = np.einsum("maij,sj->masi", np.linalg.cholesky(states.covariance), SIGMA_POINTS)
    return [
        states.rotation[:, :, None] @ rotation_matrices(moved[..., ROTATION]),
        states.position[:, :, None] + moved[..., POSITION],
        states.spin[:, :, None] + moved[..., SPIN],
        states.velocity[:, :, None] + moved[..., VELOCITY],
    ]


def _first_states(trajectories: Sequence[ObservedTrajectory], body: RigidBody, sigma: Float[Array, "m 2"]) -> _States:
    """The state at each toss's second frame, from its first two: v = (p1 - p0) / dt, moved to the end of the step."""
    m, n = len(sigma), len(trajectories)
    shapes = ((m, n, 3, 3), (m, n, 3), (m, n, 3), (m, n, 3), (m, n, 12, 12))
    states = _States(*(np.zeros(shape) for shape in shapes))
    for j, c in enumerate(trajectories):
        dt = float(c.time_s[1] - c.time_s[0])
        spin = rotation_vectors(c.rotation[0].T @ c.rotation[1]) / dt
        turning = -np.linalg.solve(body.inertia_kgm2, np.cross(spin, body.inertia_kgm2 @ spin))
        late = 0.5 * (dt - STEP_S)
        states.rotation[:, j], states.position[:, j] = c.rotation[1], c.position_m[1]
        states.spin[:, j] = spin + late * turning
        states.velocity[:, j] = (c.position_m[1] - c.position_m[0]) / dt - late * GRAVITY_M_S2 * np.eye(3)[2]
        for pose, speed, s, change in (
            (ROTATION, SPIN, sigma[:, 0], FLIGHT_CHANGE_RAD_S),
            (POSITION, VELOCITY, sigma[:, 1], FLIGHT_CHANGE_M_S),
        ):
            _add(states.covariance[:, j], pose, pose, s**2)
            _add(states.covariance[:, j], pose, speed, s**2 / dt)
            _add(states.covariance[:, j], speed, pose, s**2 / dt)
            _add(states.covariance[:, j], speed, speed, 2 * s**2 / dt**2 + change**2)
    return states


def _add(covariance: Float[Array, "*b 12 12"], rows: slice, columns: slice, values: Float[Array, "..."]) -> None:
    """Adds multiples of the identity to a block of 3 x 3."""
    covariance[..., rows, columns] += np.asarray(values)[..., None, None] * np.eye(3)


def _predicted(states: _States, dt: Float[Array, " a"], body: RigidBody, laws: Float[Array, "m 2"]) -> _States:
    """The states after dt: their sigma points rolled on."""
    rolled, _ = _rolled(_members(states), dt, body, laws)
    rotation = rolled[0][:, :, 0].copy()
    for _ in range(2):
        rotation = rotation @ rotation_matrices(_rotation_vectors(rotation, rolled[0]).mean(2))
    turns = _rotation_vectors(rotation, rolled[0])
    position, spin, velocity = means = [values.mean(2) for values in rolled[1:]]
    parts = [turns - turns.mean(2, keepdims=True), *(v - mean[:, :, None] for v, mean in zip(rolled[1:], means))]
    error = np.concatenate(parts, -1)
    covariance = np.einsum("masi,masj->maij", error, error) / MEMBERS
    return _States(rotation, position, spin, velocity, covariance)


def _rolled(
    parts: Sequence[Float[Array, "m a s ..."]],
    dt: Float[Array, " a"],
    body: RigidBody,
    laws: Float[Array, "m 2"],
) -> tuple[list[Float[Array, "m a s ..."]], Float[Array, "m a s"]]:
    """The members after dt, and each one's change of speed by contact."""
    m, a, s = parts[1].shape[:3]
    push, whole = np.zeros((m, a, s)), [np.array(p) for p in parts]
    steps = np.maximum(np.round(dt / STEP_S), 1).astype(int)
    for count in np.unique(steps):
        chosen = np.flatnonzero(steps == count)
        rows = [np.ascontiguousarray(p[:, chosen].reshape(-1, *p.shape[3:])) for p in whole]
        owner = np.repeat(np.arange(m), len(chosen) * s)
        done = _roll_in_parts(rows, owner, laws, body, int(count), float(dt[chosen].mean()) / int(count))
        push[:, chosen] = done.reshape(m, len(chosen), s)
        for values, moved in zip(whole, rows):
            values[:, chosen] = moved.reshape(m, len(chosen), *values.shape[2:])
    return whole, push


def _roll_in_parts(
    rows: Sequence[Float[Array, "r ..."]],
    owner: Int64[Array, " r"],
    laws: Float[Array, "m 2"],
    body: RigidBody,
    steps: int,
    step_s: float,
) -> Float[Array, " r"]:
    """Rolls states on in place; each one's change of speed by contact."""
    from processing.contact.physics.steps_cpu import roll_rows

    contacts = min(body.contacts, len(body.points_m))

    def roll(part: slice) -> Float[Array, " p"]:
        some, whose = [values[part] for values in rows], owner[part]
        fixed = (laws, body.points_m, body.inertia_kgm2, REFERENCE_MASS_KG, contacts, steps, step_s)
        return roll_rows(*some, whose, *fixed)[0]

    return np.concatenate(in_parts(roll, len(owner), PART))


def _disturb(covariance: Float[Array, "m a 12 12"], dt: Float[Array, " a"]) -> None:
    """Adds what free flight may leave unexplained: a white change of the velocities within dt."""
    for pose, speed, size in ((ROTATION, SPIN, FLIGHT_CHANGE_RAD_S), (POSITION, VELOCITY, FLIGHT_CHANGE_M_S)):
        _add(covariance, pose, pose, size**2 * dt**2 / 3)
        _add(covariance, pose, speed, size**2 * dt / 2)
        _add(covariance, speed, pose, size**2 * dt / 2)
        _add(covariance, speed, speed, np.full(len(dt), size**2))


def _corrected(
    ahead: _States, rotation: Float[Array, "a 3 3"], position_m: Float[Array, "a 3"], sigma: Float[Array, "m 2"]
) -> _States:
    """The states after a pose was seen."""
    turn = rotation_vectors(np.swapaxes(ahead.rotation, -1, -2) @ rotation)
    off = np.concatenate([turn, position_m - ahead.position], -1)
    P = ahead.covariance
    S = P[..., :6, :6] + np.eye(6) * np.repeat(sigma**2, 3, axis=1)[:, None, None, :]
    gain = np.swapaxes(np.linalg.solve(S, P[..., :6, :]), -1, -2)
    step = np.einsum("maij,maj->mai", gain, off)
    left = P - gain @ P[..., :6, :]
    return _States(
        ahead.rotation @ rotation_matrices(step[..., ROTATION]),
        ahead.position + step[..., POSITION],
        ahead.spin + step[..., SPIN],
        ahead.velocity + step[..., VELOCITY],
        0.5 * (left + np.swapaxes(left, -1, -2)) + 1e-12 * np.eye(12),
    )


def _rotation_vectors(mean: Float[Array, "m a 3 3"], rotation: Float[Array, "m a s 3 3"]) -> Float[Array, "m a s 3"]:
    """Rotation vectors (rad) from the mean to each, in the mean's axes."""
    return rotation_vectors(np.swapaxes(mean, -1, -2)[:, :, None] @ rotation)
