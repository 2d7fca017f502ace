"""The records that devices hand over, and what lies between a driver's thread and its reader."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquisition.devices import DeviceLost, Image, JointTrajectory, Stamp
from acquisition.drivers.inbox import Inbox
from acquisition.drivers.workers.path import BRAKE_S, Brake, along, from_here


def cubic(count: int, seconds: float) -> JointTrajectory:
    """q = t^3 - t and its slope: what Hermite interpolation reproduces exactly."""
    t = np.linspace(0, seconds, count)
    return JointTrajectory(t, (t**3 - t)[:, None], (3 * t**2 - 1)[:, None])


@given(st.integers(2, 20), st.floats(0.1, 3.0), st.floats(0.0, 1.0))
def test_a_cubic_is_interpolated_exactly(count: int, seconds: float, share: float) -> None:
    t = share * seconds * 0.999
    q, dq = cubic(count, seconds).at(t)
    assert q[0] == pytest.approx(t**3 - t, abs=1e-9)
    if t > 0:
        assert dq[0] == pytest.approx(3 * t**2 - 1, abs=1e-9)


def test_after_its_end_a_trajectory_stands_still() -> None:
    q, dq = cubic(5, 2.0).at(9.0)
    assert (q[0], dq[0]) == (6.0, 0.0)


def test_mid_exposure_is_where_the_stamp_says() -> None:
    def image(instant: str, exposure_s: float = 0.004) -> Image:
        stamp = Stamp("c", 1000, 1000, instant=instant)  # type: ignore[arg-type]
        return Image("mono", 1, stamp, 0, np.zeros((2, 2), np.uint8), exposure_s)

    assert image("mid_exposure").mid_exposure_ns == 1_000_000
    assert image("exposure_start").mid_exposure_ns == 3_000_000
    assert image("exposure_end").mid_exposure_ns == -1_000_000
    assert image("exposure_end", float("nan")).mid_exposure_ns == 1_000_000


def test_a_full_inbox_gives_up_its_oldest_and_counts_it() -> None:
    inbox: Inbox[int] = Inbox(2)
    for number in range(5):
        inbox.put(number)
    assert (inbox.take(0.0), inbox.take(0.0), inbox.take(0.0), inbox.overflowed) == (3, 4, None, 3)


def test_what_came_before_a_loss_is_still_handed_over_and_a_waiting_reader_is_woken(own_time: Any) -> None:
    inbox: Inbox[int] = Inbox(4)
    inbox.put(1)
    inbox.lose("unplugged")
    inbox.lose("something later")
    assert inbox.take(0.0) == 1
    with pytest.raises(DeviceLost, match="unplugged"):
        inbox.take(5.0)
    waiting: Inbox[int] = Inbox(4)
    threading.Timer(0.05, waiting.lose, ("gone",)).start()
    with own_time() as spent, pytest.raises(DeviceLost, match="gone"):
        waiting.take(5.0)
    assert spent.seconds < 1.0


def test_braking_follows_the_path_to_rest_within_its_time() -> None:
    t = np.arange(2000) / 1000
    path = np.stack([np.sin(t), t**2], axis=1)
    brake = Brake(500.0, 1000.0)
    places = []
    while not brake.standing:
        brake.advance(1)
        places.append(along(path, brake.place))
    assert len(places) == pytest.approx(1000 * BRAKE_S, abs=10)
    found = np.array(places)
    np.testing.assert_allclose(found[:, 1], np.arcsin(found[:, 0]) ** 2, atol=1e-6)  # never off the path
    speed = np.diff(found[:, 1]) * 1000
    assert speed[0] == pytest.approx(1.0, abs=0.01)
    assert abs(speed[-1]) < 1e-6
    assert np.abs(np.diff(speed)).max() * 1000 < 8.0  # no jolt: 2 of the path's own, the rest from braking


def test_a_path_begun_beside_its_start_joins_it_smoothly() -> None:
    path = np.zeros((1000, 1))
    joined = from_here(path, np.array([0.01]), 1000.0)
    assert joined[0, 0] == 0.01
    np.testing.assert_array_equal(joined[301:], 0)
    assert (np.diff(joined[:, 0]) <= 0).all()


def test_a_sampled_trajectory_is_the_one_that_is_asked_for_instant_by_instant() -> None:
    rng = np.random.default_rng(0)
    for rows in (1, 2, 7):
        time_s = np.concatenate([[0.0], np.cumsum(rng.uniform(0.05, 0.2, rows - 1))])
        path = JointTrajectory(time_s, rng.normal(size=(rows, 6)), rng.normal(size=(rows, 6)))
        sampled = path.sampled(500.0)
        assert len(sampled) == int(np.ceil(path.duration_s * 500.0)) + 1
        np.testing.assert_allclose(sampled, [path.at(k / 500.0)[0] for k in range(len(sampled))], atol=1e-12)
