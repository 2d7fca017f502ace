"""The one place of thresholds of motion, of tangent vectors, of poses at other times."""

import ast
import re
from pathlib import Path

import numpy as np

from processing.motion import thresholds
from processing.motion.interpolate import straight_between
from processing.motion.tangents import about
from recordings.geometry import rotation_exp


def test_every_threshold_of_motion_has_its_unit_in_its_name_and_a_sentence_below():
    body = ast.parse(Path(thresholds.__file__).read_text()).body
    assigned = [i for i, node in enumerate(body) if isinstance(node, ast.Assign)]
    assert len(assigned) >= 7
    for i in assigned:
        names = [n.id for n in ast.walk(body[i]) if isinstance(n, ast.Name)]
        assert all(re.search(r"_(M|RAD)(_S2?)?$", name) for name in names), names
        assert isinstance(body[i + 1], ast.Expr), f"{names} are not explained"


def test_a_turn_about_a_centre_moves_the_centre_by_the_shift_alone():
    center, shift = np.array([0.1, -0.2, 0.3]), np.array([0.01, 0.02, -0.03])
    motion = about(center, np.array([0.4, -1.0, 0.2]), shift)
    np.testing.assert_allclose(motion[:3, :3] @ center + motion[:3, 3], center + shift, atol=1e-15)
    np.testing.assert_allclose(motion[:3, :3], rotation_exp(np.array([0.4, -1.0, 0.2])), atol=0)


def test_a_turn_about_the_origin_leaves_the_shift_as_it_is():
    shift = np.array([0.01, 0.02, -0.03])
    np.testing.assert_array_equal(about(np.zeros(3), np.array([0.4, -1.0, 0.2]), shift)[:3, 3], shift)


def test_between_two_poses_the_way_is_straight_and_the_turn_steady():
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, :3], poses[1, :3, 3] = rotation_exp(np.array([0.0, 0.0, 1.2])), [0.2, 0.0, -0.4]
    found = straight_between(np.array([1.0, 3.0]), poses, np.array([1.0, 1.5, 3.0]))
    np.testing.assert_allclose(found[[0, 2]], poses, atol=1e-15)
    np.testing.assert_allclose(found[1, :3, 3], [0.05, 0.0, -0.1], atol=1e-15)
    np.testing.assert_allclose(found[1, :3, :3], rotation_exp(np.array([0.0, 0.0, 0.3])), atol=1e-15)
