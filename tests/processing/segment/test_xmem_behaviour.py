"""What every segmenter promises, asked of each. XMem has random weights here: where its masks lie means nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch

from processing.segment.background.segmenter import BackgroundSegmenter, BackgroundSettings
from processing.segment.background.static_scene import SceneSettings, learn_scene
from processing.segment.segmenter import Example, FrameMask, Segmenter
from processing.segment.xmem.memory import MemorySettings
from processing.segment.xmem.network import Widths, XMemNetwork
from processing.segment.xmem.segmenter import XMemSegmenter, XMemSettings
from recordings.errors import BadInput
from recordings.progress import Silent
from recordings.records import RgbdFrame

COUNT = 8


@dataclass
class Counting:
    """A progress that remembers how far it was told."""

    steps: int = 0

    def step(self, done: int, total: int, note: str = "") -> None:
        assert 0 <= done <= total
        self.steps += 1


@pytest.fixture(scope="module")
def toss(tiny_world: Any) -> tuple[list[RgbdFrame], list[np.ndarray]]:
    seen = [tiny_world.see(pose, i) for i, pose in enumerate(tiny_world.poses(COUNT))]
    return [f for f, _ in seen], [m for _, m in seen]


@pytest.fixture(scope="module")
def background(tiny_world: Any, toss: Any) -> Segmenter:
    return BackgroundSegmenter(learn_scene(toss[0], None, SceneSettings()), tiny_world.camera, BackgroundSettings())


@pytest.fixture(scope="module")
def xmem(background: Segmenter) -> Segmenter:
    torch.manual_seed(0)
    network = XMemNetwork(Widths(base=8, key=8, value=16, hidden=8, deep=32, shallow=16))
    settings = XMemSettings(48, MemorySettings(every=2, working_most=3, working_least=2, prototypes=6, long_most=10))
    return XMemSegmenter(network, settings, finder=background)


@pytest.fixture(params=["background", "xmem"])
def segmenter(request: pytest.FixtureRequest) -> Segmenter:
    found: Segmenter = request.getfixturevalue(request.param)
    assert found.name == request.param
    return found


def found(
    segmenter: Segmenter,
    frames: Sequence[RgbdFrame],
    given: Mapping[int, np.ndarray],
    example: Example | None = None,
    robot: Sequence[np.ndarray] | None = None,
) -> list[FrameMask]:
    return sorted(segmenter.masks(frames, given, example, robot, Silent()), key=lambda m: m.position)


@pytest.mark.parametrize("given", [[0], [3], [2, 6], [COUNT - 1], []])
def test_every_frame_has_one_mask_of_its_size_and_a_confidence(
    segmenter: Segmenter, toss: Any, given: list[int]
) -> None:
    frames, truth = toss
    masks = found(segmenter, frames, {i: truth[i] for i in given})
    assert [m.position for m in masks] == list(range(COUNT))
    assert all(m.mask.shape == truth[0].shape and m.mask.dtype == bool for m in masks)
    assert all(0 <= m.confidence <= 1 for m in masks)
    assert all(m.mask.any() == (m.confidence > 0) for m in masks)


def test_given_masks_are_taken_as_they_are(segmenter: Segmenter, toss: Any) -> None:
    frames, truth = toss
    masks = found(segmenter, frames, {2: truth[2], 5: truth[5]})
    for i in (2, 5):
        np.testing.assert_array_equal(masks[i].mask, truth[i])
        assert masks[i].confidence == 1


def test_without_a_mask_the_object_is_found_in_some_frame(segmenter: Segmenter, toss: Any) -> None:
    frames, truth = toss
    overlap = [(m.mask & t).sum() / (m.mask | t).sum() for m, t in zip(found(segmenter, frames, {}), truth)]
    assert max(overlap) > 0.9


def test_an_example_of_another_toss_stands_in_for_a_mask(segmenter: Segmenter, toss: Any) -> None:
    frames, truth = toss
    assert len(found(segmenter, frames, {}, example=Example(frames[3], truth[3]))) == COUNT


def test_robot_pixels_never_belong_to_the_object(segmenter: Segmenter, toss: Any) -> None:
    frames, truth = toss
    robot = [np.roll(t, 6, axis=1) for t in truth]
    masks = found(segmenter, frames, {0: truth[0] & ~robot[0]}, robot=robot)
    assert not any((m.mask & r).any() for m, r in zip(masks, robot))


def test_the_same_frames_give_the_same_masks(segmenter: Segmenter, toss: Any) -> None:
    frames, truth = toss
    one, two = (found(segmenter, frames, {0: truth[0]}) for _ in range(2))
    assert all((a.mask == b.mask).all() and a.confidence == b.confidence for a, b in zip(one, two))


def test_one_frame_is_a_toss_too(segmenter: Segmenter, toss: Any) -> None:
    frames, truth = toss
    masks = found(segmenter, frames[:1], {0: truth[0]})
    assert len(masks) == 1
    np.testing.assert_array_equal(masks[0].mask, truth[0])


def test_progress_is_told(segmenter: Segmenter, toss: Any) -> None:
    frames, truth = toss
    told = Counting()
    list(segmenter.masks(frames, {0: truth[0]}, None, None, told))
    assert told.steps >= COUNT - 1


def test_an_empty_mask_and_one_of_another_size_are_refused(segmenter: Segmenter, toss: Any) -> None:
    frames, truth = toss
    with pytest.raises(BadInput, match="frame 0 is empty"):
        found(segmenter, frames, {0: np.zeros_like(truth[0])})
    with pytest.raises(BadInput, match=r"is \(80, 60\), the image \(160, 120\)"):
        found(segmenter, frames, {0: truth[0][::2, ::2]})


def test_xmem_alone_wants_a_mask(xmem: Segmenter, toss: Any) -> None:
    assert isinstance(xmem, XMemSegmenter)
    alone = XMemSegmenter(xmem._network, xmem._settings)
    with pytest.raises(BadInput, match="xmem follows a mask, and none was given.*--segmenter background"):
        found(alone, toss[0], {})
