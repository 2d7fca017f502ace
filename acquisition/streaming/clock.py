"""Each device's clock mapped to the host's monotonic clock, from what arrives: stamps and receipt times.

A stamp arrives late by a latency that is never below its minimum. So (device time, receipt - device time) lies above a
line whose slope is the clocks' drift: the lower convex hull's edge over the mean of the device times is the line below
all points with the least sum of distances. It knows the drift and the course of time; the smallest latency stays in
it as a constant that only the data can tell (`toss-calibrate time`). Wall clocks are nowhere in here.
"""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

BUCKET_NS = 100_000_000
"""Of each such stretch of device time only the point of the smallest latency is kept."""
WINDOW_S = 300.0
"""Drift changes with temperature: older points are forgotten."""
USUAL_DRIFT = 50e-6
"""Crystals are this good; the prior of a fit over a short span."""
REFIT_EVERY_NS = 500_000_000
STEP_NS = 2_000_000
"""A smaller jump of a device's clock passes for jitter."""
LARGE_STEP_NS = 1_000_000_000
DECIDE_AFTER = 8
PERIODS = 31
GROUPS = 8


@dataclass(frozen=True)
class ClockLine:
    """host_ns = reference_host_ns + (1 + drift) * (device_ns - reference_device_ns), device time unwrapped.

    `sigma_s` is the standard deviation of the mapping's error beside the constant smallest latency; `latency_s` the
    median of what arrived later than the line says.
    """

    reference_device_ns: int
    reference_host_ns: int
    drift: float
    sigma_s: float
    latency_s: float
    samples: int
    span_s: float

    def host_ns(self, device_ns: int) -> int:
        past = device_ns - self.reference_device_ns
        return self.reference_host_ns + past + round(self.drift * past)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class ClockStep:
    """A device's clock was set, or started over: `by_ns` is what it was moved by, at a receipt time."""

    host_ns: int
    by_ns: int


class ClockMapper:
    """Follows one device clock. Feed it in order of receipt; ask for the line, or for the time of a stamp."""

    def __init__(self, wrap_ns: int | None = None) -> None:
        self._wrap_ns = wrap_ns
        self._turns_ns = 0
        self._last: tuple[int, int, int] | None = None
        self._periods: deque[float] = deque(maxlen=PERIODS)
        self._points: deque[tuple[int, int]] = deque()
        self._pending: _Pending | None = None
        self._line: ClockLine | None = None
        self._fitted_at_ns = 0
        self._count = 0
        self.steps: list[ClockStep] = []
        self.reported = 0
        """How many of the steps have been reported."""
        self.wraps = 0

    def add(self, device_ns: int, host_ns: int, number: int) -> int:
        """Take one stamp (not unwrapped) with its receipt time and frame number. Returns the unwrapped stamp."""
        device_ns = self._unwrapped(device_ns, host_ns)
        if self._last is not None:
            self._watch(device_ns, host_ns, number)
        self._last = (device_ns, host_ns, number)
        self._keep(device_ns, host_ns)
        self._count += 1
        return device_ns

    def line(self) -> ClockLine | None:
        """The present mapping; None before the first stamp. Fitted anew at most twice a second."""
        if self._last is None:
            return None
        early = self._line is not None and self._line.samples < 10 and self._count > self._line.samples
        if self._line is None or early or self._last[1] - self._fitted_at_ns >= REFIT_EVERY_NS:
            points = np.array(self._points, dtype=np.int64)
            self._line, self._fitted_at_ns = fit_line(points, self._count), self._last[1]
        return self._line

    def unwrap(self, raw_ns: int) -> int:
        """Another stamp of this clock, from about the time of the last one that was added."""
        if self._wrap_ns is None or self._last is None:
            return raw_ns + self._turns_ns
        turns = round((self._last[0] - raw_ns) / self._wrap_ns)
        return raw_ns + turns * self._wrap_ns

    def _unwrapped(self, raw_ns: int, host_ns: int) -> int:
        """As many turns of the counter as the host's clock saw pass."""
        if self._wrap_ns is None or self._last is None:
            return raw_ns + self._turns_ns
        passed_ns = host_ns - self._last[1]
        turns = round((passed_ns - (raw_ns + self._turns_ns - self._last[0])) / self._wrap_ns)
        self.wraps += max(turns, 0)
        self._turns_ns += turns * self._wrap_ns
        return raw_ns + self._turns_ns

    def _watch(self, device_ns: int, host_ns: int, number: int) -> None:
        """A step is a jump of the device's time that neither the frame number nor the host's clock explains."""
        assert self._last is not None
        passed_device, passed_host = device_ns - self._last[0], host_ns - self._last[1]
        frames = number - self._last[2]
        expected = frames * float(np.median(self._periods)) if self._periods and frames > 0 else passed_host
        jump_ns = passed_device - expected
        unexplained_ns = passed_device - passed_host
        if abs(unexplained_ns) > LARGE_STEP_NS and abs(jump_ns) > LARGE_STEP_NS:
            self._step(host_ns, round(jump_ns))
        elif len(self._periods) >= DECIDE_AFTER and abs(jump_ns) > STEP_NS:
            if self._pending is None:
                self._pending = _Pending(host_ns, round(jump_ns), self.line())
        elif frames > 0:
            self._periods.append(passed_device / frames)
        self._decide(device_ns, host_ns)

    def _decide(self, device_ns: int, host_ns: int) -> None:
        """A late trigger moves both clocks, a step only the device's: the smallest of some latencies tells."""
        pending = self._pending
        if pending is None or pending.line is None:
            return
        pending.lates_ns.append(host_ns - pending.line.host_ns(device_ns))
        clear = abs(pending.lates_ns[0] + pending.by_ns) < 0.2 * abs(pending.by_ns) and len(pending.lates_ns) == 1
        if not clear and len(pending.lates_ns) < DECIDE_AFTER:
            return
        usual_ns = pending.line.latency_s * 1e9
        if abs(min(pending.lates_ns) - usual_ns + pending.by_ns) < abs(min(pending.lates_ns) - usual_ns):
            self._step(pending.host_ns, pending.by_ns)
        self._pending = None

    def _step(self, host_ns: int, by_ns: int) -> None:
        """Begin anew: what was before says nothing about what comes."""
        self.steps.append(ClockStep(host_ns, by_ns))
        self._points.clear()
        self._periods.clear()
        self._pending, self._line, self._count = None, None, 0

    def _keep(self, device_ns: int, host_ns: int) -> None:
        latency_ns = host_ns - device_ns
        if self._pending is not None:
            return
        if self._points and device_ns // BUCKET_NS == self._points[-1][0] // BUCKET_NS:
            if latency_ns < self._points[-1][1]:
                self._points[-1] = (device_ns, latency_ns)
        else:
            self._points.append((device_ns, latency_ns))
        while device_ns - self._points[0][0] > WINDOW_S * 1e9:
            self._points.popleft()


class _Pending:
    """A jump that may be a step."""

    def __init__(self, host_ns: int, by_ns: int, line: ClockLine | None) -> None:
        self.host_ns, self.by_ns, self.line = host_ns, by_ns, line
        self.lates_ns: list[int] = []


def fit_line(points_ns: Int64[Array, "n 2"], samples: int) -> ClockLine:
    """The line below all points (device time, receipt - device time) with the least sum of distances to them.

    Over a span so short that latencies hide the drift, the slope is drawn to zero (crystals are USUAL_DRIFT good).
    """
    reference = points_ns[-1]
    x = (points_ns[:, 0] - reference[0]) / 1e9
    y = (points_ns[:, 1] - reference[1]) / 1e9
    slope = _hull_slope(x, y)
    span_s = float(np.ptp(x))
    noise_s = _group_sigma(x, y - slope * x)
    hidden_s = 2 * max(noise_s, 1e-5) / USUAL_DRIFT
    slope *= span_s**2 / (span_s**2 + hidden_s**2)
    above = y - slope * x
    offset = float(above.min())
    return ClockLine(
        int(reference[0]),
        int(reference[0] + reference[1] + round(offset * 1e9)),
        slope,
        max(_group_sigma(x, above), 1e-6),
        float(np.median(above - offset)),
        samples,
        span_s,
    )


def _hull_slope(x: Float[Array, " n"], y: Float[Array, " n"]) -> float:
    """Slope of the lower hull's edge over the mean of x."""
    hull: list[int] = []
    for i in range(len(x)):
        while len(hull) > 1 and _turn(x, y, hull[-2], hull[-1], i) <= 0:
            hull.pop()
        hull.append(i)
    if len(hull) < 2:
        return 0.0
    middle = float(x.mean())
    k = min(max(int(np.searchsorted(x[hull], middle)), 1), len(hull) - 1)
    a, b = hull[k - 1], hull[k]
    return float((y[b] - y[a]) / (x[b] - x[a]))


def _turn(x: Float[Array, " n"], y: Float[Array, " n"], a: int, b: int, c: int) -> float:
    return float((x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a]))


def _group_sigma(x: Float[Array, " n"], above: Float[Array, " n"]) -> float:
    """How far the smallest latency of a part of the span lies above that of the whole (root mean square)."""
    if len(x) < 2 * GROUPS:
        return float(np.std(above)) if len(x) > 1 else USUAL_DRIFT
    parts = np.array_split(above, GROUPS)
    lowest = np.array([part.min() for part in parts]) - above.min()
    return float(np.sqrt(np.mean(lowest**2)))


class SessionClock:
    """Nanoseconds since the session began, on the host's monotonic clock; the wall clock is read once, as an anchor."""

    def __init__(self, base_host_ns: int, unix_ns: int, starts_at_ns: int = 0) -> None:
        self._base_host_ns = base_host_ns - starts_at_ns
        self.anchor = {"session_ns": starts_at_ns, "unix_ns": unix_ns, "host_monotonic_ns": base_host_ns}

    def session_ns(self, host_ns: int) -> int:
        """The session's time of a reading of `time.monotonic_ns()`."""
        return max(host_ns - self._base_host_ns, 0)

    def host_ns(self, session_ns: int) -> int:
        return session_ns + self._base_host_ns
