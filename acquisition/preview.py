"""`--preview`: small pictures of every stream in rerun, a few times a second, from a thread that may be slow."""

from __future__ import annotations

import contextlib
from typing import Any

from acquisition.streaming.recorder import Recorder
from acquisition.streaming.side_thread import SideThread

EVERY_S = 0.2
WIDEST_PX = 480


class Preview:
    """Shows what a recorder receives for as long as it is open. Reads only what the recorder keeps anyway."""

    def __init__(self, recorder: Recorder, headless: bool = False) -> None:
        from recordings.view.live import LiveView

        self._recorder = recorder
        self.view = LiveView(headless)
        self._shown: dict[str, int] = {}
        self._thread = SideThread("preview", EVERY_S, self.show)
        self._open = contextlib.ExitStack()

    def __enter__(self) -> Preview:
        self._open.enter_context(self.view)
        self._open.enter_context(self._thread)
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def picture(self) -> bytes:
        """A PNG of the viewer's window; what is shown stays as it is from here on."""
        self._thread.stop()
        return self.view.picture()

    def show(self) -> None:
        """Everything that is new since the last time."""
        recorder, shown = self._recorder, self._shown
        for topic, image in list(recorder.latest.items()):
            if shown.get(topic) == image.number:
                continue
            shown[topic] = image.number
            time_ns = recorder.clock.session_ns(image.host_ns)
            stride = max(1, image.pixels.shape[1] // WIDEST_PX)
            small: Any = image.pixels[::stride, ::stride]
            if topic.endswith("depth"):
                unit_m = recorder.thumbnails[-1].unit_m if recorder.thumbnails else 0.001
                self.view.depth(topic, time_ns, small, unit_m)
            else:
                self.view.image(topic, time_ns, small)
            tally = recorder.queues[topic].counter.tally()
            self.view.value(f"{topic}/lost", time_ns, float(tally.dropped_total + tally.missed))
        if recorder.widths:
            sample = recorder.widths[-1]
            self.view.value("gripper/width_m", recorder.clock.session_ns(sample.host_ns), sample.width_m)
