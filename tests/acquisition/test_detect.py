"""A toss told from the gripper's width and from where the object was: known parabolas, known openings."""

from __future__ import annotations

import numpy as np
import pytest

from acquisition.arm.limits import arm_model
from acquisition.detect import Eye, Glimpse, TossWatcher, release_from_widths, still_since_s
from recordings.geometry import CameraModel, Transform, rotation_exp

RELEASE_S, HALF_M, FPS = 1.0, 0.035, 30.0
BOUNCE = 0.35


def height_m(time_s: float) -> float:
    """Of the object's middle: held at 0.3 m, tossed up at 0.5 m/s, falls, bounces once, rests."""
    t = time_s - RELEASE_S
    if t < 0:
        return 0.3 + 0.5 * t if t > -0.2 else 0.2
    lands_s = flight_s()
    if t < lands_s:
        return 0.3 + 0.5 * t - 4.905 * t * t
    up = BOUNCE * (9.81 * lands_s - 0.5)
    t -= lands_s
    return HALF_M + max(up * t - 4.905 * t * t, 0.0)


def flight_s() -> float:
    return float((0.5 + np.sqrt(0.25 + 4 * 4.905 * (0.3 - HALF_M))) / 9.81)


def watched(phase_s: float, by_hand: bool, noise_m: float = 0.002) -> TossWatcher:
    rng = np.random.default_rng(round(1e4 * phase_s))
    watcher = TossWatcher(by_hand=by_hand)
    for t in np.arange(0.3, 2.2, 0.02):
        open_m = 0.04 * float(np.clip((t - RELEASE_S) / 0.04, 0, 1))
        watcher.width(float(t), 0.04 + open_m + rng.normal(0, 2e-5))
    for t in np.arange(0.3 + phase_s, 2.2, 1 / FPS):
        along = 0.3 * (t - RELEASE_S) if RELEASE_S - 0.2 < t < RELEASE_S + 0.8 else 0.24 if t > RELEASE_S else -0.06
        middle = np.array([along, 0.0, height_m(float(t))]) + rng.normal(0, noise_m, 3)
        watcher.saw(Glimpse(float(t), middle, middle[2] - HALF_M + 0.004, 100))
    return watcher


@pytest.mark.parametrize("phase_s", [0.0, 0.011, 0.023, 0.03])
def test_release_impact_and_rest_are_found_within_a_frame(phase_s: float) -> None:
    events = watched(phase_s, by_hand=False).events()
    assert events.release is not None
    assert events.first_impact is not None
    assert events.rest is not None
    assert abs(events.release.time_s - RELEASE_S) < 1 / FPS
    assert abs(events.first_impact.time_s - RELEASE_S - flight_s()) < 1 / FPS
    assert RELEASE_S + flight_s() < events.rest.time_s < RELEASE_S + 0.95
    assert [e.kind for e in events.records()] == ["release", "first_impact", "rest"]


@pytest.mark.parametrize("phase_s", [0.0, 0.02])
def test_a_toss_by_hand_is_released_where_the_fall_begins(phase_s: float) -> None:
    events = watched(phase_s, by_hand=True).events()
    assert events.release is not None
    assert events.first_impact is not None
    assert abs(events.release.time_s - RELEASE_S) < 2 / FPS
    assert abs(events.first_impact.time_s - RELEASE_S - flight_s()) < 1.5 / FPS


def test_the_toss_is_over_only_when_the_object_rests() -> None:
    whole = watched(0.0, by_hand=False)
    watcher, over_s = TossWatcher(widths=whole.widths), None
    for glimpse in whole.glimpses:
        watcher.saw(glimpse)
        if over_s is None and watcher.over(glimpse.time_s):
            over_s = glimpse.time_s
    assert over_s is not None
    assert RELEASE_S + 0.8 < over_s < RELEASE_S + 1.3


@pytest.mark.parametrize("late_s", [0.001, 0.007, 0.015])
def test_the_opening_is_dated_between_the_samples(late_s: float) -> None:
    times = np.arange(0, 1, 0.02)
    width = 0.03 + np.clip((times - 0.5 - late_s) * 0.5, 0, 0.04)
    found = release_from_widths(np.stack([times, width], 1))
    assert found is not None
    assert found.time_s == pytest.approx(0.5 + late_s, abs=0.012)
    assert 0 < found.sigma_s < 0.02


def test_a_gripper_that_stays_closed_releases_nothing() -> None:
    times = np.arange(0, 1, 0.02)
    width = 0.03 + np.random.default_rng(0).normal(0, 2e-5, len(times))
    assert release_from_widths(np.stack([times, width], 1)) is None
    assert TossWatcher().events().release is None
    assert still_since_s([]) is None


CAMERA = CameraModel("d455", 212, 120, np.array([[150.0, 0, 105.5], [0, 150.0, 59.5], [0, 0, 1]]), "none", ())
ABOVE = Transform("world", "d455", np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1.0]))


def picture(x_px: int, y_px: int, depth_m: float) -> np.ndarray:
    """A table one metre below the camera with a square thing over it."""
    raw = np.full((120, 212), 1000, np.uint16)
    raw[y_px - 5 : y_px + 5, x_px - 5 : x_px + 5] = round(1000 * depth_m)
    return raw


def test_what_is_new_above_the_table_is_the_object() -> None:
    eye = Eye(CAMERA, ABOVE, 1)
    eye.learn([picture(40, 30, 0.8)] * 3, 0.001)  # something stands there
    still = eye.see(0.0, picture(40, 30, 0.8), 0.001, None, None)
    raw = picture(40, 30, 0.8)
    raw[55:65, 100:110] = 700
    seen = eye.see(0.1, raw, 0.001, None, None)
    assert still is None
    assert seen is not None
    np.testing.assert_allclose(seen.centroid_m, [0.0, 0.0, 0.3], atol=0.01)
    assert seen.points == 100


def test_the_arm_is_not_the_object() -> None:
    model = arm_model("panda")
    base = Transform("world", "base", rotation_exp(np.zeros(3)), np.array([-0.25, 0.0, 0.0]))
    eye = Eye(CAMERA, ABOVE, 1, model, base)
    a, b, _ = model.segments(model.ready_rad)
    elbow = base.points(0.5 * (a + b))[6]
    pixel = CAMERA.project(ABOVE.inverse().points(elbow[None]))[0]
    raw = picture(round(float(pixel[0])), round(float(pixel[1])), 1.0 - float(elbow[2]))
    assert eye.see(0.0, raw, 0.001, None, None) is not None
    assert eye.see(0.0, raw, 0.001, model.ready_rad, None) is None


def test_a_toss_that_is_not_over_says_what_it_waits_for() -> None:
    assert TossWatcher().waits_for(1.0) == "the fingers were not seen to open"
    assert TossWatcher(by_hand=True).waits_for(1.0) == "no free fall was seen"
    whole = watched(0.0, by_hand=False)
    unseen = TossWatcher(widths=whole.widths)
    assert unseen.waits_for(1.5) == "the object was not seen since it was let go: is it in the depth camera's view?"
    flying = [g for g in whole.glimpses if g.time_s < RELEASE_S + 0.3]
    assert TossWatcher(widths=whole.widths, glimpses=flying).waits_for(1.35) == "the object still moves"
    left = TossWatcher(widths=whole.widths, glimpses=flying).waits_for(flying[-1].time_s + 3.0)
    assert left == "the object left the depth camera's view 3.0 s ago"
    assert not whole.over(2.0) or "is still since" in whole.waits_for(2.0)
