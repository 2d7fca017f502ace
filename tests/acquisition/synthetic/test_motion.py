"""Hold, lead-in, flight, contact, rest: the laws they obey."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic.scene import frame_times

from acquisition.synthetic.config import ContactConfig, ObjectConfig
from acquisition.synthetic.lab import Lab
from acquisition.synthetic.motion import Release, unseen_hand
from acquisition.synthetic.objects.shapes import build, mass_properties
from acquisition.synthetic.physics import Table
from recordings.errors import BadInput
from recordings.geometry import Transform, rotation_angle_rad, rotation_exp

G = 9.81


def release(height_m=0.3, velocity=(0.3, 0.1, 0.5), spin=(2.0, 5.0, -3.0), turn=(0.4, 0.2, 0.9)):
    pose = Transform("world", "object", rotation_exp(np.array(turn)), np.array([0.0, 0.0, height_m]))
    return Release(pose, np.array(velocity), np.array(spin))


def dropped(shape="cube", contact=None, start=None, longest_s=2.5):
    contact, start = contact or ContactConfig(), start or release()
    solid = build(ObjectConfig(shape))
    return Table(solid, mass_properties(solid, 0.3), contact).drop(start, 1.0, longest_s, 0.2), solid


def test_the_centre_of_mass_flies_on_a_parabola_until_the_first_contact():
    (path, impact_s, _), solid = dropped("l")
    center = mass_properties(solid, 0.3).center_m
    rows = path.times_s < impact_s - 0.01
    t = path.times_s[rows] - 1.0
    com = np.array([path.at(s).points(center) for s in path.times_s[rows]])
    start = release()
    velocity = start.velocity_world_m_s + np.cross(
        start.angular_velocity_world_rad_s, start.world_from_object.rotation @ center
    )
    parabola = com[0] + t[:, None] * velocity - 0.5 * G * t[:, None] ** 2 * [0, 0, 1]
    np.testing.assert_allclose(com, parabola, atol=1e-3)


def test_spin_about_a_principal_axis_of_a_cube_stays_in_flight():
    (path, impact_s, _), _ = dropped("cube")
    rows = path.times_s < impact_s - 0.01
    spin = path.angular_velocity_object_rad_s[rows]
    np.testing.assert_allclose(np.linalg.norm(spin, axis=1), np.linalg.norm([2.0, 5.0, -3.0]), rtol=1e-3)
    turned = rotation_angle_rad(path.at(1.0).rotation.T @ path.at(1.1).rotation)
    assert turned == pytest.approx(0.1 * np.linalg.norm([2.0, 5.0, -3.0]), rel=1e-2)


@pytest.mark.parametrize("shape", ["cube", "prism", "l", "mug"])
def test_it_comes_to_rest_on_the_table_and_hardly_dips_into_it(shape):
    (path, impact_s, rest_s), solid = dropped(shape)
    assert 1.0 < impact_s < rest_s < 3.5
    lowest = [path.at(t).points(solid.vertices_m)[:, 2].min() for t in path.times_s[::10]]
    assert min(lowest) > -0.006
    assert -0.0015 < path.at(rest_s + 0.15).points(solid.vertices_m)[:, 2].min() < 0.001


def test_more_friction_stops_a_sliding_cube_earlier():
    flat = release(0.0525, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    slid = [dropped("cube", ContactConfig(friction=mu), flat)[0][0].position_m[-1, 0] for mu in (0.2, 0.4)]
    # v^2 / (2 mu g), for a cube that does not tip over
    assert slid[0] == pytest.approx(1 / (2 * 0.2 * G), rel=0.1)
    assert slid[1] == pytest.approx(1 / (2 * 0.4 * G), rel=0.1)


def test_an_unseen_hand_starts_at_rest_and_ends_in_the_release_state():
    start = release()
    path = unseen_hand(start, 0.3, 0.2, 0.001)
    np.testing.assert_allclose(path.position_m[:300], path.position_m[[0]].repeat(300, 0))
    np.testing.assert_allclose(path.velocity_world_m_s[0], 0)
    end_s = path.times_s[-1]
    np.testing.assert_allclose(path.at(end_s).translation_m, start.world_from_object.translation_m, atol=2e-3)
    moved = (path.position_m[-1] - path.position_m[-11]) / 0.01
    np.testing.assert_allclose(moved, start.velocity_world_m_s, rtol=0.05)
    turned = path.at(end_s).rotation @ path.at(end_s - 0.01).rotation.T
    assert rotation_angle_rad(turned) == pytest.approx(0.01 * np.linalg.norm([2.0, 5.0, -3.0]), rel=0.06)


def test_velocities_are_the_derivatives_of_the_poses(motion):
    path = motion.object
    for t in np.linspace(motion.instants.lead_in_s + 0.05, motion.instants.first_impact_s - 0.02, 7):
        row = int(np.searchsorted(path.times_s, t))
        h = 0.002
        speed = (path.at(path.times_s[row] + h).translation_m - path.at(path.times_s[row] - h).translation_m) / (2 * h)
        np.testing.assert_allclose(speed, path.velocity_world_m_s[row], atol=0.02)


def test_the_phases_follow_one_another(motion):
    i = motion.instants
    assert 0 < i.lead_in_s < i.release_s < i.first_impact_s < i.rest_s < i.end_s
    found = [i.phase(t) for t in (0.0, i.lead_in_s + 0.01, i.release_s + 0.01, i.rest_s + 0.01)]
    assert found == ["hold", "leadin", "free", "rest"]


def test_the_camera_sees_the_whole_object_all_the_time(lab, motion):
    for t in np.linspace(0, motion.instants.end_s, 50):
        points = (lab.d455.camera_from_world @ motion.object.at(t)).points(lab.solid.vertices_m)
        assert lab.d455.camera.sees(lab.d455.camera.project(points)).all()


def test_every_toss_of_a_session_is_another_one_and_the_same_again(lab, motion):
    np.testing.assert_array_equal(lab.plan(0).object.position_m, motion.object.position_m)
    assert np.abs(lab.plan(1).object.position_m[0] - motion.object.position_m[0]).max() > 0.01


@pytest.mark.parametrize("spin", [2.0, 20.0])
def test_the_spin_is_as_set(altered, spin):
    lab = Lab(altered(motion={"spin_rad_s": spin, "spread": 0.0, "lead_in_s": 0.1}))
    motion = lab.plan(0)
    row = int(np.searchsorted(motion.object.times_s, motion.free_s))
    assert np.linalg.norm(motion.object.angular_velocity_object_rad_s[row]) == pytest.approx(spin, rel=1e-6)


def test_a_toss_that_cannot_stay_in_view_is_refused_with_what_to_change(altered, monkeypatch):
    monkeypatch.setattr("acquisition.synthetic.planner.TRIES", 10)
    lab = Lab(altered(motion={"forward_speed_m_s": 6.0, "longest_free_s": 0.5}))
    with pytest.raises(BadInput, match="lower the speeds"):
        lab.plan(0)


def test_dropped_frames_are_missing_at_the_share_that_was_set(altered):
    config = altered(camera={"dropped_share": 0.1, "time_jitter_s": 0.0002})
    times, kept, lost = frame_times(config, 0, 20.0)
    assert len(times) == len(kept) + len(lost) == 601
    assert 30 < len(lost) < 95
    assert kept[0] == 0
    assert kept[-1] == 600
    assert np.std(np.diff(times)) < 0.0005
