"""Outlines and normals of meshes: laws and known answers."""

import numpy as np
import trimesh

from recordings.geometry import CameraModel, Transform
from recordings.tracks import ObjectShape
from recordings.view.mesh import outline_px, vertex_normals

PLAIN = CameraModel("c", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))


def ahead(z_m):
    return Transform("c", "object", np.eye(3), np.array([0, 0, z_m]))


def test_the_outline_of_a_cube_seen_face_on_is_its_front_face(tiny):
    (border,) = outline_px(tiny.CUBE, PLAIN, ahead(1.0))
    half_px = 500 * 0.05 / 0.95  # the near face covers all others
    np.testing.assert_allclose(np.abs(border - [320, 240]).max(axis=1), half_px, atol=0.25)
    assert len(border) == 5  # four corners, closed


def test_the_outline_is_the_border_of_what_is_covered():
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    shape = ObjectShape("object", "sphere", np.array(sphere.vertices), np.array(sphere.faces))
    (border,) = outline_px(shape, PLAIN, ahead(0.5))
    radius_px = 500 * np.tan(np.arcsin(0.05 / 0.5))
    np.testing.assert_allclose(np.linalg.norm(border - [320, 240], axis=1), radius_px, atol=0.6)


def test_a_ring_has_an_outer_and_an_inner_outline():
    ring = trimesh.creation.annulus(r_min=0.03, r_max=0.05, height=0.001)
    shape = ObjectShape("object", "ring", np.array(ring.vertices), np.array(ring.faces))
    borders = outline_px(shape, PLAIN, ahead(0.5))
    sizes = sorted(float(np.ptp(border, axis=0).max()) for border in borders)
    np.testing.assert_allclose(sizes, [2 * 500 * 0.03 / 0.5, 2 * 500 * 0.05 / 0.5], atol=1.0)


def test_what_is_behind_or_beside_the_image_has_no_outline(tiny):
    around = outline_px(
        tiny.CUBE, PLAIN, ahead(0.0)
    )  # the camera inside the cube: the faces that reach behind it are left out
    assert all(np.isfinite(border).all() for border in around)
    assert outline_px(tiny.CUBE, PLAIN, ahead(-1.0)) == []
    assert outline_px(tiny.CUBE, PLAIN, Transform("c", "object", np.eye(3), np.array([50.0, 0, 1.0]))) == []


def test_a_triangle_is_outlined_from_both_sides(tiny):
    triangle = ObjectShape("o", "t", np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.0]]), np.array([[0, 1, 2]]))
    for turn in (np.eye(3), tiny.DOWN):
        (border,) = outline_px(triangle, PLAIN, Transform("c", "o", turn, np.array([0, 0, 1.0])))
        assert len(border) == 4


def test_vertex_normals_of_a_centred_cube_point_outwards(tiny):
    outwards = (vertex_normals(tiny.CUBE.vertices_m, tiny.CUBE.faces) * tiny.CUBE.vertices_m).sum(axis=1)
    assert np.abs(outwards).min() > 0.04
    assert len(set(np.sign(outwards))) == 1
