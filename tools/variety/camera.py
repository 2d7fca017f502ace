"""From linear light to a file: auto exposure, white balance, vignetting, defocus, noise, tone curve, JPEG."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray as Array

from variety.spec import CameraSpec

MIDDLE_GREY = (0.12, 0.28)
READ_NOISE, SHOT_NOISE = 0.003, 0.0003


class ColorCamera:
    """One toss of one camera: exposure and white balance wander over its frames."""

    def __init__(
        self, spec: CameraSpec, still: Float32[Array, "h w 3"], times_s: Float[Array, " n"], rng: np.random.Generator
    ) -> None:
        self.spec = spec
        target = np.random.default_rng(int(1e6 * spec.focal_px)).uniform(*MIDDLE_GREY)
        self._gain = target / max(float(np.mean(still)), 1e-4)
        self._exposure = 1 + spec.gain_drift * _wander(times_s, rng)
        self._white = np.stack([1 + spec.white_drift * _wander(times_s, rng) for _ in range(3)], -1)
        y, x = np.mgrid[: spec.height, : spec.width].astype(np.float32)
        off = ((x - spec.width / 2) ** 2 + (y - spec.height / 2) ** 2) / ((spec.width**2 + spec.height**2) / 4)
        self._vignette = (1 - spec.vignette * off)[..., None].astype(np.float32)

    def develop(self, light: Float32[Array, "h w 3"], frame: int, rng: np.random.Generator) -> UInt8[Array, "h w 3"]:
        """The frame's picture, sRGB."""
        sharp = light if self.spec.blur_px < 0.25 else cv2.GaussianBlur(light, (0, 0), self.spec.blur_px)
        signal = (
            sharp
            * self._vignette
            * np.float32(self._gain * self._exposure[frame])
            * self._white[frame].astype(np.float32)
        )
        dim = 0.004 / self.spec.exposure_s
        variance = (READ_NOISE * dim) ** 2 + SHOT_NOISE * dim * np.clip(signal, 0, 1)
        signal = signal + np.float32(self.spec.noise) * np.sqrt(variance) * rng.standard_normal(
            signal.shape, dtype=np.float32
        )
        return np.round(255 * tone(signal)).astype(np.uint8)


def tone(linear: Float32[Array, "*n"]) -> Float32[Array, "*n"]:
    """sRGB's curve with a shoulder: highlights from 0.8 on are rolled off instead of cut."""
    over = np.maximum(linear - 0.8, 0)
    rolled = np.where(linear > 0.8, 0.8 + 0.2 * (1 - np.exp(-over / 0.2)), np.clip(linear, 0, 0.8))
    return np.where(rolled <= 0.0031308, 12.92 * rolled, 1.055 * rolled ** (1 / 2.4) - 0.055)


def jpeg(picture: UInt8[Array, "h w 3"], quality: int) -> bytes:
    """With chroma at half the resolution, as cameras write."""
    options = [
        cv2.IMWRITE_JPEG_QUALITY,
        quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
    ]
    done, data = cv2.imencode(".jpg", picture[..., ::-1], options)
    assert done
    return data.tobytes()


def _wander(times_s: Float[Array, " n"], rng: np.random.Generator) -> Float[Array, " n"]:
    """Slow waves between -1 and 1."""
    wave = sum(
        np.sin(2 * np.pi * times_s / rng.uniform(low, high) + rng.uniform(0, 2 * np.pi))
        for low, high in ((0.6, 1.2), (1.2, 3.0))
    )
    return wave / 2
