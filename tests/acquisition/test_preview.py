"""The live preview, headless: what is logged arrives in the viewer."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from acquisition.drivers.synthetic import SyntheticLab, SyntheticThrower
from acquisition.preview import Preview
from acquisition.rig import DeviceEntry, Rig
from acquisition.streaming.clock import SessionClock
from acquisition.streaming.recorder import Recorder
from acquisition.synthetic.lab_config import SyntheticConfig
from recordings.progress import Silent
from recordings.view.live import LiveView
from recordings.view.viewer import NoGraphics, ViewerFailed


@pytest.mark.slow
def test_a_picture_of_every_stream_is_in_the_viewer(tmp_path: Path) -> None:
    lab = SyntheticLab(SyntheticConfig(pictures="pool", color_size=(212, 120), mono_size=(160, 120), mono_cameras=1))
    SyntheticThrower(lab).prepare(0, 0, Silent())
    entries = (DeviceEntry("d455", "rgbd", "synthetic"), DeviceEntry("mono0", "mono", "synthetic"))
    devices = {e.name: lab.device(e.name, e.kind) for e in entries}
    recorder = Recorder(Rig("r", entries, Path("r.toml")), devices, SessionClock(time.monotonic_ns(), time.time_ns()))
    try:
        with recorder, Preview(recorder, headless=True) as preview:
            time.sleep(2.0)
            picture = preview.picture()
    except NoGraphics as fault:  # said as soon as the viewer is gone, which may be while it starts
        pytest.skip(str(fault))
    (tmp_path / "preview.png").write_bytes(picture)
    assert picture.startswith(b"\x89PNG")
    assert len(picture) > 20_000  # an empty window is smaller


def test_without_a_display_the_preview_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ViewerFailed, match="leave it out"):
        LiveView()
