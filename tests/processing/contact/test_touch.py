from dataclasses import replace

import numpy as np
import pytest

from processing.contact.friction.forecast import Law, RigidBody
from processing.contact.friction.plane_forecast import plane_by_forecasts
from processing.contact.learn import data_checks as checks
from processing.contact.learn.learn import learn_contact
from processing.contact.learn.prior import prior_from_size
from processing.contact.learn.touch import Touches, hinge, plane_by_touch, touches
from processing.contact.physics.geometry import CORNERS
from processing.contact.physics.rollout import Start, simulate_law
from processing.motion.smoother import smooth
from processing.motion.trajectory import PoseSeries, rotation_matrices
from recordings.errors import BadInput

CUBE_M = 0.05 * CORNERS
WEDGE_M = np.array([[-36, 0, -50], [36, 0, -50], [0, 72, -50], [-36, 0, 50], [36, 0, 50], [0, 72, 50]]) * 1e-3
WEDGE_M -= WEDGE_M.mean(0)


def touching(corners_m, plane_m, radius_m=0.0, count=150, noise_m=0.0):
    """Touches in attitudes all around of a body with these corners whose edges are rounded by a radius."""
    rng = np.random.default_rng(0)
    up = rng.standard_normal((count, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    lowest = (up @ corners_m.T).min(1) - radius_m
    height = plane_m - lowest + noise_m * rng.standard_normal(count)
    return Touches(up, height, np.arange(count) // 10)


@pytest.mark.parametrize("corners_m", [CUBE_M, WEDGE_M], ids=["cube", "wedge"])
@pytest.mark.parametrize("plane_m", [-0.012, -0.006, 0.0, 0.008])
def test_sharp_bodies_tell_the_height_of_their_plane(corners_m, plane_m):
    height_m, weight = hinge(touching(corners_m, plane_m))
    assert height_m == pytest.approx(plane_m, abs=1e-3)
    assert weight > 3


def test_noise_of_the_heights_moves_the_plane_less_than_it_is():
    height_m, _ = hinge(touching(CUBE_M, 0.003, noise_m=3e-4))
    assert height_m == pytest.approx(0.003, abs=1.5e-3)


def test_edges_rounded_by_a_radius_read_as_a_plane_that_is_higher_by_it():
    """The very same heights: nothing that a plane touches can tell them apart."""
    inner = CUBE_M * (0.046 / 0.05)
    np.testing.assert_allclose(touching(inner, 0.0, 0.004).height_m, touching(inner, 0.004).height_m)
    assert hinge(touching(inner, 0.0, 0.004))[0] == pytest.approx(0.004, abs=1e-3)


def test_faces_alone_tell_nothing_of_the_plane():
    """One face down, then another: any plane has a box for it."""
    faces = Touches(np.repeat(np.eye(3), 20, axis=0), np.full(60, 0.05), np.arange(60) % 4)
    assert np.isnan(hinge(faces)[0])


def test_flight_and_hard_impacts_are_no_touches(simulated_tosses):
    tracks = simulated_tosses(6, 130)
    found = [touches(t, 0, i) for i, t in enumerate(tracks)]
    lowest = np.concatenate([(f.up_object @ (CORNERS * [0.05, 0.04, 0.03]).T).min(1) + f.height_m for f in found])
    assert 6 <= len(lowest) < sum(map(len, tracks)) / 4
    assert np.median(np.abs(lowest)) < 1e-3
    flying = tracks[0].part(slice(0, 12))
    assert len(touches(replace(flying, position_m=flying.position_m + [0, 0, 1]), 0, 0).height_m) < 3


def test_frames_far_apart_or_noisy_tell_nothing(simulated_tosses):
    tracks = simulated_tosses(4, 130)
    assert plane_by_touch([t.part(slice(0, None, 5)) for t in tracks], [0] * 4) is None
    rough = np.random.default_rng(0).standard_normal((130, 3))
    assert plane_by_touch([replace(t, position_m=t.position_m + 1e-3 * rough) for t in tracks], [0] * 4) is None
    assert plane_by_touch(tracks[:2], [0, 0]) is None


@pytest.mark.parametrize("height_mm, word", [(9, "9 +- 1 mm above"), (-5, "5 +- 1 mm below"), (0, None), (4, None)])
def test_a_plane_that_the_touches_contradict_is_warned_of(height_mm, word):
    said = checks.plane_warning(1e-3 * height_mm, 1e-3)
    assert said is None if word is None else word in said and "toss-calibrate table" in said
    assert checks.plane_warning(1e-3 * height_mm, 1e-2) is None
    assert checks.plane_warning(None, None) is None


def test_a_plane_surely_5_mm_too_high_is_refused():
    checks.check_touched_plane(-0.006, 0.001)
    checks.check_touched_plane(0.012, 0.001)  # edges may be rounded by as much
    with pytest.raises(BadInput, match="8 .- 1 mm below where it was said to be"):
        checks.check_touched_plane(-0.008, 0.001)


@pytest.mark.parametrize("shift_mm, word", [(0, None), (8, "above"), (-8, "below"), (-6, "below")])
def test_real_tosses_show_a_plane_that_is_off(real_tosses, shift_mm, word):
    """Their plane is 1.2 mm low and the cube's edges are rounded by about 4 mm: they read 2.8 mm."""
    tracks = [replace(t, position_m=t.position_m + [0, 0, 1e-3 * shift_mm]) for t in real_tosses(range(10))]
    found = plane_by_touch(tracks, [2] * len(tracks))
    assert found.height_m == pytest.approx(2.8e-3 + 1e-3 * shift_mm, abs=1.5e-3)
    said = checks.plane_warning(found.height_m, found.std_m)
    assert said is None if word is None else word in said


def test_noisy_real_tosses_at_a_cameras_rate_tell_nothing(real_tosses):
    """Between such frames the cube strikes and leaves: read as touches they put the plane 15 mm too low, surely."""
    rng, tracks = np.random.default_rng(0), [t.part(slice(0, None, 5)) for t in real_tosses(range(10))]
    noisy = [
        replace(
            t,
            rotation=t.rotation @ rotation_matrices(0.009 * rng.standard_normal((len(t), 3))),
            position_m=t.position_m + 1e-3 * rng.standard_normal((len(t), 3)),
        )
        for t in tracks
    ]
    assert plane_by_touch(noisy, [0] * 10) is None


def test_a_session_whose_plane_is_far_too_high_is_refused_before_learning(real_tosses, cube_physics):
    tracks = [replace(t, position_m=t.position_m - [0, 0, 0.014]) for t in real_tosses(range(8))]
    with pytest.raises(BadInput, match="below where it was said to be"):
        learn_contact(tracks, prior_from_size("box", 0.05), cube_physics)


@pytest.mark.slow
def test_at_camera_rates_a_box_is_forecast_best_on_its_own_plane(box_body, box_physics):
    """The plane was said 6 mm too high, so the box was learned smaller by that all around."""
    half_m = np.array([0.05, 0.04, 0.03]) - 0.006
    box = RigidBody(CORNERS * half_m, 8, box_physics.inertia_kgm2)
    law = Law(0.25, 0.0, 0.05)
    tracks = [t.turned(np.eye(3), 0.006) for t in _tosses_under(law, box_body)]
    made = [smooth(t, box_physics.inertia_kgm2) for t in tracks]
    found = plane_by_forecasts(box, tracks, made, law)
    assert found.height_m == pytest.approx(-0.006, abs=2.5e-3)
    assert found.std_m < 6e-3


def _tosses_under(law, body, count=10, frames=26, step_s=5 / 148):
    """Tosses at a camera's rate under a law of contact."""
    rng = np.random.default_rng(0)
    rotation, spin = rotation_matrices(rng.uniform(-2, 2, (count, 3))), rng.uniform(-7, 7, (count, 3))
    position = np.column_stack([np.zeros((count, 2)), rng.uniform(0.13, 0.17, count)])
    velocity = np.column_stack([rng.uniform(-1, 1, (count, 2)), rng.uniform(-0.6, 0.2, count)])
    done = simulate_law(body, 8, law, Start(rotation, position, spin, velocity), frames - 1, step_s)
    return [
        PoseSeries(
            i,
            step_s * np.arange(frames),
            np.concatenate([rotation[i : i + 1], done.rotation[i]]),
            np.concatenate([position[i : i + 1], done.position_m[i]]),
        )
        for i in range(count)
    ]
