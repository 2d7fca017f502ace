"""One step of the background segmenter: where the object is in the next frame, from what is known of the last ones."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray as Array

from processing.segment.background.foreground import (
    ForegroundSettings,
    around,
    fill_holes,
    grown,
    moved_pixels,
    nearer_than_scene,
    pixel_log_odds,
    refine_border,
    smooth,
    window_around,
)
from processing.segment.background.late_depth import LateDepthSettings, at_color_time, way_px
from processing.segment.background.memory import Found, Memory
from processing.segment.background.others import expected_pieces, largest_other, things_near, without_others
from processing.segment.background.placement import best_shift, shifted
from processing.segment.background.static_scene import StaticScene
from recordings.records import RgbdFrame


@dataclass(frozen=True)
class BackgroundSettings:
    """How masks are followed from frame to frame."""

    foreground: ForegroundSettings = field(default_factory=ForegroundSettings)
    late: LateDepthSettings = field(default_factory=LateDepthSettings)
    least_px: int = 120
    """A smaller thing is not the object."""
    grown: float = 1.4
    """A component larger than the expected mask by this factor holds something else as well."""
    turned: float = 0.6
    turned_m: float = 0.15
    """What has grown on the object is its own within this share of its size, and this much in depth."""
    depth_margin_m: float = 0.04
    """The object's depth in a frame exceeds the last frame's range by no more than this, when others touch it."""
    sure: float = 0.7
    """Colours are learned from masks that are more confident than this."""
    piece_px: int = 25
    """A smaller piece behind a finger is not looked for."""
    piece_reach_px: int = 8
    """How far outside of the object's hull such a piece may lie."""
    darkest: float = 0.12
    """A frame this much darker than the scene, or brighter by the inverse, is followed by depth alone."""
    most_clipped: float = 0.5
    """So is a frame in which a larger share of the scene is overexposed."""
    least_gain: float = 0.02
    """A smaller change of brightness is not evened out."""
    table_share: float = 0.8
    """A given mask of which so much lies in the table's plane shows the table."""
    other_share: float = 0.3
    """Another thing that moves and is larger than this share of the object is counted."""
    part_of_scene: float = 0.9
    """An object less of which stands out from the scene than this was partly learned as scene."""
    unknown: float = 0.1
    """A component with a larger share of pixels whose scene is unknown is judged by its own colours."""


@dataclass(frozen=True, eq=False)
class RobotCues:
    """What the robot's drawing adds: log-odds of the object's colours against the robot's, and where the scene is
    unknown though no robot stands there."""

    odds: Float32[Array, "h w"]
    unknown: Bool[Array, "h w"]


MOST_REACH_PX = 150
MOST_ODDS = 8.0
BAND_PX = 9
"""Beyond this no border is drawn."""


def reach_px(area_px: float, steps: int) -> int:
    """How far around the expected mask the object is sought, or something that may touch it, after so many frames."""
    return int(0.6 * np.sqrt(area_px)) * steps + 4


def follow(
    frame: RgbdFrame,
    scene: StaticScene,
    memory: Memory,
    block: Bool[Array, "h w"] | None,
    cues: RobotCues | None,
    s: BackgroundSettings,
) -> Found:
    """The mask in the next frame; empty with confidence 0 where the object is not found."""
    reach = min(reach_px(memory.size_px, memory.missed + 1), MOST_REACH_PX)
    onward = shifted(memory.mask, memory.velocity_px * (memory.missed + 1))
    near = grown(onward, reach) | grown(memory.mask, reach)
    frame, s, far_px = _at_color_time(frame, scene, memory, near, block, s)
    sought = _sought(frame, scene, memory, near, reach, block, cues, s)
    rough = component_in(sought.own, sought.near)
    if cues is not None:
        rough |= _other_pieces(frame, sought.moved & ~rough, sought.expected, cues, memory, s)
    elif memory.others is not None:
        rough |= expected_pieces(sought.own & ~rough, sought.expected, s.piece_px)
    if rough.sum() < s.least_px:
        return Found(np.zeros_like(rough), 0.0)
    unknown = scene.unknown if cues is None else cues.unknown
    strange = (grown(rough, 5) & unknown).sum() > s.unknown * rough.sum()
    larger = rough.sum() > s.grown * memory.size_px
    if strange or (larger and not _is_all_object(frame, rough, sought.expected, memory, far_px, s)):
        rough = _among_others(frame, scene, sought.own, sought.expected, memory, cues, s)
        if rough.sum() < s.least_px:
            return Found(np.zeros_like(rough), 0.0)
        mask, sure = rough, 0.6
    else:
        mask, sure = _bordered(frame, scene, rough, sought, memory, cues, s)
    return _found(frame, scene, mask if block is None else mask & ~block, sure, rough, sought, memory, s)


@dataclass(frozen=True, eq=False)
class _Sought:
    """Where the object is sought: what moved, what that looks like (log-odds of the object), what of it nothing beside
    the object owns, and where it is expected."""

    moved: Bool[Array, "h w"]
    odds: Float32[Array, "h w"]
    own: Bool[Array, "h w"]
    expected: Bool[Array, "h w"]
    near: Bool[Array, "h w"]


def _at_color_time(
    frame: RgbdFrame,
    scene: StaticScene,
    memory: Memory,
    near: Bool[Array, "h w"],
    block: Bool[Array, "h w"] | None,
    s: BackgroundSettings,
) -> tuple[RgbdFrame, BackgroundSettings, float]:
    """The frame with its depth where colour shows the object, what then counts at the border, and how far (px) the
    object went between the two exposures."""
    way = way_px(frame, memory.speed_px_s)
    far_px = float(np.linalg.norm(way))
    if far_px <= s.late.least_px:
        return frame, s, far_px
    body = component_in(_moved_by_depth(frame, scene, block, s), shifted(near, -way))
    frame = at_color_time(frame, scene, body, way, s.late, s.foreground)
    return frame, replace(s, foreground=s.late.at_border(s.foreground)), far_px


def _sought(
    frame: RgbdFrame,
    scene: StaticScene,
    memory: Memory,
    near: Bool[Array, "h w"],
    reach: int,
    block: Bool[Array, "h w"] | None,
    cues: RobotCues | None,
    s: BackgroundSettings,
) -> _Sought:
    moved = moved_pixels(frame, scene, s.foreground)
    if block is not None:
        moved &= ~block
    looked = moved & around(near)
    odds = memory.own_odds(frame.color_rgb, looked, memory.others is not None)
    told = odds if cues is None else np.where(cues.odds != 0, cues.odds, odds)
    score = np.where(looked, 1 / (1 + np.exp(-told)), 0.0).astype(np.float32)
    came_px = best_shift(score, memory.mask, memory.velocity_px, memory.missed + 1, reach)
    expected, own = shifted(memory.mask, came_px), moved
    if memory.others is not None and cues is None:
        own = without_others(frame, scene, moved, expected, came_px, memory.others, odds, reach, s.foreground)
    return _Sought(moved, odds, own, expected, grown(expected, reach))


def _bordered(
    frame: RgbdFrame,
    scene: StaticScene,
    rough: Bool[Array, "h w"],
    sought: _Sought,
    memory: Memory,
    cues: RobotCues | None,
    s: BackgroundSettings,
) -> tuple[Bool[Array, "h w"], float]:
    """The rough mask with its border drawn anew, and how sure that is."""
    if cues is not None:  # where the scene's colour is known, the robot's colours speak against the object only
        odds = np.where(scene.known, np.minimum(cues.odds, 0), cues.odds)
        return refine_border(frame, scene, rough, odds, s.foreground, s.piece_px)
    odds = memory.own_odds(frame.color_rgb, grown(rough, BAND_PX), memory.others is not None)
    odds[sought.moved & ~sought.own] = -MOST_ODDS
    return refine_border(frame, scene, rough, odds, s.foreground, None if memory.others is None else s.piece_px)


def _found(
    frame: RgbdFrame,
    scene: StaticScene,
    mask: Bool[Array, "h w"],
    sure: float,
    rough: Bool[Array, "h w"],
    sought: _Sought,
    memory: Memory,
    s: BackgroundSettings,
) -> Found:
    """The mask, less sure where its size changed, and what else there is."""
    ratio = min(mask.sum(), memory.size_px) / max(mask.sum(), memory.size_px, 1)
    solid = sought.moved & sought.near & (frame.depth_m > 0)  # what only looks different may be the object's shadow
    solid &= ~(grown(rough, 3) if sought.own is sought.moved else rough)
    if memory.patches is not None:
        looks = sought.odds if memory.others is not None else memory.patches.log_odds(frame.color_rgb, solid)
        solid &= looks < 0
    others = things_near(frame, scene, solid, rough, s.foreground, s.least_px)
    largest = largest_other(frame, scene, sought.moved & ~grown(mask, 9), s.foreground, s.least_px)
    return Found(mask, float(np.clip(sure * min(1.0, ratio / 0.7), 0, 1)), others, largest)


def _moved_by_depth(
    frame: RgbdFrame, scene: StaticScene, block: Bool[Array, "h w"] | None, s: BackgroundSettings
) -> Bool[Array, "h w"]:
    nearer = nearer_than_scene(frame.depth_m, scene, s.foreground)
    nearer = nearer if block is None else nearer & ~block
    return cv2.morphologyEx(nearer.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0


def component_in(mask: Bool[Array, "h w"], region: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
    """The component that has most pixels in a region."""
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    inside = np.bincount(labels[region], minlength=count)
    inside[0] = 0
    return labels == int(inside.argmax()) if inside.any() else np.zeros_like(mask)


def _is_all_object(
    frame: RgbdFrame,
    rough: Bool[Array, "h w"],
    expected: Bool[Array, "h w"],
    memory: Memory,
    way_px: float,
    s: BackgroundSettings,
) -> bool:
    """Whether what has grown on the object is its own, as of a box that turns its broad side.

    It does not reach far, in the image (more where it moves by `way_px` between the exposures, which an impact changes)
    or in depth, and nothing else was near that could have touched it. Its colours do not count: a box that spins shows
    a side in this frame that it never showed before.
    """
    added = rough & ~expected
    reach = cv2.distanceTransform((~expected).astype(np.uint8), cv2.DIST_L2, 3)[added]
    if np.quantile(reach, 0.95) > s.turned * np.sqrt(memory.size_px) + way_px:
        return False
    low, high = memory.depth_range_m
    depth = frame.depth_m[added & (frame.depth_m > 0)]
    inside = (depth > low - s.turned_m) & (depth < high + s.turned_m)
    return bool(len(depth) > 0 and inside.mean() > 0.9)


def _other_pieces(
    frame: RgbdFrame,
    moved: Bool[Array, "h w"],
    expected: Bool[Array, "h w"],
    cues: RobotCues,
    memory: Memory,
    s: BackgroundSettings,
) -> Bool[Array, "h w"]:
    """What a finger has cut off the object: pieces of its colours and depth beside the robot, where it is expected."""
    out = np.zeros_like(expected)
    corners = cv2.findNonZero(expected.astype(np.uint8))
    if corners is None:
        return out
    hull = cv2.fillConvexPoly(np.zeros(expected.shape, np.uint8), cv2.convexHull(corners), 1)
    whole = grown(hull > 0, s.piece_reach_px)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(moved.astype(np.uint8), connectivity=4)
    low, high = memory.depth_range_m
    for k in range(1, count):
        if stats[k, cv2.CC_STAT_AREA] < s.piece_px:
            continue
        piece = np.asarray(labels == k)
        depth = frame.depth_m[piece & (frame.depth_m > 0)]
        inside = len(depth) > 0 and low - s.depth_margin_m < float(np.median(depth)) < high + s.depth_margin_m
        close = cues.odds[piece] != 0
        alike = close.any() and float(cues.odds[piece][close].mean()) > 0
        if inside and alike and whole[piece].mean() > 0.6:
            out |= piece
    return out


def _among_others(
    frame: RgbdFrame,
    scene: StaticScene,
    moved: Bool[Array, "h w"],
    expected: Bool[Array, "h w"],
    memory: Memory,
    cues: RobotCues | None,
    s: BackgroundSettings,
) -> Bool[Array, "h w"]:
    """The object among other things that are not scene either: by its colours, its depth and where it is expected."""
    at = window_around(expected, 30)
    if at is None:
        return np.zeros_like(expected)
    not_scene = np.minimum(pixel_log_odds(frame, scene, expected, at, None, s.foreground), 1.0)
    inward = cv2.distanceTransform(expected[at].astype(np.uint8), cv2.DIST_L2, 3)
    outward = cv2.distanceTransform((~expected[at]).astype(np.uint8), cv2.DIST_L2, 3)
    place = np.clip((inward - outward) / 5.0, -3.0, 1.5)
    depth, (low, high) = frame.depth_m[at], memory.depth_range_m
    elsewhere = (depth > 0) & ((depth < low - s.depth_margin_m) | (depth > high + s.depth_margin_m))
    likeness = memory.own_odds(frame.color_rgb, around(expected, 30))[at]
    if cues is not None:
        likeness = np.minimum(likeness, np.where(cues.odds[at] != 0, cues.odds[at], likeness))
    odds = not_scene + s.foreground.weight_likeness * likeness + place - 4.0 * elsewhere
    odds = np.where(moved[at], odds, np.minimum(odds, -1.0)).astype(np.float32)
    belief = smooth(odds, frame.color_rgb[at].astype(np.float32), s.foreground)
    out = np.zeros_like(expected)
    out[at] = cv2.morphologyEx((belief > 0).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    return fill_holes(component_in(out, expected))
