"""The support surface of measured meshes: known bodies, made as rough as vision leaves them."""

import numpy as np
import pytest
import trimesh

from processing.contact.physics.geometry import sphere_directions
from processing.contact.physics.support import surface_samples, trimmed_hull, trimmed_vertices
from recordings.errors import BadInput

BOX_M = (0.12, 0.1, 0.08)
TURNED = trimesh.transformations.euler_matrix(0.3, 0.5, 0.7)


def measured(mesh, noise_m=1.5e-4, spikes=0, seed=0):
    """Vertices and faces of the mesh in triangles of 2.5 mm, rough, with single vertices that stand out by 4 mm."""
    rng = np.random.default_rng(seed)
    fine = trimesh.Trimesh(*trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, 0.0025))
    vertices = np.array(fine.vertices) + noise_m * rng.standard_normal(fine.vertices.shape)
    out = rng.integers(len(vertices), size=spikes)
    vertices[out] += 0.004 * fine.vertex_normals[out]
    return vertices, np.array(fine.faces)


def support_error_m(points_m, truth_m):
    directions = sphere_directions(2000)
    return (points_m @ directions.T).max(0) - (truth_m @ directions.T).max(0)


@pytest.mark.parametrize(("spikes", "most", "off_m"), [(0, 8, 7e-4), (12, 14, 2e-3)])
def test_of_a_rough_box_little_more_than_its_corners_is_left(spikes, most, off_m):
    box = trimesh.creation.box(BOX_M, transform=TURNED)
    points = trimmed_hull(*measured(box, spikes=spikes))
    assert len(points) <= most
    assert np.abs(support_error_m(points, box.vertices)).max() < off_m


@pytest.mark.parametrize(
    "body",
    [
        trimesh.creation.cylinder(0.04, 0.12, sections=64),
        trimesh.creation.icosphere(4, 0.05),
        trimesh.creation.capsule(0.08, 0.03, count=[32, 32]),
    ],
    ids=["cylinder", "sphere", "capsule"],
)
def test_of_a_rough_round_body_the_support_is_off_by_less_than_a_point_in_so_many_must_be(body):
    error = support_error_m(trimmed_hull(*measured(body.copy().apply_transform(TURNED), spikes=12)), turned(body))
    assert abs(np.median(error)) < 6e-4
    assert np.abs(error).max() < 3e-3  # 64 points on a ball of 50 mm stand 15 degrees apart: its sagitta is 1.7 mm


def turned(body):
    return np.asarray(body.vertices) @ TURNED[:3, :3].T


def test_a_knob_is_no_spike():
    ball, knob = trimesh.creation.icosphere(4, 0.045), trimesh.creation.icosphere(3, 0.007)
    both = trimesh.util.concatenate([ball, knob.apply_translation([0, 0, 0.05])])
    assert trimmed_vertices(*measured(both))[:, 2].max() == pytest.approx(0.057, abs=7e-4)


def test_samples_stand_for_equal_areas_and_lie_on_the_surface():
    ball = trimesh.creation.icosphere(3, 0.05)
    points = surface_samples(np.asarray(ball.vertices), np.asarray(ball.faces), 4000)
    assert np.linalg.norm(points, axis=1) == pytest.approx(0.05, rel=0.01)
    nearest = (ball.triangles_center[None] * points[:, None]).sum(-1).argmax(1)  # the facets' normals are their own
    half = ball.triangles_center @ [0.3, 0.5, 0.8] > 0
    assert half[nearest].mean() == pytest.approx(ball.area_faces[half].sum() / ball.area, abs=0.005)


def test_a_mesh_without_an_area_is_refused():
    with pytest.raises(BadInput, match="no surface"):
        trimmed_hull(np.zeros((3, 3)), np.array([[0, 1, 2]]))
