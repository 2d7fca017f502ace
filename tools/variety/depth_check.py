"""Both depth models before the same flat wall and the same block, in the words in which depth cameras are specified."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray as Array

from acquisition.synthetic.config import DepthConfig
from acquisition.synthetic.render.sensors import DepthSensor
from recordings.geometry import Transform
from variety import appearance, stereo_depth
from variety.furniture import Item, colored, painted, placed, sheet
from variety.infrared import Pair
from variety.spec import DepthSpec
from variety.stereo_depth import BASELINE_M, FOCAL_PX, HEIGHT, WIDTH

WALL_ALBEDO = 0.6
BLOCK_M, BLOCK_AT_M, WALL_AT_M = (0.09, 0.12), 0.7, 1.2
RIM_PX, TOO_NEAR_M = 6, 0.02
Sensor = Callable[[float, bool], Float32[Array, "h w"]]
"""Depth (m) of a wall at a distance, with the block before it or without."""

PUBLISHED = {
    "median error at 1 m": "2.5 to 5 mm (librealsense issue 7806)",
    "median error at 4 m": "below 2 % = 80 mm (data sheet 337029; issues 6697, 7806)",
    "sub-pixel RMS": "0.08 px, at best 0.032 (A. Grunnet-Jepsen, librealsense issue 3904)",
    "RMS at 1 m": "2.0 mm at 0.08 px: z^2 s / (f b)",
    "smallest step": "1/32 px (white paper on subpixel linearity)",
    "fattening": "0.42 to 0.47 in photo_dev (another simulation); no published figure",
}


@dataclass(frozen=True)
class WallFigures:
    """On the middle 40 % of a wall: error of the median, RMS to the fitted plane, that in pixels, share with depth."""

    median_error_m: float
    rms_m: float
    subpixel_px: float
    fill: float


def on_wall(depth_m: Float32[Array, "h w"], distance_m: float) -> WallFigures:
    height, width = depth_m.shape
    y, x = np.mgrid[int(0.3 * height) : int(0.7 * height), int(0.3 * width) : int(0.7 * width)]
    z = depth_m[y, x].astype(np.float64)
    seen = z > 0
    if not seen.any():
        return WallFigures(float("nan"), float("nan"), float("nan"), 0.0)
    A = np.stack([x[seen], y[seen], np.ones(int(seen.sum()))], 1).astype(np.float64)
    plane = np.linalg.lstsq(A, 1 / z[seen], rcond=None)[0]
    rms = float(np.sqrt(np.mean((z[seen] - 1 / (A @ plane)) ** 2)))
    pixels = rms * FOCAL_PX * BASELINE_M / distance_m**2
    return WallFigures(float(np.median(z[seen])) - distance_m, rms, pixels, float(seen.mean()))


def fattening(depth_m: Float32[Array, "h w"]) -> float:
    """Share of the pixels with depth within RIM_PX outside the block that read more than TOO_NEAR_M too near."""
    block = block_mask()
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * RIM_PX + 1, 2 * RIM_PX + 1))
    rim = cv2.dilate(block.astype(np.uint8), kernel).astype(bool) & ~block & (depth_m > 0)
    return float((depth_m[rim] < WALL_AT_M - TOO_NEAR_M).mean())


def block_mask() -> Bool[Array, "h w"]:
    """The block in the left imager, which both models measure in here."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    u, v = (x - (WIDTH - 1) / 2) / FOCAL_PX * BLOCK_AT_M, (y - (HEIGHT - 1) / 2) / FOCAL_PX * BLOCK_AT_M
    return (np.abs(u) < BLOCK_M[0] / 2) & (np.abs(v) < BLOCK_M[1] / 2)


def parametric(distance_m: float, with_block: bool) -> Float32[Array, "h w"]:
    """The quick model with its default settings, at the pair's resolution."""
    config = DepthConfig()
    rng = np.random.default_rng(1)
    sensor = DepthSensor(config, WIDTH, HEIGHT, FOCAL_PX, rng)
    exact = np.full((HEIGHT, WIDTH), distance_m, np.float32)
    if with_block:
        exact[block_mask()] = BLOCK_AT_M
    ones = np.ones_like(exact)
    return sensor.measure(exact, ones, ones, rng).astype(np.float32) * np.float32(config.unit_m)


def matched(distance_m: float, with_block: bool) -> Float32[Array, "h w"]:
    """The infrared pair with its dots and the semi-global matcher, default preset."""
    facing = np.diag([1.0, -1.0, -1.0])
    wall = placed(sheet((6.0, 4.0), 4.0, 0.0), Transform("world", "wall", facing, np.array([0.0, 0.0, distance_m])))
    rng = np.random.default_rng(2)
    picture = appearance.plain(rng, (64, 96), np.full(3, WALL_ALBEDO))
    standing = [Item("wall", painted(wall, [picture], 8.0), appearance.Finish(0.9))]
    if with_block:
        half = (BLOCK_M[0] / 2, BLOCK_M[1] / 2)
        at = Transform("world", "block", facing, np.array([0.0, 0.0, BLOCK_AT_M]))
        block = placed(sheet(half, max(half), 0.0), at)
        standing.append(Item("block", colored(block, np.full(3, WALL_ALBEDO), rng), appearance.Finish(0.9)))
    spec = DepthSpec("default", False, 0.003, 1.0, 0.3, 1.0, 0.001)
    from_left = Transform("world", "d455", np.eye(3), np.array([stereo_depth.COLOR_FROM_LEFT_M, 0.0, 0.0]))
    pair = Pair(from_left, spec, tuple(standing), {}, rng)
    left, right = pair.pictures([[]], rng)
    return stereo_depth.depth_of(stereo_depth.match(left, right, stereo_depth.PRESETS["default"]))


MODELS: dict[str, Sensor] = {"parametric": parametric, "stereo-matched": matched}


def rows() -> list[tuple[str, str, str, str]]:
    """What, the parametric model, the stereo-matched one, what is published."""
    walls = {d: {n: on_wall(m(d, False), d) for n, m in MODELS.items()} for d in (0.6, 1.0, 2.0, 4.0)}
    found = []
    for distance, of in walls.items():
        at = f"at {distance:g} m"
        for what, get in FIGURES.items():
            said = PUBLISHED.get(f"{what} {at}", PUBLISHED.get(what, ""))
            found.append((f"{what} {at}", *(get(of[n]) for n in MODELS), said))
    shares = (f"{fattening(m(WALL_AT_M, True)):.2f}" for m in MODELS.values())
    found.append(("fattening", *shares, PUBLISHED["fattening"]))
    found.append(("smallest step", "1/32 px", "1/16 px", PUBLISHED["smallest step"]))
    return found


FIGURES: dict[str, Callable[[WallFigures], str]] = {
    "median error": lambda f: f"{1000 * f.median_error_m:+.1f} mm",
    "RMS": lambda f: f"{1000 * f.rms_m:.1f} mm",
    "sub-pixel RMS": lambda f: f"{f.subpixel_px:.3f} px",
    "with depth": lambda f: f"{100 * f.fill:.1f} %",
}
