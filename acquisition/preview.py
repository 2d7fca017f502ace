"""`--preview`: small pictures of every stream in rerun, a few times a second, from a thread that may be slow."""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Any

from acquisition.streaming.recorder import Recorder

EVERY_S = 0.2
WIDEST_PX = 480


class Preview:
    """Shows what a recorder receives for as long as it is open. Reads only what the recorder keeps anyway."""

    def __init__(self, recorder: Recorder, headless: bool = False) -> None:
        from recordings.view.live import LiveView

        self._recorder = recorder
        self.view = LiveView(headless)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="preview", daemon=True)

    def __enter__(self) -> Preview:
        self.view.__enter__()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join(2.0)
        self.view.__exit__(kind, error, trace)

    def picture(self) -> bytes:
        """A PNG of the viewer's window; what is shown stays as it is from here on."""
        self._stop.set()
        self._thread.join(2.0)
        return self.view.picture()

    def _run(self) -> None:
        shown: dict[str, int] = {}
        while not self._stop.wait(EVERY_S):
            self.show(shown)

    def show(self, shown: dict[str, int]) -> None:
        """Everything that is new since the last time."""
        recorder = self._recorder
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
