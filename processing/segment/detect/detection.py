"""Detection of the object without any given mask: where each toss of a session shows it most clearly."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from processing.segment.background.color_model import color_shares
from processing.segment.detect.candidates import Candidate, CandidateSettings, Finder
from processing.segment.detect.tracklets import Appearance, Tracklet, TrackletSettings, alike, choose, join
from processing.segment.robot.frames import CoarseFrames, RobotFrames
from processing.segment.segmenter import Example
from recordings.bounded.limits import read_npy
from recordings.geometry import CameraModel
from recordings.mcap.codec import decode_mask
from recordings.records import RgbdFrame
from recordings.results.stage_files import stage_document, stage_file


@dataclass(frozen=True)
class FindSettings:
    """How the object is found where no mask of it was given."""

    things: CandidateSettings = field(default_factory=CandidateSettings)
    tracklets: TrackletSettings = field(default_factory=TrackletSettings)
    every_s: float = 0.06
    """Frames are searched so far apart, and at each toss's first and last."""
    may_fall: float = 0.15
    """A tracklet that falls so clearly is searched in every frame of its fall."""
    again: float = 0.3
    """Another tracklet is so much like the object (-1..1) that it is a re-detection of it, before or after a gap."""
    jump_m: float = 0.15
    jump_m_s2: float = 15.0
    """No motion leads over a gap that is wider than this, after the velocities on both sides are taken out, and needs
    such an acceleration: the frames on the other side were recorded before the toss began, or after it."""


@dataclass(frozen=True, eq=False)
class Detection:
    """The object in one toss: rough masks (blocks of some pixels) by position of the frame. `start` is the clearest;
    the others are re-detections after it was away. `spans`: the first and the last frame of the tracklet that
    each belongs to. `shares`: of its colours, over all tosses."""

    start: int
    masks: Mapping[int, Bool[Array, "h w"]]
    spans: Mapping[int, tuple[int, int]]
    shares: Float[Array, " n"]
    score: float
    elsewhere: tuple[tuple[int, int], ...] = ()
    """First and last frames in which it is seen at a place that no motion leads from or to: not a part of the toss."""

    @property
    def again(self) -> list[int]:
        """The other frames, in time order."""
        return [i for i in sorted(self.masks) if i != self.start]

    def belongs_to(self, start: int, count: int) -> set[int]:
        """The frames, of so many, that no other tracklet than that of `start` covers."""
        others = [span for i, span in self.spans.items() if i != start] + list(self.elsewhere)
        return set(range(count)) - {i for first, last in others for i in range(first, last + 1)}


def tracklets_of(
    finder: Finder,
    frames: Sequence[RgbdFrame],
    robot: RobotFrames | None,
    gravity: Float[Array, "3"] | None,
    settings: FindSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Tracklet]:
    """Everything that moves through a toss. `robot`: drawn for coarse frames."""
    coarse = CoarseFrames(frames, finder.stride)
    things: dict[int, list[Candidate]] = {}

    def things_at(at: Sequence[int]) -> list[list[Candidate]]:
        for i in at:
            things[i] = finder.things(coarse[i], i, robot)
            progress(len(things), max(len(frames), 1))
        return [things[i] for i in sorted(things)]

    tracklets = join(things_at(positions(frames, settings.every_s)), gravity, settings.tracklets)
    falling = [c.fall_span for c in tracklets if c.fall > settings.may_fall]
    between = {i for first, last in falling for i in range(first, last) if i not in things}
    # what seemed to fall is searched in every frame: noise does not stay on its parabola
    gap_s = 2.5 * _period_s(frames)
    return join(things_at(sorted(between)), gravity, settings.tracklets, gap_s)


def _period_s(frames: Sequence[RgbdFrame]) -> float:
    if len(frames) < 2:
        return 0.0
    return (frames[len(frames) - 1].time_ns - frames[0].time_ns) * 1e-9 / (len(frames) - 1)


def positions(frames: Sequence[RgbdFrame], every_s: float) -> list[int]:
    """Positions of frames about so far apart, with the first and the last one."""
    if len(frames) < 2:
        return list(range(len(frames)))
    period_s = _period_s(frames)
    step = max(1, int(every_s / period_s + 0.2)) if period_s > 0 else 1
    return sorted({*range(0, len(frames), step), len(frames) - 1})


def detections(
    tracklets: Mapping[int, Sequence[Tracklet]],
    known: Appearance | None,
    shape: tuple[int, ...],
    stride: int,
    s: FindSettings,
) -> dict[int, Detection]:
    """The object in every toss in which it is found. `known`: its appearance, where a mask of it was given."""
    chosen = choose(tracklets, known, s.tracklets)
    if not chosen:
        return {}
    shares = np.asarray(np.mean([c.shares for c, _ in chosen.values()], axis=0))
    appearance = Appearance(
        shares if known is None else known.shares, float(np.median([c.size_m for c, _ in chosen.values()]))
    )
    found = {}
    for toss, (tracklet, score) in chosen.items():
        first = clearest(tracklet)
        others = [
            c for c in tracklets[toss] if c is not tracklet and apart(c, tracklet) and alike(c, appearance) > s.again
        ]
        seen = {clearest(c).position: c for c in others} | {first.position: tracklet}
        jumped = [c for c in seen.values() if c is not tracklet and not leads_to(tracklet, c, s)]
        seen = {i: c for i, c in seen.items() if c not in jumped}
        elsewhere = tuple(_up_to(c, tracklet) for c in jumped)
        masks = {i: clearest(c).picture(shape, stride) for i, c in seen.items()}
        spans = {i: _span(c) for i, c in seen.items()}
        found[toss] = Detection(first.position, masks, spans, appearance.shares, score, elsewhere)
    return found


def appearance_of(example: Example, camera: CameraModel) -> Appearance:
    """The object's appearance in a frame with a given mask."""
    depth = example.frame.depth_m[example.mask & (example.frame.depth_m > 0)]
    median_m = float(np.median(depth)) if len(depth) else 1.0
    size = float(np.sqrt(example.mask.sum())) * median_m / float(camera.fx)
    return Appearance(color_shares(example.frame.color_rgb, example.mask), size)


def _span(tracklet: Tracklet) -> tuple[int, int]:
    return tracklet.seen[0].position, tracklet.seen[-1].position


def _up_to(away: Tracklet, tracklet: Tracklet) -> tuple[int, int]:
    """The frames of a tracklet and those between it and another: the object jumped in one of them."""
    (first, last), (begins, ends) = _span(away), _span(tracklet)
    return (first, begins - 1) if last < begins else (ends + 1, last)


def apart(a: Tracklet, b: Tracklet) -> bool:
    """Whether two tracklets share no time."""
    return a.seen[-1].position < b.seen[0].position or b.seen[-1].position < a.seen[0].position


def leads_to(a: Tracklet, b: Tracklet, s: FindSettings) -> bool:
    """Whether some motion connects two tracklets: an object does not jump."""
    first, second = (a, b) if a.seen[0].position < b.seen[0].position else (b, a)
    last, next_ = first.seen[-1], second.seen[0]
    passed_s = next_.time_s - last.time_s
    velocity = 0.5 * (_velocity(first.seen[-3:]) + _velocity(second.seen[:3]))
    gap_m = float(np.linalg.norm(next_.center_m - last.center_m - velocity * passed_s))
    return gap_m < s.jump_m or 4 * gap_m / passed_s**2 < s.jump_m_s2


def _velocity(seen: Sequence[Candidate]) -> Float[Array, "3"]:
    passed_s = seen[-1].time_s - seen[0].time_s
    return (seen[-1].center_m - seen[0].center_m) / passed_s if passed_s > 0 else np.zeros(3)


def clearest(tracklet: Tracklet) -> Candidate:
    """The frame in which the object stands most freely, as large as elsewhere, and hardly moves in the picture."""
    sizes = np.array([c.size_m for c in tracklet.seen])
    usual = float(np.quantile(sizes, 0.6))
    areas = np.array([c.area_px for c in tracklet.seen], dtype=float)
    places = np.array([c.center_m for c in tracklet.seen])
    step = np.linalg.norm(np.gradient(places, axis=0), axis=1) if len(places) > 1 else np.zeros(len(places))
    whole = np.exp(-2 * np.abs(np.log(np.maximum(sizes, 1e-6) / usual)))
    free = np.array([c.free for c in tracklet.seen])
    score = free * whole * (0.5 + 0.5 * areas / areas.max()) / (1 + step / 0.05)
    return tracklet.seen[int(score.argmax())]


def write_detections(folder: Path, found: Mapping[int, Detection]) -> None:
    """Into a stage's folder: detections.json, and the rough masks as toss_XX/<position>.png (0 or 255)."""
    document: dict[str, Any] = {}
    for toss, detection in found.items():
        spans = {str(i): list(span) for i, span in detection.spans.items()}
        document[str(toss)] = {"start": detection.start, "score": round(detection.score, 3), "spans": spans}
        document[str(toss)]["elsewhere"] = [list(span) for span in detection.elsewhere]
        (folder / f"toss_{toss:02d}").mkdir()
        for position, mask in detection.masks.items():
            cv2.imwrite(str(folder / f"toss_{toss:02d}" / f"{position:06d}.png"), mask.astype(np.uint8) * 255)
    (folder / "detections.json").write_text(json.dumps(document, indent=1) + "\n")
    if found:
        np.save(folder / "shares.npy", next(iter(found.values())).shares)


def read_detection(folder: Path, toss: int) -> Detection | None:
    """One toss's, from a stage's folder; None where the object was not found in it."""
    path, shares_path = folder / "detections.json", folder / "shares.npy"
    entry = stage_document(path).get(str(toss))
    if entry is None:
        return None
    files = sorted((folder / f"toss_{toss:02d}").glob("*.png"))
    with stage_file(shares_path):
        shares = read_npy(shares_path)
    with stage_file(path):
        masks = {int(f.stem): decode_mask(f.read_bytes(), f.name) for f in files}
        spans = {int(i): (int(first), int(last)) for i, (first, last) in entry["spans"].items()}
        elsewhere = tuple((int(first), int(last)) for first, last in entry["elsewhere"])
        return Detection(int(entry["start"]), masks, spans, shares, float(entry["score"]), elsewhere)
