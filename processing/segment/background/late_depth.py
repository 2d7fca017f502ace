"""Depth that was exposed at another time than colour: the object's returns are put where colour shows it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array

from processing.segment.background.foreground import ForegroundSettings, shadow_distance, window_around
from processing.segment.background.static_scene import StaticScene
from recordings.records import RgbdFrame


@dataclass(frozen=True)
class LateDepthSettings:
    """When depth is moved, how far around the predicted place colour is asked, and what moved depth is worth then."""

    least_px: float = 1.0
    """A smaller way between the exposures is left to the border's refinement."""
    search_px: int = 3
    search_share: float = 0.6
    """The way is sought within so many pixels, and this share of it, around the predicted one."""
    color_step: float = 20.0
    """The least difference of colour from the scene that counts."""
    shadow: float = 0.3
    """What may be the scene in a shadow counts so much: the object's own shadow lies beside it and is no part of it."""
    pull: float = 0.002
    """Share of the object's pixels that a pixel off the predicted way must win."""
    border_depth: float = 0.25
    border_px: int = 4
    """Moved depth counts so much less at the border, which is drawn anew so far to either side of it: the object has
    turned, too."""

    def at_border(self, s: ForegroundSettings) -> ForegroundSettings:
        """How a pixel's log-odds are weighed where depth was moved."""
        return replace(
            s,
            weight_depth=self.border_depth * s.weight_depth,
            band_inside_px=max(s.band_inside_px, self.border_px),
            band_outside_px=max(s.band_outside_px, self.border_px),
        )


def way_px(frame: RgbdFrame, speed_px_s: Float[Array, "2"]) -> Float[Array, "2"]:
    """How far (x, y) the object moves in the image from depth's exposure to colour's."""
    return np.asarray(-speed_px_s * (frame.depth_time_ns - frame.time_ns) * 1e-9)


def at_color_time(
    frame: RgbdFrame,
    scene: StaticScene,
    body: Bool[Array, "h w"],
    predicted_px: Float[Array, "2"],
    s: LateDepthSettings,
    look: ForegroundSettings,
) -> RgbdFrame:
    """The frame with the depth of `body` (its pixels in the depth image) moved by the whole pixels, near
    `predicted_px`, after which it covers most of what does not look like the scene; behind it the scene's depth."""
    reach = s.search_px + int(np.ceil(s.search_share * float(np.linalg.norm(predicted_px))))
    center_px = np.round(predicted_px).astype(int)
    at = window_around(body, int(np.abs(center_px).max()) + reach + 1)
    if at is None:
        return frame
    part = window_around(body, 0)
    assert part is not None
    strange = unlike_scene(frame, scene, at, s, look)
    template = body[part].astype(np.float32)
    steps = [(dx, dy) for dy in range(-reach, reach + 1) for dx in range(-reach, reach + 1)]
    top, left = part[0].start - at[0].start, part[1].start - at[1].start
    scores = cv2.matchTemplate(strange, template, cv2.TM_CCORR) / template.sum()
    best, chosen = -np.inf, None
    for dx, dy in steps:
        y, x = top + center_px[1] + dy, left + center_px[0] + dx
        if 0 <= y < scores.shape[0] and 0 <= x < scores.shape[1]:
            score = float(scores[y, x]) - s.pull * float(np.hypot(dx, dy))
            if score > best:
                best, chosen = score, (center_px[0] + dx, center_px[1] + dy)
    return frame if chosen is None else _moved(frame, scene, body, (int(chosen[0]), int(chosen[1])))


def unlike_scene(
    frame: RgbdFrame, scene: StaticScene, at: tuple[slice, slice], s: LateDepthSettings, look: ForegroundSettings
) -> Float32[Array, "a b"]:
    """1 where the colour is not the scene's, less where it may be the scene's in a shadow."""
    color, own = frame.color_rgb[at].astype(np.float32), scene.color_rgb[at]
    least = np.maximum(s.color_step, 4 * scene.color_sigma[at])
    other = np.where(shadow_distance(color, own, look.lit) > least, 1.0, s.shadow)
    unlike = np.where(np.abs(color - own).max(-1) > least, other, 0.0)
    return np.where(scene.known[at], unlike, 0.5).astype(np.float32)


def _moved(frame: RgbdFrame, scene: StaticScene, body: Bool[Array, "h w"], by_px: tuple[int, int]) -> RgbdFrame:
    depth = np.where(body, scene.depth_m, frame.depth_m).astype(np.float32)
    v, u = np.nonzero(body & (frame.depth_m > 0))
    x, y = u + by_px[0], v + by_px[1]
    inside = (x >= 0) & (y >= 0) & (x < depth.shape[1]) & (y < depth.shape[0])
    depth[y[inside], x[inside]] = frame.depth_m[v[inside], u[inside]]
    return replace(frame, depth_m=depth)
