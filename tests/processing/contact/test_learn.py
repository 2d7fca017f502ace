from dataclasses import replace

import numpy as np
import pytest
import torch

from processing.contact.friction.estimate import Interval
from processing.contact.learn.dissipation_weight import Candidate, choose
from processing.contact.learn.fit import FRICTION, Fit, FitConfig, Model, fit
from processing.contact.learn.intervals import _sandwich
from processing.contact.learn.learn import ContactConfig, learn_contact
from processing.contact.learn.prepared import prepare, transitions
from processing.contact.learn.prior import prior_from_shape, prior_from_size
from processing.contact.physics.geometry import SCALE_M, Box, FreePoints, hull_mesh, hull_of, sphere
from processing.contact.physics.inertia import known_physics, physics_of_session, uniform_physics
from processing.contact.physics.loss import StepData, Weights
from processing.contact.physics.pieces import carried, convex_pieces
from processing.contact.physics.plane import Plane
from processing.contact.report.rollout_errors import evaluate, summarise
from processing.motion.trajectory import PoseSeries, rotation_matrices
from recordings.errors import BadInput
from recordings.tracks import ObjectShape

QUICK = ContactConfig(weights=Weights(dissipation=10.0), bootstrap_repeats=2)
TRUE_EDGES_M = np.array([0.1, 0.08, 0.06])
TRUE_SIDE_M = 0.1048
"""Of the real cube: twice the length by which its publishers divide positions (DAIRLab/contact-nets)."""


def l_shape():
    """An L of two blocks: 120 x 100 x 50 mm, arms 40 mm wide, as one closed mesh."""
    outline = np.array([[0, 0], [0.12, 0], [0.12, 0.04], [0.04, 0.04], [0.04, 0.1], [0, 0.1]])
    n = len(outline)
    vertices = np.concatenate([np.column_stack([outline, np.full(n, z)]) for z in (0.0, 0.05)])
    caps = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    around = [[i, (i + 1) % n, n + i] for i in range(n)] + [[(i + 1) % n, n + (i + 1) % n, n + i] for i in range(n)]
    return ObjectShape("object", "test", vertices, np.concatenate([caps[:, ::-1], caps + n, np.array(around)]))


def test_a_box_is_learned_from_a_wrong_start(simulated_tosses, box_physics):
    learning = learn_contact(simulated_tosses(5), prior_from_size("box", 0.05), box_physics, config=QUICK)
    np.testing.assert_allclose([e.value for e in learning.extents], TRUE_EDGES_M, atol=1.5e-3)
    assert learning.friction.value == pytest.approx(0.25, abs=0.02)
    assert learning.solver_failures == 0
    assert learning.spread.method == "bootstrap over tosses"
    assert learning.untouched_vertices == ()
    assert learning.plane_sensitivity["mean_extent_m_per_m"] < -1.0  # about -2 where a box rests on its faces
    done = evaluate(learning, simulated_tosses(8)[5:], steps=60)
    assert done.position.mean < 0.004


@pytest.mark.slow
def test_mass_makes_no_difference(simulated_tosses, box_physics):
    heavy = known_physics(10 * box_physics.mass_kg, 10 * box_physics.inertia_kgm2)
    tracks = simulated_tosses(3)
    one, other = (learn_contact(tracks, prior_from_size("box", 0.08), p, config=QUICK) for p in (box_physics, heavy))
    assert other.friction.value == pytest.approx(one.friction.value, rel=2e-3)
    np.testing.assert_allclose(other.model.support_vertices_m, one.model.support_vertices_m, rtol=2e-3)
    np.testing.assert_allclose(other.model.inertia_kgm2, 10 * one.model.inertia_kgm2, rtol=1e-6)


@pytest.mark.slow
def test_a_raised_and_tilted_plane_is_the_same_lab(simulated_tosses, box_physics):
    turn = rotation_matrices(np.array([0.1, -0.2, 0.0]))
    tracks = simulated_tosses(3)
    moved = [
        replace(t, rotation=turn @ t.rotation, position_m=t.position_m @ turn.T + 0.3 * turn[:, 2]) for t in tracks
    ]
    plane = Plane(turn[:, 2], 0.3)
    one = learn_contact(tracks, prior_from_size("box", 0.08), box_physics, config=QUICK)
    other = learn_contact(moved, prior_from_size("box", 0.08), box_physics, plane, QUICK)
    assert other.friction.value == pytest.approx(one.friction.value, abs=1e-3)
    np.testing.assert_allclose([e.value for e in other.extents], [e.value for e in one.extents], atol=2e-4)


@pytest.mark.slow
def test_an_impact_that_the_plane_cannot_explain_is_left_out_and_counted(simulated_tosses, box_physics):
    tracks = simulated_tosses(3)
    hit = tracks[0]
    speed = np.array([1.5, 0.0, 0.0])  # between two fingers in free flight: pushed after frame 5, back after frame 7
    push = np.clip(hit.time_s - hit.time_s[5], 0, 2 / 148)[:, None] * speed
    pushed = [replace(hit, position_m=hit.position_m + push), *tracks[1:]]
    learning = learn_contact(pushed, prior_from_size("box", 0.08), box_physics, config=QUICK)
    assert 6 in learning.unexplained[0]
    assert sum(len(f) for f in learning.unexplained.values()) <= 6
    assert learning.friction.value == pytest.approx(0.25, abs=0.03)
    clean = learn_contact(tracks, prior_from_size("box", 0.08), box_physics, config=QUICK)
    assert clean.unexplained == {}


def test_one_toss_has_wide_intervals_from_the_curvature(simulated_tosses, box_physics):
    one = learn_contact(simulated_tosses(1), prior_from_size("box", 0.05), box_physics)
    assert one.spread.method == "curvature of the loss"
    assert one.friction.low <= 0.25 <= one.friction.high
    for edge, true in zip(one.extents, TRUE_EDGES_M):
        assert edge.low <= true <= edge.high


def test_where_nothing_depends_on_friction_and_size_the_prior_is_left():
    """A hand pushed the object, which never reached the plane: no gradient, no curvature, and no information."""
    n, prior = 40, np.array([0.7, 0.2, 0.3, 0.4])
    covariance, freedom = _sandwich(np.zeros((4, 4)), np.zeros((n, 4)), np.zeros(n, dtype=int), 2, prior)
    np.testing.assert_allclose(covariance, np.diag(prior**2))
    assert freedom == 2.0


def test_duplicates_count_once(simulated_tosses, box_physics):
    tracks = simulated_tosses(3)
    learning = learn_contact(
        [*tracks, replace(tracks[1], toss=7)], prior_from_size("box", 0.08), box_physics, config=QUICK
    )
    assert learning.tosses == (0, 1, 2)
    assert learning.duplicates == ((1, 7),)
    assert "same recording" in learning.left_out[7]


def test_a_measured_prior_must_rest_on_the_plane(simulated_tosses, box_physics):
    vertices, faces = hull_mesh(Box(TRUE_EDGES_M / 2).points(torch.as_tensor(TRUE_EDGES_M / 0.1)).numpy())
    prior = prior_from_shape("hull", ObjectShape("object", "vision", vertices, faces), box_physics)
    with pytest.raises(BadInput, match=r"8\.\d mm above the plane"):
        learn_contact(simulated_tosses(3, 130), prior, box_physics, Plane(offset_m=-0.008), QUICK)


def test_points_that_nothing_touched_stay_at_the_prior(simulated_tosses, box_physics):
    rng = np.random.default_rng(0)
    inner = 0.02 * rng.standard_normal((6, 3))
    corners = Box(TRUE_EDGES_M / 2).points(torch.as_tensor(TRUE_EDGES_M / 0.1)).numpy() * 1.03
    start = FreePoints(np.concatenate([corners, np.clip(inner, -0.025, 0.025)]), (tuple(range(14)),))
    prior = replace(prior_from_size("hull", 0.08), geometry=start)
    config = replace(QUICK, fit=FitConfig(adam_iterations=40), bootstrap_repeats=2)
    learning = learn_contact(simulated_tosses(4), prior, box_physics, config=config)
    assert set(range(8, 14)) <= set(learning.untouched_vertices)
    np.testing.assert_array_equal(learning.model.support_vertices_m[8:], start.points_m[8:])
    assert not set(range(4)) <= set(learning.untouched_vertices)


@pytest.mark.slow
def test_a_hull_is_learned_from_a_sphere(real_tosses, cube_physics):
    learning = learn_contact(
        [replace(t, velocity_world_m_s=None, spin_object_rad_s=None) for t in real_tosses(range(16))],
        prior_from_size("hull", 0.05),
        cube_physics,
        config=replace(QUICK, weights=Weights(dissipation=30.0)),
    )
    np.testing.assert_allclose([e.value for e in learning.extents], TRUE_SIDE_M, atol=0.004)
    assert learning.friction.value == pytest.approx(0.18, abs=0.02)


def test_real_tosses_give_the_cube(real_tosses, cube_physics):
    """Measured before with weight 30 on 4 tosses: friction .170; edges 101.6 102.1 100.7 +- 2.6 mm."""
    config = replace(QUICK, weights=Weights(dissipation=30.0))
    learning = learn_contact(real_tosses(range(4)), prior_from_size("box", 0.05), cube_physics, config=config)
    np.testing.assert_allclose([e.value for e in learning.extents], 0.102, atol=0.004)
    assert learning.friction.value == pytest.approx(0.175, abs=0.03)
    assert learning.unexplained == {}


def test_the_weight_is_the_one_whose_rollouts_leave_surface_points_least_far_off():
    nowhere = Fit(np.zeros(1), 0.0, 0, 0, 0)

    def tried(weight, position_m, rotation_rad):
        return Candidate(weight, nowhere, np.full(4, position_m), np.full(4, rotation_rad))

    few, middle, many = tried(10.0, 0.020, 0.30), tried(30.0, 0.011, 0.32), tried(100.0, 0.010, 0.40)
    assert choose([few, middle, many], 0.05) is middle
    assert choose([few, middle, many], 0.0) is many


def test_physics_come_from_the_session_or_are_refused():
    document = {"object": {"name": "cube", "physics": {"mass_kg": 0.37, "inertia_kgm2": np.diag([8e-4] * 3).tolist()}}}
    assert physics_of_session(document).mass_kg == 0.37
    assert physics_of_session({"object": {"name": "cube"}}) is None
    document["object"]["physics"]["inertia_kgm2"] = np.diag([1.0, 1.0, 3.0]).tolist()
    with pytest.raises(BadInput, match="no body has them"):
        physics_of_session(document)


def test_uniform_density_of_an_l_shape_is_known():
    """Two blocks: 0.12 x 0.04 and 0.04 x 0.06 m: the centre of mass by hand."""
    found = uniform_physics(l_shape(), 2.0)
    areas = np.array([0.12 * 0.04, 0.04 * 0.06])
    x, y = (areas @ [0.06, 0.02]) / areas.sum(), (areas @ [0.02, 0.07]) / areas.sum()
    np.testing.assert_allclose(found.center_of_mass_m, [x, y, 0.025], atol=1e-12)
    assert "unit mass" in found.source


def test_an_l_shape_is_cut_into_its_two_blocks():
    from scipy.spatial import ConvexHull

    shape = l_shape()
    free = convex_pieces(shape.vertices_m, shape.faces)
    assert len(free.groups) == 2
    volume = sum(ConvexHull(free.points_m[list(g)]).volume for g in free.groups)
    assert volume == pytest.approx((0.12 * 0.04 + 0.04 * 0.06) * 0.05, rel=1e-6)
    assert free.name == "nonconvex"


def test_a_mesh_is_carried_along_and_keeps_its_notch():
    shape = l_shape()
    free = convex_pieces(shape.vertices_m, shape.faces)
    np.testing.assert_allclose(carried(shape.vertices_m, free.points_m, free.points_m), shape.vertices_m, atol=1e-12)
    longer = free.points_m * [1.1, 1.0, 1.0]
    moved = carried(shape.vertices_m, free.points_m, longer)
    np.testing.assert_allclose(moved, shape.vertices_m * [1.1, 1.0, 1.0], atol=1e-6)


def test_a_body_of_pieces_may_start_from_a_size_alone(simulated_tosses, box_physics):
    """Eight octants of a sphere with the middle: what a hull learns, they learn, and the middle stays."""
    config = replace(QUICK, fit=FitConfig(adam_iterations=30))
    pieces, hull = (
        learn_contact(simulated_tosses(3), prior_from_size(name, 0.05), box_physics, config=config)
        for name in ("nonconvex", "hull")
    )
    assert (pieces.geometry, len(pieces.model.pieces)) == ("nonconvex", 8)
    assert 64 in pieces.untouched_vertices  # the middle
    np.testing.assert_allclose(pieces.model.support_vertices_m[:64], hull.model.support_vertices_m, atol=1e-6)
    assert pieces.friction.value == pytest.approx(hull.friction.value, rel=1e-4)
    assert pieces.shape.faces.max() == len(pieces.shape.vertices_m) - 1


def test_support_points_of_a_fine_mesh_keep_its_hull():
    points = hull_of(sphere(0.05, 4000).points_m, 64).points_m
    assert len(points) == 64
    directions = sphere(1.0, 500).points_m
    assert (directions @ points.T).max(1).min() > 0.05 * 0.93


def test_a_summary_has_its_interval_and_ends_with_the_tosses():
    errors = np.array([[1.0, 2.0, np.nan], [3.0, 4.0, 5.0]])
    done = summarise(errors)
    assert done.mean == pytest.approx((1.5 + 4.0) / 2)
    assert done.low < done.mean < done.high
    np.testing.assert_allclose(done.curve, [2, 3, 5])
    assert done.count.tolist() == [2, 2, 1]


def test_rolling_out_the_body_that_made_the_tosses_repeats_them(simulated_tosses, box_physics):
    learning = learn_contact(simulated_tosses(2), prior_from_size("box", 0.08), box_physics, config=QUICK)
    parameters = learning.fit.parameters.copy()
    parameters[:3], parameters[FRICTION] = TRUE_EDGES_M / 0.1, 0.25**0.5
    true = replace(learning, fit=replace(learning.fit, parameters=parameters))
    done = evaluate(true, simulated_tosses(4), steps=40)
    assert np.median(done.errors.per_toss_m) < 1e-3
    assert isinstance(learning.friction, Interval)


@pytest.mark.slow
def test_tosses_at_30_hz_with_noise_are_learned_from(simulated_tosses, box_physics):
    tracks = []
    for t in simulated_tosses(9, 130):
        rng, part = np.random.default_rng(t.toss), t.part(slice(0, None, 5))
        turned = part.rotation @ rotation_matrices(0.009 * rng.standard_normal((len(part), 3)))
        tracks.append(
            PoseSeries(t.toss, part.time_s, turned, part.position_m + 0.001 * rng.standard_normal((len(part), 3)))
        )
    learning = learn_contact(tracks, prior_from_size("box", 0.05), box_physics, config=replace(QUICK, weights=None))
    assert learning.friction.value == pytest.approx(0.25, abs=0.06)
    np.testing.assert_allclose([e.value for e in learning.extents], TRUE_EDGES_M, atol=0.006)
    assert learning.sweep is not None


class InflatedGrid:
    """A shape kept as a signed distance on a grid: its surface points, moved along the gradient by one learned
    offset."""

    name, contacts = "nonconvex", 8

    def __init__(self, half_m, too_big_m):
        axes = [np.linspace(-h - 0.01, h + 0.01, 21) for h in half_m]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
        beyond = np.abs(grid) - half_m
        distance = np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0)
        slope = np.stack(np.gradient(distance, *axes), -1)
        near = np.abs(distance) < 0.008
        normal = slope[near] / np.linalg.norm(slope[near], axis=-1, keepdims=True)
        self.surface_m, self.normal = grid[near] - distance[near][:, None] * normal, normal
        self.too_big_m = too_big_m

    def start(self):
        return np.array([self.too_big_m / SCALE_M])

    def points(self, parameters):
        surface, normal = (torch.as_tensor(a, dtype=parameters.dtype) for a in (self.surface_m, self.normal))
        return surface + SCALE_M * parameters[0] * normal

    def pieces(self):
        return (tuple(range(len(self.surface_m))),)


def test_a_signed_distance_grid_can_stand_behind_the_geometry(simulated_tosses, box_physics):
    """Against a plane a body touches with points: any shape that offers them, as its grid's surface does, is fitted."""
    prior = prior_from_size("box", 0.08)
    prepared = prepare(simulated_tosses(4), prior.frame, Plane(), box_physics.inertia_kgm2)
    model = Model(InflatedGrid(np.array([0.05, 0.04, 0.03]), 0.004), box_physics.inertia_kgm2, FitConfig())
    data = StepData(transitions(prepared))
    found = fit(model, model.start(), data, Weights(dissipation=30.0), 0.5)
    assert found.parameters[0] * SCALE_M == pytest.approx(0.0, abs=1.5e-3)
    assert found.parameters[FRICTION] ** 2 == pytest.approx(0.25, abs=0.06)
