"""Depth that is exposed later than its stamps say is found from how far it shows the object from colour."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pytest

from processing.config import Config
from processing.pipeline.start import start_run
from processing.run import Run
from processing.segment.background.depth_delay import (
    DepthDelay,
    DepthDelaySettings,
    OutlineShifts,
    delay_of,
    outline_shifts,
    posterior_delay,
)
from processing.segment.background.static_scene import StaticScene
from processing.sensor.depth_stamps import with_depth_later
from processing.sensor.still import StillSettings, ThinnedSession, kept_of
from processing.stages.masks.find import find_object
from processing.stages.masks.segment import segment
from processing.stages.recording.depth_delay import with_depth_in_time
from processing.stages.recording.rig import refine_rig
from processing.stages.recording.scene import learn_static_scene
from recordings.geometry import Transform, rotation_exp, rotation_log
from recordings.progress import Silent
from recordings.records import RgbdFrame
from recordings.session import RgbdFrames, Session

Record = Callable[..., Path]
SETTINGS = DepthDelaySettings()
FRAME_S, COUNT = 1 / 30, 16


def between(tiny_world: Any, frame: float) -> Transform:
    """The box's pose at a part of a frame's interval."""
    poses = tiny_world.poses(COUNT)
    i = min(max(int(frame), 0), COUNT - 2)
    share = min(max(frame - i, 0.0), 1.0)
    place = (1 - share) * poses[i].translation_m + share * poses[i + 1].translation_m
    turn = rotation_exp(share * rotation_log(poses[i].rotation.T @ poses[i + 1].rotation))
    return replace(poses[i], rotation=poses[i].rotation @ turn, translation_m=place)


def late(tiny_world: Any, frames: list[RgbdFrame], delay_s: float) -> list[RgbdFrame]:
    """The frames with depth from so much later; their stamps do not say so."""
    seen = [tiny_world.see(between(tiny_world, i + delay_s / FRAME_S), i)[0] for i in range(len(frames))]
    return [replace(f, depth_m=d.depth_m) for f, d in zip(frames, seen)]


def told(tiny_world: Any, scene: StaticScene, delay_s: float) -> DepthDelay | None:
    seen = [tiny_world.see(between(tiny_world, float(i)), i) for i in range(COUNT)]
    frames = late(tiny_world, [f for f, _ in seen], delay_s)
    times_ns = np.array([f.time_ns for f in frames], dtype=np.int64)
    stream = RgbdFrames(times_ns, lambda i: frames[i], times_ns, (), 0)
    return delay_of(outline_shifts(stream, [m for _, m in seen], scene, SETTINGS), SETTINGS)


@pytest.mark.parametrize("delay_s", [-0.008, 0.0, 0.004, 0.016])
def test_the_delay_of_depth_is_told_to_two_milliseconds_by_one_toss_of_a_tiny_camera(
    tiny_world: Any, scene: StaticScene, delay_s: float
) -> None:
    found = told(tiny_world, scene, delay_s)
    assert found is not None
    assert found.delay_s == pytest.approx(delay_s, abs=2e-3)  # .6 px of 300 px/s
    assert abs(found.delay_s - delay_s) < 3 * found.sigma_s < 6e-3


def test_an_offset_that_is_there_at_rest_is_no_delay() -> None:
    speed = np.concatenate([np.zeros((6, 2)), np.linspace([100, 0], [400, 300], 12)])
    noise = 0.1 * np.random.default_rng(0).standard_normal(speed.shape)
    found = delay_of(OutlineShifts(np.array([1.5, -0.7]) - 0.012 * speed + noise, speed), SETTINGS)
    assert found is not None
    assert found.delay_s == pytest.approx(0.012, abs=3 * found.sigma_s)
    still = delay_of(OutlineShifts(np.array([1.5, -0.7]) + noise, speed), SETTINGS)
    assert posterior_delay(still, 0.0, SETTINGS) == 0.0


def test_frames_in_which_colour_was_mistaken_do_not_pull() -> None:
    speed = np.linspace([100, 0], [400, 300], 20)
    way = -0.01 * speed + 0.1 * np.random.default_rng(1).standard_normal(speed.shape)
    way[[0, 5, 11, 17]] += 15.0
    found = delay_of(OutlineShifts(way, speed), SETTINGS)
    assert found is not None
    assert found.delay_s == pytest.approx(0.01, abs=1e-3)


def test_what_hardly_moves_tells_nothing() -> None:
    speed = np.full((30, 2), 20.0)
    assert delay_of(OutlineShifts(-0.01 * speed, speed), SETTINGS) is None
    assert posterior_delay(None, 0.0, SETTINGS) == 0.0


def test_a_delay_is_believed_the_more_the_surer_it_is_and_only_beyond_what_the_stamps_say() -> None:
    assert posterior_delay(DepthDelay(0.012, 0.0005, 20), 0.0, SETTINGS) == pytest.approx(0.012, rel=5e-3)
    assert posterior_delay(DepthDelay(0.012, 0.0005, 20), 0.009, SETTINGS) == pytest.approx(0.003, rel=5e-3)
    assert posterior_delay(DepthDelay(0.012, 0.0005, 20), 0.0115, SETTINGS) == 0.0
    assert posterior_delay(DepthDelay(0.05, 0.0005, 20), 0.0, SETTINGS) == 0.0
    sure, likely, hardly = (posterior_delay(DepthDelay(0.012, x, 20), 0.0, SETTINGS) for x in (0.003, 0.0045, 0.007))
    assert 0.010 < sure < 0.012
    assert 0.007 < likely < sure
    assert 0.0 <= hardly < likely
    assert posterior_delay(DepthDelay(0.004, 0.004, 20), 0.0, SETTINGS) == 0.0  # as likely chance
    own = posterior_delay(DepthDelay(0.0096, 0.0017, 20), 0.0137, SETTINGS)  # depth has stamps of its own
    assert own == 0.0
    assert posterior_delay(DepthDelay(0.0041, 0.0017, 20), 0.0, SETTINGS) > 0.002


def test_what_is_believed_is_nearer_to_the_truth_on_average_than_what_is_measured_or_nothing() -> None:
    rng = np.random.default_rng(0)
    true = np.where(rng.random(4000) < 0.5, 0.0, SETTINGS.off_s * rng.standard_normal(4000))
    true = true[np.abs(true) < 0.02]
    for sigma in (0.001, 0.004, 0.008):
        seen = true + sigma * rng.standard_normal(len(true))
        believed = np.array([posterior_delay(DepthDelay(float(x), sigma, 20), 0.0, SETTINGS) for x in seen])
        error = float(np.square(believed - true).mean())
        assert error < 1.05 * np.square(seen - true).mean()
        assert error < np.square(np.where(np.abs(seen) > 4 * sigma, seen, 0.0) - true).mean() + 1e-7


def put_right(session: Path, out: Path) -> tuple[Run, Run]:
    """The run before and after its depth's stamps were looked at."""
    run = start_run(Session.open(session), [0], out, Config(), "multi-hypothesis", lambda name: Silent())
    scene = learn_static_scene(run)
    rig = refine_rig(run, scene)
    masks = {0: segment(run, 0, scene, rig, find_object(run, scene, rig))}
    return run, with_depth_in_time(run, scene, masks)


def test_a_run_sees_late_depth_at_its_own_time_and_says_so(
    tiny_world: Any, record_tiny: Record, tmp_path: Path
) -> None:
    session = record_tiny(tosses=(0,), frames=COUNT, seen_again=lambda frames: late(tiny_world, frames, 0.016))
    before, after = put_right(session, tmp_path / "out")
    frames = after.session.toss(0).rgbd()
    later_s = (frames.depth_times_ns - frames.times_ns) * 1e-9
    np.testing.assert_allclose(later_s, 0.016, atol=0.002)
    assert frames[3].depth_time_ns == frames.depth_times_ns[3]
    assert frames[3].time_ns == before.session.toss(0).rgbd()[3].time_ns
    assert after.keys["toss_00"] != before.keys["toss_00"]
    assert "after colour" in after.warnings[-1].seen


def test_a_run_whose_stamps_are_right_stays_the_same(record_tiny: Record, tmp_path: Path) -> None:
    before, after = put_right(record_tiny(tosses=(0,), frames=COUNT), tmp_path / "out")
    assert after is before


def test_of_a_thinned_session_only_the_kept_frames_are_seen_at_their_own_depths_time(record_tiny: Record) -> None:
    whole = Session.open(record_tiny(tosses=(0,), frames=COUNT))
    kept = kept_of([(4, 15)], COUNT, StillSettings(kept=2))
    session = with_depth_later(ThinnedSession(whole, {0: kept}), 5_000_000)
    frames = session.toss(0).rgbd()
    assert len(frames) == len(kept.positions) < COUNT
    assert {f.depth_time_ns - f.time_ns for f in frames} == {5_000_000}
    assert isinstance(session, ThinnedSession)
    every = session.whole.toss(0).rgbd()
    np.testing.assert_array_equal(every.depth_times_ns, every.times_ns + 5_000_000)


def test_another_process_sees_the_same_frames_at_the_same_times(record_tiny: Record) -> None:
    whole = Session.open(record_tiny(tosses=(0,), frames=COUNT))
    kept = kept_of([(4, 15)], COUNT, StillSettings(kept=2))
    for here in (with_depth_later(whole, 5_000_000), with_depth_later(ThinnedSession(whole, {0: kept}), 5_000_000)):
        for sent in (here.toss, here.toss(0)):
            there = cloudpickle.loads(cloudpickle.dumps(sent))
            frames = (there(0) if sent == here.toss else there).rgbd()
            np.testing.assert_array_equal(frames.depth_times_ns, here.toss(0).rgbd().depth_times_ns)
            assert frames[3].depth_time_ns - frames[3].time_ns == 5_000_000
