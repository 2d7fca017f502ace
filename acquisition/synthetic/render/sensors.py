"""From light and exact depth to what the devices deliver: colour, mono, a D455's depth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8, UInt16
from numpy import ndarray as Array

from acquisition.synthetic.config import DepthConfig, DepthPreset

READ_NOISE, SHOT_NOISE = 0.002, 0.0002
"""Standard deviation of the dark signal, and variance per unit of signal, of a 4 ms exposure (full scale 1)."""
REFERENCE_EXPOSURE_S = 0.004
REFERENCE_WIDTH_PX = 640
EDGE_STEP_PX = 1.2
"""A jump of disparity that the matcher's window smears."""


@dataclass(frozen=True)
class EdgeManner:
    """How a matcher treats the rim of things. Reaches in pixels of a 640 px wide image, the rest are shares."""

    reach_px: float
    fattened: float
    flying: float
    dropped: float
    holes: float
    filled_shadow: float
    grazing_cos: float


MANNERS: dict[DepthPreset, EdgeManner] = {
    "default": EdgeManner(1.5, 0.45, 0.10, 0.30, 1.0, 0.15, 0.13),
    "high-accuracy": EdgeManner(1.0, 0.20, 0.02, 0.65, 2.5, 0.0, 0.2),
    "high-density": EdgeManner(3.0, 0.75, 0.25, 0.05, 0.2, 0.8, 0.08),
}


def to_srgb(linear: Float32[Array, "*n"]) -> Float32[Array, "*n"]:
    """sRGB's transfer curve, 0..1 to 0..1."""
    clipped = np.clip(linear, 0, 1)
    return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** np.float32(1 / 2.4) - 0.055)


def exposed(
    radiance: Float32[Array, "*n"], gain: float, exposure_s: float, noise: float, rng: np.random.Generator
) -> Float32[Array, "*n"]:
    """Linear signal with shot and read noise. A shorter exposure needs more amplification, so it is noisier."""
    signal = np.float32(gain) * radiance
    amplified = REFERENCE_EXPOSURE_S / exposure_s
    variance = READ_NOISE**2 * amplified**2 + SHOT_NOISE * amplified * np.clip(signal, 0, 1)
    sigma = np.float32(noise) * np.sqrt(variance).astype(np.float32)
    return signal + sigma * rng.standard_normal(signal.shape, dtype=np.float32)


def color_image(signal: Float32[Array, "h w 3"]) -> UInt8[Array, "h w 3"]:
    """sRGB 8 bit."""
    return np.round(255 * to_srgb(signal)).astype(np.uint8)


def grey(radiance: Float32[Array, "h w 3"]) -> Float32[Array, "h w"]:
    """What a monochrome sensor makes of colours."""
    return radiance @ np.array([0.3, 0.55, 0.15], np.float32)


def mono_image(signal: Float32[Array, "h w"]) -> UInt8[Array, "h w"]:
    """Linear 8-bit grey (a machine-vision camera with gamma 1)."""
    return np.round(255 * np.clip(signal, 0, 1)).astype(np.uint8)


class DepthSensor:
    """A D455's depth for one session: its fixed pattern stays, the rest is new in every frame."""

    def __init__(self, config: DepthConfig, width: int, height: int, focal_px: float, rng: np.random.Generator) -> None:
        self.config = config
        self._focal_px = focal_px
        self._scale = width / REFERENCE_WIDTH_PX
        self._fixed = self._grain(rng, (height, width))

    def measure(
        self,
        depth_m: Float32[Array, "h w"],
        facing: Float32[Array, "h w"],
        weakness: Float32[Array, "h w"],
        rng: np.random.Generator,
    ) -> UInt16[Array, "h w"]:
        """Depth in the device's unit, 0 where there is no return.

        `facing`: cosine between ray and surface normal. `weakness` >= 1 multiplies noise and holes where the surface
        gives the projector's pattern back badly (dark, glossy).
        """
        config, manner = self.config, MANNERS[self.config.preset]
        exact = np.where(np.isfinite(depth_m), depth_m, 1e3)
        disparity = (config.stereo_focal_px * config.baseline_m / exact).astype(np.float32)
        shadow = self._shadow(disparity)
        smeared, dropped = self._edges(disparity, manner, rng)
        if manner.filled_shadow > 0:  # a dense preset invents what lies there: the ground, here what is really there
            shadow = shadow & (_level(_smooth(rng, shadow.shape, 3 * self._scale)) >= manner.filled_shadow)
        tilt = np.clip(1.0 / np.maximum(facing, 0.25), 1.0, 2.5)
        noisy = smeared + self._noise(rng, disparity.shape) * weakness * np.sqrt(tilt)
        noisy = np.round(noisy / config.quantum_px) * config.quantum_px
        z = config.stereo_focal_px * config.baseline_m / np.maximum(noisy, 1e-3) * config.scale
        none = shadow | dropped | self._holes(weakness, manner, rng) | self._grazing(facing, manner, rng)
        none |= (z < config.nearest_m) | (z > config.farthest_m) | ~np.isfinite(depth_m)
        return np.where(none, 0, np.round(z / config.unit_m)).astype(np.uint16)

    def _noise(self, rng: np.random.Generator, shape: tuple[int, int]) -> Float32[Array, "h w"]:
        share = self.config.fixed_share
        mixed = np.sqrt(share) * self._fixed + np.sqrt(1 - share) * self._grain(rng, shape)
        return (self.config.noise * mixed).astype(np.float32)

    def _grain(self, rng: np.random.Generator, shape: tuple[int, int]) -> Float32[Array, "h w"]:
        fine = _smooth(rng, shape, 1.4 * self._scale) * self.config.fine_sigma_px
        return fine + _smooth(rng, shape, 20.0 * self._scale) * self.config.coarse_sigma_px

    def _shadow(self, disparity: Float32[Array, "h w"]) -> Bool[Array, "h w"]:
        """What the pair's other eye, to the right, cannot see: something nearer lies in the way."""
        shift = disparity * np.float32(self._focal_px / self.config.stereo_focal_px)
        seen_at = np.arange(disparity.shape[1], dtype=np.float32) - shift
        in_front = np.minimum.accumulate(seen_at[:, ::-1], axis=1)[:, ::-1]
        return in_front < seen_at - 0.7

    def _edges(
        self, disparity: Float32[Array, "h w"], manner: EdgeManner, rng: np.random.Generator
    ) -> tuple[Float32[Array, "h w"], Bool[Array, "h w"]]:
        reach = max(1, round(manner.reach_px * self._scale))
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        nearest = cv2.dilate(disparity, kernel)
        rim = nearest - disparity > EDGE_STEP_PX
        band = rim | (disparity - cv2.erode(disparity, np.ones((3, 3))) > EDGE_STEP_PX)
        luck = _level(_smooth(rng, disparity.shape, 1.2 * self._scale))
        out = np.where(rim & (luck < manner.fattened), nearest, disparity)
        flying = band & (rng.random(disparity.shape, dtype=np.float32) < manner.flying)
        mix = rng.random(disparity.shape, dtype=np.float32)
        out = np.where(flying, mix * nearest + (1 - mix) * cv2.erode(disparity, kernel), out)
        dropped = band & ~flying & (_level(_smooth(rng, disparity.shape, 0.8 * self._scale)) < manner.dropped)
        return out.astype(np.float32), dropped

    def _holes(
        self, weakness: Float32[Array, "h w"], manner: EdgeManner, rng: np.random.Generator
    ) -> Bool[Array, "h w"]:
        blobs = _smooth(rng, weakness.shape, 1.8 * self._scale)
        share = np.clip(0.0006 * manner.holes * self.config.noise * weakness**4, 0, 0.6)
        return _level(blobs) < share

    def _grazing(
        self, facing: Float32[Array, "h w"], manner: EdgeManner, rng: np.random.Generator
    ) -> Bool[Array, "h w"]:
        luck = _level(_smooth(rng, facing.shape, 1.2 * self._scale))
        return facing < manner.grazing_cos * (0.6 + 0.8 * luck)


def _smooth(rng: np.random.Generator, shape: tuple[int, int], sigma_px: float) -> Float32[Array, "h w"]:
    """Gaussian noise of unit variance, correlated over `sigma_px`."""
    if sigma_px > 6:
        small = (max(4, int(shape[0] * 3 / sigma_px)), max(4, int(shape[1] * 3 / sigma_px)))
        coarse = cv2.resize(_smooth(rng, small, 3.0), (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
        return coarse
    white = rng.standard_normal(shape, dtype=np.float32)
    if sigma_px < 0.3:
        return white
    blurred = cv2.GaussianBlur(white, (0, 0), sigma_px)
    # a Gaussian kernel of sigma s keeps 1 / (4 pi s^2) of white noise's variance; exact value from the kernel itself
    kernel = cv2.getGaussianKernel(int(6 * sigma_px + 1) | 1, sigma_px)
    return blurred / np.float32((kernel**2).sum())


def _level(normal: Float32[Array, "h w"]) -> Float32[Array, "h w"]:
    """Gaussian noise to even noise in 0..1."""
    return (0.5 * (1 + _erf(normal * np.float32(0.70710678)))).astype(np.float32)


def _erf(x: Float32[Array, "h w"]) -> Float32[Array, "h w"]:
    from scipy.special import erf

    return erf(x)
