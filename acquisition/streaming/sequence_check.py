"""What a stream's frames must be like to be kept: new numbers, one size, a picture that changes."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from typing import Literal

from acquisition.devices import Image
from acquisition.streaming.streams import Cause, Counter

FROZEN_AFTER = 3
LONGEST_GAP_FRAMES = 60
RESTARTED_AFTER = 300
"""Numbers that fall by more than this begin anew (the device was started again)."""
Level = Literal["info", "warning", "error"]


@dataclass(frozen=True)
class Trouble:
    """Something that went wrong, or got well again, with a device."""

    host_ns: int
    device: str
    kind: str
    text: str
    level: Level = "warning"


@dataclass
class SequenceCheck:
    """Judges the frames of one stream in order of receipt; counts what it does not let through."""

    topic: str
    counter: Counter
    troubles: list[Trouble] = field(default_factory=list)
    period_ns: float = 0.0
    """Between two frames, where the device's stamps can be trusted to show it (0: not watched)."""
    _number: int | None = None
    _ticks: int | None = None
    _shape: tuple[int, ...] | None = None
    _digest: int = 0
    _alike: int = 0

    def restart(self) -> None:
        """Numbers begin anew."""
        self._number = self._ticks = None

    def passes(self, image: Image) -> bool:
        """Whether to keep a frame. `troubles` then says what there is to tell."""
        cause = self._numbered(image) or self._shaped(image)
        if cause is not None:
            self.counter.came_and_dropped(cause)
            return False
        self._watch_frozen(image)
        return True

    def _numbered(self, image: Image) -> Cause | None:
        last = self._number
        if last is not None and image.number <= last and last - image.number < RESTARTED_AFTER:
            cause: Cause = "duplicate" if image.number == last else "out of order"
            self._report(image, cause, f"frame {image.number} came after {last}")
            return cause
        if last is not None and image.number > last + 1:
            self.counter.missed(image.number - last - 1)
            self._report(image, "gap", f"{image.number - last - 1} frames are missing before {image.number}")
        elif last is not None:
            self._watch_trigger(image)
        self._number, self._ticks = image.number, image.stamp.ticks
        return None

    def _watch_trigger(self, image: Image) -> None:
        """A camera that was not triggered does not count: only its stamps are too far apart."""
        if self._ticks is None or not self.period_ns or image.stamp.instant == "arrival":
            return
        ticks = image.stamp.ticks - self._ticks
        passed_ns = (ticks % image.stamp.wrap_ticks if image.stamp.wrap_ticks else ticks) * image.stamp.tick_ns
        missing = round(passed_ns / self.period_ns) - 1
        if 0 < missing < LONGEST_GAP_FRAMES and abs(passed_ns / self.period_ns - missing - 1) < 0.25:
            self.counter.missed(missing)
            self._report(image, "trigger", f"{missing} triggers were lost before {image.number}")

    def _shaped(self, image: Image) -> Cause | None:
        if self._shape is None:
            self._shape = image.pixels.shape
        if image.pixels.shape != self._shape:
            self._report(image, "invalid", f"an image of {image.pixels.shape} after {self._shape}", "error")
            return "invalid"
        return None

    def _watch_frozen(self, image: Image) -> None:
        digest = zlib.crc32(image.pixels[::16, ::16].tobytes())
        self._alike = self._alike + 1 if digest == self._digest else 0
        self._digest = digest
        if self._alike == FROZEN_AFTER:
            self._report(image, "frozen", f"the same picture {FROZEN_AFTER + 1} times in a row", "error")

    def _report(self, image: Image, kind: str, text: str, level: Level = "warning") -> None:
        self.troubles.append(Trouble(image.host_ns, self.topic, kind, text, level))

    def new_troubles(self) -> list[Trouble]:
        """New troubles, once."""
        found, self.troubles = self.troubles, []
        return found
