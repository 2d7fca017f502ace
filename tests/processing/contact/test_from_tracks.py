import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from processing.contact.fuse import Field, FusionConfig, Readings, Sizes, Surface, likely_sizes
from processing.contact.learn.convexity import choose_geometry, measured_prior
from processing.contact.learn.data_checks import InconsistentPoses
from processing.contact.learn.fit import FitConfig
from processing.contact.learn.from_tracks import TracksConfig, learn_from_tracks
from processing.contact.learn.learn import ContactConfig
from processing.contact.learn.resting_plane import moved_to
from processing.contact.learn.shape_comparison import contact_loss_of, mean_loss_j
from processing.contact.physics.inertia import uniform_physics
from processing.contact.physics.loss import Weights
from processing.contact.physics.plane import Plane, calibrated_plane
from processing.contact.physics.support import trimmed_hull, volume_m3
from processing.contact.report.figure4 import learn_figure_4
from processing.contact.report.rollout_errors import world_poses
from processing.evaluate.metrics import rollout_errors
from processing.motion.trajectory import PoseSeries, rotation_matrices
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.tracks import ContactModel, ObjectShape, ObjectTrack, RigCalibration

EDGES_M = np.array([0.1, 0.08, 0.06])
WORLD_FROM_CAMERA = Transform(
    "world", "d455", rotation_matrices(np.array([[2.2, 0.0, 0.0]]))[0], np.array([0, -0.6, 0.5])
)
QUICK = TracksConfig(
    contact=ContactConfig(
        fit=FitConfig(adam_iterations=60, held_rate=0.02),
        weights=Weights(dissipation=30.0, penetration=20.0),
        bootstrap_repeats=2,
    ),
    geometry="hull",
)


def noisy_box(noise_m=0.0007, bigger=1.0, seed=0, unseen_above=None):
    """A box as vision would give it: a fine mesh with noise; what lies above a height was never seen and is missing."""
    mesh = trimesh.creation.box(bigger * EDGES_M)
    mesh = mesh.subdivide_to_size(0.008)
    rng = np.random.default_rng(seed)
    vertices = mesh.vertices + noise_m * rng.standard_normal(mesh.vertices.shape)
    observed = np.ones(len(vertices), dtype=bool)
    if unseen_above is not None:
        observed = vertices[:, 2] < unseen_above - 1e-6
        vertices[:, 2] = np.minimum(vertices[:, 2], unseen_above)
    return ObjectShape("object", "field", vertices, np.asarray(mesh.faces, dtype=np.int64), None, observed)


def tracks_of(series: list[PoseSeries], every=5, position_m=0.0007, rotation_rad=0.004, camera=WORLD_FROM_CAMERA):
    """Poses as a 30 Hz camera and a tracker would give them."""
    out = {}
    for s in series:
        rng, part = np.random.default_rng(s.toss), s.part(slice(0, None, every))
        pose = np.tile(np.eye(4), (len(part), 1, 1))
        pose[:, :3, :3] = part.rotation @ rotation_matrices(rotation_rad * rng.standard_normal((len(part), 3)))
        pose[:, :3, 3] = part.position_m + position_m * rng.standard_normal((len(part), 3))
        poses = camera.inverse().matrix @ pose
        time_ns = np.rint(1e9 * part.time_s).astype(np.int64) + 5_000_000_000
        status = ("tracked",) * len(part)
        out[s.toss] = ObjectTrack(s.toss, "d455", "object", time_ns, poses, status, np.full((len(part), 6, 6), np.nan))
    return out


def box_distance_m(points_m, edges_m=EDGES_M):
    """Distance of points to a box's surface."""
    gap = np.abs(points_m) - edges_m / 2
    outside = np.linalg.norm(np.maximum(gap, 0), axis=1)
    return np.where((gap < 0).all(1), -gap.max(1), outside)


def test_a_box_that_vision_made_too_big_is_corrected_and_its_friction_found(simulated_tosses):
    shape = noisy_box(bigger=1.03)
    tracks = tracks_of(simulated_tosses(5, 130))
    found = learn_from_tracks(tracks, shape, WORLD_FROM_CAMERA, config=QUICK)
    before, after = (box_distance_m(s.vertices_m).mean() for s in (shape, found.shape))
    assert after < before
    assert (found.shape.faces == shape.faces).all()
    assert found.shape.object_frame == found.model.object_frame == "object"
    assert np.median(found.rollouts.position.per_toss) < 0.04  # of a way of half a metre
    loss = found.document["contact_loss_j"]
    assert loss["refined"] < loss["vision"]
    json.dumps(found.document)


def test_an_underside_that_no_camera_saw_is_found_by_contact(simulated_tosses):
    """Vision closed the box 12 mm too early on the side that most tosses come to rest on."""
    shape = noisy_box(unseen_above=0.018)
    found = learn_from_tracks(tracks_of(simulated_tosses(5, 130)), shape, WORLD_FROM_CAMERA, config=QUICK)
    missing = ~shape.observed
    before, after = (box_distance_m(s.vertices_m[missing]).mean() for s in (shape, found.shape))
    assert after < 0.6 * before
    seen = box_distance_m(found.shape.vertices_m[shape.observed]).mean()
    assert seen < box_distance_m(shape.vertices_m[shape.observed]).mean() + 3e-4
    assert found.document["fusion"]["moved_unseen_m"]["mean"] > 3 * found.document["fusion"]["moved_seen_m"]["mean"]


def test_one_toss_alone_is_enough(simulated_tosses):
    shape = noisy_box()
    found = learn_from_tracks(tracks_of(simulated_tosses(1, 130)), shape, WORLD_FROM_CAMERA, config=QUICK)
    assert found.model.friction_low <= 0.25 <= found.model.friction_high
    before, after = (box_distance_m(s.vertices_m).mean() for s in (shape, found.shape))
    assert after < before + 1e-4
    assert any("from one toss only" in w["seen"] for w in found.document["warnings"])


def test_a_track_that_is_lost_for_most_of_a_toss_is_left_out_and_counted(simulated_tosses):
    tracks = tracks_of(simulated_tosses(3, 130))
    lost = tracks[1]
    poses = lost.camera_from_object.copy()
    poses[5:] = np.nan
    status = ("tracked",) * 5 + ("lost",) * (len(poses) - 5)
    tracks[1] = replace(lost, camera_from_object=poses, status=status)
    found = learn_from_tracks(tracks, noisy_box(), WORLD_FROM_CAMERA, config=QUICK)
    assert set(found.left_out) == {1}
    assert "tracked in 19 % of its frames" in found.left_out[1]
    assert found.learning.tosses == (0, 2)


def test_other_object_frames_and_cameras_are_refused(simulated_tosses):
    tracks = tracks_of(simulated_tosses(2))
    with pytest.raises(BadInput, match="different object frames"):
        learn_from_tracks(tracks, replace(noisy_box(), object_frame="other"), WORLD_FROM_CAMERA, config=QUICK)
    turned = Transform("world", "mono0", WORLD_FROM_CAMERA.rotation, WORLD_FROM_CAMERA.translation_m)
    with pytest.raises(BadInput, match="wanted world_from_camera"):
        learn_from_tracks(tracks, noisy_box(), turned, config=QUICK)


def test_tracks_whose_impacts_fit_another_reading_are_said_to_be_off(simulated_tosses, monkeypatch):
    def refused(*_):
        raise InconsistentPoses("import the data again", "most likely its orientation is off")

    monkeypatch.setattr("processing.contact.learn.data_checks.check_orientations", refused)
    with pytest.raises(BadInput, match="most likely its orientation is off") as wrong:
        learn_from_tracks(tracks_of(simulated_tosses(2, 130)), noisy_box(), WORLD_FROM_CAMERA, config=QUICK)
    assert "import" not in str(wrong.value)


def test_a_plane_that_contradicts_what_the_camera_saw_is_refused(simulated_tosses):
    raised = Transform("world", "d455", WORLD_FROM_CAMERA.rotation, WORLD_FROM_CAMERA.translation_m + [0, 0, 0.016])
    tracks = tracks_of(simulated_tosses(1, 130))
    with pytest.raises(BadInput, match=r"\d mm above the plane"):
        learn_from_tracks(tracks, noisy_box(), raised, config=QUICK)


def _heights(*heights_mm: float) -> dict[int, float]:
    return dict(enumerate(1e-3 * np.array(heights_mm)))


def test_a_plane_off_by_as_much_in_every_toss_is_moved_and_said(simulated_tosses):
    """The table lies 8 mm lower than it was calibrated: as if the calibration were right, but for the plane."""
    raised = Transform("world", "d455", WORLD_FROM_CAMERA.rotation, WORLD_FROM_CAMERA.translation_m + [0, 0, 0.008])
    tracks = tracks_of(simulated_tosses(2, 130))
    right = learn_from_tracks(tracks, noisy_box(), WORLD_FROM_CAMERA, config=QUICK)
    found = learn_from_tracks(tracks, noisy_box(), raised, config=QUICK)
    assert right.plane.offset_m == 0.0
    assert right.plane_off is None
    assert found.plane.offset_m == pytest.approx(0.008, abs=0.002)  # the box is noisy
    assert found.model.plane_offset_m == found.plane.offset_m
    assert f"{1e3 * found.plane.offset_m:.1f} mm above the table" in found.plane_off.text
    assert "toss-calibrate table" in found.plane_off.text
    assert found.document["plane"]["offset_m"] == found.plane.offset_m
    assert found.document["warnings"][0]["seen"] == found.plane_off.seen
    assert found.model.friction == pytest.approx(right.model.friction, abs=0.05)


@pytest.mark.parametrize("heights_m", [_heights(12), _heights(4, 20), _heights(35, 35, 36)])
def test_tosses_that_differ_and_centimetres_do_not_move_the_plane(heights_m):
    with pytest.raises(BadInput, match="above the plane"):
        moved_to(heights_m, Plane())
    for near in (_heights(), _heights(-4, -5)):
        assert moved_to(near, Plane())[1] is None
    plane, off = moved_to(_heights(8), Plane())
    assert plane.offset_m == 0.008
    assert "pose at rest" in off.text


@pytest.mark.slow
def test_spikes_below_the_table_do_not_keep_contact_out(simulated_tosses):
    """Six blobs of 9 mm on each face, as a field leaves them: the lowest vertex is far below the table at rest, the
    surface is not. A shape that is sunk as a whole is still refused."""
    from processing.contact.learn.data_checks import lowest_point_m
    from processing.motion.phases import find_phases

    shape, series = noisy_box(), simulated_tosses(4, 130)
    rng = np.random.default_rng(3)
    vertices = shape.vertices_m.copy()
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = np.flatnonzero(np.abs(vertices[:, axis] * side - EDGES_M[axis] / 2) < 0.004)
            vertices[rng.choice(face, 6, replace=False), axis] += side * 0.009
    spiky = replace(shape, vertices_m=vertices)
    phases = find_phases(series[0], np.eye(3) * 1e-3)
    assert lowest_point_m(series[0], vertices, phases) < -0.006
    found = learn_from_tracks(tracks_of(series), spiky, WORLD_FROM_CAMERA, config=QUICK)
    assert found.model.friction_low <= 0.25 <= found.model.friction_high
    sunk = Transform("world", "d455", WORLD_FROM_CAMERA.rotation, WORLD_FROM_CAMERA.translation_m - [0, 0, 0.014])
    with pytest.raises(BadInput, match=r"\d mm below the plane"):
        learn_from_tracks(tracks_of(series[:1]), spiky, sunk, config=QUICK)


def uniform_model(shape, physics, friction, plane):
    """A model that nothing was learned for: a shape's hull with a friction, to compare others with."""
    points = trimmed_hull(shape.vertices_m, shape.faces)
    return ContactModel(
        object_frame=shape.object_frame,
        support_vertices_m=points,
        pieces=(tuple(range(len(points))),),
        friction=friction,
        friction_low=0.0,
        friction_high=1.0,
        mass_kg=physics.mass_kg,
        inertia_kgm2=physics.inertia_kgm2,
        center_of_mass_m=physics.center_of_mass_m,
        physics_source=physics.source,
        plane_normal_world=plane.normal_world,
        plane_offset_m=plane.offset_m,
    )


def test_the_contact_loss_tells_a_wrong_shape_and_wrong_poses(simulated_tosses):
    tracks = tracks_of(simulated_tosses(4, 130))
    model = uniform_model(noisy_box(), uniform_physics(noisy_box()), 0.25, Plane())
    held_out, moved = {3: tracks[3]}, {3: tracks_of(simulated_tosses(4, 130), 5, 0.006, 0.04)[3]}
    support, large = (trimmed_hull(s.vertices_m, s.faces) for s in (noisy_box(), noisy_box(bigger=1.15)))
    right = contact_loss_of(held_out, support, model, WORLD_FROM_CAMERA)
    bigger = contact_loss_of(held_out, large, model, WORLD_FROM_CAMERA)
    shaken = contact_loss_of(moved, model.support_vertices_m, model, WORLD_FROM_CAMERA)
    assert set(right) == {3}
    assert abs(right[3].rest_height_m) < 0.003
    assert mean_loss_j(bigger) > 1.3 * mean_loss_j(right)
    assert mean_loss_j(shaken) > 1.3 * mean_loss_j(right)


def test_spikes_do_not_make_the_support_bigger():
    shape = noisy_box(0.0)
    vertices = shape.vertices_m.copy()
    vertices[::60] *= 1.04
    loose, trimmed = (trimesh.convex.convex_hull(p).volume for p in (vertices, trimmed_hull(vertices, shape.faces)))
    true = float(np.prod(EDGES_M))
    assert abs(trimmed / true - 1) < 0.6 * abs(loose / true - 1)
    assert volume_m3(shape) == pytest.approx(true)
    assert volume_m3(replace(shape, faces=shape.faces[1:])) is None


def readings(sigma_m, further_m=0.002):
    point = np.array([[0.05, 0.0, 0.0]])
    return Readings(point, np.array([[1.0, 0.0, 0.0]]), np.array([further_m]), np.array([sigma_m]))


def test_a_reading_moves_the_surface_there_by_its_weight_and_nothing_far_away():
    """One reading of 2 mm: the correction there is 2 mm s^2 / (s^2 + noise^2), and fades beyond the local length."""
    surface = Surface(noisy_box(0.0).vertices_m, None)
    config = FusionConfig(contact_m=0.0, local_m=0.006)
    moves = Field(readings(0.001), Sizes(0.001, 0.01, 0.0), config, surface, 0.0)
    np.testing.assert_allclose(moves.at(np.array([[0.05, 0, 0]])), [[0.001, 0, 0]], atol=1e-9)
    assert np.abs(moves.at(np.array([[-0.05, 0, 0], [0.02, 0.03, 0]]))).max() < 1e-5


def test_an_unseen_surface_moves_more_than_a_seen_one():
    shape = noisy_box(0.0, unseen_above=0.0)
    surface = Surface(shape.vertices_m, shape.observed)
    sizes = Sizes(0.0007, 0.008, 0.0)

    def moved(z):
        at = np.array([[0.05, 0.0, z]])
        r = Readings(at, np.array([[1.0, 0, 0]]), np.array([0.004]), np.array([0.001]))
        return float(Field(r, sizes, FusionConfig(), surface, 0.0005).at(at)[0, 0])

    assert moved(0.0) > 3 * moved(-0.028)


def test_an_error_of_the_plane_is_not_taken_for_the_shape():
    """All contacts read 0.5 mm too much: what they share with the plane stays out of a precise surface."""
    surface = Surface(noisy_box(0.0).vertices_m, None)
    rng = np.random.default_rng(0)
    direction = rng.standard_normal((40, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    r = Readings(0.05 * direction, direction, np.full(40, 0.0005), np.full(40, 0.0003))
    sizes = likely_sizes(r, surface, FusionConfig(), 0.0005)
    assert sizes.scale < 0.006
    shared = Field(r, sizes, FusionConfig(), surface, 0.0005).at(r.point_m)
    own = Field(r, sizes, FusionConfig(), surface, 0.0).at(r.point_m)
    assert np.linalg.norm(shared, axis=1).mean() < 0.8 * np.linalg.norm(own, axis=1).mean()


@pytest.fixture
def figure(simulated_tosses):
    """Three tosses of which the last is not learned from; the second ends early."""
    tosses = simulated_tosses(3, 130)
    tosses[1] = tosses[1].part(slice(0, 60))
    found, _ = learn_figure_4(tracks_of(tosses), noisy_box(), WORLD_FROM_CAMERA, config=QUICK)
    return found


def test_figure_4_learns_on_all_but_the_last_and_counts_tosses_per_step(figure, simulated_tosses):
    assert (figure.learning.tosses, figure.not_learned) == ((0, 1), (2,))
    document = figure.to_json()
    json.dumps(document, allow_nan=False)
    assert (document["steps"], document["dt_s"]) == (99, pytest.approx(1 / 148))
    part = document["against_track"]
    assert part["tosses_per_step"][0] == 3
    assert part["tosses_per_step"][-1] == 2
    assert set(part["not_learned"]) == {"2"}
    assert part["position_m"]["mean"] < 0.03
    # truth in another object frame: 30 degrees and 5 cm off, which is no error of the poses
    turn, shift = rotation_matrices(np.array([[0.0, 0.3, 0.4]]))[0], np.array([0.05, 0.0, -0.02])
    rolled = world_poses(figure.learning, figure.estimated, figure.plane)
    for i, t in enumerate(simulated_tosses(2, 130)):
        true = np.tile(np.eye(4), (len(t), 1, 1))
        true[:, :3, :3], true[:, :3, 3] = t.rotation @ turn, t.position_m + t.rotation @ shift
        rolled_s = figure.estimated.start_time_s[i] + np.arange(100) / 148
        errors = rollout_errors(rolled[t.toss], rolled_s, true, t.time_s, figure.learning.frame.origin_object_m)
        gap = errors[0] - figure.estimated.errors.position_m[i]
        assert np.nanmean(np.abs(gap)) < 0.003  # the track is 30 Hz, straight between its frames
        assert np.isfinite(errors[0]).sum() >= np.isfinite(figure.estimated.errors.position_m[i]).sum() - 1
        assert np.isfinite(errors[0][-1])  # the truth of the second toss goes on where its track ends


def test_rollouts_are_poses_of_the_object_frame_in_the_world(figure, simulated_tosses):
    poses = world_poses(figure.learning, figure.estimated, figure.plane)
    true = simulated_tosses(1)[0]
    at = round(figure.estimated.start_time_s[0] * 148)
    assert poses[0].shape == (100, 4, 4)
    np.testing.assert_allclose(poses[0][0, :3, 3], true.position_m[at], atol=0.003)
    np.testing.assert_allclose(poses[0][0, :3, :3], true.rotation[at], atol=0.03)


def test_an_l_shape_stays_one_and_a_box_a_box(simulated_tosses):
    """Concavity decides; with few tosses contact has no say."""
    outline = np.array([[0, 0], [0.12, 0], [0.12, 0.04], [0.04, 0.04], [0.04, 0.1], [0, 0.1]])
    ends = [np.column_stack([outline, np.full(6, z)]) for z in (0.0, 0.05)]
    caps = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    i, j = np.arange(6), (np.arange(6) + 1) % 6
    faces = np.concatenate([caps[:, ::-1], caps + 6, np.stack([i, j, i + 6], 1), np.stack([j, j + 6, i + 6], 1)])
    mesh = trimesh.Trimesh(np.concatenate(ends), faces).subdivide_to_size(0.01)
    shape = ObjectShape("object", "field", np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64))
    series, plane, config = simulated_tosses(1), Plane(), QUICK.contact
    chosen = choose_geometry(series, shape, uniform_physics(shape), plane, config, (0.003, 0.03))
    assert chosen.name == "nonconvex"
    assert chosen.concavity == pytest.approx(0.25, abs=0.05)
    prior = measured_prior("nonconvex", shape, uniform_physics(shape), 0.003, 0.03)
    assert len(prior.geometry.pieces()) >= 2
    box = noisy_box()
    assert choose_geometry(series, box, uniform_physics(box), plane, config, (0.003, 0.03)).name == "hull"


def test_the_calibrated_table_is_the_plane():
    table = {"normal_world": [0.0, 0.02, 1.0], "offset_m": 0.003, "std_m": 0.0004, "source": "board"}
    plane = calibrated_plane(RigCalibration(cameras={}, residuals={"table": table}))
    assert np.linalg.norm(plane.normal_world) == pytest.approx(1.0)
    assert (plane.std_m, plane.source) == (0.0004, "calibration.json: table (board)")
    assert "no table" in calibrated_plane(RigCalibration(cameras={})).source
    with pytest.raises(BadInput, match="wanted a unit vector"):
        calibrated_plane(RigCalibration(cameras={}, residuals={"table": {"normal_world": [0, 0], "offset_m": 0}}))
