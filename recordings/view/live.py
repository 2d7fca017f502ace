"""Pictures and lines as they come, in rerun's viewer: what `toss-record --preview` shows."""

from __future__ import annotations

import uuid
from types import TracebackType

import rerun as rr
from jaxtyping import UInt8, UInt16
from numpy import ndarray as Array

from recordings.console import has_display
from recordings.view.viewer import Viewer, ViewerFailed

APPLICATION = "toss-record"
TIME = "time"
LOG = "log"


class LiveView:
    """A viewer that is fed while something is recorded. Raises ViewerFailed where there is no display."""

    def __init__(self, headless: bool = False) -> None:
        if not headless and not has_display():
            raise ViewerFailed(
                "there is no display here for --preview; leave it out, or run where there is one. What was recorded "
                "can be looked at with `toss-view SESSION --save out.rrd`"
            )
        self._viewer = Viewer(headless=headless)
        self._recording = rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4())

    def __enter__(self) -> LiveView:
        self._viewer.__enter__()
        self._recording.connect_grpc(self._viewer.url)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._recording.disconnect()
        self._viewer.__exit__(kind, error, trace)

    def image(self, topic: str, time_ns: int, pixels: UInt8[Array, "h w"] | UInt8[Array, "h w 3"]) -> None:
        self._at(time_ns)
        self._recording.log(topic, rr.Image(pixels).compress(jpeg_quality=75))

    def depth(self, topic: str, time_ns: int, raw: UInt16[Array, "h w"], unit_m: float) -> None:
        self._at(time_ns)
        self._recording.log(topic, rr.DepthImage(raw, meter=1.0 / unit_m))

    def value(self, topic: str, time_ns: int, value: float) -> None:
        self._at(time_ns)
        self._recording.log(topic, rr.Scalars(value))

    def line(self, time_ns: int, text: str) -> None:
        self._at(time_ns)
        self._recording.log(LOG, rr.TextLog(text))

    def picture(self) -> bytes:
        """A PNG of the viewer's window."""
        self._recording.flush()
        return self._viewer.picture()

    def _at(self, time_ns: int) -> None:
        self._recording.set_time(TIME, duration=time_ns / 1e9)
