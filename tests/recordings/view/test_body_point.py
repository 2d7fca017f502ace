"""Truth and estimates are followed at one and the same point of the body, whatever frames they are in."""

from dataclasses import replace

import numpy as np
import pytest

from recordings.geometry import rotation_exp
from recordings.records import StampedPose
from recordings.tracks import RigCalibration
from recordings.view.bodies import speeds_m_s
from recordings.view.body_point import at_same_point
from recordings.view.scene import TRUTH_NAME, Body, Scene, root_poses

STEP_NS = 33_000_000


def tumbling(count=12):
    """World poses of a body that flies and turns."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for k in range(count):
        poses[k, :3, :3] = rotation_exp(np.array([0.4, 0.2, 0.3]) * k)
        poses[k, :3, 3] = [0.02 * k, 0.01 * k, 0.3 - 0.002 * k * k]
    return poses


def body(name, poses, shapes, shown=True):
    stamped = tuple(StampedPose(k * STEP_NS, "world", name, pose) for k, pose in enumerate(poses))
    return Body(name, name, (1, 2, 3), {0: stamped}, shapes, shown)


def scene(*bodies):
    return Scene("s", None, RigCalibration({}, ()), "world", bodies, (0,), {0: 0}, {0: (0, 1)}, ())


def followed(among, one):
    return at_same_point(among, one, 0, *root_poses(among, one.poses[0]))


@pytest.fixture
def moved_frame():
    """truth_from_estimate: the estimate's frame lies 3 cm beside the truth's, and is turned."""
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = rotation_exp(np.array([0.5, -1.0, 0.2])), [0.03, -0.02, 0.01]
    return found


def test_an_estimate_in_another_body_frame_has_the_truths_height_and_speed(tiny, moved_frame):
    truth = body(TRUTH_NAME, tumbling(), {0: tiny.CUBE})
    estimate = body("ours", tumbling() @ moved_frame, {})
    both = scene(estimate, truth)
    a, b = followed(both, truth), followed(both, estimate)
    np.testing.assert_allclose(b[:, :3, 3], a[:, :3, 3], atol=1e-9)
    times_ns = np.arange(len(a)) * STEP_NS
    np.testing.assert_allclose(speeds_m_s(times_ns, b)[1:], speeds_m_s(times_ns, a)[1:], atol=1e-6)


def test_poses_that_are_wrong_in_some_frames_stay_wrong_there_alone(tiny, moved_frame):
    wrong = tumbling() @ moved_frame
    wrong[3, 2, 3] += 0.05
    wrong[7] = np.nan
    truth, estimate = body(TRUTH_NAME, tumbling(), {0: tiny.CUBE}), body("ours", wrong, {})
    both = scene(truth, estimate)
    gap = followed(both, estimate)[:, 2, 3] - followed(both, truth)[:, 2, 3]
    assert gap[3] == pytest.approx(0.05, abs=1e-9)
    assert np.isnan(gap[7])
    np.testing.assert_allclose(np.delete(gap, [3, 7]), 0, atol=1e-9)


def test_the_point_is_the_middle_of_the_shape_and_without_a_shape_the_origin(tiny):
    off = replace(tiny.CUBE, vertices_m=tiny.CUBE.vertices_m + [0.1, 0, 0])
    alone = body(TRUTH_NAME, tumbling(), {0: off})
    middle = tumbling()[:, :3, :3] @ [0.1, 0, 0] + tumbling()[:, :3, 3]
    np.testing.assert_allclose(followed(scene(alone), alone)[:, :3, 3], middle, atol=1e-12)
    bare = body("ours", tumbling(), {})
    np.testing.assert_allclose(followed(scene(bare), bare), tumbling())
