"""Device clocks on the host's clock: known drifts, wraps, steps."""

from __future__ import annotations

import numpy as np
import pytest

from acquisition.streaming.clock import ClockMapper, SessionClock, fit_line

EPOCH_NS = 10**12
DEVICE_START_NS = 5 * 10**9


def run(
    seed: int,
    seconds: float = 30.0,
    skew: float = 25e-6,
    load: float = 0.3,
    step: tuple[int, float] | None = None,
    wrap_ns: int | None = None,
    starts_ns: int = DEVICE_START_NS,
) -> tuple[ClockMapper, np.ndarray]:
    """A 30 Hz camera whose frames take 4 ms or more; `load`: share of frames that are held up by 10 ms on average.
    Returns the mapper and, frame by frame, mapped minus true time in ms."""
    rng = np.random.default_rng(seed)
    mapper = ClockMapper(wrap_ns)
    errors = []
    for k in range(int(seconds * 30)):
        true_ns = k / 30 * 1e9 + rng.normal(0, 2e5)
        device_ns = starts_ns + true_ns * (1 + skew) + (step[1] if step and k >= step[0] else 0.0)
        latency_ns = 4e6 + rng.exponential(1e6) + (rng.random() < load) * rng.exponential(10e6)
        stamp_ns = int(device_ns) // 1000 * 1000
        unwrapped = mapper.add(stamp_ns % wrap_ns if wrap_ns else stamp_ns, int(EPOCH_NS + true_ns + latency_ns), k)
        line = mapper.line()
        assert line is not None
        errors.append((line.host_ns(unwrapped) - EPOCH_NS - true_ns) / 1e6)
    return mapper, np.array(errors)


@pytest.mark.parametrize("seed", range(2))
def test_a_drifting_clock_under_load_is_mapped_to_a_twentieth_of_a_millisecond(seed: int) -> None:
    mapper, error_ms = run(seed)
    assert error_ms[300:].std() < 0.05  # from ten seconds on
    assert error_ms[300:].mean() == pytest.approx(4.0, abs=0.1)  # the smallest latency cannot be told from one way
    line = mapper.line()
    assert line is not None
    assert line.drift == pytest.approx(-25e-6, abs=3e-6)
    assert line.sigma_s < 0.1e-3
    assert not mapper.steps


def test_the_line_lies_below_all_points_and_touches_one() -> None:
    rng = np.random.default_rng(3)
    device = np.sort(rng.integers(0, 60 * 10**9, 200))
    late = (1e6 + rng.exponential(3e6, 200) + 3e-5 * device).astype(np.int64)
    line = fit_line(np.stack([device, late], axis=1), 200)
    above = device + late - np.array([line.host_ns(int(d)) for d in device])
    assert above.min() == pytest.approx(0, abs=2)
    assert (above >= -2).all()


def test_a_perfect_clock_keeps_its_times() -> None:
    mapper = ClockMapper()
    for k in range(100):
        mapper.add(k * 33_333_333, 7 * 10**9 + k * 33_333_333, k)
    line = mapper.line()
    assert line is not None
    assert line.host_ns(50 * 33_333_333) == pytest.approx(7 * 10**9 + 50 * 33_333_333, abs=2)


def test_a_32_bit_counter_of_microseconds_may_start_over() -> None:
    wrap_ns = 2**32 * 1000
    mapper, error_ms = run(5, wrap_ns=wrap_ns, starts_ns=wrap_ns - 12 * 10**9)
    assert mapper.wraps == 1
    assert not mapper.steps
    assert error_ms[400:].std() < 0.05


def test_another_stamp_of_the_same_clock_is_put_beside_the_last_one() -> None:
    wrap_ns = 2**32 * 1000
    mapper = ClockMapper(wrap_ns)
    mapper.add(wrap_ns - 10_000_000, 10**12, 0)
    after = mapper.add(5_000_000, 10**12 + 15_000_000, 1)
    assert mapper.unwrap(wrap_ns - 1_000_000) == after - 6_000_000
    assert mapper.unwrap(6_000_000) == after + 1_000_000


@pytest.mark.parametrize("by_ns", [3e6, -3e6, 20e6, -20e6, 5e8, -5e8, 3.6e12, -3.6e12])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_step_of_the_device_clock_is_seen_and_measured(seed: int, by_ns: float) -> None:
    mapper, error_ms = run(100 + seed, seconds=20, step=(300, by_ns))
    assert len(mapper.steps) == 1
    assert mapper.steps[0].by_ns == pytest.approx(by_ns, abs=2e6)
    assert error_ms[450:].std() < 0.1  # the new line, five seconds on


def test_late_frames_and_lost_frames_are_no_steps() -> None:
    rng = np.random.default_rng(9)
    mapper = ClockMapper()
    for k in range(600):
        if rng.random() < 0.2:
            continue
        late = 200e6 if 300 <= k < 315 else 0.0
        mapper.add(k * 33_333_333, int(EPOCH_NS + k * 33_333_333 + 5e6 + rng.exponential(2e6) + late), k)
    assert not mapper.steps


def test_a_resumed_session_goes_on_where_it_was() -> None:
    first = SessionClock(base_host_ns=1_000, unix_ns=77)
    assert first.session_ns(1_000) == 0
    assert first.session_ns(5_000) == 4_000
    second = SessionClock(base_host_ns=9_000, unix_ns=99, starts_at_ns=50_000)
    assert second.session_ns(9_001) == 50_001
    assert second.host_ns(50_001) == 9_001
    assert second.anchor["session_ns"] == 50_000
    assert second.anchor["unix_ns"] == 99
