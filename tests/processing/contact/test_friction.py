from dataclasses import replace

import numba
import numpy as np
import pytest

from processing.contact.friction.estimate import (
    FRICTION_UNSEEN,
    PRIOR_LOG_SIGMA,
    PRIOR_MEDIAN,
    frames_are_slow,
    friction_by_forecasts,
    marginal,
    posterior,
)
from processing.contact.friction.forecast import MEMBERS, Forecasts, Law, ObservedTrajectory, RigidBody
from processing.contact.learn.fit import FRICTION, Fit
from processing.contact.learn.intervals import Spread
from processing.contact.learn.learn import ContactConfig, with_friction
from processing.contact.learn.prepared import prepare
from processing.contact.learn.prior import prior_from_size
from processing.contact.physics.plane import Plane
from processing.contact.physics.rollout import Start, simulate, simulate_law
from processing.contact.physics.steps_cpu import roll_rows
from processing.motion.phases import Noise
from processing.motion.trajectory import GRAVITY_M_S2, rotation_matrices

BOX_FRICTION = 0.25


@pytest.fixture
def rigid_box(box_body):
    return RigidBody(box_body.points_m.numpy(), 4, box_body.inertia_kgm2.numpy())


def found_at(tosses, body, physics):
    prepared = prepare(tosses, prior_from_size("box", 0.08).frame, Plane(), physics.inertia_kgm2)
    return friction_by_forecasts(body, prepared.tracks, prepared.smoothed)


def noisy(track, seed):
    rng = np.random.default_rng([seed, track.toss])
    turned = track.rotation @ rotation_matrices(np.radians(0.5) * rng.standard_normal((len(track), 3)))
    return replace(track, rotation=turned, position_m=track.position_m + 1e-3 * rng.standard_normal((len(track), 3)))


@pytest.mark.slow
def test_friction_by_forecasts_at_30_hz_under_noise_is_the_true_one(simulated_tosses, rigid_box, box_physics):
    tosses = [noisy(t.part(slice(0, None, 5)), 1) for t in simulated_tosses(5, 130)]
    found = found_at(tosses, rigid_box, box_physics)
    assert found.friction.value == pytest.approx(BOX_FRICTION, rel=0.12)
    assert found.friction.low < BOX_FRICTION < found.friction.high
    assert found.law.restitution < 0.15


def test_of_frictions_at_30_hz_under_noise_the_true_one_forecasts_best(simulated_tosses, rigid_box):
    tosses = [noisy(t.part(slice(0, 90, 5)), 1) for t in simulated_tosses(6, 130)]
    trajectories = [ObservedTrajectory(t.time_s, t.rotation, t.position_m, 3) for t in tosses]
    laws = [Law(f * BOX_FRICTION, 0.0, 0.05) for f in (0.6, 0.8, 1.0, 1.25, 1.7)]
    found = Forecasts(trajectories, rigid_box, Noise(1e-3, np.radians(0.5))).scores(laws)
    assert found.shape == (5, 6)
    assert found.sum(1).argmin() == 2


def test_a_law_is_rolled_out_once_and_scores_the_same_in_any_company(simulated_tosses, rigid_box, monkeypatch):
    tosses = [t.part(slice(0, 40, 5)) for t in simulated_tosses(2, 130)]
    trajectories = [ObservedTrajectory(t.time_s, t.rotation, t.position_m, 3) for t in tosses]
    forecasts, fresh = (Forecasts(trajectories, rigid_box, Noise(1e-3, np.radians(0.5))) for _ in range(2))
    slow, fast = Law(0.2, 0.1, 0.05), Law(0.3, 0.0, 0.05)
    first = forecasts.scores([slow, fast])
    np.testing.assert_array_equal(fresh.scores([slow, fast]), first)
    alone = fresh.energies([fast])[0] / fresh._scale_m
    np.testing.assert_array_equal(alone.sum(2), first[1:])
    monkeypatch.setattr(forecasts, "energies", lambda laws: pytest.fail("rolled out again"))
    np.testing.assert_array_equal(forecasts.scores([fast, slow, fast]), first[[1, 0, 1]])


def test_forecasts_and_rollouts_call_the_kernel_with_one_signature(simulated_tosses, rigid_box, box_body, monkeypatch):
    """Every further one is compiled anew, which takes ten seconds."""
    signatures = set()

    def recorded(*arguments):
        signatures.add(tuple(numba.typeof(a) for a in arguments))
        return roll_rows(*arguments)

    monkeypatch.setattr("processing.contact.physics.steps_cpu.roll_rows", recorded)
    tosses = [t.part(slice(0, 40, 5)) for t in simulated_tosses(2, 130)]
    trajectories = [ObservedTrajectory(t.time_s, t.rotation, t.position_m, 3) for t in tosses]
    Forecasts(trajectories, rigid_box, Noise(1e-3, np.radians(0.5))).scores([Law(0.2, 0.1, 0.05), Law(0.3, 0.0, 0.05)])
    start = Start(*(x[None] for x in (np.eye(3), np.array([0.0, 0.0, 0.2]), np.zeros(3), np.zeros(3))))
    simulate_law(box_body, 4, Law(0.2, 0.1, 0.05), start, 2, 1 / 148)
    assert len(signatures) == 1


class Scored(Forecasts):
    """Scores by a formula of log friction, restitution and the logarithm of what they leave unexplained."""

    def __init__(self, formula):
        self.formula = formula

    def scores(self, laws):
        columns = np.array([[np.log(w.friction), w.restitution, np.log(w.unexplained)] for w in laws]).T
        return (self.formula(*columns) + np.zeros(len(laws)))[:, None]


@pytest.mark.parametrize("slope", [0, 2, 4, 6])
def test_the_posterior_follows_a_valley_in_which_friction_trades_for_restitution(slope):
    """Best at .2, .32 and .05."""

    def valley(log_friction, rebound, log_rest):
        off, beside = log_friction - np.log(0.2), rebound - 0.32
        return 100 * (off + slope * beside) ** 2 + 20 * off**2 + (log_rest - np.log(0.05)) ** 2

    found = posterior(Scored(valley))
    assert found.unexplained == 0.05
    assert found.friction.value == pytest.approx(0.2, rel=0.15)
    assert found.friction.low < 0.2 < found.friction.high
    assert found.friction.high / found.friction.low < 3


def test_tosses_that_tell_nothing_leave_the_prior():
    found = posterior(Scored(lambda *law: 7.0)).friction
    assert found.value == pytest.approx(PRIOR_MEDIAN, rel=0.03)
    assert np.log(found.high / found.low) == pytest.approx(2 * 1.96 * PRIOR_LOG_SIGMA, rel=0.1)


def test_two_valleys_are_both_within_the_interval():
    two = posterior(
        Scored(lambda log_friction, *_: 30 * np.minimum(*(abs(log_friction - np.log(m)) for m in (0.1, 0.8))))
    )
    assert two.friction.low < 0.1
    assert two.friction.high > 0.8


def test_a_marginals_value_and_interval_are_a_gaussians():
    at = np.linspace(-3.0, 1.0, 16)
    middle, low, high = marginal(at, -0.5 * ((at + 1.2) / 0.2) ** 2, 0.15)
    assert middle == pytest.approx(-1.2, abs=0.015)
    assert high - low == pytest.approx(2 * 1.96 * 0.25, rel=0.03)
    assert (high - middle, middle - low) == (pytest.approx(0.49, abs=0.04), pytest.approx(0.49, abs=0.04))


def test_an_interval_may_hold_the_grids_end():
    at = np.linspace(0.0, 0.8, 6)
    middle, low, high = marginal(at, -0.5 * (at / 0.1) ** 2, 0.1)
    assert low == 0.0 <= middle < 0.07
    assert high == pytest.approx(1.96 * 0.1 * 2**0.5, abs=0.06)


@pytest.mark.parametrize("count", [1, 2])
def test_few_tosses_hold_the_true_friction_within_their_interval(simulated_tosses, rigid_box, box_physics, count):
    found = found_at([t.part(slice(0, None, 5)) for t in simulated_tosses(count)], rigid_box, box_physics)
    assert found.friction.value == pytest.approx(BOX_FRICTION, rel=0.5)
    assert found.friction.low < BOX_FRICTION < found.friction.high


def test_a_toss_that_never_hits_tells_no_friction(simulated_tosses, rigid_box, box_physics):
    flight = [t.part(slice(0, 8)) for t in simulated_tosses(1)]
    assert found_at(flight, rigid_box, box_physics) is None


def test_where_forecasts_were_wanted_and_none_could_be_made_friction_is_what_any_may_be(simulated_tosses, box_physics):
    frame, fit = prior_from_size("box", 0.08).frame, Fit(np.array([0.3]), 0.0, 1, 0, 0)
    spread = Spread("bootstrap", 0.02, np.zeros(3), None)
    for every, seen in ((1, True), (5, False)):
        tosses = [t.part(slice(0, None, every)) for t in simulated_tosses(1)]
        prepared = prepare(tosses, frame, Plane(), box_physics.inertia_kgm2)
        told, wide = with_friction(fit, spread, None, prepared, ContactConfig())
        assert wide.friction_seen == seen
        if seen:
            assert (told, wide) == (fit, spread)
        else:
            assert told.parameters[FRICTION] ** 2 == pytest.approx(FRICTION_UNSEEN.value)
            assert wide.friction > 1.0


def test_a_cameras_frames_are_slow_and_a_motion_capture_systems_are_not(simulated_tosses):
    fast = simulated_tosses(3)
    assert (frames_are_slow(fast), frames_are_slow([t.part(slice(0, None, 5)) for t in fast])) == (False, True)


def dropped(restitution, height_m=0.2, steps=200):
    """A level box dropped onto its face: height of its middle after each of `steps` steps of 1/592 s."""
    points = np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.04, 0.04) for z in (-0.03, 0.03)])
    state = [np.eye(3)[None].copy(), np.array([[0.0, 0.0, height_m]]), np.zeros((1, 3)), np.zeros((1, 3))]
    laws, owner, heights = np.array([[0.3, restitution]]), np.zeros(1, dtype=int), []
    for _ in range(steps):
        roll_rows(*state, owner, laws, points, np.diag([1e-3, 1e-3, 1e-3]), 0.37, 8, 1, 1 / 592)
        heights.append(float(state[1][0, 2]))
    return np.array(heights)


def test_a_dropped_box_rebounds_to_restitution_squared_times_its_height():
    heights = dropped(0.5)
    hit = int(heights.argmin())
    assert heights[hit:].max() - 0.03 == pytest.approx(0.25 * 0.17, abs=1.83 / 592)  # the gap that one step may leave
    still = dropped(0.0)
    assert still[int(still.argmin()) :].max() == pytest.approx(0.03, abs=2e-3)


def test_a_sliding_box_slows_down_by_friction_times_gravity(rigid_box):
    state = [np.eye(3)[None].copy(), np.array([[0.0, 0.0, 0.03]]), np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]])]
    laws, owner = np.array([[0.2, 0.3]]), np.zeros(1, dtype=int)
    inertia = rigid_box.inertia_kgm2
    pushed, failures = roll_rows(*state, owner, laws, rigid_box.points_m, inertia, 0.37, 8, 120, 1 / 592)
    assert failures == 0
    assert state[3][0, 0] == pytest.approx(1.0 - 0.2 * GRAVITY_M_S2 * 120 / 592, rel=0.02)
    assert pushed[0] == pytest.approx(GRAVITY_M_S2 * 120 / 592 * (1 + 0.2**2) ** 0.5, rel=0.02)


@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_a_plate_that_strikes_at_a_slant_leaves_by_coulombs_law(restitution):
    """v_z+ = -e v_z-, and the push along the plane is friction times the push across it; sliding lifts nothing."""
    plate = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.005, 0.005)])
    state = [np.eye(3)[None].copy(), np.array([[0.0, 0.0, 0.005]]), np.zeros((1, 3)), np.array([[2.0, 0.0, -1.0]])]
    inertia = np.diag([1.2e-3, 1.2e-3, 2.5e-3])
    laws, owner = np.array([[0.3, restitution]]), np.zeros(1, dtype=int)
    roll_rows(*state, owner, laws, plate, inertia, 0.37, 4, 1, 1 / 592)
    fall = 1.0 + GRAVITY_M_S2 / 592
    assert state[3][0] == pytest.approx([2.0 - 0.3 * (1 + restitution) * fall, 0.0, restitution * fall], abs=5e-3)


def test_in_flight_no_friction_forecasts_better_than_another(rigid_box):
    """And the score is that of a forecast as wide as the truth: a mean distance less half the members' own."""
    rng, time_s = np.random.default_rng(0), np.arange(9) / 30
    fall = np.stack([1.0 * time_s, 0 * time_s, 3 + 0.2 * time_s - 0.5 * GRAVITY_M_S2 * time_s**2], 1)
    turns = rotation_matrices(np.outer(time_s, [0.0, 0.0, 4.0]))
    trajectories = [
        ObservedTrajectory(
            time_s,
            turns @ rotation_matrices(0.01 * rng.standard_normal((9, 3))),
            fall + 1e-3 * rng.standard_normal((9, 3)),
            6,
        )
        for _ in range(12)
    ]
    found = (
        Forecasts(trajectories, rigid_box, Noise(1e-3, 0.01)).scores([Law(0.1, 0.0, 0.1), Law(0.5, 0.3, 0.4)]).sum(1)
    )
    assert found[0] == pytest.approx(found[1])
    # three frames a toss; of a Gaussian as wide as the truth the score is half the mean distance
    assert found[0] / (12 * 3) == pytest.approx(0.5, abs=0.15)
    assert MEMBERS == 24


def test_rollouts_under_a_law_without_rebound_are_those_without_a_law(box_body, simulated_tosses):
    """Over the flight and the first impacts; then points below the plane, which a law does not push out, differ."""
    tosses = simulated_tosses(4)
    start = Start(
        np.stack([t.rotation[0] for t in tosses]),
        np.stack([t.position_m[0] for t in tosses]),
        np.tile([1.0, -2.0, 0.5], (4, 1)),
        np.tile([0.5, 0.2, -0.3], (4, 1)),
    )
    plain = simulate(box_body, 8, start, 160, 1 / 592)
    lawful = simulate_law(box_body, 8, Law(float(box_body.friction), 0.0, 0.1), start, 40, 4 / 592)
    assert lawful.failures == 0
    np.testing.assert_allclose(lawful.position_m[:, :16], plain.position_m[:, 3:64:4], atol=3e-3)
    np.testing.assert_allclose(lawful.rotation[:, :16], plain.rotation[:, 3:64:4], atol=0.1)
    np.testing.assert_allclose(lawful.position_m[:, 0], plain.position_m[:, 3], atol=1e-9)
