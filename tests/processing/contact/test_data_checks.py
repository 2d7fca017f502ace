from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from processing.contact.learn import data_checks as checks
from processing.contact.learn.learn import learn_contact
from processing.contact.learn.prior import prior_from_size
from processing.contact.physics.plane import Plane
from processing.motion.trajectory import PoseSeries, differences
from recordings.errors import BadInput


def permuted(track):
    """The track as it reads when stored x y z w and read as w x y z."""
    q = Rotation.from_matrix(track.rotation).as_quat()  # x y z w
    return replace(track, rotation=Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix())


def claiming(track):
    s = differences(track)
    return replace(track, velocity_world_m_s=s.velocity_world_m_s, spin_object_rad_s=s.spin_object_rad_s)


def test_nan_is_refused_with_its_frame():
    q = np.tile([1.0, 0, 0, 0], (6, 1))
    q[3] = np.nan
    with pytest.raises(BadInput, match="toss 4: the pose of frame 3"):
        PoseSeries.from_quaternions(4, 0.01, q, np.zeros((6, 3)))


def test_short_tosses_are_refused(simulated_tosses):
    with pytest.raises(BadInput, match="4 frames with a pose; wanted at least 5"):
        checks.check_frames(simulated_tosses(1)[0].part(slice(0, 4)))


def test_jumps_are_refused_with_their_frame(simulated_tosses):
    track = simulated_tosses(1)[0]
    position = track.position_m.copy()
    position[50:] += [0.2, 0, 0]
    with pytest.raises(BadInput, match="jumps at frame 50"):
        checks.check_frames(replace(track, position_m=position))
    rotation = track.rotation.copy()
    rotation[60:] = rotation[60:] @ Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    with pytest.raises(BadInput, match="jumps at frame 60"):
        checks.check_frames(replace(track, rotation=rotation))


def test_a_jumping_toss_is_left_out_and_the_others_are_used(simulated_tosses, box_physics):
    tracks = simulated_tosses(3)
    position = tracks[1].position_m.copy()
    position[50:] += [0.2, 0, 0]
    tracks[1] = replace(tracks[1], position_m=position)
    from processing.contact.learn.prepared import prepare

    prepared = prepare(tracks, prior_from_size("box", 0.08).frame, Plane(), box_physics.inertia_kgm2)
    assert [t.toss for t in prepared.tracks] == [0, 2]
    assert "jumps" in prepared.left_out[1]


def test_a_wrong_step_is_told_from_free_fall(simulated_tosses):
    tracks = [replace(t, time_s=t.time_s * 1.1) for t in simulated_tosses(4)]
    with pytest.raises(BadInput, match=r"free fall reads 8\.\d+ m/s\^2 instead of 9\.81.*time step.*scale"):
        checks.check_fall(tracks)
    assert checks.check_fall(simulated_tosses(4)) == pytest.approx(-9.81, abs=0.02)


def test_a_wrong_scale_is_told_from_free_fall(simulated_tosses):
    tracks = [replace(t, position_m=t.position_m * 19.08) for t in simulated_tosses(4)]
    with pytest.raises(BadInput, match=r"1 m in the data would be 0\.052"):
        checks.check_fall(tracks)


def test_z_down_is_told_from_free_fall(simulated_tosses):
    tracks = [replace(t, position_m=t.position_m * [1, -1, -1]) for t in simulated_tosses(4)]
    with pytest.raises(BadInput, match="upwards"):
        checks.check_fall(tracks)


def test_right_orientations_pass(simulated_tosses, box_physics):
    assert checks.check_orientations(simulated_tosses(4), box_physics.inertia_kgm2) < 0.2


def test_quaternions_in_the_wrong_order_are_told_from_impacts_alone(real_tosses):
    tracks = [permuted(t) for t in real_tosses(range(8))]
    with pytest.raises(BadInput, match="quaternions stored as x y z w"):
        checks.check_orientations(tracks, np.eye(3))


def test_inverse_rotations_are_told_from_impacts_alone(real_tosses):
    tracks = [replace(t, rotation=np.swapaxes(t.rotation, 1, 2).copy()) for t in real_tosses(range(8))]
    with pytest.raises(BadInput, match="inverse rotations"):
        checks.check_orientations(tracks, np.eye(3))


def test_the_real_tosses_mean_what_they_say(real_tosses):
    tracks = real_tosses(range(8))
    checks.check_velocities(tracks)
    assert checks.check_fall(tracks) == pytest.approx(-9.67, abs=0.15)  # as measured before: -9.67 +- noise
    assert checks.check_orientations(tracks, np.eye(3)) < 0.2


def test_velocities_in_the_wrong_frame_are_named(simulated_tosses):
    tracks = [claiming(t) for t in simulated_tosses(3)]
    checks.check_velocities(tracks)
    in_object = [
        replace(t, velocity_world_m_s=np.einsum("nji,nj->ni", t.rotation, t.velocity_world_m_s)) for t in tracks
    ]
    with pytest.raises(BadInput, match=r"linear velocity.*velocity in the object frame"):
        checks.check_velocities(in_object)
    in_world = [replace(t, spin_object_rad_s=np.einsum("nij,nj->ni", t.rotation, t.spin_object_rad_s)) for t in tracks]
    with pytest.raises(BadInput, match=r"angular velocity.*angular velocity in the world frame"):
        checks.check_velocities(in_world)
    degrees = [replace(t, spin_object_rad_s=np.degrees(t.spin_object_rad_s)) for t in tracks]
    with pytest.raises(BadInput, match="degrees per second"):
        checks.check_velocities(degrees)


def test_quaternions_in_the_wrong_order_are_told_from_claimed_spins(simulated_tosses):
    tracks = [permuted(claiming(t)) for t in simulated_tosses(3)]
    with pytest.raises(BadInput, match="x y z w"):
        checks.check_velocities(tracks)


@pytest.mark.parametrize("offset, side", [(0.008, "below"), (-0.008, "above")])
def test_a_plane_8_mm_off_is_refused(offset, side):
    with pytest.raises(BadInput, match=f"8.0 mm {side} the plane"):
        checks.check_plane({0: -offset, 1: -offset, 2: -offset}, "the prior shape")
    assert checks.check_plane({0: 0.004}, "the prior shape") == 0.004


def test_a_plane_is_blamed_first_only_where_every_toss_says_the_same():
    told = []
    for heights_m in ({0: 0.008, 1: 0.0078, 2: 0.0081}, {0: 0.008, 1: 0.0005, 2: 0.02}, {0: 0.008}):
        with pytest.raises(BadInput) as refused:
            checks.check_plane(heights_m, "the prior shape")
        told.append(str(refused.value))
    same, scattered, one = told
    assert same.index("the plane (`toss-calibrate table") < same.index("the poses at rest")
    assert scattered.index("the poses at rest") < scattered.index("the plane (`toss-calibrate table")
    assert "One toss cannot tell" in one


def test_own_tracks_are_never_asked_to_be_imported_in_another_reading(real_tosses):
    tracks = [replace(t, rotation=np.swapaxes(t.rotation, 1, 2).copy()) for t in real_tosses(range(8))]
    with pytest.raises(checks.InconsistentPoses, match="import the data again") as refused:
        checks.check_orientations(tracks, np.eye(3))
    assert "import" not in refused.value.of_own_tracks
    assert refused.value.of_own_tracks.index("its orientation is off") < refused.value.of_own_tracks.index("the table")


def test_duplicates_are_found_and_refused_across_the_split(simulated_tosses):
    tracks = simulated_tosses(3)
    turn = Rotation.from_rotvec([0, 0, 0.7]).as_matrix()
    twin = replace(tracks[1].turned(turn, 0.0), toss=9)  # turned about z, as dair_pll's copies are
    groups = checks.duplicate_groups([*tracks, twin])
    assert groups == [(1, 9)]
    with pytest.raises(BadInput, match="toss 9 of --test is the same recording as toss 1"):
        checks.refuse_leaks([0, 1], [2, 9], groups)
    with pytest.raises(BadInput, match=r"tosses \[1\] are in --train and in --test"):
        checks.refuse_leaks([0, 1], [1, 2], [])
    checks.refuse_leaks([1, 9], [2], groups)


def test_tosses_dropped_from_one_height_are_no_duplicates(simulated_tosses):
    """As simulations make them: the centre falls alike until something touches, but they turn differently."""
    first, second = (t.part(slice(0, 20)) for t in simulated_tosses(2))
    assert checks.duplicate_groups([first, replace(second, position_m=first.position_m.copy())]) == []


def test_flight_alone_teaches_nothing(simulated_tosses, box_physics):
    tracks = [t.part(slice(0, 12)) for t in simulated_tosses(3)]
    higher = [replace(t, position_m=t.position_m + [0, 0, 1.0]) for t in tracks]
    flown = []
    for t in higher:
        time_s = t.time_s[:, None]
        s = differences(t)
        position = t.position_m[0] + time_s * s.velocity_world_m_s[1] - 0.5 * 9.81 * time_s**2 * [0, 0, 1]
        rotation = t.rotation[:1] @ Rotation.from_rotvec(time_s * [0, 0, 3.0]).as_matrix()
        flown.append(PoseSeries(t.toss, t.time_s, rotation, position))
    with pytest.raises(BadInput, match="no contact in the data"):
        learn_contact(flown, prior_from_size("box", 0.08), box_physics)
