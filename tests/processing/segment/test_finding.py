"""The object found without a mask: by its free fall, by what is alike in all tosses, and said where it is nowhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from processing.cli import main
from processing.config import Config
from processing.pipeline.start import start_run
from processing.segment.background.follow import BackgroundSettings
from processing.segment.background.segmenter import BackgroundSegmenter
from processing.segment.background.static_scene import SceneSettings, StaticScene, learn_scene
from processing.segment.detect.candidates import Candidate, CandidateSettings, Finder
from processing.segment.detect.detection import (
    FindSettings,
    detections,
    positions,
    read_detection,
    tracklets_of,
    write_detections,
)
from processing.segment.detect.tracklets import Appearance, TrackletSettings, choose, free_fall, join
from processing.stages.lose import without_lost
from processing.stages.masks.segment import SegmentResult
from processing.store import Done
from recordings.errors import BadInput
from recordings.progress import Silent
from recordings.records import RgbdFrame
from recordings.results.folder import Results
from recordings.session import Session

DOWN = np.array([0.0, 0.6, 0.8])
RED, GREEN = np.eye(4096)[3840], np.eye(4096)[240]
NOISE_M = 0.003


def thing(
    position: int, center_m: np.ndarray, shares: np.ndarray = RED, size_m: float = 0.08, free: float = 1.0
) -> Candidate:
    return Candidate(position, position / 30, (5, 5), np.ones((9, 9), bool), center_m, size_m, free, shares)


def thrown(at_m: Sequence[float], frames: int = 14, pull: float = 9.81, **appearance: Any) -> list[Candidate]:
    """A thing on a parabola, seen with some noise."""
    rng, t = np.random.default_rng(0), np.arange(frames) / 30
    way = np.array(at_m) + t[:, None] * [0.7, -0.3, 0.1] + 0.5 * pull * t[:, None] ** 2 * DOWN
    return [thing(i, p + rng.normal(0, NOISE_M, 3), **appearance) for i, p in enumerate(way)]


def lying(at_m: Sequence[float], frames: int = 14, **appearance: Any) -> list[Candidate]:
    return [thing(i, np.array(at_m, dtype=float), **appearance) for i in range(frames)]


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max(1, (a | b).sum()))


@pytest.mark.parametrize("gravity", [DOWN, None])
def test_a_free_fall_is_recognised_with_and_without_knowing_where_down_is(gravity: np.ndarray | None) -> None:
    settings = TrackletSettings()
    assert free_fall(thrown([0, 0, 1]), gravity, settings)[0] > 0.8
    assert free_fall(lying([0, 0, 1]), gravity, settings)[0] == 0
    assert free_fall(thrown([0, 0, 1], pull=1.0), gravity, settings)[0] < 0.05


def test_a_fall_in_another_direction_is_none_where_down_is_known() -> None:
    assert free_fall(thrown([0, 0, 1]), -DOWN, TrackletSettings())[0] < 0.01


def test_things_keep_their_tracklets_where_they_pass_each_other() -> None:
    red, green = thrown([0, 0, 1]), thrown([0.35, 0, 1], shares=GREEN)
    green = [replace(g, center_m=g.center_m * [-1, 1, 1] + [0.35, 0, 0]) for g in green]
    tracklets = join([list(pair) for pair in zip(red, green)], DOWN, TrackletSettings())
    assert len(tracklets) == 2
    assert all(len({int(c.shares.argmax()) for c in tracklet.seen}) == 1 for tracklet in tracklets)


def test_what_appears_alike_in_all_tosses_is_the_object_though_something_else_flies_in_one() -> None:
    settings = TrackletSettings()

    def tracklets(*things: list[Candidate]) -> Any:
        return join([list(seen) for seen in zip(*things)], DOWN, settings)

    tosses = {
        0: tracklets(thrown([0, 0, 1])),
        1: tracklets(thrown([0, 0, 1]), thrown([0.6, 0, 1.2], shares=GREEN, size_m=0.2)),
        2: tracklets(thrown([0, 0, 1])),
    }
    for known in (None, Appearance(RED, 0.08)):
        found = choose(tosses, known, settings)
        assert sorted(found) == [0, 1, 2]
        assert all(tracklet.shares.argmax() == RED.argmax() for tracklet, _ in found.values())


def test_a_hand_at_the_images_border_is_not_taken_for_the_object() -> None:
    hand = [replace(c, free=0.0) for c in thrown([0.5, 0, 1], shares=GREEN, size_m=0.1, pull=3.0)]
    tracklets = join([list(pair) for pair in zip(hand, thrown([0, 0, 1]))], DOWN, TrackletSettings())
    (tracklet, _), *_ = choose({0: tracklets}, None, TrackletSettings()).values()
    assert tracklet.shares.argmax() == RED.argmax()


def test_between_two_things_that_merely_move_nobody_chooses() -> None:
    settings = TrackletSettings()

    def pushed(x_m: float, shares: np.ndarray) -> list[Candidate]:
        return [thing(i, np.array([x_m + 0.02 * i, 0, 1]), shares) for i in range(14)]

    one, two = pushed(-0.5, RED), pushed(0.5, GREEN)
    assert choose({0: join([[a] for a in one], DOWN, settings)}, None, settings)
    both = {0: join([list(pair) for pair in zip(one, two)], DOWN, settings)}
    assert choose(both, None, settings) == {}
    (tracklet, _), *_ = choose(both, Appearance(GREEN, 0.08), settings).values()
    assert tracklet.shares.argmax() == GREEN.argmax()


def test_the_clearest_frame_is_where_the_object_stands_free_and_whole(
    tiny_world: Any, scene: StaticScene, toss: Any
) -> None:
    frames, truth = toss
    settings = FindSettings(things=CandidateSettings(widest_px=160))
    finder = Finder(scene, tiny_world.camera, settings.things)
    tracklets = tracklets_of(finder, frames, None, None, settings)
    detection = detections({0: tracklets}, None, finder.full_size, finder.stride, settings)[0]
    assert iou(detection.masks[detection.start], truth[detection.start]) > 0.85


def test_detections_come_back_from_their_folder(tiny_world: Any, scene: StaticScene, toss: Any, tmp_path: Path) -> None:
    settings = FindSettings()
    finder = Finder(scene, tiny_world.camera, settings.things)
    found = detections({3: tracklets_of(finder, toss[0], None, None, settings)}, None, (120, 160), 1, settings)
    write_detections(tmp_path, found)
    again = read_detection(tmp_path, 3)
    assert again is not None
    assert (again.start, again.spans) == (found[3].start, found[3].spans)
    np.testing.assert_array_equal(again.masks[again.start], found[3].masks[again.start])
    assert read_detection(tmp_path, 4) is None


def test_frames_are_searched_evenly_with_the_first_and_the_last(toss: Any) -> None:
    assert positions(toss[0], 0.06) == [0, 2, 4, 6, 8, 10, 11]
    assert positions(toss[0], 0.001) == list(range(12))
    assert positions(toss[0][:1], 0.06) == [0]


def test_an_object_that_was_hidden_is_found_on_either_side(tiny_world: Any) -> None:
    poses = tiny_world.poses(16)
    shown = [poses[0]] * 7 + [None] * 4 + poses[:15]
    seen = [tiny_world.see(pose, i) for i, pose in enumerate(shown)]
    frames = [f for f, _ in seen]
    scene = learn_scene([*frames, *(tiny_world.see(None, i)[0] for i in range(30, 60))], None, SceneSettings())
    segmenter = BackgroundSegmenter(scene, tiny_world.camera, BackgroundSettings())
    found = sorted(segmenter.masks(frames, {}, None, None, Silent()), key=lambda m: m.position)
    assert not any(m.mask.any() for m in found[7:11])
    assert min(iou(m.mask, t) for m, (_, t) in zip(found, seen) if t.any()) > 0.85


def test_frames_that_no_motion_connects_with_the_toss_are_left_out(tiny_world: Any) -> None:
    """As where a recording begins with the last toss's rest: the object lies there, then it is in the hand again."""
    poses = tiny_world.poses(16)
    shown = [poses[15]] * 7 + [None, *poses[:15]]
    seen = [tiny_world.see(pose, i) for i, pose in enumerate(shown)]
    frames = [f for f, _ in seen]
    scene = learn_scene([*frames, *(tiny_world.see(None, i)[0] for i in range(30, 60))], None, SceneSettings())
    segmenter = BackgroundSegmenter(scene, tiny_world.camera, BackgroundSettings())
    found = sorted(segmenter.masks(frames, {}, None, None, Silent()), key=lambda m: m.position)
    assert not any(m.mask.any() for m in found[:8])
    assert min(iou(m.mask, t) for m, (_, t) in zip(found[8:], seen[8:])) > 0.85


@pytest.mark.parametrize("count", [1, 6])
def test_identical_frames_and_a_single_one_show_no_object_and_the_error_says_what_to_type(
    tiny_world: Any, toss: Any, count: int
) -> None:
    frames: list[RgbdFrame] = [replace(toss[0][4], index=i, time_ns=i * 33_333_333) for i in range(count)]
    segmenter = BackgroundSegmenter(learn_scene(frames, None, SceneSettings()), tiny_world.camera, BackgroundSettings())
    with pytest.raises(BadInput, match="no mask of the object was given.*mask_first.png.*--masks first-toss"):
        list(segmenter.masks(frames, {}, None, None, Silent()))


def test_a_toss_without_the_object_is_lost_and_said_and_the_others_go_on(
    record_tiny: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = record_tiny(tosses=(0, 1), frames=12, first_mask=False, gone=lambda toss, frame: toss == 1)
    out = tmp_path / "out"
    assert main([str(session), "--variant", "bundlesdf-1", "--tracker", "frame-to-model", "--out", str(out)]) == 0
    assert "toss 1: the object was not found" in capsys.readouterr().out
    tracks = Results.open(out).tracks()
    assert tracks[1].lost.all()
    assert not tracks[0].lost.all()


def test_a_toss_whose_masks_hold_no_depth_is_lost_and_one_clear_error_where_all_are(
    record_tiny: Callable[..., Path], tmp_path: Path
) -> None:
    def done(**found: bool) -> Done[SegmentResult]:
        return Done(Path("segment-0"), "key", SegmentResult(2, 0, **found), reused=False)

    with Session.open(record_tiny(tosses=(0, 1, 2), frames=2)) as session:
        run = start_run(session, session.tosses, tmp_path / "out", Config(), "multi-hypothesis", lambda name: Silent())
    masks = {0: done(with_depth=True), 1: done(), 2: done(not_found=True)}
    kept = without_lost(run, masks)
    assert (kept.tosses, kept.lost, kept.recorded) == ((0,), (1, 2), (0, 1, 2))
    assert "toss 1: the object's masks hold no depth: lost" in kept.warnings[0].text
    with pytest.raises(BadInput, match="no toss can be tracked.*toss 1: .*no depth"):
        without_lost(replace(run, tosses=(1, 2)), masks)


def test_an_object_in_none_of_the_tosses_is_one_clear_error(
    record_tiny: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = record_tiny(tosses=(0, 1), first_mask=False, gone=lambda toss, frame: True)
    assert main([str(session), "--out", str(tmp_path / "out")]) == 2
    assert "no mask of the object was given" in capsys.readouterr().err
