"""Shapes are closed and in metres; masses follow the textbook."""

import numpy as np
import pytest
import trimesh
from variety import appearance, masses, shapes

from recordings.errors import BadInput

BOX = trimesh.creation.box((0.1, 0.2, 0.3))
BALL = trimesh.creation.icosphere(subdivisions=5, radius=0.05)


@pytest.mark.parametrize("family", shapes.FAMILIES)
@pytest.mark.parametrize("seed", [0, 1])
def test_every_shape_is_one_closed_body_in_metres_between_4_and_20_cm(family, seed):
    solid = shapes.make(family, np.random.default_rng(seed))
    mesh = trimesh.Trimesh(solid.vertices_m, solid.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert 0.04 - 1e-9 <= np.ptp(solid.vertices_m, axis=0).max() <= 0.2 + 1e-9
    assert len(mesh.split(only_watertight=False)) == 1


def test_sizes_are_log_uniform():
    sizes = [np.ptp(shapes.make("box", np.random.default_rng(s)).vertices_m, axis=0).max() for s in range(300)]
    assert np.median(sizes) == pytest.approx(np.sqrt(0.04 * 0.2), rel=0.12)


def test_the_corners_of_the_hull_reach_as_far_as_the_body_within_half_a_per_cent():
    solid = shapes.make("blob", np.random.default_rng(3))
    directions = np.random.default_rng(0).standard_normal((200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    whole, few = ((directions @ points.T).max(axis=1) for points in (solid.vertices_m, solid.pieces_m[0]))
    assert ((whole - few) < 0.005 * np.ptp(solid.vertices_m, axis=0).max()).all()


@pytest.mark.parametrize("kind", appearance.KINDS)
def test_every_manner_of_paint_gives_albedos_that_exist(kind):
    solid = shapes.make("box", np.random.default_rng(1))
    atlas = appearance.paint(solid, kind, np.random.default_rng(2)).atlas
    used = atlas[atlas.sum(axis=-1) > 0]
    assert used.min() >= 0.02 - 1e-6
    assert used.max() <= 0.92 + 1e-6
    assert (used.std(axis=0).max() > 0.05) == (kind in ("label", "pattern", "printed", "dense"))


def test_a_solid_box_has_the_textbooks_inertia():
    found = masses.of_solid(BOX.vertices, BOX.faces, 3.0)
    x, y, z = 0.1**2, 0.2**2, 0.3**2
    np.testing.assert_allclose(found.inertia_kgm2, np.diag([y + z, x + z, x + y]) * 3.0 / 12, atol=1e-9)
    np.testing.assert_allclose(found.center_m, 0, atol=1e-12)


def test_a_thin_ball_has_two_thirds_and_a_solid_one_two_fifths_of_m_r_squared():
    shell = masses.of_shell(BALL.vertices, BALL.faces, 0.3)
    solid = masses.of_solid(BALL.vertices, BALL.faces, 0.3)
    np.testing.assert_allclose(np.diag(shell.inertia_kgm2), 2 / 3 * 0.3 * 0.05**2, rtol=2e-3)  # an icosphere is smaller
    np.testing.assert_allclose(np.diag(solid.inertia_kgm2), 2 / 5 * 0.3 * 0.05**2, rtol=4e-3)


def test_two_halves_of_a_box_together_are_the_box():
    half = trimesh.creation.box((0.1, 0.2, 0.15))
    parts = [masses.of_solid(half.vertices + [0, 0, s * 0.075], half.faces, 1.5) for s in (-1, 1)]
    whole = masses.of_solid(BOX.vertices, BOX.faces, 3.0)
    found = masses.together(parts)
    np.testing.assert_allclose(found.inertia_kgm2, whole.inertia_kgm2, atol=1e-9)
    np.testing.assert_allclose(found.center_m, 0, atol=1e-12)


@pytest.mark.parametrize("manner", ["solid", "hollow", "off-centre"])
def test_every_inertia_could_be_a_bodys(manner):
    """Each principal moment is below the sum of the others, and the centre lies inside the bounding box."""
    found = masses.draw(BOX.vertices, BOX.faces, manner, np.random.default_rng(5))
    a, b, c = np.linalg.eigvalsh(found.inertia_kgm2)
    assert 0 < a <= b <= c <= a + b + 1e-12
    assert (np.abs(found.center_m) < [0.05, 0.1, 0.15]).all()
    assert (np.linalg.norm(found.center_m) > 0.002) == (manner == "off-centre")


def test_an_open_surface_has_no_solid_mass():
    with pytest.raises(BadInput, match="not closed"):
        masses.of_solid(BOX.vertices, BOX.faces[:-1], 1.0)
