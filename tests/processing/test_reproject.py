"""Reprojection: known depths of a known box, both renderers, occlusion."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from processing.sensor import render
from processing.sensor.render import RaycastRenderer, make_renderer, reproject
from recordings.errors import BadInput
from recordings.geometry import CameraModel
from recordings.records import RgbdFrame
from recordings.tracks import ObjectShape

PINHOLE = CameraModel("d455", 320, 240, np.array([[190.0, 0, 160.2], [0, 191.0, 119.4], [0, 0, 1]]))
BENT = CameraModel("d455", 320, 240, PINHOLE.K, "brown-conrady", (-0.06, 0.07, 0.0006, -0.0004, -0.02))


@pytest.fixture(scope="module")
def box() -> ObjectShape:
    mesh = trimesh.creation.box((0.10, 0.08, 0.06))
    return ObjectShape("object", "test", np.asarray(mesh.vertices), np.asarray(mesh.faces))


def at(depth_m: float, turn: Rotation | None = None, sideways_m: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = (turn or Rotation.identity()).as_matrix()
    pose[:3, 3] = [sideways_m, 0, depth_m]
    return pose


def test_a_box_seen_head_on_has_the_depth_of_its_front_face(box):
    depth_m = RaycastRenderer(box, PINHOLE).depth(at(0.6))
    assert depth_m[119, 160] == pytest.approx(0.57, abs=1e-6)
    np.testing.assert_allclose(depth_m[depth_m > 0], 0.57, atol=1e-6)


def test_the_mask_of_a_box_has_the_size_that_projection_gives(box):
    mask = RaycastRenderer(box, PINHOLE).depth(at(0.6)) > 0
    rows, columns = np.nonzero(mask)
    assert columns.max() - columns.min() + 1 == pytest.approx(190.0 * 0.10 / 0.57, abs=1)
    assert rows.max() - rows.min() + 1 == pytest.approx(191.0 * 0.08 / 0.57, abs=1)


@pytest.mark.parametrize("camera", [PINHOLE, BENT], ids=["pinhole", "distorted"])
def test_every_rendered_point_lies_on_the_box(box, camera):
    pose = at(0.5, Rotation.from_rotvec([0.4, -0.7, 0.3]), 0.1)
    depth_m = RaycastRenderer(box, camera).depth(pose)
    v, u = np.nonzero(depth_m)
    points = camera.back_project(np.stack([u, v], -1).astype(float), depth_m[v, u].astype(float))
    in_object = (points - pose[:3, 3]) @ pose[:3, :3]
    gap = np.abs(np.abs(in_object) - np.array([0.05, 0.04, 0.03])).min(-1)
    assert len(v) > 500
    assert gap.max() < 1e-5


@pytest.mark.parametrize("camera", [PINHOLE, BENT], ids=["pinhole", "distorted"])
def test_drake_agrees_to_half_a_millimetre_and_99_percent_of_the_mask(box, camera):
    pytest.importorskip("pydrake", reason="Drake is not installed: pip install -e .[sim]")
    if not render._opengl_driver():
        pytest.skip("no OpenGL driver: apt-get install libegl-mesa0 libgl1-mesa-dri")
    pose = at(0.5, Rotation.from_rotvec([0.4, -0.7, 0.3]), 0.05)
    ours, drakes = make_renderer("raycast", box, camera).depth(pose), make_renderer("drake", box, camera).depth(pose)
    both = (ours > 0) & (drakes > 0)
    assert both.sum() / ((ours > 0) | (drakes > 0)).sum() > 0.99
    assert np.quantile(np.abs(ours - drakes)[both], 0.99) < 0.0005


def test_without_an_opengl_driver_drake_says_what_to_install_instead_of_ending_the_process(box, monkeypatch):
    pytest.importorskip("pydrake", reason="Drake is not installed: pip install -e .[sim]")
    monkeypatch.setattr(render, "_opengl_driver", lambda: False)
    with pytest.raises(BadInput, match="apt-get install .*libegl-mesa0.* or leave out"):
        make_renderer("drake", box, PINHOLE)


def test_a_shape_behind_the_camera_or_beside_the_image_is_not_drawn(box):
    renderer = RaycastRenderer(box, PINHOLE)
    assert not renderer.depth(at(-0.6)).any()
    assert not renderer.depth(at(0.6, sideways_m=3.0)).any()


def test_an_occluder_is_filled_by_default_and_subtracted_on_request(box):
    renderer = RaycastRenderer(box, PINHOLE)
    occluder = np.zeros((240, 320), dtype=bool)
    occluder[:, 160:] = True
    whole = renderer.depth(at(0.6)) > 0
    filled = reproject(renderer, at(0.6), occluder)
    assert (filled.mask == whole).all()
    assert (filled.colorless == (whole & occluder)).all()
    cut = reproject(renderer, at(0.6), occluder, "subtract")
    assert (cut.mask == (whole & ~occluder)).all()
    assert not cut.depth_m[~cut.mask].any()


def test_a_reprojected_frame_keeps_the_raw_depth_outside_the_mask(box):
    raw = RgbdFrame("d455", 0, 0, 0, np.zeros((240, 320, 3), np.uint8), np.full((240, 320), 0.9, np.float32))
    drawn = reproject(RaycastRenderer(box, PINHOLE), at(0.6))
    frame = drawn.frame(raw)
    assert (frame.depth_m[~drawn.mask] == np.float32(0.9)).all()
    assert frame.depth_m[drawn.mask] == pytest.approx(0.57, abs=1e-6)
