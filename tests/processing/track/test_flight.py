"""A flight solved as one: which frames it has, its derivatives, and a spin that no frame-to-frame prior foretells."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from processing.features.sift import Sift
from processing.motion.motion_prior import MotionConfig, change_cost, gravity_in_camera
from processing.motion.rotation_grid import ball
from processing.sensor import view_layout as lay
from processing.track.beam import Hypothesis, Scene, _put_at_color_time, seconds
from processing.track.flight import FlightConfig, fallen, flights_followed, flying, solved
from processing.track.flight_kernels import UNKNOWNS, _place
from processing.track.track_toss import TrackConfig, _followed, _Known, first_pose, started, views_of
from recordings.geometry import Transform, rotation_exp, rotation_log
from recordings.progress import Silent

STEP_S = 1 / 30
HELD, FLIES = 3, 8
SPIN = np.array([9.0, -12.0, 10.0])
"""18 rad/s: 34 degrees a frame."""


def thrown(i: float) -> Transform:
    """world_from_object: held still, then thrown up and across the table."""
    t = max(i - HELD, 0) * STEP_S
    place = np.array([-0.12, -0.05, 0.14]) + np.array([0.8, 0.2, 0.9]) * t - np.array([0, 0, 0.5 * 9.81]) * t * t
    return Transform("world", "object", rotation_exp(SPIN * t) @ rotation_exp(np.array([0.7, 0.5, 0.3])), place)


@pytest.fixture(scope="module")
def scene(tiny_world: Any) -> Scene:
    seen = [tiny_world.see(thrown(i), i) for i in range(HELD + FLIES)]
    frames = [replace(f, time_ns=round(i * STEP_S * 1e9), depth_time_ns=round(i * STEP_S * 1e9))
              for i, (f, _) in enumerate(seen)]  # fmt: skip
    store, times_ns, _ = views_of(
        frames, [m for _, m in seen], tiny_world.camera, np.ones(len(frames)), TrackConfig(),
        tiny_world.world_from_camera, Silent(),
    )  # fmt: skip
    return Scene(store, seconds(times_ns), gravity_in_camera(tiny_world.world_from_camera.matrix), np.zeros(3), Sift())


def test_no_place_in_a_ball_is_far_from_its_lattice() -> None:
    points = ball(1.0, 0.2)
    places = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3))
    nearest = np.linalg.norm(places[:, None] - points, axis=2).min(1)
    assert nearest.max() < 0.2 * 2 / np.sqrt(3) * np.sqrt(5) / 4 + 1e-9  # the lattice's covering radius
    assert np.linalg.norm(points, axis=1).max() <= 1.0


def test_a_view_that_shows_nothing_any_more_is_no_part_of_its_flight(scene: Scene) -> None:
    """The beam makes views again with the motion between the exposures, and one may leave its mask."""
    n, count = len(scene.times_s), scene.store.table[:, lay.COUNT].copy()
    fly = replace(scene, flying=np.isin(np.arange(n), flying(scene, n, FlightConfig())))
    nothing = started(n, 0, first_pose(scene.store, 0))
    scene.store.table[HELD + 4, lay.COUNT] = 0
    try:
        found = flights_followed(fly, 0, nothing, [], TrackConfig().beam, FlightConfig())
    finally:
        scene.store.table[:, lay.COUNT] = count
    assert found
    assert np.isfinite(found[0].poses[HELD + 5]).all()
    assert np.isnan(found[0].poses[HELD + 4]).all()


@pytest.mark.parametrize("t", [-0.07, 0.0, 0.1])
def test_a_flights_pose_has_the_derivatives_that_are_stated(t: float) -> None:
    x = np.array([0.1, -0.05, 0.8, 0.7, -0.3, 1.1, 8.0, -15.0, 6.0])
    gravity = np.array([0.5, 9.5, 2.0])
    pose, J = np.zeros((4, 4)), np.zeros((6, UNKNOWNS))
    _place(x, t, gravity, pose, J)
    for a in range(UNKNOWNS):
        near, unused = np.zeros((4, 4)), np.zeros((6, UNKNOWNS))
        _place(x + 1e-6 * np.eye(UNKNOWNS)[a], t, gravity, near, unused)
        step = np.linalg.inv(near) @ pose  # object_from_camera <- exp(twist) object_from_camera
        twist = np.concatenate([step[:3, 3], rotation_log(step[:3, :3])]) / 1e-6
        np.testing.assert_allclose(J[:, a], twist, atol=1e-5)


def test_the_frames_in_which_the_body_falls_are_found_and_held_ones_are_not(scene: Scene) -> None:
    found = flying(scene, len(scene.times_s), FlightConfig())
    assert set(range(HELD + 1, HELD + FLIES)) <= set(found.tolist())
    assert found.min() >= HELD - 1


def swung(i: int) -> np.ndarray:
    """Centre in the world: a hand's swing that gathers speed, then the flight, then the table's rebound."""
    t, release, impact = i * STEP_S, 8 * STEP_S, 18 * STEP_S
    speed = np.array([0.9, 0.2, 0.6])
    if t < release:
        return np.array([0.0, 0.0, 0.2]) + 0.5 * speed / release * t * t - 0.5 * speed * release
    fallen = min(t, impact) - release
    at = np.array([0.0, 0.0, 0.2]) + speed * fallen - np.array([0, 0, 0.5 * 9.81]) * fallen**2
    return at + np.array([0.5, 0.1, 0.8]) * max(t - impact, 0.0)


@pytest.mark.parametrize("noise_m", [0.0, 0.001, 0.002])
def test_a_swing_before_and_a_bounce_after_it_are_no_part_of_the_flight(noise_m: float) -> None:
    """Both lie within a tenth of the body's size of the parabola of a longer run."""
    n, rng = 24, np.random.default_rng(0)
    centers_m = np.array([swung(i) for i in range(n)]) + rng.normal(0, noise_m, (n, 3))
    found = fallen(centers_m, np.arange(n) * STEP_S, np.array([0.0, 0.0, -9.81]), 0.15, FlightConfig())
    assert 7 <= found.start <= 9
    assert 17 <= found.stop - 1 <= 19


@pytest.mark.parametrize("falls", [False, True])
def test_late_depth_is_moved_as_the_body_moves(tiny_world: Any, monkeypatch: Any, falls: bool) -> None:
    """As if it fell where it falls; not at all where a hand holds it, though the images do not say that it stands
    still."""
    n, now, late_s = 8, 6, 0.013
    times = [HELD + i if falls else 0 for i in range(n)]
    after = [t + late_s / STEP_S if falls else 0 for t in times]
    seen = [tiny_world.see(thrown(t), i) for i, t in enumerate(times)]
    later = [tiny_world.see(thrown(t), i)[0] for i, t in enumerate(after)]
    frames = [
        replace(f, depth_m=x.depth_m, time_ns=round(i * STEP_S * 1e9), depth_time_ns=round((i * STEP_S + late_s) * 1e9))
        for i, ((f, _), x) in enumerate(zip(seen, later))
    ]
    world = tiny_world.world_from_camera
    store, times_ns, _ = views_of(
        frames, [m for _, m in seen], tiny_world.camera, np.ones(n), TrackConfig(), world, Silent()
    )
    monkeypatch.setattr(type(store), "stands_still", lambda *_: False)
    gravity, flies = gravity_in_camera(world.matrix), np.arange(n) >= (0 if falls else n - 1)
    scene = Scene(store, seconds(times_ns), gravity, np.zeros(3), Sift(), flying=flies)
    true, at_depth = (np.array([(world.inverse() @ thrown(t)).matrix for t in when]) for when in (times, after))
    h = started(n, 0, true[0])
    known = np.where(np.arange(n)[:, None, None] < now, true, np.nan)
    h = replace(h, poses=known, done=tuple(range(now)), keyframes=tuple(range(now)))
    for i in range(now):
        store.fill(i, true[i] @ np.linalg.inv(at_depth[i]))
    _put_at_color_time(scene, h, now, TrackConfig().beam)
    moved = store.motion[now] @ at_depth[now]
    assert np.linalg.norm(moved[:3, 3] - true[now][:3, 3]) < 0.002


def test_without_gravity_nothing_is_known_to_fly(scene: Scene) -> None:
    nowhere = replace(scene, gravity_camera_m_s2=np.zeros(3))
    assert len(flying(nowhere, len(scene.times_s), FlightConfig())) == 0


def test_frames_whose_times_do_not_grow_fly_nowhere(scene: Scene) -> None:
    stopped = replace(scene, times_s=np.zeros_like(scene.times_s))
    assert len(flying(stopped, len(scene.times_s), FlightConfig())) == 0


def test_a_spin_of_34_degrees_a_frame_is_found_among_all(scene: Scene, tiny_world: Any) -> None:
    best = solved(scene, np.arange(HELD + 1, HELD + 6), FlightConfig())[0]
    true = tiny_world.world_from_camera.inverse().vectors(SPIN[None])[0]
    np.testing.assert_allclose(best.spin_rad_s, true, atol=0.8)


def test_the_beam_goes_on_from_a_solved_flight_both_ways(scene: Scene, tiny_world: Any) -> None:
    n, camera = len(scene.times_s), tiny_world.world_from_camera.rotation
    fly = replace(scene, flying=np.isin(np.arange(n), flying(scene, n, FlightConfig())))
    nothing = started(n, 0, first_pose(scene.store, 0))
    best = flights_followed(fly, 0, nothing, [], TrackConfig().beam, FlightConfig())[0]
    assert best.tracked == tuple(range(n))
    assert flights_followed(fly, 0, best, [best], TrackConfig().beam, FlightConfig()) == []  # all agree already
    for i in range(HELD + 1, n):
        turn = best.poses[i, :3, :3] @ best.poses[HELD, :3, :3].T
        true = camera.T @ thrown(i).rotation @ thrown(HELD).rotation.T @ camera
        assert np.degrees(np.linalg.norm(rotation_log(turn @ true.T))) < 5.0


def test_in_flight_a_change_of_spin_costs_more_the_greater_it_is_and_an_impact_may_do_anything() -> None:
    def cost(change_rad_s: float, flies: bool) -> float:
        poses = [np.eye(4), np.eye(4), np.eye(4)]
        poses[2][:3, :3] = rotation_exp(np.array([0, 0, change_rad_s * STEP_S]))
        return change_cost(tuple(poses), (STEP_S, STEP_S), np.zeros(3), np.zeros(3), MotionConfig(), flying=flies)

    assert cost(20.0, False) < MotionConfig().impact_cost
    assert cost(20.0, True) > 4 * cost(20.0, False)
    assert cost(24.0, True) == pytest.approx(4 * cost(12.0, True))


def test_where_the_way_back_slid_away_the_first_frame_goes_with_it(scene: Scene, monkeypatch: Any) -> None:
    """Left where it was, it would lie as no pair of views says, and all poses are judged from it."""
    n, slid = len(scene.times_s), Transform("a", "b", rotation_exp(np.array([0.0, 0.0, 2.0])), np.zeros(3)).matrix
    true = np.array([thrown(i).matrix for i in range(n)])

    def followed(_: Scene, order: Any, beam: list[Hypothesis], *unused: Any) -> tuple[Hypothesis, dict[int, Any]]:
        poses = beam[0].poses.copy()
        poses[order] = true[order] if order[0] < order[-1] else true[order] @ slid
        return replace(beam[0], poses=poses, done=(*beam[0].done, *map(int, order))), {}

    monkeypatch.setattr("processing.track.track_toss.follow", followed)
    known = _Known(true[0], 0, None, None)
    for hypothesis in _followed(scene, 0, known, TrackConfig(), Silent())[0]:
        np.testing.assert_allclose(hypothesis.poses[0], true[0])
        steps, right = (p[1:] @ np.linalg.inv(p[:-1]) for p in (hypothesis.poses, true))
        np.testing.assert_allclose(steps[:-1], right[:-1], atol=1e-9)  # at the last frame the slide begins
