"""How likely tosses are, given friction and restitution: a filter that predicts every frame from the frames before it.

A rollout from the release ends in chaos, and where to stop believing it is a choice that decides the friction found.
Here nothing has to be chosen: from frame to frame a state (pose and velocities, with covariance) is rolled on in steps
of STEP_S, compared with the pose seen, and corrected by it (a sigma-point Kalman filter on SE(3): Julier and Uhlmann
1997, with cubature points). A frame counts by how well it could be predicted:

    log p(y_k | y_0 .. y_{k-1}) = -(nu + 6)/2 log(1 + r' S^-1 r / nu) - 1/2 log |S|,
    S = predicted covariance of the pose + pose noise

(a Student's t of nu = FREEDOM: now and then another corner touches than was predicted; the covariance predicted is
then widened by (nu + r' S^-1 r) / (nu + 6), so that the pose seen is believed).

What rigid bodies, Coulomb's and Newton's laws leave unexplained is a Trial's `unexplained`: that share of the speed
change by contact within a frame is added to the covariance as white noise. It and the size of the pose noise are
found with friction and restitution, by the same likelihood. Pose noise is that of segment.py, median over tosses,
times `noise`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.contact.loss import REFERENCE_MASS_KG
from processing.contact.motion import GRAVITY_M_S2, rotation_matrices, rotation_vectors
from processing.contact.segment import Noise

STEP_S = 1 / 592
"""Of the rollouts: in steps of 1/148 s friction comes out a tenth lower."""
FLIGHT_CHANGE_M_S, FLIGHT_CHANGE_RAD_S = 0.004, 0.05
"""What free flight may leave unexplained in the velocities of neighbouring frames, as in smooth.py."""
ROTATION, POSITION, SPIN, VELOCITY = (slice(i, i + 3) for i in range(0, 12, 3))
"""Places in a state's error: turn (object axes), position, spin, velocity."""


@dataclass(frozen=True)
class Trial:
    """What a likelihood is asked for."""

    friction: float
    restitution: float
    unexplained: float
    noise: float
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors on the body's points along its axes: a size that is off would be taken for another friction."""


@dataclass(frozen=True, eq=False)
class Course:
    """The poses of one toss from the release on (of the centre of mass, the plane at z = 0)."""

    time_s: Float[Array, " k"]
    rotation: Float[Array, "k 3 3"]
    position_m: Float[Array, "k 3"]


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
    """Means and covariance of the states of m trials and a tosses."""

    rotation: Float[Array, "m a 3 3"]
    position: Float[Array, "m a 3"]
    spin: Float[Array, "m a 3"]
    velocity: Float[Array, "m a 3"]
    covariance: Float[Array, "m a 12 12"]

    def of(self, tosses: Sequence[int]) -> _States:
        return _States(*(values[:, list(tosses)] for values in vars(self).values()))


def _sigma_points() -> Float[Array, "s 12"]:
    """Twice 12 points with mean 0 and covariance 1, in directions that lie along no axis: along the axes they would be
    3.5 standard deviations out, where another corner touches."""
    directions, _ = np.linalg.qr(np.random.default_rng(3).standard_normal((12, 12)))
    return np.concatenate([directions.T, -directions.T]) * 12**0.5


SIGMA_POINTS = _sigma_points()
FREEDOM = 4.0


def log_likelihoods(
    courses: Sequence[Course], body: RigidBody, trials: Sequence[Trial], noise: Noise
) -> Float[Array, "m n"]:
    """log p of every toss under every trial (without the constant), summed over its frames from the third on."""
    laws = np.array([[t.friction, t.restitution] for t in trials])
    unexplained, factor = np.array([[t.unexplained, t.noise] for t in trials]).T
    points = np.array([body.points_m * np.asarray(t.stretch) for t in trials])
    sigma = np.stack([noise.rotation_rad * factor, noise.position_m * factor], 1)
    states = _first_states(courses, body, sigma)
    found = np.zeros((len(trials), len(courses)))
    for k in range(2, max(len(c.time_s) for c in courses)):
        going = [j for j, c in enumerate(courses) if k < len(c.time_s)]
        dt = np.array([courses[j].time_s[k] - courses[j].time_s[k - 1] for j in going])
        ahead, push = _predicted(states.of(going), dt, body, points, laws)
        _disturb(ahead.covariance, unexplained[:, None] * push, dt, body.reach_m)
        seen = np.stack([courses[j].rotation[k] for j in going]), np.stack([courses[j].position_m[k] for j in going])
        corrected, likelihood = _corrected(ahead, *seen, sigma)
        found[:, going] += likelihood
        for into, values in zip(vars(states).values(), vars(corrected).values()):
            into[:, going] = values
    return found


def _first_states(courses: Sequence[Course], body: RigidBody, sigma: Float[Array, "m 2"]) -> _States:
    """The state at each toss's second frame, from its first two: v = (p1 - p0) / dt, moved to the end of the step."""
    m, n = len(sigma), len(courses)
    shapes = ((m, n, 3, 3), (m, n, 3), (m, n, 3), (m, n, 3), (m, n, 12, 12))
    states = _States(*(np.zeros(shape) for shape in shapes))
    for j, c in enumerate(courses):
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


def _add(covariance: Float[Array, "*b 12 12"], rows: slice, columns: slice, values: Float[Array, "*b"]) -> None:
    """Adds multiples of the identity to a block of 3 x 3."""
    covariance[..., rows, columns] += np.asarray(values)[..., None, None] * np.eye(3)


def _predicted(
    states: _States,
    dt: Float[Array, " a"],
    body: RigidBody,
    points_m: Float[Array, "m v 3"],
    laws: Float[Array, "m 2"],
) -> tuple[_States, Float[Array, "m a"]]:
    """The states after dt (their sigma points rolled on), and the mean change of speed by contact."""
    factor = np.linalg.cholesky(states.covariance)
    moved = np.einsum("maij,sj->masi", factor, SIGMA_POINTS)
    rotation = states.rotation[:, :, None] @ _matrices(moved[..., ROTATION])
    others = [
        values[:, :, None] + moved[..., place]
        for values, place in ((states.position, POSITION), (states.spin, SPIN), (states.velocity, VELOCITY))
    ]
    rolled, push = _rolled([rotation, *others], dt, body, points_m, laws)
    middle = rolled[0][:, :, 0].copy()
    for _ in range(2):
        middle = middle @ _matrices(_turns(middle, rolled[0]).mean(2))
    turns = _turns(middle, rolled[0])
    position, spin, velocity = means = [values.mean(2) for values in rolled[1:]]
    parts = [turns - turns.mean(2, keepdims=True), *(v - mean[:, :, None] for v, mean in zip(rolled[1:], means))]
    error = np.concatenate(parts, -1)
    covariance = np.einsum("masi,masj->maij", error, error) / len(SIGMA_POINTS)
    return _States(middle, position, spin, velocity, covariance), push.mean(2)


def _rolled(
    parts: Sequence[Float[Array, "m a s ..."]],
    dt: Float[Array, " a"],
    body: RigidBody,
    points_m: Float[Array, "m v 3"],
    laws: Float[Array, "m 2"],
) -> tuple[list[Float[Array, "m a s ..."]], Float[Array, "m a s"]]:
    from processing.contact.steps_cpu import roll_rows

    m, a, s = parts[1].shape[:3]
    push, whole = np.zeros((m, a, s)), [np.array(p) for p in parts]
    steps = np.maximum(np.round(dt / STEP_S), 1).astype(int)
    for count in np.unique(steps):
        chosen = np.flatnonzero(steps == count)
        rows = [np.ascontiguousarray(p[:, chosen].reshape(-1, *p.shape[3:])) for p in whole]
        owner = np.repeat(np.arange(m), len(chosen) * s)
        contacts = min(body.contacts, len(body.points_m))
        step_s = float(dt[chosen].mean()) / int(count)
        inertia = body.inertia_kgm2
        done, _ = roll_rows(*rows, owner, laws, points_m, inertia, REFERENCE_MASS_KG, contacts, int(count), step_s)
        push[:, chosen] = done.reshape(m, len(chosen), s)
        for values, moved in zip(whole, rows):
            values[:, chosen] = moved.reshape(m, len(chosen), *values.shape[2:])
    return whole, push


def _disturb(
    covariance: Float[Array, "m a 12 12"], speed_m_s: Float[Array, "m a"], dt: Float[Array, " a"], reach_m: float
) -> None:
    """Adds a white change of velocity of this size within dt, and of spin by the same push at a lever of reach_m."""
    for pose, speed, size in (
        (ROTATION, SPIN, (speed_m_s / reach_m) ** 2 + FLIGHT_CHANGE_RAD_S**2),
        (POSITION, VELOCITY, speed_m_s**2 + FLIGHT_CHANGE_M_S**2),
    ):
        _add(covariance, pose, pose, size * dt**2 / 3)
        _add(covariance, pose, speed, size * dt / 2)
        _add(covariance, speed, pose, size * dt / 2)
        _add(covariance, speed, speed, size)


def _corrected(
    ahead: _States, rotation: Float[Array, "a 3 3"], position_m: Float[Array, "a 3"], sigma: Float[Array, "m 2"]
) -> tuple[_States, Float[Array, "m a"]]:
    """The states after a pose was seen, and how likely it was."""
    turn = rotation_vectors(np.swapaxes(ahead.rotation, -1, -2) @ rotation)
    off = np.concatenate([turn, position_m - ahead.position], -1)
    P = ahead.covariance
    noise = np.eye(6) * np.repeat(sigma**2, 3, axis=1)[:, None, None, :]
    S = P[..., :6, :6] + noise
    distance = np.einsum("mai,mai->ma", off, np.linalg.solve(S, off[..., None])[..., 0])
    likelihood = -0.5 * (FREEDOM + 6) * np.log1p(distance / FREEDOM) - 0.5 * np.linalg.slogdet(S)[1]
    wide = np.maximum((FREEDOM + distance) / (FREEDOM + 6), 1.0)[..., None, None]
    P = P * wide
    S = P[..., :6, :6] + noise
    gain = np.swapaxes(np.linalg.solve(S, P[..., :6, :]), -1, -2)
    step = np.einsum("maij,maj->mai", gain, off)
    left = P - gain @ P[..., :6, :]
    left = 0.5 * (left + np.swapaxes(left, -1, -2)) + 1e-12 * np.eye(12)
    corrected = _States(
        ahead.rotation @ _matrices(step[..., ROTATION]),
        ahead.position + step[..., POSITION],
        ahead.spin + step[..., SPIN],
        ahead.velocity + step[..., VELOCITY],
        left,
    )
    return corrected, likelihood


def _matrices(vectors: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    return rotation_matrices(vectors)


def _turns(middle: Float[Array, "m a 3 3"], rotation: Float[Array, "m a s 3 3"]) -> Float[Array, "m a s 3"]:
    """Rotation vectors from the middle to each."""
    return rotation_vectors(np.swapaxes(middle, -1, -2)[:, :, None] @ rotation)
