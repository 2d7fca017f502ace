"""Poses adjusted with the surface free: a plain ellipsoid, seen by a noiseless camera, known as too small."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from processing.features.sift import Sift
from processing.motion import se3_kernels as se3
from processing.sensor import view_layout as lay
from processing.sensor.noise import TRACK_COVARIANCE_SCALE, DepthNoise
from processing.sensor.render import RaycastRenderer
from processing.sensor.view import Crop
from processing.track.beam import Scene
from processing.track.free_surface.adjust import PosedToss, adjusted
from processing.track.free_surface.appearance import AppearanceTerms
from processing.track.free_surface.drawn import DrawnViews
from processing.track.free_surface.kernels import slide
from processing.track.free_surface.surface import OFFSET_SIGMA_M, FreeSurface
from processing.track.free_surface.terms import (
    LEAST_SIGMA_PX,
    SurfaceMeasurements,
    SurfaceTerms,
    not_its_own,
    signed_distance_px,
)
from processing.track.hypotheses import HypothesisConfig
from processing.track.track_toss import TrackConfig, views_of
from recordings.geometry import CameraModel, rotation_exp
from recordings.progress import Silent
from recordings.records import RgbdFrame
from recordings.tracks import ObjectShape

CAMERA = CameraModel("d455", 320, 240, np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]]))
AXES_M = np.array([0.03, 0.045, 0.06])
FAR_M = 0.6
NOISE = DepthNoise(0.005, 49.0)
COUNT = 12


def ellipsoid(smaller_m: float = 0.0) -> ObjectShape:
    """Its surface moved in along the normals."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4)
    points = np.asarray(ball.vertices) * AXES_M
    normals = np.asarray(ball.vertices) / AXES_M
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return ObjectShape("object", "test", points - smaller_m * normals, np.asarray(ball.faces, dtype=np.int64))


def true_poses(seed: int) -> np.ndarray:
    """A body that turns steadily about a random axis, from a random side."""
    random = np.random.default_rng(seed)
    start, axis = Rotation.random(random_state=seed).as_matrix(), random.normal(size=3)
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    for i, pose in enumerate(poses):
        pose[:3, :3] = rotation_exp(np.radians(18.0) * i * axis / np.linalg.norm(axis)) @ start
        pose[:3, 3] = [-0.1 + 0.2 * i / COUNT, 0.02 * np.sin(i), FAR_M]
    return poses


def seen(poses: np.ndarray, printed: bool = False, bent_m: float = 0.0) -> Scene:
    """Views of the ellipsoid at the poses, without any texture or `printed`, each one's depth bent by so much."""
    renderer, random, frames = RaycastRenderer(ellipsoid(), CAMERA), np.random.default_rng(3), []
    v, u = np.indices((CAMERA.height, CAMERA.width))
    for i, pose in enumerate(poses):
        hits, depth_m, points = renderer.hits(pose), renderer.depth(pose), np.zeros((*v.shape, 3))
        points[hits.box] = np.einsum("hwc,hwcj->hwj", hits.weight, ellipsoid().vertices_m[ellipsoid().faces[hits.face]])
        waves = np.sin(points @ [[200, 0, 90], [0, 300, 60], [90, 40, 250]]) if printed else np.zeros(points.shape)
        color = np.where(depth_m[..., None] > 0, 128 + 60 * waves, 90).astype(np.uint8)
        bend = bent_m * np.sin(u / 20 + random.uniform(0, 6)) * np.sin(v / 20 + random.uniform(0, 6))
        depth_m = np.where(depth_m > 0, depth_m + bend, 0).astype(np.float32)
        frames.append(RgbdFrame("d455", i, i * 33_333_333, i * 33_333_333, color, depth_m))
    store, times_ns, _ = views_of(frames, [f.depth_m > 0 for f in frames], CAMERA, np.ones(len(poses)), TrackConfig(),
                                  None, Silent())  # fmt: skip
    return Scene(store, 1e-9 * times_ns, np.zeros(3), np.zeros(3), Sift())


def apart_deg(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """How far poses are turned against the true ones, but for one turn of the object frame that all have in common."""
    off = Rotation.from_matrix(np.einsum("nji,njk->nik", found[:, :3, :3], true[:, :3, :3]))
    return np.degrees((off.mean().inv() * off).magnitude())


@pytest.fixture(scope="module")
def tosses() -> list[Scene]:
    return [seen(true_poses(seed)) for seed in (1, 2)]


@pytest.fixture(scope="module")
def printed() -> Scene:
    """The body printed, the depth of each view bent by 8 mm."""
    return seen(true_poses(1), printed=True, bent_m=0.008)


def measured_by(scene: Scene, smaller_m: float) -> SurfaceMeasurements:
    return SurfaceMeasurements(FreeSurface(ellipsoid(smaller_m), CAMERA), scene.store, NOISE)


def test_a_right_shape_at_right_poses_leaves_nothing(tosses):
    measured = measured_by(tosses[0], 0.0)
    for view, pose in enumerate(true_poses(1)):
        outline, depth = measured.of(view, pose)
        assert abs(np.mean(outline.value_m * outline.scale_px)) < 0.1
        assert np.abs(outline.value_m * outline.scale_px).max() < 1.0
        assert np.abs(depth.value_m).mean() < 0.001  # depth is smoothed over windows


@pytest.mark.parametrize("smaller_m", [0.002, -0.002])
def test_outlines_alone_tell_the_surface_both_ways(tosses, smaller_m):
    measured = measured_by(tosses[0], smaller_m)
    measured.sigma_px = LEAST_SIGMA_PX
    said = sum(measured.of(i, p)[0].of_offsets(measured.surface.count) for i, p in enumerate(true_poses(1)))
    offsets_m = -measured.surface.prior.with_more(said[0]).solver()(said[1])
    told = said[0] > np.median(said[0][said[0] > 0])
    assert told.sum() > 40
    assert np.median(offsets_m[told]) == pytest.approx(smaller_m, rel=0.3)  # less: they are held to 0


@pytest.mark.parametrize("which", [0, 1], ids=["outline", "depth"])
def test_residuals_change_as_their_derivatives_say(tosses, which):
    measured, pose = measured_by(tosses[0], 0.001), true_poses(1)[4]
    measured.of(4, pose)  # the outline is drawn here, and its points now lie between pixels
    pose[:3, 3] += [0.0003, 0.0002, 0.0]
    before = measured.of(4, pose)[which]
    used = before.weight > 0
    for a in range(6):
        twist = np.zeros(6)
        twist[a] = 1e-5
        ends = [measured.of(4, pose @ se3.inverse(se3.exponential(t)))[which].value_m[used] for t in (twist, -twist)]
        change = (ends[0] - ends[1]) / 2e-5
        error = np.abs(change - before.by_twist[used, a])
        assert np.median(error) < 0.01 * np.abs(before.by_twist[used, a]).max()


@pytest.mark.parametrize("grown_m", [0.002, -0.002])
def test_a_surface_that_moved_is_drawn_where_it_is_and_held_by_what_was_known(grown_m):
    surface, pose = FreeSurface(ellipsoid(), CAMERA), true_poses(1)[4]
    before = surface.depth(pose)
    surface.move(np.full(surface.count, 0.5 * grown_m))
    surface.move(np.full(surface.count, 0.5 * grown_m))
    moved = np.einsum("vj,vj->v", surface.vertices_m - ellipsoid().vertices_m, FreeSurface(ellipsoid(), CAMERA).normals)
    np.testing.assert_allclose(moved, grown_m, rtol=0.05)
    middle = before[np.nonzero(before)].min() == before
    assert (before - surface.depth(pose))[middle].max() == pytest.approx(grown_m, rel=0.1)
    assert surface.pull @ surface.moved_m == pytest.approx((grown_m / OFFSET_SIGMA_M) ** 2)  # as likely as one patch's


def test_offsets_are_solved_for_by_all_that_is_known_of_them():
    random = np.random.default_rng(4)
    surface = FreeSurface(ellipsoid(), CAMERA)
    told = random.random(surface.count) < 0.5
    known = surface.prior.with_more(np.where(told, 1e7 * random.random(surface.count), 0.0))
    columns = random.normal(size=(surface.count, 3))
    for column, offsets_m in zip(columns.T, known.solver()(columns).T):
        np.testing.assert_allclose(known.times(offsets_m), column, atol=1e-9)


def test_a_surface_beside_the_image_has_no_depth_and_no_outline():
    surface, pose = FreeSurface(ellipsoid(), CAMERA), true_poses(1)[4]
    pose[:3, 3] = [5.0, 0.0, FAR_M]
    assert not surface.depth(pose).any()
    points, vertices, _ = surface.outline(pose)
    assert points.shape == (0, 3)
    assert vertices.shape == (0,)


def test_what_no_view_saw_of_a_surface_has_no_depth():
    half = replace(ellipsoid(), observed=ellipsoid().vertices_m[:, 0] > 0)
    depth_m, whole_m = (FreeSurface(s, CAMERA).depth(true_poses(1)[4]) for s in (half, ellipsoid()))
    assert 0 < (depth_m > 0).sum() < (whole_m > 0).sum()
    np.testing.assert_array_equal(depth_m[depth_m > 0], whole_m[depth_m > 0])


def test_an_outline_moves_with_its_surface(tosses):
    pose = true_poses(1)[4]
    thin, thick = (measured_by(tosses[0], s).of(4, pose)[0] for s in (0.001, 0.0))
    moved = np.median(thick.value_m) - np.median(thin.value_m)
    assert moved == pytest.approx(0.001 * np.median(thin.by_offset), rel=0.15)


def test_terms_know_no_turn_that_the_surface_can_follow(tosses):
    """One view alone, whose surface may go with it, holds no pose as the same view does against a known surface."""
    measured, poses = measured_by(tosses[0], 0.0), true_poses(1)
    count, place = measured.surface.count, np.where(np.arange(COUNT) == 4, 0, -1)
    held = []
    for others in (np.zeros((2, count)), np.stack([np.full(count, 1e12), np.zeros(count)])):
        H, g = np.zeros((1, 1, 6, 6)), np.zeros((1, 6))
        SurfaceTerms(measured, slice(COUNT), np.array([4]), others).add(H, g, poses, place)
        held.append(np.linalg.eigvalsh(H[0, 0]))
    assert (held[0] > -1e-6 * held[1].max()).all()
    assert (held[0] < 0.5 * held[1]).all()


@pytest.mark.parametrize(
    ("smaller_m", "left"),
    [pytest.param(0.0, 0.4, marks=pytest.mark.slow, id="right"), pytest.param(0.003, 1.0, id="too small")],
)
def test_poses_that_drift_come_to_one_surface(tosses, smaller_m, left):
    """Pairs of these views alone, whose depth may err and which have no texture, turn them by 7 degrees."""
    random, config = np.random.default_rng(0), HypothesisConfig(depth_noise=NOISE)
    starts = [true_poses(seed) for seed in (1, 2)]
    for poses in starts:
        drift = random.normal(size=3)
        for i, pose in enumerate(poses):
            pose[:3, :3] = pose[:3, :3] @ rotation_exp(np.radians(8.0) * i / COUNT * drift / np.linalg.norm(drift))
    posed = [PosedToss(scene, start) for scene, start in zip(tosses, starts)]
    found = adjusted(posed, ellipsoid(smaller_m), config, Silent())
    for seed, start, end in zip((1, 2), starts, found):
        assert apart_deg(start, true_poses(seed)).mean() == pytest.approx(2.0)
        assert apart_deg(end.poses, true_poses(seed)).mean() < left * 2.0
        variance = TRACK_COVARIANCE_SCALE * np.trace(end.covariance[:, 3:, 3:], axis1=1, axis2=2)
        claimed_deg = np.degrees(np.sqrt(variance))
        assert np.sqrt(np.mean((apart_deg(end.poses, true_poses(seed)) / claimed_deg) ** 2)) < 1.0
        assert claimed_deg.max() < 6.0  # and the claim says something: of a body without texture


def test_print_is_compared_on_the_surface_that_all_show_not_on_each_views_own_depth(printed):
    """Poses that drift by 8 degrees come back although each view's depth bends by 8 mm, and the shape is too small."""
    random, config = np.random.default_rng(0), HypothesisConfig(depth_noise=DepthNoise(0.011, 1000.0))
    poses, drift = true_poses(1), random.normal(size=3)
    for i, pose in enumerate(poses):
        pose[:3, :3] = pose[:3, :3] @ rotation_exp(np.radians(8.0) * i / COUNT * drift / np.linalg.norm(drift))
    (end,) = adjusted([PosedToss(printed, poses)], ellipsoid(0.002), config, Silent())
    assert apart_deg(poses, true_poses(1)).mean() == pytest.approx(2.0)
    assert apart_deg(end.poses, true_poses(1)).mean() < 0.6


@pytest.mark.parametrize("its_own", [True, False], ids=["its points in others", "theirs in its image"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_print_tells_how_far_one_view_is_turned(printed, its_own, axis):
    """About the body's middle, which a turn leaves where it is; others are where they should be."""
    poses, turn = true_poses(1), np.zeros(3)
    turn[axis] = np.radians(1.5)
    drawn = DrawnViews([printed.store])
    poses[4, :3, :3] = poses[4, :3, :3] @ rotation_exp(turn)
    drawn.draw(0, FreeSurface(ellipsoid(), CAMERA), poses, np.ones(COUNT, dtype=bool))
    ends = [4] * 4, [2, 3, 5, 6]
    terms = AppearanceTerms(drawn, np.stack(ends if its_own else ends[::-1], -1), 0.3)
    H, g = np.zeros((1, 1, 6, 6)), np.zeros((1, 6))
    terms.add(H, g, poses, np.where(np.arange(COUNT) == 4, 0, -1))
    step = -np.linalg.solve(H[0, 0, 3:, 3:], g[0, 3:])
    np.testing.assert_allclose(step, turn, atol=np.radians(0.3))  # object_from_camera turns by as much


def test_what_a_view_shows_stays_on_the_surface_when_the_view_moves(printed):
    store, pose, surface = printed.store, true_poses(1)[4], FreeSurface(ellipsoid(), CAMERA)
    drawn = DrawnViews([store])
    drawn.draw(0, surface, true_poses(1), np.arange(COUNT) == 4)
    first, count = drawn.store.table[4, lay.FIRST], drawn.store.table[4, lay.COUNT]
    before = drawn.store.samples[first : first + count].copy()
    after = before.copy()
    now = pose @ se3.exponential(np.array([0.001, -0.001, 0.002, 0.02, 0.01, -0.01]))
    slide(pose, now, after)
    np.testing.assert_allclose(after[:, :2] / after[:, 2:3], before[:, :2] / before[:, 2:3], atol=1e-6)

    def beside_m(samples: np.ndarray, at: np.ndarray) -> np.ndarray:
        points = (samples[:, :3].astype(float) - at[:3, 3]) @ at[:3, :3]
        vertex = surface.nearest(points)[1]
        return np.abs(np.einsum("nj,nj->n", surface.normals[vertex], points - surface.vertices_m[vertex]))

    facing = np.einsum("nj,nj->n", before[:, :3], before[:, 3:6]) / np.linalg.norm(before[:, :3], axis=1) < -0.4
    drawn_m = beside_m(before[facing], pose).mean()  # drawn depth is smoothed over windows
    assert beside_m(before[facing], now).mean() > 3 * drawn_m
    assert beside_m(after[facing], now).mean() < 1.2 * drawn_m


def test_frames_without_a_pose_stay_so(tosses):
    poses = true_poses(1)
    poses[3] = np.nan
    found = adjusted([PosedToss(tosses[0], poses)], ellipsoid(), HypothesisConfig(depth_noise=NOISE), Silent())
    (one,) = found
    assert np.isnan(one.poses[3]).all()
    assert np.isnan(one.covariance[3]).all()
    assert np.isnan(one.cost[3])
    assert all(np.isfinite(np.delete(x, 3, axis=0)).all() for x in (one.poses, one.covariance, one.cost))


def test_distances_to_an_outline_are_half_a_pixel_on_either_side():
    mask = np.zeros((20, 20), dtype=bool)
    mask[5:15, 5:15] = True
    distance = signed_distance_px(mask)
    assert distance[10, 4] == pytest.approx(0.5)
    assert distance[10, 5] == pytest.approx(-0.5)
    assert distance[10, 2] == pytest.approx(2.5, abs=0.1)


def test_an_outline_beside_what_hides_the_body_says_nothing():
    mask, covered = np.zeros((40, 40), dtype=bool), np.zeros((40, 40), dtype=bool)
    mask[5:20, 10:30], covered[20:30, 10:30] = True, True
    empty = np.zeros(mask.shape, np.float32)
    crop = Crop(0, (100, 100), mask, empty, np.zeros((*mask.shape, 3), np.float32), covered, None, 0.0)
    silent = not_its_own(crop, CAMERA)
    assert silent[19, 20]
    assert not silent[5, 20]
    assert not_its_own(replace(crop, corner=(100, -4)), CAMERA)[5, 20]
