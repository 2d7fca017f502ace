import numpy as np
import pytest

from processing.contact.friction import STEP_S, frames_are_slow, friction_by_rollouts
from processing.contact.plane import Plane
from processing.contact.prepared import prepare, starts
from processing.contact.prior import prior_from_size

BOX_FRICTION = 0.25


def found_at(tosses, body, physics):
    prepared = prepare(tosses, prior_from_size("box", 0.08).frame, Plane(), physics.inertia_kgm2)
    start, begin = starts(prepared, STEP_S, physics.inertia_kgm2)
    return friction_by_rollouts(body, 8, prepared.tracks, prepared.smoothed, start, begin)


@pytest.mark.parametrize("every", [1, 5])
def test_friction_by_rollouts_is_the_true_one_at_148_and_at_30_hz(simulated_tosses, box_body, box_physics, every):
    tosses = [t.part(slice(0, None, every)) for t in simulated_tosses(6, 130)]
    found = found_at(tosses, box_body, box_physics)
    assert found.value == pytest.approx(BOX_FRICTION, rel=0.12)
    assert abs(found.value - BOX_FRICTION) < found.half_width
    assert np.isfinite(found.error_m).all()


def test_two_tosses_are_too_few(simulated_tosses, box_body, box_physics):
    assert found_at(simulated_tosses(2), box_body, box_physics) is None


def test_a_cameras_frames_are_slow_and_a_motion_capture_systems_are_not(simulated_tosses):
    fast = simulated_tosses(3)
    assert (frames_are_slow(fast), frames_are_slow([t.part(slice(0, None, 5)) for t in fast])) == (False, True)
