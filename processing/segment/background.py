"""Masks without learned weights: what differs from the static scene, followed through the toss by its motion.

Where other things touch the object (a hand, a stick) or the scene behind it was never seen, the object's own colours,
its depth and its last place decide instead.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array

from processing.segment.foreground import (
    ForegroundSettings,
    evidence,
    fill_holes,
    kernel,
    moved_pixels,
    nearer_than_scene,
    refine_border,
    smooth,
    window_around,
)
from processing.segment.likeness import Likeness
from processing.segment.robot_frames import RobotFrames, robot_likeness, with_robot
from processing.segment.segmenter import Example, FrameMask
from processing.segment.static_scene import StaticScene, surroundings, with_object_removed
from recordings.errors import BadInput
from recordings.geometry import CameraModel
from recordings.progress import Progress
from recordings.records import RgbdFrame

OBJECT_LIKE = 0.7
"""Log-odds of the object's colours against the robot's from which a pixel is not certainly the robot."""


@dataclass(frozen=True)
class BackgroundSettings:
    """How masks are followed from frame to frame."""

    foreground: ForegroundSettings = field(default_factory=ForegroundSettings)
    least_px: int = 120
    """A smaller thing is not the object."""
    grown: float = 1.4
    """A component larger than the expected mask by this factor holds something else as well."""
    alike: float = 0.6
    """Share of the pixels that have grown on the object which must have its colours to be taken as its own."""
    depth_margin_m: float = 0.04
    """The object's depth in a frame exceeds the last frame's range by no more than this, when others touch it."""
    sure: float = 0.7
    """Colours are learned from masks that are more confident than this."""
    piece_px: int = 25
    """A smaller piece behind a finger is not looked for."""
    piece_reach_px: int = 8
    """How far outside of the object's hull such a piece may lie."""
    part_of_scene: float = 0.9
    """An object less of which stands out from the scene than this was partly learned as scene."""
    unknown: float = 0.02
    """A component with a larger share of pixels whose scene is unknown is told by its own colours."""


@dataclass(frozen=True, eq=False)
class _Memory:
    """What is known when the next frame comes."""

    mask: Bool[Array, "h w"]
    velocity_px: Float[Array, "2"]
    depth_range_m: tuple[float, float]
    likeness: Likeness
    missed: int = 0


@dataclass(frozen=True, eq=False)
class _Beside:
    """What the robot's drawing adds: log-odds of the object's colours against the robot's, and where the scene is
    unknown though no robot stands there."""

    odds: Float32[Array, "h w"]
    unknown: Bool[Array, "h w"]


class BackgroundSegmenter:
    """Segmenter for a camera that stands still. See `Segmenter`."""

    name = "background"

    def __init__(
        self,
        scene: StaticScene,
        camera: CameraModel | None,
        settings: BackgroundSettings,
        drawn: RobotFrames | None = None,
    ) -> None:
        """`drawn`: the robot in every frame of the toss, where it is known; it says more than its pixels alone."""
        self._scene = scene
        self._camera = camera
        self._settings = settings
        self._drawn = drawn

    def masks(
        self,
        frames: Sequence[RgbdFrame],
        given: Mapping[int, Bool[Array, "h w"]],
        example: Example | None,
        robot: Sequence[Bool[Array, "h w"]] | None,
        progress: Progress,
    ) -> Iterator[FrameMask]:
        """Yield a mask for every frame: the first known one, then those after it, then those before it."""
        shape = frames[0].depth_m.shape
        given = {i: _checked(m, i, shape) for i, m in given.items() if i < len(frames)}
        start = min(given) if given else None
        if start is None:
            start, first = self._find(frames, example, robot)
        else:
            first = given[start]
        s, scene = self._settings, self._scene_without(frames[start], first)
        yield FrameMask(start, first, 1.0 if start in given else 0.8)
        done = 1
        for order in (range(start + 1, len(frames)), range(start - 1, -1, -1)):
            memory = _remember(None, frames[start], first)
            for i in order:
                block = None if robot is None else robot[i]
                frame = frames[i]
                if i in given:
                    mask, confidence = given[i], 1.0
                else:
                    mask, confidence = self._followed(frame, i, scene, memory, block)
                memory = _remember(memory, frame, mask, learn=confidence > s.sure)
                done += 1
                progress.step(done, len(frames), "masks")
                yield FrameMask(i, mask, confidence)

    def _followed(
        self, frame: RgbdFrame, i: int, scene: StaticScene, memory: _Memory, block: Bool[Array, "h w"] | None
    ) -> tuple[Bool[Array, "h w"], float]:
        seen = None if self._drawn is None else self._drawn.seen(frame, i)
        if self._drawn is None or seen is None:
            return _follow(frame, scene, memory, block, None, self._settings)
        s = self._drawn.settings
        odds = robot_likeness(frame, seen, memory.likeness, self._drawn.shares, s)
        unknown = ~scene.known & (seen.at_color_m == 0)
        certain = seen.certain & (odds < OBJECT_LIKE)
        certain = certain if block is None else certain | block
        beside = _Beside(odds, unknown)
        return _follow(frame, with_robot(scene, frame, seen, s), memory, certain, beside, self._settings)

    def _scene_without(self, frame: RgbdFrame, mask: Bool[Array, "h w"]) -> StaticScene:
        moved = moved_pixels(frame, self._scene, self._settings.foreground)
        stands_out = (moved & mask).sum() >= self._settings.part_of_scene * mask.sum()
        unknown = (~self._scene.known & surroundings(mask)).sum()
        if stands_out and unknown <= self._settings.unknown * mask.sum():
            return self._scene
        return with_object_removed(self._scene, frame, mask, moved, self._camera)

    def _find(
        self, frames: Sequence[RgbdFrame], example: Example | None, robot: Sequence[Bool[Array, "h w"]] | None
    ) -> tuple[int, Bool[Array, "h w"]]:
        """The first frame in which something stands out from the scene, and its mask."""
        known = None if example is None else Likeness.of(example.frame.color_rgb, example.mask)
        for i in range(len(frames)):
            frame = frames[i]
            block = None if robot is None else robot[i]
            rough = _best_candidate(frame, self._scene, known, block, self._settings)
            if rough is not None:
                return i, refine_border(frame, self._scene, rough, None, self._settings.foreground)[0]
        raise BadInput(
            "no mask of the object was given, and in no frame does anything stand out from the static scene. "
            "Wanted: a mask of the first frame (mask_first.png in the folder layout, masks/ in BundleSDF's), "
            "or a recording in which the object moves in front of a camera that stands still"
        )


def _checked(mask: Bool[Array, "h w"], position: int, shape: tuple[int, ...]) -> Bool[Array, "h w"]:
    if mask.shape != shape:
        raise BadInput(
            f"the given mask of frame {position} is {mask.shape[::-1]}, the image {shape[::-1]}; wanted the same size"
        )
    if not mask.any():
        raise BadInput(f"the given mask of frame {position} is empty; wanted the object's pixels, or no mask at all")
    return mask


def _best_candidate(
    frame: RgbdFrame,
    scene: StaticScene,
    known: Likeness | None,
    block: Bool[Array, "h w"] | None,
    s: BackgroundSettings,
) -> Bool[Array, "h w"] | None:
    """The component most likely to be the object: large, of known colours, in view as a whole, above the table."""
    moved = moved_pixels(frame, scene, s.foreground)
    if block is not None:
        moved &= ~block
    if scene.table_depth_m.any():
        below = (scene.table_depth_m > 0) & (frame.depth_m > scene.table_depth_m + s.foreground.nearer_m)
        moved &= ~below
    count, labels, stats, _ = cv2.connectedComponentsWithStats(moved.astype(np.uint8), connectivity=4)
    best, best_score = None, 0.0
    odds = None if known is None else known.log_odds(frame.color_rgb)
    height, width = moved.shape
    for k in range(1, count):
        left, top, w, h, area = stats[k]
        mask = labels == k
        if area < s.least_px or (frame.depth_m[mask] > 0).mean() < 0.3:
            continue
        cut = left == 0 or top == 0 or left + w == width or top + h == height
        alike = 1.0 if odds is None else float(np.exp(odds[mask].mean()))
        score = float(area) * alike * (0.2 if cut else 1.0)
        if score > best_score:
            best, best_score = mask, score
    return best


def _remember(memory: _Memory | None, frame: RgbdFrame, mask: Bool[Array, "h w"], learn: bool = True) -> _Memory:
    """Memory after a frame. An empty mask leaves everything but the count of misses; colours are learned on request."""
    if memory is not None and not mask.any():
        return replace(memory, missed=memory.missed + 1)
    depth = frame.depth_m[mask & (frame.depth_m > 0)]
    low, high = (float(d) for d in np.quantile(depth, (0.02, 0.98))) if len(depth) > 10 else (0.0, 20.0)
    if memory is None:
        return _Memory(mask, np.zeros(2), (low, high), Likeness.of(frame.color_rgb, mask))
    velocity = (_center(mask) - _center(memory.mask)) / (memory.missed + 1)
    likeness = memory.likeness.learned(frame.color_rgb, mask) if learn else memory.likeness
    return _Memory(mask, velocity, (low, high), likeness)


def _center(mask: Bool[Array, "h w"]) -> Float[Array, "2"]:
    """Centroid (x, y) in pixels."""
    moments = cv2.moments(mask.astype(np.uint8), binaryImage=True)
    return np.array([moments["m10"], moments["m01"]]) / max(moments["m00"], 1.0)


def _follow(
    frame: RgbdFrame,
    scene: StaticScene,
    memory: _Memory,
    block: Bool[Array, "h w"] | None,
    beside: _Beside | None,
    s: BackgroundSettings,
) -> tuple[Bool[Array, "h w"], float]:
    """The mask in the next frame and how sure it is; empty with 0 where the object is not found."""
    shift = memory.velocity_px * (memory.missed + 1)
    expected = _shifted(memory.mask, shift)
    area = int(memory.mask.sum())
    reach = int(0.6 * np.sqrt(area)) * (memory.missed + 1) + 4
    near = cv2.dilate(expected.astype(np.uint8), kernel(min(reach, 150))) > 0
    moved = moved_pixels(frame, scene, s.foreground)
    likeness = memory.likeness.log_odds(frame.color_rgb)
    moved &= scene.known | nearer_than_scene(frame.depth_m, scene, s.foreground) | (likeness > 0)
    if block is not None:
        moved &= ~block
    rough = _component_in(moved, near)
    if beside is not None:
        rough |= _other_pieces(frame, moved & ~rough, expected, beside, memory, s)
    if rough.sum() < s.least_px:
        return np.zeros_like(rough), 0.0
    wide = cv2.dilate(rough.astype(np.uint8), kernel(5)) > 0
    strange = (wide & (~scene.known if beside is None else beside.unknown)).sum() > s.unknown * rough.sum()
    grown = rough.sum() > s.grown * area
    if strange or (grown and not _is_all_object(frame, rough, expected, memory, s)):
        rough = _among_others(frame, scene, moved, expected, memory, beside, s)
        if rough.sum() < s.least_px:
            return np.zeros_like(rough), 0.0
        mask, sure = rough, 0.6
    else:
        least = None if beside is None else s.piece_px
        odds = None if beside is None else beside.odds
        mask, sure = refine_border(frame, scene, rough, odds, s.foreground, least)
    if block is not None:
        mask = mask & ~block
    ratio = min(mask.sum(), area) / max(mask.sum(), area, 1)
    return mask, float(np.clip(sure * min(1.0, ratio / 0.7), 0, 1))


def _shifted(mask: Bool[Array, "h w"], by_px: Float[Array, "2"]) -> Bool[Array, "h w"]:
    moved = np.array([[1, 0, by_px[0]], [0, 1, by_px[1]]], dtype=np.float32)
    return cv2.warpAffine(mask.astype(np.uint8), moved, mask.shape[::-1], flags=cv2.INTER_NEAREST) > 0


def _component_in(mask: Bool[Array, "h w"], region: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
    """The component that has most pixels in a region."""
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    inside = np.bincount(labels[region], minlength=count)
    inside[0] = 0
    return labels == int(inside.argmax()) if inside.any() else np.zeros_like(mask)


def _is_all_object(
    frame: RgbdFrame,
    rough: Bool[Array, "h w"],
    expected: Bool[Array, "h w"],
    memory: _Memory,
    s: BackgroundSettings,
) -> bool:
    """Whether what has grown on the object has its colours and its depth: a box that turns its broad side."""
    added = rough & ~expected
    if rough.sum() > s.grown**3 * memory.mask.sum():
        return False
    low, high = memory.depth_range_m
    depth = frame.depth_m[added & (frame.depth_m > 0)]
    inside = (depth > low - s.depth_margin_m) & (depth < high + s.depth_margin_m)
    alike = memory.likeness.log_odds(frame.color_rgb, crowded=True)[added]
    return bool(len(depth) > 0 and inside.mean() > 0.9 and (alike > 0).mean() > s.alike)


def _other_pieces(
    frame: RgbdFrame,
    moved: Bool[Array, "h w"],
    expected: Bool[Array, "h w"],
    beside: _Beside,
    memory: _Memory,
    s: BackgroundSettings,
) -> Bool[Array, "h w"]:
    """What a finger has cut off the object: pieces of its colours and depth beside the robot, where it is expected."""
    out = np.zeros_like(expected)
    corners = cv2.findNonZero(expected.astype(np.uint8))
    if corners is None:
        return out
    hull = cv2.fillConvexPoly(np.zeros(expected.shape, np.uint8), cv2.convexHull(corners), 1)
    whole = cv2.dilate(hull, kernel(s.piece_reach_px)) > 0
    count, labels, stats, _ = cv2.connectedComponentsWithStats(moved.astype(np.uint8), connectivity=4)
    low, high = memory.depth_range_m
    for k in range(1, count):
        if stats[k, cv2.CC_STAT_AREA] < s.piece_px:
            continue
        piece = np.asarray(labels == k)
        depth = frame.depth_m[piece & (frame.depth_m > 0)]
        inside = len(depth) > 0 and low - s.depth_margin_m < float(np.median(depth)) < high + s.depth_margin_m
        close = beside.odds[piece] != 0
        alike = close.any() and float(beside.odds[piece][close].mean()) > 0
        if inside and alike and whole[piece].mean() > 0.6:
            out |= piece
    return out


def _among_others(
    frame: RgbdFrame,
    scene: StaticScene,
    moved: Bool[Array, "h w"],
    expected: Bool[Array, "h w"],
    memory: _Memory,
    beside: _Beside | None,
    s: BackgroundSettings,
) -> Bool[Array, "h w"]:
    """The object among other things that are not scene either: by its colours, its depth and where it is expected."""
    at = window_around(expected, 30)
    if at is None:
        return np.zeros_like(expected)
    not_scene = np.minimum(evidence(frame, scene, expected, at, None, s.foreground), 1.0)
    inward = cv2.distanceTransform(expected[at].astype(np.uint8), cv2.DIST_L2, 3)
    outward = cv2.distanceTransform((~expected[at]).astype(np.uint8), cv2.DIST_L2, 3)
    place = np.clip((inward - outward) / 5.0, -3.0, 1.5)
    depth, (low, high) = frame.depth_m[at], memory.depth_range_m
    elsewhere = (depth > 0) & ((depth < low - s.depth_margin_m) | (depth > high + s.depth_margin_m))
    likeness = memory.likeness.log_odds(frame.color_rgb[at], crowded=True)
    if beside is not None:
        likeness = np.minimum(likeness, np.where(beside.odds[at] != 0, beside.odds[at], likeness))
    odds = not_scene + s.foreground.weight_likeness * likeness + place - 4.0 * elsewhere
    odds = np.where(moved[at], odds, np.minimum(odds, -1.0)).astype(np.float32)
    belief = smooth(odds, frame.color_rgb[at].astype(np.float32), s.foreground)
    out = np.zeros_like(expected)
    out[at] = cv2.morphologyEx((belief > 0).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    return fill_holes(_component_in(out, expected))
