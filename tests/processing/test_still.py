"""Cost grows with motion, not with waiting: still stretches are found from the images, and every frame keeps a pose."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from processing.config import Config
from processing.field.learn import LearnConfig
from processing.field.train import FieldConfig
from processing.pipeline.process import process
from processing.pipeline.start import start_run
from processing.sensor.still import StillSettings, kept_of, still_stretches
from processing.variants import rows_of
from recordings.progress import Silent
from recordings.records import RgbdFrame
from recordings.results.folder import Results
from recordings.session import Session

SETTINGS = StillSettings()
WAITING = 300


def noisy(frame: RgbdFrame, index: int, seed: int, light: float = 1.0, grey: float = 3.0) -> RgbdFrame:
    """The frame seen again: noise of some grey levels and 0.4 % of depth, holes, and another light."""
    rng = np.random.default_rng(seed)
    color = frame.color_rgb * light + rng.normal(0, grey, frame.color_rgb.shape)
    depth = frame.depth_m * (1 + rng.normal(0, 0.004, frame.depth_m.shape))
    depth[rng.random(depth.shape) < 0.03] = 0
    return replace(frame, index=index, color_rgb=np.clip(color, 0, 255).astype(np.uint8),
                   depth_m=depth.astype(np.float32))  # fmt: skip


def repeated(frames: Sequence[RgbdFrame], position: int, times: int, grey: float = 3.0) -> list[RgbdFrame]:
    """The frames with one of them shown `times` times more, each time with other noise in a light that drifts and
    flickers by 8 %."""
    waiting = [(frames[position], 1 + 0.08 * np.sin(0.3 * i)) for i in range(times)]
    every = [*((f, 1.0) for f in frames[: position + 1]), *waiting, *((f, 1.0) for f in frames[position + 1 :])]
    return [noisy(f, i, i, light, grey) for i, (f, light) in enumerate(every)]


def found(frames: Sequence[RgbdFrame]) -> list[tuple[int, int]]:
    return still_stretches(frames, SETTINGS, Silent())


def test_a_frame_shown_again_and_again_is_one_still_stretch_whatever_noise_and_light_do(toss: Any) -> None:
    frames, _ = toss
    for position in (0, 6, 11):
        [(first, last)] = found(repeated(frames, position, WAITING))
        assert position - 1 <= first <= position + 1  # the toss ends with two frames at rest
        assert position + WAITING - 1 <= last <= position + WAITING + 1


def test_what_moves_is_never_still_and_what_creeps_neither(tiny_world: Any) -> None:
    assert found([noisy(tiny_world.see(p, i)[0], i, i) for i, p in enumerate(tiny_world.poses(60))]) == []
    start = tiny_world.poses(60)[30]
    step_m = np.array([0.0003, 0.0, 0.0])  # a thirteenth of a pixel a frame
    crept = [replace(start, translation_m=start.translation_m + i * step_m) for i in range(100)]
    assert found([noisy(tiny_world.see(p, i)[0], i, i) for i, p in enumerate(crept)]) == []


def test_a_camera_that_moves_over_a_textured_scene_is_not_still() -> None:
    rng = np.random.default_rng(0)
    wide = np.repeat(np.repeat(rng.integers(40, 200, (30, 120, 3)), 4, 0), 4, 1).astype(np.uint8)
    depth = np.full((120, 160), 0.7, dtype=np.float32)
    assert found([RgbdFrame("d455", i, i, i, wide[:, 2 * i : 2 * i + 160], depth) for i in range(100)]) == []


def test_what_only_depth_sees_moving_is_not_still(toss: Any) -> None:
    frames, masks = toss
    away = [replace(frames[5], depth_m=np.where(masks[5], frames[5].depth_m + 0.002 * i, frames[5].depth_m)
                    .astype(np.float32)) for i in range(60)]  # fmt: skip
    assert found([noisy(f, i, i) for i, f in enumerate(away)]) == []


def test_short_rests_stay_whole(toss: Any) -> None:
    assert found(repeated(toss[0], 11, SETTINGS.least - 3)) == []


def test_of_a_still_stretch_the_frames_beside_motion_are_kept_and_the_others_look_like_the_nearest_of_them() -> None:
    s = replace(SETTINGS, kept=2, least=6)
    kept = kept_of([(0, 9), (12, 19)], 20, s)
    assert kept.positions.tolist() == [0, 1, 8, 9, 10, 11, 12, 13]
    assert kept.positions[kept.like].tolist() == [0, 1, 1, 1, 1, 8, 8, 8, 8, 9, 10, 11, 12, *[13] * 7]


def quick() -> Config:
    return replace(Config(), shape=LearnConfig(field=FieldConfig(steps=10, rays=256, pose_rounds=0)))


def processed(session: Path) -> tuple[Results, list[int]]:
    """The results of the first pass, and how many frames were tracked per toss."""
    with Session.open(session) as opened:
        run = start_run(opened, opened.tosses, session / "results", quick(), "multi-hypothesis", lambda label: Silent())
        for variant, scope in rows_of("bundlesdf-1", "all"):
            process(run, variant, scope)
    stages = [json.loads(p.read_text()) for p in (session / "results").glob("track-*/stage.json")]
    return Results.open(session / "results"), [s["counts"]["frames"] for s in stages]


@pytest.mark.slow
@pytest.mark.parametrize("position", [11, 0, 6])
def test_waiting_three_hundred_frames_costs_a_few_and_leaves_every_frame_a_pose(
    tiny_world: Any, tmp_path: Path, position: int
) -> None:
    short, long = (
        tiny_world.record(tmp_path / name, tosses=(0,), frames=12,
                          seen_again=lambda f, n=times: repeated(f, position, n, grey=1.0))
        for name, times in (("short", 0), ("long", WAITING))
    )  # fmt: skip
    (brief, few), (waited, tracked) = processed(short), processed(long)
    assert few == [12]
    assert tracked[0] <= 12 + 2 * SETTINGS.kept + 2
    assert len(waited.masks(toss=0)) == 12 + WAITING
    track, usual = waited.tracks()[0], brief.tracks()[0]
    assert len(track.status) == 12 + WAITING
    assert set(track.status) == {"tracked"}
    still = slice(position + 2, position + WAITING)
    assert np.isfinite(track.covariance[still]).all()
    before, after = track.camera_from_object[: position + 1], track.camera_from_object[position + WAITING + 1 :]
    same_moments = np.concatenate([before, after])
    off_m = np.linalg.norm(same_moments[:, :3, 3] - usual.camera_from_object[:, :3, 3], axis=1)
    assert off_m.max() < 0.004
    at_rest = track.camera_from_object[still]
    assert np.linalg.norm(at_rest[:, :3, 3] - usual.camera_from_object[position, :3, 3], axis=1).max() < 0.004


def test_a_session_without_waiting_is_worked_on_as_it_is(record_tiny: Callable[..., Path]) -> None:
    with Session.open(record_tiny(frames=45, tosses=(0,))) as session:
        run = start_run(session, session.tosses, session.path / "results", Config(), "multi-hypothesis",
                        lambda label: Silent())  # fmt: skip
        assert run.session is session
        assert not run.kept


@pytest.mark.parametrize("name", ["cube_dev", "lab_dev"])
def test_the_takes_of_the_shared_sessions_are_worked_on_whole(
    name: str, data: Callable[[str], Path], tmp_path: Path
) -> None:
    from recordings.importers.folder import import_folder

    import_folder(data(name), tmp_path / "session")
    with Session.open(tmp_path / "session") as session:
        for number in session.tosses[:2]:
            assert found(session.toss(number).rgbd("d455")) == []
