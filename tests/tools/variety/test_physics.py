"""Both engines obey the laws of flight and contact."""

import numpy as np
import pytest
import trimesh
from variety import masses, physics
from variety.physics_mujoco import MuJoCo, bounced, damping_of
from variety.physics_rigid import RigidImpulses

from acquisition.synthetic.motion import Release
from recordings.geometry import Transform, rotation_exp, rotation_from_quaternion

ENGINES = [pytest.param(MuJoCo(), id="mujoco"), pytest.param(RigidImpulses(), id="rigid")]
BRICK = trimesh.creation.box((0.06, 0.1, 0.16))
HULL = np.array(BRICK.vertices)
EARTH, SPACE = np.array([0.0, 0.0, -9.81]), np.zeros(3)


def brick(drag_area_m2=0.0, off=(0.0, 0.0, 0.0)):
    mass = masses.of_solid(HULL + np.array(off), BRICK.faces, 0.5)
    return physics.Thrown(HULL + np.array(off), mass, drag_area_m2)


def release(height_m, velocity, spin, turn=(0.0, 0.0, 0.0)):
    place = Transform("world", "object", rotation_exp(np.array(turn)), np.array([0.0, 0.0, height_m]))
    return Release(place, np.array(velocity, float), np.array(spin, float))


def ground(friction=0.3, restitution=0.3, gravity=EARTH):
    return physics.Ground(friction, restitution, 0.0, gravity)


@pytest.mark.parametrize("engine", ENGINES)
def test_free_flight_keeps_angular_momentum_and_energy(engine):
    body = brick(off=(0.01, -0.02, 0.03))
    path = engine.drop(body, ground(gravity=SPACE), release(1.0, (0.1, 0, 0.2), (9, 14, -11)), 0.0, 1.0, 0.1).path
    inertia, spin = body.mass.inertia_kgm2, path.angular_velocity_object_rad_s
    turns = np.array([rotation_from_quaternion(q) for q in path.quaternion_wxyz])
    momentum = np.einsum("nij,jk,nk->ni", turns, inertia, spin)
    energy = 0.5 * np.einsum("ni,ij,nj->n", spin, inertia, spin)
    size = np.linalg.norm(momentum[0])
    assert np.abs(momentum - momentum[0]).max() < 1e-6 * size
    assert np.abs(energy / energy[0] - 1).max() < 1e-5
    assert np.linalg.norm(spin - spin[0], axis=1).max() > 5  # it does tumble: the spin itself is not constant


@pytest.mark.parametrize("engine", ENGINES)
def test_the_centre_of_mass_not_the_meshs_origin_flies_a_parabola(engine):
    body = brick(off=(0.02, 0.0, 0.03))
    start = release(2.0, (0.5, 0, 1.0), (0, 12, 3))
    path = engine.drop(body, ground(), start, 0.0, 0.3, 0.1).path
    rows = path.times_s < 0.3
    com = np.array([path.at(float(t)).points(body.mass.center_m) for t in path.times_s[rows]])
    place, velocity = physics.com_state(start, body.mass.center_m)
    t = path.times_s[rows, None]
    np.testing.assert_allclose(
        com, place + velocity * t + 0.5 * EARTH * t**2, atol=2.5e-3
    )  # first-order steps: g t dt / 2
    assert np.linalg.norm(path.position_m[rows] - com, axis=1).max() > 0.03


@pytest.mark.parametrize("engine", ENGINES)
def test_a_sliding_brick_stops_after_v_squared_over_two_mu_g(engine):
    for friction in (0.15, 0.5):
        start = release(0.0301, (0.8, 0, 0), (0, 0, 0), turn=(0.0, np.pi / 2, 0.0))
        path = engine.drop(brick(), ground(friction, 0.0), start, 0.0, 2.0, 0.2).path
        slid = float(np.linalg.norm(path.position_m[-1, :2] - path.position_m[0, :2]))
        assert slid == pytest.approx(0.8**2 / (2 * friction * 9.81), rel=0.08)


def test_the_impulse_engine_returns_the_wanted_share_of_the_speed():
    for restitution in (0.0, 0.3, 0.7):
        start = release(0.03 + 0.2, (0, 0, 0), (0, 0, 0), turn=(0.0, np.pi / 2, 0.0))
        path = RigidImpulses().drop(brick(), ground(0.3, restitution), start, 0.0, 0.5, 0.1).path
        before = -path.velocity_world_m_s[:, 2].min()
        after = path.velocity_world_m_s[path.velocity_world_m_s[:, 2].argmin() :, 2].max()
        assert after / before == pytest.approx(restitution, abs=0.02)


def test_mujocos_damping_gives_the_wanted_restitution_of_a_ball():
    for restitution in (0.1, 0.4, 0.7):
        assert bounced(damping_of(restitution)) == pytest.approx(restitution, abs=0.01)


@pytest.mark.parametrize("engine", ENGINES)
def test_air_slows_a_light_body_as_the_square_of_its_speed(engine):
    area, mass, speed = 0.2, 0.5, 3.0
    start = release(50.0, (speed, 0, 0), (0, 0, 0))
    path = engine.drop(brick(area), ground(gravity=SPACE), start, 0.0, 1.0, 0.1).path
    rate = 0.5 * physics.AIR_KG_M3 * area / mass
    expected = speed / (1 + rate * speed * path.times_s[-1])
    assert path.velocity_world_m_s[-1, 0] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_tumbling_brick_comes_to_rest_on_the_table(engine):
    fall = engine.drop(brick(), ground(0.4, 0.2), release(0.3, (0.4, 0.2, 0.5), (6, 3, -4)), 0.5, 2.5, 0.3)
    lowest = fall.path.at(float(fall.path.times_s[-1])).points(HULL)[:, 2].min()
    assert 0.5 < fall.impact_s < fall.rest_s < fall.path.times_s[-1]
    assert abs(lowest) < 0.001
