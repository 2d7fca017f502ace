"""A session whose depth was exposed later than its stamps say: the same frames, depth's times put right."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from processing.sensor.still import ThinnedSession
from recordings.records import RgbdFrame
from recordings.session import RgbdFrames, Session, Toss
from recordings.tracks import RigCalibration


class _RestampedToss(Toss):
    """A toss whose depth times are later by a constant."""

    def __init__(self, stamped: Toss, later_ns: int) -> None:
        self.path, self.file, self.calibration = stamped.path, stamped.file, stamped.calibration
        self.info, self.index = stamped.info, stamped.index
        self._stamped, self._later_ns = stamped, later_ns

    def __reduce__(self) -> tuple[Any, ...]:
        return _RestampedToss, (self._stamped, self._later_ns)

    def rgbd(self, camera: str = "d455") -> RgbdFrames:
        """Colour frames with their depth, whose time is put right."""
        frames, later_ns = self._stamped.rgbd(camera), self._later_ns

        def load(i: int) -> RgbdFrame:
            frame = frames[i]
            return replace(frame, depth_time_ns=frame.depth_time_ns + later_ns)

        depth_times_ns = frames.depth_times_ns + later_ns
        return RgbdFrames(frames.times_ns, load, depth_times_ns, frames.without_depth, frames.unused_depth)


class RestampedSession(Session):
    """A session whose depth was exposed `later_ns` after what its stamps say."""

    def __init__(self, stamped: Session, later_ns: int) -> None:
        document = {"start": stamped.start, "stop": stamped.stop}
        super().__init__(stamped.path, document, stamped.calibration, stamped._files)
        self._open = stamped._open
        self._stamped, self._later_ns = stamped, later_ns

    def toss(self, toss: int) -> Toss:
        return _RestampedToss(self._stamped.toss(toss), self._later_ns)

    def with_calibration(self, calibration: RigCalibration) -> RestampedSession:
        return RestampedSession(self._stamped.with_calibration(calibration), self._later_ns)


def with_depth_later(session: Session, later_ns: int) -> Session:
    """The session with depth's times put right; of one whose still stretches were thinned, every frame's."""
    if isinstance(session, ThinnedSession):
        return session.of(RestampedSession(session.whole, later_ns))
    return RestampedSession(session, later_ns)
