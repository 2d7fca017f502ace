"""A session as it is so far: the tosses that are finished, each decoded once and kept while it is worked on."""

from __future__ import annotations

from collections.abc import Sequence

from recordings.records import RgbdFrame
from recordings.session import RgbdFrames, Session, Toss


class _KeptToss(Toss):
    """A toss whose frames are decoded once."""

    def __init__(self, whole: Toss) -> None:
        self.path, self.file, self.calibration = whole.path, whole.file, whole.calibration
        self.info, self.index = whole.info, whole.index
        self._frames: dict[str, RgbdFrames] = {}

    def rgbd(self, camera: str = "d455") -> RgbdFrames:
        """As Toss.rgbd; a frame that was read before is not decoded again."""
        if camera not in self._frames:
            frames, kept = super().rgbd(camera), dict[int, RgbdFrame]()

            def load(i: int) -> RgbdFrame:
                if i not in kept:
                    kept[i] = frames[i]
                return kept[i]

            self._frames[camera] = RgbdFrames(
                frames.times_ns, load, frames.depth_times_ns, frames.without_depth, frames.unused_depth
            )
        return self._frames[camera]


class SessionSoFar(Session):
    """The finished tosses of a session that goes on. Nothing on disk changes, and none of the others is looked at."""

    def __init__(self, whole: Session, tosses: Sequence[int]) -> None:
        files = {t: whole.file(t) for t in tosses}
        super().__init__(whole.path, {"start": whole.start, "stop": whole.stop}, whole.calibration, files)

    def toss(self, toss: int) -> Toss:
        if toss not in self._open:
            self._open[toss] = _KeptToss(Toss(self.file(toss)))
        return self._open[toss]
