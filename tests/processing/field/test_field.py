"""The field on a cube that is drawn by an exact ray cast: every answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from processing.field.fuse import FuseConfig, fuse
from processing.field.mesh import extract_mesh, grid_mesh, surface_of
from processing.field.rays import make_ray_dataset
from processing.field.train import FieldConfig, train_field
from processing.field.views import FieldView, make_view, object_points, without_strays
from processing.motion.interpolate import pose_at
from recordings.errors import BadInput
from recordings.geometry import CameraModel
from recordings.records import RgbdFrame
from recordings.tracks import ObjectShape, ObjectTrack

HALF_M = 0.04
RED_OF_FACE = (60, 140, 220)
"""Red tells the axis of a face; green and blue are chequered."""
CAMERA = CameraModel("d455", 160, 120, np.array([[190.0, 0, 79.5], [0, 190.0, 59.5], [0, 0, 1]]))


def looking_at_cube(turn: Rotation) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = turn.as_matrix()
    pose[:3, 3] = [0.0, 0.0, 0.35]
    return pose


def draw(pose: np.ndarray, noise_m: float = 0.0, seed: int = 0) -> tuple[RgbdFrame, np.ndarray]:
    """An exact picture of a chequered cube."""
    rays = CAMERA.pixel_rays()
    origin, along = -pose[:3, :3].T @ pose[:3, 3], rays @ pose[:3, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-HALF_M - origin) / along, (HALF_M - origin) / along
    enter, leave = np.minimum(first, second).max(-1), np.maximum(first, second).min(-1)
    mask = (enter < leave) & (enter > 0)
    points = origin + np.where(mask, enter, 0)[..., None] * along
    chequer = np.floor(points / 0.02 + 1e-4).astype(int).sum(-1) % 2
    shade = (0.3 + 0.5 * chequer) * 255
    red = np.array(RED_OF_FACE)[np.abs(points).argmax(-1)]
    rgb = np.where(mask[..., None], np.stack([red, shade * 0.8, 255 - shade], -1), 90).astype(np.uint8)
    noise = noise_m * np.random.default_rng(seed).normal(size=mask.shape)
    depth_m = np.where(mask, enter + noise, 0.9).astype(np.float32)
    return RgbdFrame("d455", seed, 0, 0, rgb, depth_m), mask


def cube_views(count: int, noise_m: float = 0.0005) -> list[FieldView]:
    turns = Rotation.random(count, random_state=1)
    views = []
    for i, turn in enumerate(turns):
        pose = looking_at_cube(turn)
        frame, mask = draw(pose, noise_m, i)
        view = make_view(frame, mask, CAMERA, pose, pose)
        assert view is not None
        views.append(view)
    return views


def distance_to_cube_m(points_m: np.ndarray) -> np.ndarray:
    q = np.abs(points_m) - HALF_M
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


@pytest.fixture(scope="module")
def views() -> list[FieldView]:
    return cube_views(24)


def test_fusing_exact_poses_gives_the_cube(views):
    shape = grid_mesh(fuse(views, FuseConfig(truncation_m=0.005)))
    error_m = np.abs(distance_to_cube_m(shape.vertices_m))
    assert np.median(error_m) < 0.0002
    assert np.quantile(error_m, 0.95) < 0.001


def test_the_mesh_is_watertight_faces_outward_and_all_of_it_was_seen(views):
    import trimesh

    shape = grid_mesh(fuse(views, FuseConfig(truncation_m=0.005)))
    mesh = trimesh.Trimesh(shape.vertices_m, shape.faces)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx((2 * HALF_M) ** 3, rel=0.02)
    assert shape.observed.mean() > 0.98


def test_what_no_view_saw_is_closed_and_marked_unobserved():
    turns = [Rotation.from_euler("xyz", [a, b, 0]) for a in (-0.7, 0.0, 0.7) for b in (-0.7, 0.0, 0.7)]
    views = []
    for turn in turns:
        frame, mask = draw(looking_at_cube(turn))
        views.append(make_view(frame, mask, CAMERA, looking_at_cube(turn), looking_at_cube(turn)))
    shape = grid_mesh(fuse(views, FuseConfig(truncation_m=0.005)))
    seen, unseen = shape.vertices_m[shape.observed], shape.vertices_m[~shape.observed]
    assert len(unseen) > 100
    assert unseen[:, 2].mean() > seen[:, 2].mean() + 0.02  # the side turned away from every camera


def test_what_no_view_saw_stays_as_a_shape_is_believed_to_be_and_what_views_saw_does_not():
    import trimesh

    turns = [Rotation.from_euler("xyz", [a, b, 0]) for a in (-0.7, 0.0, 0.7) for b in (-0.7, 0.0, 0.7)]
    views = []
    for turn in turns:
        frame, mask = draw(looking_at_cube(turn))
        views.append(make_view(frame, mask, CAMERA, looking_at_cube(turn), looking_at_cube(turn)))
    longer_m = 0.012  # than the cube, on both sides of z: one of them is in view
    box = trimesh.creation.box([2 * HALF_M, 2 * HALF_M, 2 * (HALF_M + longer_m)]).subdivide().subdivide()
    green = np.tile(np.array([0, 255, 0], dtype=np.uint8), (len(box.vertices), 1))
    prior_shape = ObjectShape("object", "test", np.asarray(box.vertices), np.asarray(box.faces), green)
    grid = fuse(views, FuseConfig(truncation_m=0.005), prior_shape)
    shape = grid_mesh(grid)
    assert shape.vertices_m[:, 2].max() == pytest.approx(HALF_M + longer_m, abs=0.001)
    assert shape.vertices_m[:, 2].min() > -HALF_M - 0.2 * longer_m
    assert np.quantile(np.abs(distance_to_cube_m(shape.vertices_m[shape.observed])), 0.9) < 0.001
    assert trimesh.Trimesh(shape.vertices_m, shape.faces).is_watertight
    assert shape.observed[shape.vertices_m[:, 2] > HALF_M + 0.5 * longer_m].mean() < 0.05
    far = np.rint((np.array([0, 0, HALF_M + longer_m]) - grid.origin_m) / grid.voxel_m).astype(int)
    np.testing.assert_allclose(grid.rgb[tuple(far)], [0, 1, 0], atol=0.01)


def moved_about(views: list[FieldView], by_deg: float, by_m: float) -> list[FieldView]:
    """The views with poses that are off by so much (standard deviations by axis)."""
    random = np.random.default_rng(3)
    disturbed = []
    for view in views:
        off = np.eye(4)
        off[:3, :3] = Rotation.from_rotvec(np.radians(by_deg) * random.normal(size=3)).as_matrix()
        off[:3, 3] = by_m * random.normal(size=3)
        pose = view.camera_from_object @ off
        disturbed.append(view.posed(pose, pose))
    return disturbed


def test_refinement_pulls_disturbed_poses_back(views):
    disturbed = moved_about(views, 0.8, 0.001)
    trained = train_field(disturbed, FieldConfig(steps=0))
    assert spread_deg(trained.views, views) < 0.4 * spread_deg(disturbed, views)


def test_views_whose_poses_are_guesses_leave_the_surface_to_the_others(views):
    wrong = moved_about(views, by_deg=30.0, by_m=0.01)
    mixed = [view if i % 3 else other for i, (view, other) in enumerate(zip(views, wrong))]
    weighed = [view if i % 3 else replace(view, weight=1e-3) for i, view in enumerate(mixed)]
    errors_m = [
        np.quantile(np.abs(distance_to_cube_m(grid_mesh(fuse(v, FuseConfig(voxel_m=0.002))).vertices_m)), 0.95)
        for v in (weighed, mixed)
    ]
    assert errors_m[0] < 0.0015 < 0.004 < errors_m[1]


def test_two_views_that_count_half_count_as_one(views):
    twice, config = [*views[:8], *views[:8]], FuseConfig(voxel_m=0.003)
    halves = fuse([replace(v, weight=0.5) for v in twice], config)
    once = fuse([replace(v, weight=1.0 if i < 8 else 0.0) for i, v in enumerate(twice)], config)
    np.testing.assert_allclose(halves.sdf_m, once.sdf_m, atol=1e-6)
    np.testing.assert_allclose(halves.weight, once.weight, rtol=1e-5)
    np.testing.assert_array_equal(halves.free, once.free)


def test_what_only_a_guess_has_seen_is_unseen(views):
    config = FuseConfig(voxel_m=0.003)
    alone = fuse(
        [replace(views[0], weight=0.4), *(replace(v, depth_m=0 * v.depth_m, weight=0.0) for v in views[1:])], config
    )
    assert fuse(views[:1], config).weight.any()
    assert not alone.weight.any()


def test_of_a_view_that_counts_a_quarter_a_quarter_of_the_rays_is_learned_from(views):
    whole, part = (make_ray_dataset([replace(views[0], weight=w), views[1]]) for w in (1.0, 0.25))
    for name in ("view", "passing_view"):
        of_both = [np.bincount(getattr(rays, name).numpy(), minlength=2) for rays in (whole, part)]
        assert of_both[1][0] == round(0.25 * of_both[0][0])
        assert of_both[1][1] == of_both[0][1]


def spread_deg(estimated, true) -> float:
    """Median rotation error after the best common alignment."""
    gaps = [np.linalg.inv(e.camera_from_object) @ t.camera_from_object for e, t in zip(estimated, true, strict=True)]
    turns = Rotation.from_matrix([g[:3, :3] for g in gaps])
    return float(np.degrees(np.median((turns.mean().inv() * turns).magnitude())))


def test_the_field_reaches_the_surface(views):
    torch.set_num_threads(1)
    trained = train_field(views, FieldConfig(steps=40, pose_rounds=0, rays=1024))
    shape = extract_mesh(trained.field, trained.grid)
    assert np.median(np.abs(distance_to_cube_m(shape.vertices_m))) < 0.0003
    assert trained.losses[-1] < 2 * trained.losses[0]


def test_vertex_colours_are_the_cubes(views):
    trained = train_field(views, FieldConfig(steps=20, pose_rounds=0, rays=1024))
    shape = extract_mesh(trained.field, trained.grid)
    size = np.abs(shape.vertices_m)
    for axis, red in enumerate(RED_OF_FACE):
        inner = (size.argmax(1) == axis) & (np.sort(size, axis=1)[:, 1] < HALF_M - 0.006)
        assert np.median(shape.vertex_rgb[inner, 0]) == pytest.approx(red, abs=12)


def test_foreign_colour_does_not_reach_the_shape(views):
    painted = []
    for number, view in enumerate(views):
        color, bar = view.color_rgb.copy(), np.zeros_like(view.inside)
        bar[:, (5 * number) % view.inside.shape[1] :][:, :12] = True
        color[bar] = (255, 255, 0)
        painted.append(replace(view, color_rgb=color, colorless=bar))
    trained, untouched = (train_field(v, FieldConfig(steps=20, pose_rounds=1, rays=1024)) for v in (painted, views))
    shape = extract_mesh(trained.field, trained.grid)
    size = np.abs(shape.vertices_m)
    for axis, red in enumerate(RED_OF_FACE):
        inner = (size.argmax(1) == axis) & (np.sort(size, axis=1)[:, 1] < HALF_M - 0.006)
        assert np.median(shape.vertex_rgb[inner, 0]) == pytest.approx(red, abs=12)
    assert spread_deg(trained.views, views) < spread_deg(untouched.views, views) + 0.1


def test_a_corner_that_depth_never_tells_of_grows_no_spike():
    """What lies behind one face, and beside the mask wherever it would be seen, is empty."""
    shape = grid_mesh(fuse(cube_views(60, noise_m=0.001), FuseConfig(truncation_m=0.005)))
    pixel_m = 0.35 / CAMERA.K[0, 0]  # outlines tell no more
    assert distance_to_cube_m(shape.vertices_m).max() < pixel_m


def test_the_same_seed_gives_the_same_field(views):
    config = FieldConfig(steps=5, rays=256)
    first, second = train_field(views[:8], config), train_field(views[:8], config)
    assert first.losses == second.losses
    np.testing.assert_array_equal(first.views[3].camera_from_object, second.views[3].camera_from_object)


def test_mask_and_colour_are_moved_to_where_late_depth_saw_the_object():
    color_pose = looking_at_cube(Rotation.from_euler("xyz", [20, 30, 0], degrees=True))
    depth_pose = looking_at_cube(Rotation.from_euler("xyz", [20, 30, 5], degrees=True))
    depth_pose[:3, 3] += [0.01, 0.03, 0.0]  # 17 px
    (frame, mask), (later, _) = draw(color_pose), draw(depth_pose)
    view = make_view(replace(frame, depth_m=later.depth_m), mask, CAMERA, color_pose, depth_pose)
    assert view is not None
    points_m = object_points(view)
    assert len(points_m) > 0.7 * mask.sum()
    assert np.abs(distance_to_cube_m(points_m)).max() < 0.001
    left, top = (CAMERA.K[:2, 2] - view.K[:2, 2]).astype(int)
    h, w = view.outside.shape
    _, there = draw(depth_pose)
    assert (view.outside & there[top : top + h, left : left + w]).sum() < 0.002 * mask.sum()
    size = np.sort(np.abs(points_m), axis=1)
    inner = size[:, 1] < HALF_M - 0.006
    red = np.array(RED_OF_FACE)[np.abs(points_m[inner]).argmax(1)]
    assert np.mean(np.abs(view.color_rgb[view.depth_m > 0][inner, 0] - red) < 12) > 0.97


def test_an_empty_mask_gives_no_view():
    pose = looking_at_cube(Rotation.identity())
    frame, mask = draw(pose)
    assert make_view(frame, np.zeros_like(mask), CAMERA, pose, pose) is None


def test_a_mask_of_another_size_is_refused():
    pose = looking_at_cube(Rotation.identity())
    frame, _ = draw(pose)
    with pytest.raises(BadInput, match="a mask of"):
        make_view(frame, np.ones((3, 3), dtype=bool), CAMERA, pose, pose)


def test_views_without_depth_are_refused():
    pose = looking_at_cube(Rotation.identity())
    frame, mask = draw(pose)
    blind = RgbdFrame("d455", 0, 0, 0, frame.color_rgb, np.zeros_like(frame.depth_m))
    with pytest.raises(BadInput, match="depth points"):
        fuse([make_view(blind, mask, CAMERA, pose, pose)], FuseConfig())


def test_the_pose_at_depths_exposure_lies_on_the_parabola():
    """Depth 16 ms late in free flight: the straight way between frames would be 1.4 mm off."""
    times_ns = (np.arange(4) * 33_333_333).astype(np.int64)
    poses = np.tile(np.eye(4), (4, 1, 1))
    for pose, t in zip(poses, times_ns * 1e-9, strict=True):
        pose[:3, :3] = Rotation.from_rotvec([0, 5 * t, 0]).as_matrix()
        pose[:3, 3] = [0.5 * t, -1.2 * t + 0.5 * 9.81 * t * t, 0.8]
    track = ObjectTrack(0, "d455", "object", times_ns, poses, ("tracked",) * 4, np.zeros((4, 6, 6)))
    t = times_ns[1] * 1e-9 + 0.016
    found = pose_at(track, 1, int(times_ns[1]) + 16_000_000)
    np.testing.assert_allclose(found[:3, 3], [0.5 * t, -1.2 * t + 0.5 * 9.81 * t * t, 0.8], atol=1e-6)
    np.testing.assert_allclose(found[:3, :3], Rotation.from_rotvec([0, 5 * t, 0]).as_matrix(), atol=1e-6)
    before = pose_at(track, 0, int(times_ns[0]) + 16_000_000)
    assert abs(before[1, 3] - (-1.2 * 0.016 + 0.5 * 9.81 * 0.016**2)) < 0.0015


def test_a_lost_frame_has_no_pose_at_depths_exposure_either() -> None:
    poses = np.tile(looking_at_cube(Rotation.from_rotvec([0.3, 0.2, 0.1])), (4, 1, 1))
    poses[[1, 3]] = np.nan
    times_ns, status = (np.arange(4) * 33_333_333).astype(np.int64), ("tracked", "lost", "tracked", "lost")
    track = ObjectTrack(0, "d455", "object", times_ns, poses, status, np.zeros((4, 6, 6)))
    for i in range(4):
        for late_ns in (-9_000_000, 0, 16_000_000):
            np.testing.assert_array_equal(pose_at(track, i, int(times_ns[i]) + late_ns), poses[i])


def test_pieces_that_were_seen_are_all_kept_but_crumbs_and_what_few_views_saw_are_not() -> None:
    """A hand cuts one piece off, and a thin part is lost between them; what masks let through may be larger."""
    grid = fuse(cube_views(8), FuseConfig(truncation_m=0.005))
    sdf, weight = np.full_like(grid.sdf_m, grid.voxel_m), np.zeros_like(grid.weight)
    for start, edge, seen in ((2, 8, 9.0), (14, 6, 4.0), (22, 2, 9.0), (26, 10, 0.5)):
        sdf[start : start + edge, 2 : 2 + edge, 2 : 2 + edge] = -grid.voxel_m
        weight[start - 1 : start + edge + 1, 1 : 3 + edge, 1 : 3 + edge] = seen
    vertices_m, faces = surface_of(sdf, replace(grid, sdf_m=sdf, weight=weight))
    bodies = trimesh.Trimesh(vertices_m, faces).split()
    sizes = sorted(float(np.ptp(b.vertices, axis=0).mean()) / grid.voxel_m for b in bodies)
    assert sizes == pytest.approx([6, 8], abs=0.01)
    assert all(b.is_watertight for b in bodies)


def test_depth_past_the_edge_of_masks_does_not_make_the_grid_larger(views: list[FieldView]) -> None:
    """In two views a part of the mask shows what is far behind the body, as where depth is exposed late."""
    behind = []
    for number, view in enumerate(views):
        depth_m = view.depth_m.copy()
        if number in (3, 11):
            rows = np.flatnonzero((depth_m > 0).any(axis=1))[:20]
            depth_m[rows] = np.where(depth_m[rows] > 0, np.float32(1.4), 0)
        behind.append(replace(view, depth_m=depth_m))
    cleaned = without_strays(behind)
    for was, dirty, clean in zip(views, behind, cleaned):
        np.testing.assert_array_equal(clean.depth_m, np.where(dirty.depth_m == was.depth_m, was.depth_m, 0))
    config = FuseConfig(truncation_m=0.005)
    grids = [fuse(v, config) for v in (views, behind, cleaned)]
    sizes_m = [max(g.sdf_m.shape) * g.voxel_m for g in grids]
    assert sizes_m[1] > 0.5
    assert sizes_m[2] == pytest.approx(sizes_m[0], abs=0.003)
    error_m = np.abs(distance_to_cube_m(grid_mesh(grids[2]).vertices_m))
    assert np.quantile(error_m, 0.95) < 0.001


def test_views_without_strays_or_without_points_stay_as_they_are(views: list[FieldView]) -> None:
    assert all(a is b for a, b in zip(without_strays(views), views, strict=True))
    blind = [replace(v, depth_m=np.zeros_like(v.depth_m)) for v in views[:2]]
    assert all(a is b for a, b in zip(without_strays(blind), blind, strict=True))
    assert without_strays([]) == []
