"""Tracking with what is known beforehand: a shape, poses of some frames, a start, pixels without colour."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from processing.evaluate.metrics import frame_errors
from processing.features.sift import Sift
from processing.motion.motion_prior import gravity_in_camera
from processing.track.beam import Scene, seconds
from processing.track.known_shape import ShapeConfig, ShapeViews, center_of, path_through
from processing.track.registration.register import register_tosses
from processing.track.schedule import rows
from processing.track.track_toss import TossTrack, TrackConfig, track_toss, views_of
from processing.track.windows import pair_costs
from recordings.errors import BadInput
from recordings.geometry import Transform, rotation_exp
from recordings.progress import Silent
from recordings.records import RgbdFrame
from recordings.tracks import ObjectShape

COUNT = 8
CONFIG = TrackConfig(shape=ShapeConfig(directions=24, turns=240))
Toss = tuple[list[RgbdFrame], list[np.ndarray], np.ndarray]


def box_shape(size_m: np.ndarray, face_rgb: np.ndarray | None) -> ObjectShape:
    """The box, every triangle with corners of its own, so that faces keep their colours."""
    import open3d

    box = open3d.t.geometry.TriangleMesh.create_box(*size_m).translate(-size_m / 2)
    corners = box.vertex.positions.numpy()[box.triangle.indices.numpy()].reshape(-1, 3).astype(np.float64)
    rgb = None if face_rgb is None else np.repeat(face_rgb[np.arange(12) // 2], 3, axis=0).astype(np.uint8)
    return ObjectShape("learned", "test", corners, np.arange(36).reshape(12, 3), rgb)


@pytest.fixture(scope="module")
def shape() -> ObjectShape:
    faces = np.array([[200, 40, 40], [40, 200, 40], [40, 40, 200], [200, 200, 40], [200, 40, 200], [40, 200, 200]])
    return box_shape(np.array([0.10, 0.08, 0.06]), faces)


@pytest.fixture(scope="module")
def toss(tiny_world: Any) -> Toss:
    poses = tiny_world.poses(COUNT, 0)
    seen = [tiny_world.see(pose, i) for i, pose in enumerate(poses)]
    truth = np.stack([(tiny_world.world_from_camera.inverse() @ p).matrix for p in poses])
    return [f for f, _ in seen], [m for _, m in seen], truth


def followed(world: Any, seen: Any, **more: Any) -> TossTrack:
    return track_toss(seen[0], seen[1], world.camera, CONFIG, world_from_camera=world.world_from_camera, **more)


def worst(track: TossTrack, truth: np.ndarray) -> tuple[float, float]:
    """Largest errors (deg, m) without any alignment."""
    errors = frame_errors(track.track.camera_from_object, truth, np.eye(3) * 0.05)
    return errors.rotation_deg.max(), errors.translation_m.max()


def test_a_known_shape_is_found_from_scratch_and_tracked_in_its_own_frame(
    tiny_world: Any, toss: Toss, shape: Any
) -> None:
    found = followed(tiny_world, toss, model=shape)
    assert found.track.object_frame == "learned"
    assert found.track.status == ("tracked",) * COUNT
    degrees, metres = worst(found, toss[2])
    assert degrees < 2.5
    assert metres < 0.004
    assert found.pairs.max() < COUNT
    assert max(found.keyframes) < COUNT


def test_a_shape_without_colours_is_followed_by_its_form(tiny_world: Any, toss: Toss) -> None:
    found = followed(tiny_world, toss, model=box_shape(np.array([0.10, 0.08, 0.06]), None))
    twins = np.einsum("nji,njk->nik", toss[2][:, :3, :3], found.track.camera_from_object[:, :3, :3])
    np.testing.assert_allclose(np.abs(np.diag(twins[0])), 1, atol=0.005)  # one of four, each a half turn away
    np.testing.assert_allclose(twins, np.broadcast_to(twins[0], twins.shape), atol=0.08)  # and the same in all frames


def tumbling(world: Any) -> Toss:
    """The toss, but it turns by three quarters of a right angle from each frame to the next."""
    turn, seen, truth = np.eye(3), [], []
    step = rotation_exp(np.radians(67.5) * np.array([0.48, -0.6, 0.64]))
    for i, pose in enumerate(world.poses(COUNT, 0)):
        turn = step @ turn
        turned = Transform("world", "object", turn @ pose.matrix[:3, :3], pose.matrix[:3, 3] + [0, 0, 0.05])
        seen.append(world.see(turned, i))
        truth.append((world.world_from_camera.inverse() @ turned).matrix)
    return [f for f, _ in seen], [m for _, m in seen], np.stack(truth)


def scene_of(world: Any, toss: Toss, shape: ObjectShape) -> tuple[Scene, ShapeViews]:
    sure = np.ones(len(toss[0]))
    store, times_ns, drawn = views_of(
        toss[0], toss[1], world.camera, sure, CONFIG, world.world_from_camera, Silent(), model=shape
    )
    assert drawn is not None
    gravity = gravity_in_camera(world.world_from_camera.matrix)
    return Scene(store, seconds(times_ns), gravity, center_of(shape), Sift()), drawn


def path_of(world: Any, toss: Toss, shape: ObjectShape) -> np.ndarray:
    """Poses before any refinement."""
    scene, drawn = scene_of(world, toss, shape)
    return path_through(scene, drawn, CONFIG.beam, CONFIG.windows, CONFIG.shape)


def test_a_turn_after_which_nothing_can_be_compared_is_not_free(tiny_world: Any, toss: Toss, shape: Any) -> None:
    scene, _ = scene_of(tiny_world, toss, shape)
    one, two = toss[2][:2]
    behind = one.copy()
    behind[:3, :3] = rotation_exp(np.array([0, np.pi, 0])) @ one[:3, :3]  # about an axis across the line of sight
    motions = [pose @ np.linalg.inv(one) for pose in (two, behind)]
    row = rows(CONFIG.windows.compared, 0.6)[0]
    price = pair_costs(scene, 0, 1, motions, row, CONFIG.shape.unseen) - pair_costs(scene, 0, 1, motions, row)
    assert price[0] < 0.2 * CONFIG.shape.unseen  # nearly all points of one view are seen in the other
    assert price[1] == pytest.approx(CONFIG.shape.unseen)  # and none once it has turned its back


def test_on_a_shape_no_frame_rests_on_the_one_before(tiny_world: Any, shape: Any) -> None:
    toss = tumbling(tiny_world)
    errors = frame_errors(path_of(tiny_world, toss, shape), toss[2], np.eye(3) * 0.05)
    assert errors.rotation_deg.max() < 5.0
    assert errors.translation_m.max() < 0.006


def test_a_path_passes_by_frames_that_do_not_show_the_shape(tiny_world: Any, toss: Toss, shape: Any) -> None:
    empty = [np.zeros_like(m) if i == 3 else m for i, m in enumerate(toss[1])]
    path = path_of(tiny_world, (toss[0], empty, toss[2]), shape)
    assert np.flatnonzero(~np.isfinite(path[:, 0, 0])).tolist() == [3]
    nowhere = path_of(tiny_world, toss, box_shape(np.array([0.6, 0.5, 0.02]), None))
    assert not np.isfinite(nowhere).any()


def test_given_poses_are_refined_and_unknown_frames_are_found(tiny_world: Any, toss: Toss) -> None:
    rng = np.random.default_rng(0)
    poses = toss[2].copy()
    poses[1:, :3, 3] += 0.003 * rng.normal(size=(COUNT - 1, 3))
    poses[4] = np.nan
    found = followed(tiny_world, toss, poses=poses)
    assert found.track.status == ("tracked",) * COUNT
    np.testing.assert_allclose(found.track.camera_from_object[0], toss[2][0], atol=1e-12)
    degrees, metres = worst(found, toss[2])
    assert degrees < 2.0
    assert metres < 0.003


def test_tracking_goes_both_ways_from_a_given_frame(tiny_world: Any, toss: Toss) -> None:
    start = Transform.from_matrix("d455", "object", toss[2][4])
    found = followed(tiny_world, toss, start=start, start_frame=4)
    np.testing.assert_allclose(found.track.camera_from_object[4], toss[2][4], atol=1e-12)
    assert found.track.status == ("tracked",) * COUNT
    degrees, metres = worst(found, toss[2])
    assert degrees < 2.0
    assert metres < 0.004


@pytest.mark.slow
def test_the_colour_of_an_occluder_does_not_count_where_it_is_said_to_be_foreign(tiny_world: Any, toss: Toss) -> None:
    """A bar that moves with the camera, painted over the object; the depth is the object's own."""
    painted, foreign = [], []
    for i, (frame, mask) in enumerate(zip(toss[0], toss[1])):
        columns = np.zeros_like(mask)
        middle = int(np.nonzero(mask)[1].mean()) + (i % 3) * 4 - 4
        columns[:, middle - 3 : middle + 4] = True
        color = frame.color_rgb.copy()
        color[columns & mask] = (250, 250, 250)
        painted.append(replace(frame, color_rgb=color))
        foreign.append(columns & mask)
    start = Transform.from_matrix("d455", "object", toss[2][0])
    said = followed(tiny_world, (painted, toss[1]), start=start, colorless=foreign)
    silent = followed(tiny_world, (painted, toss[1]), start=start)
    assert worst(said, toss[2])[0] < 2.0
    assert np.nanmean(said.cost) < 0.7 * np.nanmean(silent.cost)


def test_what_does_not_fit_together_is_refused_in_words(tiny_world: Any, toss: Toss, shape: Any) -> None:
    start = Transform.from_matrix("d455", "object", toss[2][0])
    with pytest.raises(BadInput, match="both a start and poses"):
        followed(tiny_world, toss, start=start, poses=toss[2])
    with pytest.raises(BadInput, match=r"wanted \(8, 4, 4\)"):
        followed(tiny_world, toss, poses=toss[2][:3])
    with pytest.raises(BadInput, match="start_frame 9 of 8"):
        followed(tiny_world, toss, start=start, start_frame=9)
    with pytest.raises(BadInput, match="none of the 8 usable frames"):
        followed(tiny_world, toss, poses=np.full((COUNT, 4, 4), np.nan))
    with pytest.raises(BadInput, match="8 frames and 2 masks of colourless"):
        followed(tiny_world, toss, colorless=toss[1][:2])
    with pytest.raises(BadInput, match="no faces"):
        followed(tiny_world, toss, model=replace(shape, faces=np.zeros((0, 3), dtype=np.int64)))
    hidden = [np.zeros_like(toss[1][0]), *toss[1][1:]]
    with pytest.raises(BadInput, match="does not show the object"):
        followed(tiny_world, (toss[0], hidden), start=start, start_frame=0)


@pytest.mark.slow
def test_a_toss_is_placed_in_the_frame_of_a_known_shape(tiny_world: Any, toss: Toss, shape: Any) -> None:
    alone = followed(tiny_world, toss)
    placed = register_tosses([alone], model=shape)
    assert placed.joined == (True,)
    assert placed.ambiguous == (False,)
    assert len(placed.tracks) == 1
    errors = frame_errors(placed.tracks[0].camera_from_object, toss[2], np.eye(3) * 0.05)
    assert errors.rotation_deg.max() < 3.0
    assert errors.translation_m.max() < 0.005


@pytest.mark.slow
def test_a_toss_of_an_object_with_twins_is_said_to_be_ambiguous(tiny_world: Any, toss: Toss) -> None:
    """A box without colours fits onto itself in four ways: one of them is taken, and nobody is told that it is sure."""
    grey = [replace(f, color_rgb=np.full_like(f.color_rgb, 128)) for f in toss[0][:5]]
    alone = followed(tiny_world, (grey, toss[1][:5]))
    placed = register_tosses([alone], model=box_shape(np.array([0.10, 0.08, 0.06]), None))
    assert placed.ambiguous == (True,)
    assert placed.gap[0] < 0.02
