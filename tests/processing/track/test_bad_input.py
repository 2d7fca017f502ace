"""What tracking does with frames that show too little, the same twice, or more than one rigid body."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from processing.evaluate.metrics import align_first, frame_errors
from processing.track.flags import FlagConfig, uncertainty, unfit
from processing.track.track_toss import TossTrack, track_toss
from recordings.errors import BadInput
from recordings.geometry import Transform, rotation_exp
from recordings.records import RgbdFrame

COUNT = 12
Toss = tuple[list[RgbdFrame], list[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def toss(tiny_world: Any) -> Toss:
    poses = tiny_world.poses(COUNT, 0)
    seen = [tiny_world.see(pose, i) for i, pose in enumerate(poses)]
    truth = np.stack([(tiny_world.world_from_camera.inverse() @ p).matrix for p in poses])
    return [f for f, _ in seen], [m for _, m in seen], truth


def followed(world: Any, frames: list[RgbdFrame], masks: list[np.ndarray]) -> TossTrack:
    return track_toss(frames, masks, world.camera, world_from_camera=world.world_from_camera)


def errors_deg(found: TossTrack, truth: np.ndarray) -> np.ndarray:
    estimate = found.track.camera_from_object
    return frame_errors(estimate @ align_first(estimate, truth), truth, np.eye(3) * 0.05).rotation_deg


def without_depth(frame: RgbdFrame) -> RgbdFrame:
    return replace(frame, depth_m=np.zeros_like(frame.depth_m))


def test_an_object_that_leaves_the_view_is_found_again(tiny_world: Any, toss: Toss) -> None:
    masks = [np.zeros_like(m) if 3 <= i <= 9 else m for i, m in enumerate(toss[1])]
    found = followed(tiny_world, toss[0], masks)
    assert found.track.status == ("tracked",) * 3 + ("lost",) * 7 + ("tracked",) * 2
    assert np.isnan(found.track.camera_from_object[3:10]).all()
    assert errors_deg(found, toss[2])[[1, 2, 10, 11]].max() < 3.0


@pytest.mark.parametrize("gone", ["no return", "beyond range"])
def test_frames_without_depth_on_the_object_carry_no_silent_pose(tiny_world: Any, toss: Toss, gone: str) -> None:
    """A sensor gives no depth beyond its range: that is zero, as for a surface that it cannot see."""
    frames = list(toss[0])
    for i in (4, 5):
        mask = toss[1][i] if gone == "no return" else np.ones_like(toss[1][i])
        frames[i] = replace(frames[i], depth_m=np.where(mask, np.float32(0), frames[i].depth_m))
    found = followed(tiny_world, frames, toss[1])
    assert found.track.status[4:6] == ("interpolated",) * 2
    assert (found.track.covariance[4, :3, :3].trace()) > 10 * found.track.covariance[7, :3, :3].trace()


def test_a_toss_without_any_depth_is_refused_in_words(tiny_world: Any, toss: Toss) -> None:
    with pytest.raises(BadInput, match="no frame shows the object"):
        followed(tiny_world, [without_depth(f) for f in toss[0]], toss[1])


def test_blurred_pictures_are_followed_by_their_depth(tiny_world: Any, toss: Toss) -> None:
    frames = [replace(f, color_rgb=cv2.GaussianBlur(f.color_rgb, (0, 0), 3.0)) for f in toss[0]]
    found = followed(tiny_world, frames, toss[1])
    assert found.track.status == ("tracked",) * COUNT
    assert errors_deg(found, toss[2]).max() < 5.0


def test_identical_frames_stand_still(tiny_world: Any, toss: Toss) -> None:
    frames = [
        replace(toss[0][0], index=i, time_ns=f.time_ns, depth_time_ns=f.time_ns) for i, f in enumerate(toss[0][:6])
    ]
    poses = followed(tiny_world, frames, [toss[1][0]] * 6).track.camera_from_object
    np.testing.assert_allclose(poses, np.broadcast_to(poses[0], poses.shape), atol=1e-4)


def test_two_objects_under_one_mask_are_not_taken_for_one_rigid_body(tiny_world: Any, toss: Toss) -> None:
    """A second box that goes its own way, in the same mask: the residuals say so."""
    frames, masks = [], []
    count = 5
    for i, (frame, mask) in enumerate(zip(toss[0][:count], toss[1])):
        turn = rotation_exp(np.array([0.2 - 0.15 * i, 0.1 * i, 0.0]))
        place = np.array([0.16 - 0.03 * i, -0.12 + 0.02 * i, 0.1 + 0.01 * i])
        other, other_mask = tiny_world.see(Transform("world", "object", turn, place), i)
        nearer = other_mask & (~mask | (other.depth_m < frame.depth_m))
        depth_m = np.where(nearer, other.depth_m, frame.depth_m)
        color = np.where(nearer[..., None], other.color_rgb, frame.color_rgb)
        frames.append(replace(frame, depth_m=depth_m, color_rgb=color))
        masks.append(mask | other_mask)
    one, two = followed(tiny_world, toss[0][:count], toss[1][:count]), followed(tiny_world, frames, masks)
    assert unfit(one.store, one.cost, FlagConfig()) == 0
    assert unfit(two.store, two.cost, FlagConfig()) > 0.5 * count


def test_another_hypothesis_of_the_same_frames_adds_uncertainty() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    rival = poses.copy()
    rival[1, :3, :3] = rotation_exp(np.array([0.0, 0.0, 0.4]))
    rival[2] = np.nan
    added = uncertainty(poses, rival, 0.0, FlagConfig())
    assert added[1, 5, 5] == pytest.approx(0.16)
    assert np.count_nonzero(added) == 1
    assert uncertainty(poses, rival, 10 * FlagConfig().rival_cost, FlagConfig())[1, 5, 5] < 0.002
