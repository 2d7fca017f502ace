"""Waiting costs nothing: frames in which nothing moves are recognised, and few of them are worked on.

A take that goes on while the object lies still shows the same image again and again. Such a stretch keeps a few frames
at its ends; masks, tracks and shapes are made from what is kept, and at the end every frame left out gets the mask and
the pose (with its covariance and status) of the kept frame that it looks like. Found from the images alone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray as Array

from recordings.constants import MAD_TO_SIGMA
from recordings.given_masks import GivenMasks
from recordings.progress import Progress
from recordings.records import RgbdFrame
from recordings.session import RgbdFrames, Session, Toss
from recordings.tracks import RigCalibration


@dataclass(frozen=True)
class StillSettings:
    """What counts as the same image. Colours and inverse depths are compared as means over blocks, after the light of
    the whole image (gain and offset) is taken out, with the first frame of the stretch: what creeps is noticed too."""

    block_px: int = 8
    sigmas: float = 6.0
    """A block has changed where it differs by more than so many standard deviations of its noise."""
    least_blocks: int = 3
    """So many changed blocks are a motion."""
    color_noise: tuple[float, float] = (0.15, 1.0)
    """A block's noise, grey levels, is measured between neighbouring frames and taken to be within these: where a
    camera moves, neighbouring frames differ by more than noise."""
    depth_noise: tuple[float, float] = (0.001, 0.005)
    """The same of a block's inverse depth, as a share."""
    clipped: float = 245.0
    """Blocks brighter than this do not follow the light."""
    kept: int = 12
    """Frames kept at each end of a stretch (at the end of a toss: at its beginning only)."""
    least: int = 40
    """Shorter stretches stay whole: usual tosses rest for some ten frames."""


@dataclass(frozen=True, eq=False)
class Kept:
    """`positions` (m) of the frames that are worked on, and for every frame (n) which of them it looks like."""

    positions: Int64[Array, " m"]
    like: Int64[Array, " n"]

    @property
    def digest(self) -> str:
        """Fingerprint, for the keys of stages."""
        return hashlib.sha256(self.positions.astype("<i8").tobytes()).hexdigest()


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Block means of one frame: colours (NaN where clipped), inverse depth (NaN where much of it is missing)."""

    color: Float32[Array, "b c 3"]
    inverse_depth: Float32[Array, "b c"]


def still_stretches(frames: Sequence[RgbdFrame], settings: StillSettings, progress: Progress) -> list[tuple[int, int]]:
    """First and last position of every run of `settings.least` frames or more in which nothing moves."""
    known: dict[int, _Blocks] = {}

    def looked(i: int) -> _Blocks:
        if i not in known:
            known[i] = _blocks(frames[i], settings)
            progress.step(len(known), len(frames))
        return known[i]

    apart, most = settings.least - 1, (settings.color_noise[1], settings.depth_noise[1])
    ends = ((looked(i), looked(i + apart)) for i in range(len(frames) - apart))
    if all(_moved(one, other, most, settings) for one, other in ends):  # by more than any noise: no run is so long
        return []
    blocks = [looked(i) for i in range(len(frames))]
    noise = _noise(blocks, settings)
    found, first = [], 0
    for i in range(1, len(blocks) + 1):
        if i < len(blocks) and not _moved(blocks[first], blocks[i], noise, settings):
            continue
        if i - first >= settings.least:
            found.append((first, i - 1))
        first = i
    return found


def kept_of(stretches: Sequence[tuple[int, int]], count: int, settings: StillSettings) -> Kept:
    """Which of `count` frames are worked on. The first one always is."""
    left_out = np.zeros(count, dtype=bool)
    like = np.arange(count)
    for first, last in stretches:
        after = last + 1 if last == count - 1 else last + 1 - settings.kept
        begin, middle = first + settings.kept, (first + settings.kept + after) // 2
        left_out[begin:after] = True
        like[begin:after] = begin - 1
        if after <= last:
            like[middle:after] = after
    positions = np.flatnonzero(~left_out)
    return Kept(positions, np.searchsorted(positions, like))


def _blocks(frame: RgbdFrame, settings: StillSettings) -> _Blocks:
    height, width = frame.depth_m.shape
    size = (max(1, width // settings.block_px), max(1, height // settings.block_px))
    color = cv2.resize(frame.color_rgb.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    valid = (frame.depth_m > 0).astype(np.float32)
    inverse = np.divide(1.0, frame.depth_m, out=np.zeros_like(frame.depth_m), where=frame.depth_m > 0)
    share, total = (cv2.resize(x, size, interpolation=cv2.INTER_AREA) for x in (valid, inverse))
    color[(color > settings.clipped).any(-1)] = np.nan
    return _Blocks(color, np.where(share > 0.75, total / np.maximum(share, 1e-6), np.nan).astype(np.float32))


def _noise(blocks: Sequence[_Blocks], settings: StillSettings) -> tuple[float, float]:
    """Standard deviation of the difference of a block between two frames at rest, in colour and in inverse depth."""
    pairs = zip(blocks, blocks[1:])
    differences = [_difference(a, b) for a, b in pairs]
    color = float(np.nanmedian([settings.color_noise[0], *(_noise_of_differences(c) for c, _ in differences)]))
    depth = float(np.nanmedian([settings.depth_noise[0], *(_noise_of_differences(d) for _, d in differences)]))
    return float(np.clip(color, *settings.color_noise)), float(np.clip(depth, *settings.depth_noise))


def _noise_of_differences(values: Float32[Array, "..."]) -> float:
    known = values[np.isfinite(values)]
    return MAD_TO_SIGMA * float(np.median(np.abs(known))) if len(known) else float("nan")


def _difference(one: _Blocks, other: _Blocks) -> tuple[Float32[Array, "b c 3"], Float32[Array, "b c"]]:
    """Colours of `other` in the light of `one` minus its own, and the relative difference of inverse depth."""
    color = np.stack([_in_light_of(one.color[..., k], other.color[..., k]) for k in range(3)], -1) - one.color
    return color, other.inverse_depth / one.inverse_depth - 1


def _in_light_of(one: Float32[Array, "b c"], other: Float32[Array, "b c"]) -> Float32[Array, "b c"]:
    """Grey levels with the gain and offset that most blocks agree on."""
    use = np.isfinite(one) & np.isfinite(other)
    gain, offset = 1.0, 0.0
    for _ in range(3):
        if use.sum() < 8 or np.ptp(other[use]) < 1.0:
            break
        gain, offset = np.polyfit(other[use], one[use], 1)
        off = np.abs(gain * other + offset - one)
        use = np.isfinite(off) & (off <= 3 * MAD_TO_SIGMA * np.nanmedian(off) + 1e-3)
    return (gain * other + offset).astype(np.float32)


def _moved(one: _Blocks, other: _Blocks, noise: tuple[float, float], settings: StillSettings) -> bool:
    color, depth = _difference(one, other)
    changed = (np.abs(color) > settings.sigmas * noise[0]).any(-1)
    further = (np.abs(depth) > settings.sigmas * noise[1]).astype(np.uint8)
    area = cv2.morphologyEx(further, cv2.MORPH_OPEN, np.ones((2, 2), dtype=np.uint8))  # single blocks: an edge's noise
    return int(changed.sum()) >= settings.least_blocks or int(area.sum()) >= settings.least_blocks


class _ThinnedToss(Toss):
    """A toss of which only the kept frames are seen."""

    def __init__(self, whole: Toss, kept: Kept) -> None:
        self.path, self.file, self.calibration = whole.path, whole.file, whole.calibration
        self.info, self.index = whole.info, whole.index
        self._whole, self._kept = whole, kept

    def __reduce__(self) -> tuple[Any, ...]:
        return _ThinnedToss, (self._whole, self._kept)

    def rgbd(self, camera: str = "d455") -> RgbdFrames:
        """The kept frames of the camera that the stretches were found from."""
        frames, at = self._whole.rgbd(camera), self._kept.positions
        without = tuple(int(i) for i in np.flatnonzero(np.isin(at, frames.without_depth)))
        return RgbdFrames(frames.times_ns[at], lambda i: frames[int(at[i])], frames.depth_times_ns[at], without,
                          frames.unused_depth)  # fmt: skip

    def masks(self) -> GivenMasks:
        """Given masks, at the kept frames that look like theirs."""
        return super().masks().relabelled(self._kept.like)


class ThinnedSession(Session):
    """A session of whose tosses only the kept frames are seen; `whole` is the session itself."""

    def __init__(self, whole: Session, kept: Mapping[int, Kept]) -> None:
        super().__init__(whole.path, {"start": whole.start, "stop": whole.stop}, whole.calibration, whole._files)
        self._open = whole._open
        self.whole, self._kept = whole, kept

    def toss(self, toss: int) -> Toss:
        found = self.whole.toss(toss)
        return _ThinnedToss(found, self._kept[toss]) if toss in self._kept else found

    def with_calibration(self, calibration: RigCalibration) -> ThinnedSession:
        return self.of(self.whole.with_calibration(calibration))

    def of(self, whole: Session) -> ThinnedSession:
        """The kept frames of the same session seen otherwise."""
        return ThinnedSession(whole, self._kept)


def whole_session(session: Session) -> Session:
    """The session with every frame that was recorded."""
    return session.whole if isinstance(session, ThinnedSession) else session
