"""What one frame shows of the object, made ready for alignment: smooth depth, normals, appearance, outline, samples."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array

from processing.sensor import view_layout as lay
from processing.sensor.rectification import Rectification
from processing.sensor.surface_kernel import fit_surface
from recordings.constants import LUMA
from recordings.records import RgbdFrame


@dataclass(frozen=True)
class ViewConfig:
    """How a frame is turned into a view."""

    margin_px: int = 14
    """Rim of the crop around the mask: how far outside the outline still has a slope."""
    window_px: int = 3
    """Half width of the window in which depth is fitted by planes."""
    edge_share: float = 0.012
    """Depth off a plane by more than this share of the distance belongs to another surface."""
    smooth_px: float = 2.5
    """Blur of the smooth grey level, which widens the basin of attraction."""
    rim_px: float = 2.0
    rim_share: float = 0.05
    """Appearance so near to the outline (pixels; at most this share of the object's size) is mixed with the
    background's by the lens and JPEG: it would stay with the picture. That farther inside is blurred outwards over
    them."""
    shade_px: float = 5.0
    """Scale over which brightness is levelled: shading and exposure are no texture."""
    bright_gain: float = 0.5
    """Of levelled brightness: shadows and highlights stay with the room and mislead."""
    color_gain: float = 3.0
    """Of colour differences: shading leaves them alone, so that a faint one counts more than a strong shadow."""
    jump_m: float = 0.015
    """A step of depth inside the outline (beyond a slope's): near it, the far surface gets the near one's depth ..."""
    jump_px: int = 3
    """... so that no samples are taken so near to it (they would stay with the picture, not with the object)."""
    samples: int = 500
    """Surface points of a view that alignment uses."""
    least_samples: int = 40
    """A view with fewer cannot be tracked."""
    cover_m: float = 0.015
    """What is nearer than the object by this may cover it."""
    turn_share: float = 1.0
    """Of what depth says of turns: the rest is the noise of patches that err alike (`DepthNoise.turn_share`)."""
    above_table_m: float = 0.02
    """What is lower above the table than this is the table, which covers nothing."""


@dataclass(frozen=True, eq=False)
class Crop:
    """The rectified pixels around the object in one frame: all that later steps need of it."""

    position: int
    corner: tuple[int, int]
    """u, v of the crop's first pixel."""
    mask: Bool[Array, "h w"]
    depth_m: Float32[Array, "h w"]
    color: Float32[Array, "h w 3"]
    """RGB 0..1 at the session's usual exposure."""
    covered: Bool[Array, "h w"]
    """Pixels outside the mask where something nearer may hide the object."""
    height_m: Float32[Array, "h w"] | None
    depth_delay_s: float
    """Depth's exposure time minus colour's."""
    colorless: Bool[Array, "h w"] | None = None
    """Pixels of the mask whose colour is not the object's; None: there are none."""


def cut(
    frame: RgbdFrame,
    mask: Bool[Array, "h w"],
    position: int,
    rectified: Rectification,
    gain: float,
    config: ViewConfig,
    camera_from_world: Float[Array, "4 4"] | None = None,
    colorless: Bool[Array, "h w"] | None = None,
) -> Crop | None:
    """The crop around the mask, or None where the mask holds too little. `camera_from_world` has the table at z = 0;
    `colorless` marks pixels of the mask that show something else's colour."""
    straight_mask = rectified.straight(mask.astype(np.uint8), smooth=False) > 0
    rows, columns = np.flatnonzero(straight_mask.any(1)), np.flatnonzero(straight_mask.any(0))
    h, w = straight_mask.shape
    if len(rows) == 0 or int(straight_mask.sum()) < config.least_samples:
        return None
    top, bottom = max(int(rows[0]) - config.margin_px, 0), min(int(rows[-1]) + config.margin_px + 1, h)
    left, right = max(int(columns[0]) - config.margin_px, 0), min(int(columns[-1]) + config.margin_px + 1, w)
    area = np.s_[top:bottom, left:right]
    color = rectified.straight(frame.color_rgb, smooth=True)[area].astype(np.float32) / np.float32(255.0 * gain)
    depth_m = np.ascontiguousarray(rectified.straight(frame.depth_m, smooth=False)[area])
    inside = np.ascontiguousarray(straight_mask[area])
    height_m = _heights(depth_m, (left, top), rectified, camera_from_world)
    covered = _covered(depth_m, inside, height_m, config)
    delay_s = (frame.depth_time_ns - frame.time_ns) * 1e-9
    foreign = None if colorless is None else rectified.straight(colorless.astype(np.uint8), smooth=False)[area] > 0
    return Crop(position, (int(left), int(top)), inside, depth_m, color, covered, height_m, delay_s, foreign)


def _heights(
    depth_m: Float32[Array, "h w"],
    corner: tuple[int, int],
    rectified: Rectification,
    camera_from_world: Float[Array, "4 4"] | None,
) -> Float32[Array, "h w"] | None:
    """Height above the table of every pixel; None where the table is not known."""
    if camera_from_world is None:
        return None
    up = camera_from_world[:3, 2]
    v, u = np.indices(depth_m.shape)
    x = (u + corner[0] - rectified.camera.cx) / rectified.camera.fx
    y = (v + corner[1] - rectified.camera.cy) / rectified.camera.fy
    height = depth_m * (up[0] * x + up[1] * y + up[2]) - up @ camera_from_world[:3, 3]
    return height.astype(np.float32)


def _covered(
    depth_m: Float32[Array, "h w"],
    inside: Bool[Array, "h w"],
    height_m: Float32[Array, "h w"] | None,
    config: ViewConfig,
) -> Bool[Array, "h w"]:
    """Where something nearer than the object's nearest mask pixel stands, the table excepted."""
    seen = inside & (depth_m > 0)
    if not seen.any():
        return np.zeros_like(inside)
    _, label = cv2.distanceTransformWithLabels((~seen).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    by_label = np.zeros(int(label.max()) + 1, dtype=np.float32)
    by_label[label[seen]] = depth_m[seen]
    covered = ~inside & (depth_m > 0) & (depth_m < by_label[label] - config.cover_m)
    if height_m is not None:
        covered &= height_m > config.above_table_m
    return np.asarray(covered)


@dataclass(frozen=True, eq=False)
class View:
    """One view: `pixels` (h, w, CHANNELS) and `samples` (n, SAMPLE) as kernels.py has them."""

    position: int
    corner: tuple[int, int]
    pixels: Float32[Array, "h w c"]
    samples: Float32[Array, "n s"]

    @property
    def center_m(self) -> Float[Array, "3"]:
        """Center of the seen surface, camera frame."""
        return np.asarray(np.median(self.samples[:, :3], axis=0), dtype=np.float64)


def make_view(
    crop: Crop, rectified: Rectification, config: ViewConfig, motion: Float[Array, "4 4"] | None = None
) -> View | None:
    """Depth made smooth, normals, levelled appearance, distance to the outline, samples.

    `motion` (4x4, camera frame) moves the object from its place at depth's exposure to that at colour's; None: at rest.
    None is returned where too few points are left.
    """
    depth_m = _cleaned(crop) if motion is None else _moved_depth(crop, rectified, motion, config)
    inside = cv2.erode(crop.mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    h, w = crop.mask.shape
    pixels = np.zeros((h, w, lay.CHANNELS), dtype=np.float32)
    rays = _ray_steps(crop.corner, rectified)
    smooth_m, normals = np.zeros((h, w), dtype=np.float32), np.zeros((h, w, 3), dtype=np.float32)
    fit_surface(depth_m, inside, rays, config.window_px, config.edge_share, smooth_m, normals)
    pixels[..., lay.Z], pixels[..., lay.NX : lay.NZ + 1] = smooth_m, normals
    outside = cv2.distanceTransform((~crop.mask).astype(np.uint8), cv2.DIST_L2, 5)
    pixels[..., lay.OUTSIDE] = np.where(crop.covered, lay.HIDDEN, outside)
    pixels[..., lay.SHARP :] = _appearance(crop, config)
    samples = _samples(pixels, rays, config, crop.position)
    return View(crop.position, crop.corner, pixels, samples) if len(samples) >= config.least_samples else None


def _ray_steps(corner: tuple[int, int], rectified: Rectification) -> Float[Array, "4"]:
    c = rectified.camera
    return np.array([1 / c.fx, 1 / c.fy, (corner[0] - c.cx) / c.fx, (corner[1] - c.cy) / c.fy])


def _cleaned(crop: Crop) -> Float32[Array, "h w"]:
    """Depth inside the mask, without what lies far from the object's bulk."""
    inside = crop.mask & (crop.depth_m > 0)
    if not inside.any():
        return np.zeros_like(crop.depth_m)
    return np.where(inside & _near_bulk(crop.depth_m, inside), crop.depth_m, np.float32(0))


def _near_bulk(depth_m: Float32[Array, "h w"], inside: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
    """Depth within the object's possible reach: no farther from its median than 1.5 times its 10-90 % spread + 5 cm."""
    low, middle, high = np.quantile(depth_m[inside], [0.1, 0.5, 0.9])
    reach = 0.05 + 1.5 * (high - low)
    return np.asarray(np.abs(depth_m - middle) < reach)


def _moved_depth(
    crop: Crop, rectified: Rectification, motion: Float[Array, "4 4"], config: ViewConfig
) -> Float32[Array, "h w"]:
    """Depth as it would have been at colour's exposure: the object's points moved, then seen again (nearest wins)."""
    dx, dy, x0, y0 = _ray_steps(crop.corner, rectified)
    depth_m = crop.depth_m.copy()
    h, w = depth_m.shape
    center = crop.depth_m[crop.mask & (crop.depth_m > 0)]
    if len(center) == 0:
        return np.zeros_like(depth_m)
    z = float(np.median(center))
    shift_px = motion[:2, :3] @ [0, 0, z] + motion[:2, 3]
    reach = int(np.ceil(np.abs(shift_px).max() / z * rectified.camera.fx)) + 2
    grown = cv2.dilate(crop.mask.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
    use = grown & (depth_m > 0) & _near_bulk(depth_m, crop.mask & (depth_m > 0))
    if crop.height_m is not None:
        use &= crop.mask | (crop.height_m > 0.5 * config.above_table_m)
    v, u = np.nonzero(use)
    points = np.stack([(x0 + dx * u), (y0 + dy * v), np.ones(len(u))], -1) * depth_m[v, u][:, None]
    moved = points @ motion[:3, :3].T + motion[:3, 3]
    uu = np.round((moved[:, 0] / moved[:, 2] - x0) / dx).astype(int)
    vv = np.round((moved[:, 1] / moved[:, 2] - y0) / dy).astype(int)
    ok = (uu >= 0) & (vv >= 0) & (uu < w) & (vv < h)
    out = np.full((h, w), np.inf, dtype=np.float32)
    np.minimum.at(out, (vv[ok], uu[ok]), moved[ok, 2].astype(np.float32))
    return np.where(np.isfinite(out) & crop.mask, out, np.float32(0))


def _appearance(crop: Crop, config: ViewConfig) -> Float32[Array, "h w 6"]:
    """Brightness divided by that around it (shading and shadows stay with the room, not with the object), and two
    differences of colour, each sharp and smooth."""
    color, mask = crop.color, crop.mask
    foreign = None if crop.colorless is None else cv2.dilate(crop.colorless.astype(np.uint8), np.ones((3, 3))) > 0
    rim_px = min(config.rim_px, config.rim_share * float(np.sqrt(mask.sum())))
    own = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) > rim_px
    weight = (own if foreign is None else own & ~foreign).astype(np.float32)
    red, green, blue = color[..., 0], color[..., 1], color[..., 2]
    gray = LUMA[0] * red + LUMA[1] * green + LUMA[2] * blue
    total = red + green + blue + 0.1
    channels = (
        config.bright_gain * (gray / (_masked_blur(gray, weight, config.shade_px) + 0.03) - 1.0),
        config.color_gain * (red - green) / total,
        config.color_gain * (blue - 0.5 * (red + green)) / total,
    )
    smooth = [_masked_blur(channel, weight, config.smooth_px) for channel in channels]
    sharp = [np.where(own, channel, blurred) for channel, blurred in zip(channels, smooth)]
    out = np.stack([*sharp, *smooth], -1).astype(np.float32)
    if foreign is not None:
        out[foreign & mask] = lay.NO_APPEARANCE
    return out


def _masked_blur(image: Float32[Array, "h w"], weight: Float32[Array, "h w"], sigma_px: float) -> Float32[Array, "h w"]:
    above = cv2.GaussianBlur(image * weight, (0, 0), sigma_px)
    return above / np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma_px), 1e-3)


def _near_jumps(depth_m: Float32[Array, "h w"], slope: float, config: ViewConfig) -> Bool[Array, "h w"]:
    """Pixels close to a step of depth between two surfaces of the object."""
    seen = depth_m > 0
    small = np.ones((3, 3), np.uint8)
    high = cv2.dilate(depth_m, small)
    low = cv2.erode(np.where(seen, depth_m, np.float32(1e3)), small)
    steps = (seen & (high - low > config.jump_m + slope * depth_m)).astype(np.uint8)
    wide = np.ones((2 * config.jump_px + 1, 2 * config.jump_px + 1), np.uint8)
    return np.asarray(cv2.dilate(steps, wide) > 0)


def _samples(
    pixels: Float32[Array, "h w c"], rays: Float[Array, "4"], config: ViewConfig, seed: int
) -> Float32[Array, "n s"]:
    v, u = np.nonzero((pixels[..., lay.Z] > 0) & ~_near_jumps(pixels[..., lay.Z], 5.0 * float(rays[0]), config))
    order = np.random.default_rng(seed).permutation(len(u))[: config.samples]
    u, v = u[order], v[order]
    seen = pixels[v, u]
    directions = np.stack([rays[2] + rays[0] * u, rays[3] + rays[1] * v, np.ones(len(u))], -1)
    points = directions * seen[:, lay.Z, None]
    return np.concatenate([points, seen[:, lay.NX : lay.NZ + 1], seen[:, lay.SHARP :]], -1).astype(np.float32)
