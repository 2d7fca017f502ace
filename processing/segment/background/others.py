"""What stands beside the object and is no scene, a hand or a stick: told apart from it by where both were."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array

from processing.segment.background.channels import most_of_channels
from processing.segment.background.foreground import (
    ForegroundSettings,
    grown,
    kernel,
    nearer_than_scene,
    scene_colored,
    smooth,
    window_around,
)
from processing.segment.background.placement import best_shift, shifted
from processing.segment.background.static_scene import StaticScene
from recordings.records import RgbdFrame

PLACE_PX = 5.0
"""A pixel so much nearer to where the one is expected than to where the other is speaks for it by one nat ..."""
MOST_PLACE = 3.0
"""... and by no more than this: both may have turned."""
OWN_NATS = 1.6
"""A colour that the object shows five times as often as its surroundings is its own, also where it may be a shade of
the scene's: a dark bottle is, of any table."""
RIM_PX = 9
"""Farther from the mask than this, what stands before the scene is no rim of stereo's ..."""
THICK, NEAR_THICK = 0.03, 4
"""... nor is what is thicker than this share of the object's size; what is near such a thick part goes with it."""
MOST_INSIDE = 0.8
"""Of a thing beside the object, within the object's hull."""
DEPTH_EDGE_M = 0.02
"""A step of depth this large between neighbours cuts their pull as a strong edge of colour does."""


def things_near(
    frame: RgbdFrame,
    scene: StaticScene,
    solid: Bool[Array, "h w"],
    mask: Bool[Array, "h w"],
    s: ForegroundSettings,
    least_px: int,
) -> Bool[Array, "h w"] | None:
    """What of some pixels is a thing beside the object; None where there is none of `least_px` pixels.

    Part of it stands before the scene, farther from the mask than stereo's rim, or has another colour than the scene.
    It is thicker than rims and shadows are, and most of it lies outside of the object's hull: within, it may be a side
    that was never seen.
    """
    at = window_around(solid, 0)
    if at is None or solid.sum() <= least_px:
        return None
    told = np.zeros_like(solid)
    told[at] = ~scene_colored(frame, scene, at, s)
    told |= nearer_than_scene(frame.depth_m, scene, s) & ~grown(mask, RIM_PX)
    told = _apart(solid & scene.known & told, mask, s)
    radius = max(s.band_inside_px, round(THICK * float(np.sqrt(mask.sum()))))
    thick = cv2.morphologyEx(solid.astype(np.uint8), cv2.MORPH_OPEN, kernel(radius))
    bodies = (cv2.dilate(thick, kernel(NEAR_THICK * radius)) > 0) & solid
    count, labels = cv2.connectedComponents(bodies.astype(np.uint8), connectivity=4)
    sizes, inside, known = (np.bincount(labels[p], minlength=count) for p in (bodies, _hull(mask), told))
    keep = (known > least_px) & (inside < MOST_INSIDE * sizes)
    keep[0] = False
    return np.asarray(keep[labels]) if keep.any() else None


def _apart(seen: Bool[Array, "h w"], mask: Bool[Array, "h w"], s: ForegroundSettings) -> Bool[Array, "h w"]:
    """Components that are somewhere wider than a rim and lie for the most part farther from the mask than one."""
    wide = cv2.morphologyEx(seen.astype(np.uint8), cv2.MORPH_OPEN, kernel(max(1, s.band_inside_px // 2))) > 0
    count, labels = cv2.connectedComponents(seen.astype(np.uint8), connectivity=4)
    sizes, close = (np.bincount(labels[p], minlength=count) for p in (seen, grown(mask, s.band_inside_px)))
    keep = np.isin(np.arange(count), labels[wide]) & (close < 0.5 * sizes)
    keep[0] = False
    return np.asarray(keep[labels])


def _hull(mask: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
    """The pixels of a mask's convex hull."""
    out, points = np.zeros(mask.shape, np.uint8), cv2.findNonZero(mask.astype(np.uint8))
    if points is not None:
        cv2.fillConvexPoly(out, cv2.convexHull(points), 1)
    return out > 0


def without_others(
    frame: RgbdFrame,
    scene: StaticScene,
    moved: Bool[Array, "h w"],
    expected: Bool[Array, "h w"],
    way_px: Float[Array, "2"],
    others: Bool[Array, "h w"],
    odds: Float32[Array, "h w"],
    reach_px: int,
    s: ForegroundSettings,
) -> Bool[Array, "h w"]:
    """The moved pixels near the object that are its own.

    `expected` is where the object is expected, `way_px` (x, y) how far it has come since the last frame: the others
    came with it, or stayed where they were. `odds`: of the object, by what either looks like; a border between two that
    look alike stays where it was. What shows the scene's colour is the object's only where that is expected, or where
    it looks like the object by more than OWN_NATS.
    """
    out = np.zeros_like(moved)
    at = window_around(expected | others, reach_px)
    if at is None:
        return out
    looks, before = odds[at], others[at]
    score = moved[at] / (1 + np.exp(looks))
    theirs = shifted(before, best_shift(score.astype(np.float32), before, way_px, 1, reach_px))
    place = np.clip((_away(theirs) - _away(expected[at])) / PLACE_PX, -MOST_PLACE, MOST_PLACE)
    votes = np.where(moved[at], s.weight_likeness * looks + place, 0.0).astype(np.float32)
    depth = np.where(frame.depth_m[at] > 0, frame.depth_m[at], np.float32(0)) * np.float32(s.edge_color / DEPTH_EDGE_M)
    belief = smooth(votes, np.dstack([frame.color_rgb[at].astype(np.float32), depth]), s)
    own = expected[at] | ~scene_colored(frame, scene, at, s) | (looks > OWN_NATS)
    out[at] = moved[at] & (belief > 0) & own
    return out


def expected_pieces(own: Bool[Array, "h w"], expected: Bool[Array, "h w"], least_px: int) -> Bool[Array, "h w"]:
    """What a hand has cut off the object: pieces of what is its own, most of which lie where it is expected."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(own.astype(np.uint8), connectivity=4)
    inside = np.bincount(labels[expected], minlength=count)
    kept = (stats[:, cv2.CC_STAT_AREA] >= least_px) & (inside > 0.5 * stats[:, cv2.CC_STAT_AREA])
    kept[0] = False
    return np.asarray(kept[labels])


def largest_other(
    frame: RgbdFrame, scene: StaticScene, moved: Bool[Array, "h w"], s: ForegroundSettings, least_px: int
) -> int:
    """Size of the largest thing, away from the object, that is not scene: what looks as the scene always looked there
    has not moved, however its depth flickers."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(moved.astype(np.uint8), connectivity=4)
    order = 1 + np.argsort(-stats[1:count, cv2.CC_STAT_AREA])
    for k in order:
        if stats[k, cv2.CC_STAT_AREA] < least_px:
            break
        left, top, width, height = stats[k, :4]
        at = np.s_[top : top + height, left : left + width]
        thing = labels[at] == k
        apart = most_of_channels(np.abs(frame.color_rgb[at] - scene.color_rgb[at]))[thing]
        if (apart > np.maximum(s.color_step, 4 * scene.color_sigma[at][thing])).mean() > 0.5:
            return int(stats[k, cv2.CC_STAT_AREA])
    return 0


def _away(mask: Bool[Array, "a b"]) -> Float[Array, "a b"]:
    """How far (px) each pixel lies outside of a mask; negative inside. Nothing lies near an empty one."""
    if not mask.any():
        return np.full(mask.shape, 1e3)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(outside - cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3), dtype=np.float64)
