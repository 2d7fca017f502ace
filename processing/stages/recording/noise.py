"""Stage `noise`: how depth errs on the table of the static scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from processing.run import CAMERA, Run, toss_keys
from processing.segment.background.static_scene import StaticScene
from processing.sensor.noise import PUBLISHED, DepthNoise, measured_noise
from processing.store import Done

VERSION = 1
FRAMES = 3


@dataclass(frozen=True)
class NoiseResult:
    """Frames whose table was large enough, and the medians over them (published figures where there is none): standard
    deviation of depth at 1 m (m), pixels that err as one."""

    frames: int
    sigma_at_1m: float
    patch_px: float

    @property
    def noise(self) -> DepthNoise:
        """As the estimators use it."""
        return DepthNoise(self.sigma_at_1m, self.patch_px)


def measure_noise(run: Run, scene: Done) -> Done[NoiseResult]:
    """On frames spread over the first toss. Without a calibrated table what the scene shows there is taken for it:
    then planes only are measured."""
    toss = run.recorded[0]

    def compute(_: Path) -> NoiseResult:
        frames = run.session.toss(toss).rgbd(CAMERA)
        background = StaticScene.read(scene.folder)
        rays = run.camera.pixel_rays()
        rays = rays / np.maximum(rays[..., 2:], 1e-9)
        chosen = np.unique(np.linspace(0, len(frames) - 1, FRAMES).astype(int))
        found = [measured_noise(frames[int(i)].depth_m, background.table_depth_m, rays) for i in chosen]
        measured = [n for n in found if n is not None] or [PUBLISHED]
        sigma, patch = (float(np.median([getattr(n, name) for n in measured])) for name in ("sigma_at_1m", "patch_px"))
        return NoiseResult(sum(n is not None for n in found), sigma, patch)

    return run.store.run("noise", VERSION, {}, {"scene": scene.key, **toss_keys(run, toss)}, NoiseResult, compute)
