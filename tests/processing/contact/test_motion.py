from dataclasses import replace

import numpy as np
import pytest

from processing.motion.phases import Noise, find_phases, pose_noise
from processing.motion.smoother import smooth
from processing.motion.trajectory import PoseSeries, differences, rotation_matrices, steps_of
from recordings.errors import BadInput
from recordings.records import StampedPose


def with_noise(track, every, position_m, rotation_rad, seed=0):
    rng, part = np.random.default_rng(seed), track.part(slice(0, None, every))
    return replace(
        part,
        rotation=part.rotation @ rotation_matrices(rotation_rad * rng.standard_normal((len(part), 3))),
        position_m=part.position_m + position_m * rng.standard_normal((len(part), 3)),
    )


def test_differences_undo_the_step(simulated_tosses):
    track = simulated_tosses(1)[0]
    s, dt = differences(track), 1 / 148
    np.testing.assert_allclose(track.position_m[1:], track.position_m[:-1] + dt * s.velocity_world_m_s[1:], atol=1e-12)
    stepped = track.rotation[:-1] @ rotation_matrices(dt * s.spin_object_rad_s[1:])
    np.testing.assert_allclose(stepped, track.rotation[1:], atol=1e-9)


def test_a_gap_of_lost_frames_makes_no_transition(simulated_tosses):
    track = simulated_tosses(1)[0]
    kept = np.delete(np.arange(len(track)), [40, 41])
    torn = PoseSeries(0, track.time_s[kept], track.rotation[kept], track.position_m[kept])
    assert len(steps_of([differences(track)])) == len(track) - 2
    # gone with the two frames: the step over the gap, and the one after it, whose first velocity spans it
    assert len(steps_of([differences(torn)])) == len(kept) - 2 - 2


def test_lost_poses_are_left_out_and_other_frames_refused():
    def stamped(i, status="tracked", target="world"):
        matrix = np.full((4, 4), np.nan) if status == "lost" else np.eye(4)
        return StampedPose(i * 10_000_000, target, "object", matrix, status)

    series = PoseSeries.from_poses(3, [stamped(0), stamped(1, "lost"), stamped(2)])
    np.testing.assert_allclose(series.time_s, [0, 0.02])
    with pytest.raises(BadInput, match="world_from_object"):
        PoseSeries.from_poses(3, [stamped(0, target="d455")])


@pytest.mark.parametrize("every", [1, 5])
def test_phases_are_found_at_148_and_at_30_hz(simulated_tosses, box_physics, every):
    for track in simulated_tosses(4):
        part = track.part(slice(0, None, every))
        change = np.diff(differences(part).velocity_world_m_s, axis=0) / np.diff(part.time_s)[:, None] + [0, 0, 9.81]
        first = int(np.flatnonzero(np.linalg.norm(change[1:], axis=1) > 1.0)[0]) + 2
        phases = find_phases(part, box_physics.inertia_kgm2)
        assert phases.release == 0
        assert abs(phases.first_impact - first) <= 1


def test_rest_is_found_where_nothing_moves(simulated_tosses, box_physics):
    for track in simulated_tosses(3, frames=130):
        phases = find_phases(track, box_physics.inertia_kgm2)
        moving = np.linalg.norm(differences(track).velocity_world_m_s, axis=1) > 0.02
        assert phases.rest is not None
        assert phases.rest >= np.flatnonzero(moving)[-1] - 4


def test_a_hand_before_the_release_is_no_flight(simulated_tosses, box_physics):
    track = simulated_tosses(1)[0]
    t = np.arange(-20, 0)[:, None] / 148
    wobble = 0.02 * np.sin(40 * t) * np.array([1.0, 0.5, 0.8])
    v0 = differences(track).velocity_world_m_s[0]
    held = track.position_m[0] + t * v0 + wobble
    longer = PoseSeries(
        0,
        np.arange(len(track) + 20) / 148,
        np.concatenate([np.repeat(track.rotation[:1], 20, 0), track.rotation]),
        np.concatenate([held, track.position_m]),
    )
    assert abs(find_phases(longer, box_physics.inertia_kgm2).release - 20) <= 2


def test_the_noise_of_poses_is_measured(simulated_tosses):
    found = [pose_noise(with_noise(t, 5, 0.002, 0.015, seed=i)) for i, t in enumerate(simulated_tosses(9, frames=130))]
    assert np.median([n.position_m for n in found]) == pytest.approx(0.002, rel=0.4)
    assert np.median([n.rotation_rad for n in found]) == pytest.approx(0.015, rel=0.4)


def test_smoothing_helps_in_flight_and_leaves_impacts_sharp(simulated_tosses, box_physics):
    raw, better, sharp, blunt = [], [], [], []
    for i, track in enumerate(simulated_tosses(6)):
        noisy = with_noise(track, 1, 0.001, 0.009, seed=i)
        done = smooth(noisy, box_physics.inertia_kgm2, Noise(0.001, 0.009))
        true, rough = differences(track).velocity_world_m_s, differences(noisy).velocity_world_m_s
        flight = slice(1, done.phases.first_impact - 1)
        raw.append(np.linalg.norm(rough[flight] - true[flight], axis=1))
        better.append(np.linalg.norm(done.states.velocity_world_m_s[flight] - true[flight], axis=1))
        hit = int(np.linalg.norm(np.diff(true, axis=0), axis=1).argmax())
        jump = true[hit + 1] - true[hit]
        for velocities, out in ((done.states.velocity_world_m_s, sharp), (rough, blunt)):
            found = velocities[hit + 1] - velocities[hit]
            out.append(float(found @ jump / (jump @ jump)))
    assert np.concatenate(better).mean() < 0.25 * np.concatenate(raw).mean()
    # of the jump at the hardest impact, the smoother keeps as much as the differences do
    assert np.mean(sharp) == pytest.approx(np.mean(blunt), abs=0.15)
    assert np.mean(sharp) > 0.8


def test_covariances_tell_the_errors(simulated_tosses, box_physics):
    """Normalised squared errors of position and velocity in flight average to about 1 per component."""
    position, velocity, spin = [], [], []
    for i, track in enumerate(simulated_tosses(8)):
        done = smooth(with_noise(track, 1, 0.001, 0.009, seed=i), box_physics.inertia_kgm2, Noise(0.001, 0.009))
        flight = slice(1, max(done.phases.first_impact - 1, 2))
        C = done.states.covariance[flight]
        true = differences(track)
        for found, wanted, block, out in (
            (done.states.position_m, track.position_m, 3, position),
            (done.states.spin_object_rad_s, true.spin_object_rad_s, 6, spin),
            (done.states.velocity_world_m_s, true.velocity_world_m_s, 9, velocity),
        ):
            variance = np.diagonal(C[:, block : block + 3, block : block + 3], axis1=1, axis2=2)
            out.append(((found[flight] - wanted[flight]) ** 2 / variance).mean())
    assert 0.4 < np.mean(position) < 2.5
    assert 0.3 < np.mean(velocity) < 2.5
    assert 0.2 < np.mean(spin) < 2.5
