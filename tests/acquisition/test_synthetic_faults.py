"""Faults of the simulated lab's devices happen when they were planned, however late anybody asks."""

from __future__ import annotations

import time

import numpy as np
import pytest

from acquisition.drivers.synthetic import SyntheticLab, SyntheticThrower
from acquisition.simulators.faults import Faults
from acquisition.synthetic.lab_config import SyntheticConfig
from recordings.progress import Silent


@pytest.mark.parametrize("kind", ["silence", "lost_trigger"])
def test_frames_of_a_short_silence_are_lost_to_a_reader_that_slept_through_it(kind: str) -> None:
    lab = SyntheticLab(SyntheticConfig(pictures="pool", color_size=(64, 48), mono_size=(64, 48), buffer_frames=400))
    SyntheticThrower(lab).prepare(0, 0, Silent())
    camera = lab.device("mono0", "mono", 100.0)
    camera.open()
    camera.start()
    try:
        assert camera.read(1.0) is not None
        lab.faults("mono0").inject(kind, at_s=0.1, for_s=0.1)
        time.sleep(0.5)
        seen = [image for image in (camera.read(1.0) for _ in range(20)) if image is not None]
    finally:
        camera.close()
    gaps_s = 1e-9 * np.diff([image.stamp.device_ns for image in seen])
    lost = int((gaps_s / np.median(gaps_s)).round().max()) - 1
    numbers = np.diff([image.number for image in seen])
    assert lost in (2, 3, 4)
    assert sorted(numbers)[-2] == 1
    assert numbers.max() == (1 if kind == "lost_trigger" else 1 + lost)


def test_a_fault_is_asked_for_at_any_time() -> None:
    faults = Faults({"silence": "frames stop"})
    begun_ns = time.monotonic_ns()
    faults.inject("silence", at_s=10.0, for_s=1.0)
    assert faults.active("silence") is None
    assert faults.active("silence", begun_ns + 10_500_000_000) is not None
    assert faults.active("silence", begun_ns + 12_000_000_000) is None
