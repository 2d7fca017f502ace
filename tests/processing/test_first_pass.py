"""Tosses that are turned against each other show no one shape, and are told from those that do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from processing.config import Config
from processing.images import Images, TossImages
from processing.pipeline import first_pass
from processing.pipeline.first_pass import _left, kept_apart
from processing.pipeline.notices import of_shapes
from processing.pipeline.start import start_run
from processing.run import Run
from processing.stages.field import FieldResult
from processing.stages.fuse import fuse_frames
from processing.stages.register import RegisterResult
from processing.stages.track import TrackResult
from processing.store import Done
from recordings.geometry import rotation_exp
from recordings.progress import Silent
from recordings.results.folder import read_masks, read_shape, read_track, write_masks, write_track
from recordings.session import RgbdFrames, Session
from recordings.tracks import ObjectTrack


def stages(
    tiny_world: Any, run: Run, folder: Path, turned: int | None, narrower_px: int = 0, unsure: tuple[int, ...] = ()
) -> tuple[Done, dict[int, Images]]:
    """True poses as the stage of all tosses, one of them turned about the object's centre, some not sure of any frame,
    and true masks (or narrower ones)."""
    tracks, images = folder / "register-0", {}
    tracks.mkdir(parents=True)
    for toss in run.tosses:
        frames = run.session.toss(toss).rgbd()
        times_ns = frames.times_ns
        poses = [(tiny_world.world_from_camera.inverse() @ p).matrix for p in tiny_world.poses(len(times_ns), toss)]
        turn = np.eye(4)
        if toss == turned:
            turn[:3, :3] = rotation_exp(np.array([0.0, np.pi / 2, 0.0]))
        n = len(times_ns)
        status: Any = ("interpolated" if toss in unsure else "tracked",) * n
        covariance = np.tile((9.0 if toss in unsure else 1e-6) * np.eye(6), (n, 1, 1))
        track = ObjectTrack(toss, "d455", "object", times_ns, np.stack(poses) @ turn, status, covariance)
        write_track(tracks, track)
        own = folder / f"segment-{toss}"
        own.mkdir()
        seen = [tiny_world.see(p, i)[1].astype(np.uint8) for i, p in enumerate(tiny_world.poses(n, toss))]
        kernel = np.ones((2 * narrower_px + 1, 2 * narrower_px + 1), np.uint8)
        write_masks(own, toss, [cv2.erode(mask, kernel) > 0 for mask in seen], np.ones(n))
        images[toss] = seen_as(toss, frames, own, f"masks {toss} {turned} {narrower_px}")
    return Done(tracks, f"tracks {turned}", None, False), images


def seen_as(toss: int, frames: RgbdFrames, masks: Path, key: str) -> Images:
    def opened() -> TossImages:
        seen = read_masks(masks, toss)
        return TossImages(frames, frames.depth_times_ns, seen, seen.confidence, None, None)

    return Images(toss, {"masks": key}, opened)


@pytest.mark.parametrize(("turned", "apart"), [(None, ()), (1, (1,))])
def test_a_toss_that_is_turned_against_the_others_is_kept_apart(
    tiny_world: Any, tmp_path: Path, turned: int | None, apart: tuple[int, ...]
) -> None:
    session = Session.open(tiny_world.record(tmp_path / "tiny", tosses=(0, 1, 2), frames=6))
    run = start_run(session, session.tosses, tmp_path / "out", Config(), "multi-hypothesis", lambda _: Silent())
    together, images = stages(tiny_world, run, tmp_path, turned)
    fused = fuse_frames(run, dict.fromkeys(session.tosses, together), images)
    assert kept_apart(run, together, fused, images, session.tosses) == apart


@pytest.mark.parametrize(("unsure", "apart"), [((1,), [()]), ((0,), [(1,), (2,)]), ((0, 2), [()])])
def test_a_toss_without_a_sure_frame_explains_nothing_alone_and_ends_no_run(
    tiny_world: Any, tmp_path: Path, unsure: tuple[int, ...], apart: list[tuple[int, ...]]
) -> None:
    """Of two that contradict each other either may stay."""
    session = Session.open(tiny_world.record(tmp_path / "tiny", tosses=(0, 1, 2), frames=6))
    run = start_run(session, session.tosses, tmp_path / "out", Config(), "multi-hypothesis", lambda _: Silent())
    turned = 1 if unsure == (1,) else 2
    together, images = stages(tiny_world, run, tmp_path, turned, unsure=unsure)
    fused = fuse_frames(run, dict.fromkeys(session.tosses, together), images)
    assert kept_apart(run, together, fused, images, session.tosses) in apart


def test_of_two_tosses_that_contradict_each_other_the_one_stays_that_its_own_frames_explain(
    tiny_world: Any, tmp_path: Path
) -> None:
    session = Session.open(tiny_world.record(tmp_path / "tiny", tosses=(0, 1), frames=6))
    run = start_run(session, session.tosses, tmp_path / "out", Config(), "multi-hypothesis", lambda _: Silent())
    together, images = stages(tiny_world, run, tmp_path, 1)
    slid = read_track(together.folder, 0)
    poses = slid.camera_from_object.copy()
    poses[3:, :3, :3] = poses[3:, :3, :3] @ rotation_exp(np.array([0.4, 0.0, 0.0]))
    write_track(together.folder, replace(slid, camera_from_object=poses))
    fused = fuse_frames(run, dict.fromkeys(session.tosses, together), images)
    assert kept_apart(run, together, fused, images, session.tosses) == (0,)


def test_where_no_frame_of_any_toss_is_sure_the_shape_is_a_guess_and_said_to_be(
    tiny_world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Session.open(tiny_world.record(tmp_path / "tiny", tosses=(0, 1), frames=4))
    run = start_run(session, session.tosses, tmp_path / "out", Config(), "multi-hypothesis", lambda _: Silent())
    together, images = stages(tiny_world, run, tmp_path, None, unsure=session.tosses)
    placed = replace(together, result=RegisterResult((), (), ()))
    monkeypatch.setattr(first_pass, "register", lambda *_: placed)
    alone = {t: replace(together, result=TrackResult(4, 4, 0)) for t in run.tosses}
    found = first_pass.first_pass(run, alone, images)
    assert found.shape.result.views == 8
    assert not found.shape.result.sure
    extent_m = np.ptp(read_shape(found.shape.folder).vertices_m, axis=0)
    np.testing.assert_allclose(extent_m, [0.10, 0.08, 0.06], atol=0.012)
    (notice,) = of_shapes(found.shapes)
    assert notice.weight == "high"
    assert notice.seen == "tosses [0, 1]: no frame has a pose that is sure: the shape is a guess, as they are"


def test_tosses_whose_masks_are_bad_alike_are_not_kept_apart(tiny_world: Any, tmp_path: Path) -> None:
    """No shape explains such masks well, that of all tosses no worse than that of each alone."""
    session = Session.open(tiny_world.record(tmp_path / "tiny", tosses=(0, 1), frames=6))
    run = start_run(session, session.tosses, tmp_path / "out", Config(), "multi-hypothesis", lambda _: Silent())
    together, images = stages(tiny_world, run, tmp_path, None, narrower_px=2)
    true_images = stages(tiny_world, run, tmp_path / "true", None)[1]
    fused = fuse_frames(run, dict.fromkeys((0, 1), together), true_images)
    left = _left(run, together, dict.fromkeys((0, 1), fused), images)
    assert max(left.values()) > run.config.cycle.apart_mask
    badly = fuse_frames(run, dict.fromkeys((0, 1), together), images)
    assert kept_apart(run, together, badly, images, [0, 1]) == ()


@pytest.mark.parametrize("found_again", [False, True])
def test_the_others_are_joined_anew_without_a_toss_that_is_kept_apart(
    tiny_world: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, found_again: bool
) -> None:
    """And it is one of them after all, where it is found on their shape."""
    session = Session.open(tiny_world.record(tmp_path / "tiny", tosses=(0, 1, 2), frames=2))
    run = start_run(session, session.tosses, tmp_path / "out", Config(), "multi-hypothesis", lambda _: Silent())
    alone = {t: Done(tmp_path, f"track {t}", TrackResult(2, 0, 0, unfit=int(t == 1)), False) for t in run.tosses}

    def register(_: Run, tracks: dict[int, Done], __: Any) -> Done[RegisterResult]:
        return Done(tmp_path, f"together {sorted(tracks)}", RegisterResult((), (), ()), False)

    def field(_: Run, name: str, tracks: dict[int, Done], __: Any) -> Done:
        return Done(tmp_path, f"{name} {sorted(tracks)}", FieldResult(2, 8, 0.0), False)

    def apart(_: Run, __: Done, ___: Done, ____: Any, joined: list[int]) -> tuple[int, ...]:
        return tuple(t for t in joined if t == 1)

    def fuse(_: Run, tracks: dict[int, Done], __: Any) -> Done:
        return Done(tmp_path, f"fused {sorted(tracks)}", None, False)

    def located(_: Run, __: Any, joined: dict[int, Done], missing: dict[int, Done]) -> dict[int, Done]:
        assert (sorted(joined), missing) == ([0, 2], {1: alone[1]})
        return {1: Done(tmp_path, "located", None, False)} if found_again else {}

    fakes = {"register": register, "learn_field": field, "kept_apart": apart, "fused": fuse, "located": located}
    for name, fake in fakes.items():
        monkeypatch.setattr(first_pass, name, fake)
    asked: list[list[int]] = []

    def cross_fitted(_: Run, __: Any, tracks: dict[int, Done], ___: Any) -> dict[int, Done]:
        asked.append(sorted(tracks))
        return tracks

    monkeypatch.setattr(first_pass, "cross_fitted", cross_fitted)
    monkeypatch.setattr(first_pass, "with_free_surface", lambda _, tracks, __: tracks)
    found = first_pass.first_pass(run, alone, {})
    others = {0: "together [0, 2]", 2: "together [0, 2]"}
    assert {t: d.key for t, d in found.tracks.items()} == (others | {1: "located"} if found_again else others)
    assert asked == [[0, 2], *([[0, 1, 2]] if found_again else [])]
    assert {d.key for d in found.shapes.values()} == {f"all tosses {sorted(found.tracks)}"}
    assert found.shared_frame == found_again
    assert any("kept apart" in w.text for w in found.warnings) != found_again
