"""Solids: closed, painted where they say, with the mass that a solid of their shape has."""

from __future__ import annotations

import re

import numpy as np
import pytest
import trimesh

from acquisition.synthetic.config import ObjectConfig
from acquisition.synthetic.objects import shapes as objects
from acquisition.synthetic.objects.grasp import WIDEST_M, grasp
from acquisition.synthetic.objects.paint import paint_object
from acquisition.synthetic.objects.solids import corner_normals
from recordings.errors import BadInput

SHAPES = list(objects.USUAL_SIZE_M)


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_is_closed_and_centred_and_looks_outwards(shape):
    solid = objects.build(ObjectConfig(shape))
    mesh = trimesh.Trimesh(solid.vertices_m, solid.faces, process=False)
    mesh.merge_vertices()
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    np.testing.assert_allclose(mesh.bounds[0], -mesh.bounds[1], atol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_charts_are_isometric_and_their_axes_point_right_down_and_in(shape):
    solid = objects.build(ObjectConfig(shape))
    for face, chart_number, uv in zip(solid.faces, solid.face_chart, solid.corner_uv_m):
        chart = solid.charts[chart_number]
        if chart.object_from_chart is None:
            continue
        corners = solid.vertices_m[face]
        np.testing.assert_allclose(
            chart.object_from_chart.points(np.column_stack([uv, np.zeros(3)])), corners, atol=1e-9
        )
        outward = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        assert outward @ chart.object_from_chart.rotation[:, 2] < 0


@pytest.mark.parametrize("shape", SHAPES)
def test_the_convex_pieces_fill_the_shape(shape):
    solid = objects.build(ObjectConfig(shape))
    volume = trimesh.Trimesh(solid.vertices_m, solid.faces).volume
    hulls = sum(trimesh.convex.convex_hull(piece).volume for piece in solid.pieces_m)
    # the two legs of an L share their corner, the mug's staves are chords of its wall
    assert hulls == pytest.approx(volume, rel={"l": 0.3, "mug": 0.1}.get(shape, 1e-9))


def test_the_inertia_of_a_box_is_the_textbooks():
    x, y, z, m = 0.16, 0.11, 0.07, 0.3
    mass = objects.mass_properties(objects.build(ObjectConfig("box", (x, y, z))), m)
    expected = m / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
    np.testing.assert_allclose(mass.inertia_kgm2, np.diag(expected), atol=1e-9)
    np.testing.assert_allclose(mass.center_m, 0, atol=1e-9)


def test_the_centre_of_mass_of_an_l_is_not_its_boxs_centre():
    mass = objects.mass_properties(objects.build(ObjectConfig("l")), 0.3)
    assert mass.center_m[0] < -0.005
    assert mass.center_m[1] < -0.005


def test_normals_are_smooth_on_a_mug_and_sharp_on_a_cube():
    cube, mug = (objects.build(ObjectConfig(s)) for s in ("cube", "mug"))
    normals = corner_normals(cube.vertices_m, cube.faces)
    assert (np.isclose(np.abs(normals).max(axis=2), 1)).all()
    on_wall = np.isclose(np.linalg.norm(mug.vertices_m[mug.faces][:, :, :2] * 0, axis=2), 0)
    lengths = np.linalg.norm(corner_normals(mug.vertices_m, mug.faces), axis=2)
    np.testing.assert_allclose(lengths[on_wall], 1, atol=1e-6)


def test_a_mesh_file_keeps_its_shape(tmp_path):
    shape = trimesh.creation.capsule(height=0.06, radius=0.03)
    shape.apply_translation([0.5, 0, 0])
    shape.export(tmp_path / "capsule.stl")
    solid = objects.build(ObjectConfig("mesh", mesh_file=tmp_path / "capsule.stl"))
    np.testing.assert_allclose(np.ptp(solid.vertices_m, axis=0), shape.extents, atol=1e-6)
    assert len(solid.pieces_m) == 1
    painted, tags = paint_object(solid, "textured", np.random.default_rng(0))
    assert painted.atlas.max() > 0.1
    assert tags == ()


def test_an_open_mesh_file_is_refused(tmp_path):
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).export(tmp_path / "open.stl")
    with pytest.raises(BadInput, match="not watertight; close its holes first"):
        objects.build(ObjectConfig("mesh", mesh_file=tmp_path / "open.stl"))


def test_a_mesh_without_a_file_says_which_setting_is_missing():
    with pytest.raises(BadInput, match=re.escape("set ObjectConfig.mesh_file")):
        objects.build(ObjectConfig("mesh"))


def test_sizes_must_be_positive():
    with pytest.raises(BadInput, match="three positive lengths"):
        objects.build(ObjectConfig("box", (0.1, 0.0, 0.1)))


@pytest.mark.parametrize("shape", ["box", "prism", "l", "mug"])
def test_the_gripper_holds_the_usual_shapes_between_its_pads(shape):
    config = ObjectConfig(shape)
    solid = objects.build(config)
    held = grasp(config, solid)
    assert 0 < held.width_m <= WIDEST_M
    if shape != "mug":  # a mug is held by its handle
        across = held.object_from_tool.inverse().points(solid.vertices_m)[:, 1]
        np.testing.assert_allclose([across.min(), across.max()], [-held.width_m / 2, held.width_m / 2], atol=1e-9)


def test_a_cube_too_thick_for_the_gripper_is_refused():
    config = ObjectConfig("cube")
    with pytest.raises(BadInput, match="105 mm thick where the gripper closes; it opens to 78 mm"):
        grasp(config, objects.build(config))
