"""One config in, one toss out: everything that the devices would give, and everything that is true.

    toss = simulate(SceneConfig(seed=3, object=ObjectConfig("mug", surface="plain")))

Several tosses of one session share a `Lab`, which keeps the still pictures: `simulate(config, toss, lab)`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8, UInt16
from numpy import ndarray as Array

from acquisition.synthetic.config import SceneConfig
from acquisition.synthetic.lab import Lab
from acquisition.synthetic.planner import Motion
from acquisition.synthetic.random_draws import ARM_NOISE, COLOR, TIMES, generator
from recordings.geometry import Transform
from recordings.progress import Progress, Silent

ARM_AFTER_LAST_FRAME_S = 0.02


@dataclass(frozen=True, eq=False)
class SyntheticFrame:
    """One colour image with its depth and what is true about them. Times are true times on the toss's clock.

    `depth_raw` is in the device's unit; `mask` is the object's visible part at `time_s`, `robot_mask` the arm's (None
    without an arm), `depth_exact_object_m` the depth along the axis on the mask's pixels, 0 elsewhere.
    """

    nominal: int
    time_s: float
    depth_time_s: float
    color_rgb: UInt8[Array, "h w 3"]
    depth_raw: UInt16[Array, "h w"]
    mask: Bool[Array, "h w"]
    robot_mask: Bool[Array, "h w"] | None
    depth_exact_object_m: Float32[Array, "h w"]
    world_from_object: Transform
    brightness: float


@dataclass(frozen=True, eq=False)
class MonoShot:
    """The three ground-truth images of one trigger."""

    time_s: float
    images: tuple[UInt8[Array, "h w"], ...]
    world_from_object: Transform


@dataclass(frozen=True, eq=False)
class SyntheticToss:
    """Everything of one toss. `arm_states`: rows time_s, q1..q7, dq1..dq7, finger_width_m; None without an arm."""

    motion: Motion
    frames: tuple[SyntheticFrame, ...]
    dropped: tuple[int, ...]
    mono: tuple[MonoShot, ...]
    arm_states: Float[Array, "n 16"] | None


def simulate(
    config: SceneConfig, toss: int = 0, lab: Lab | None = None, progress: Progress | None = None
) -> SyntheticToss:
    """Simulate and render toss number `toss`. The same config and number give the same bytes."""
    lab = lab or Lab(config)
    progress = progress or Silent()
    motion = lab.plan(toss)
    times, kept, dropped = frame_times(config, toss, motion.instants.end_s)
    brightness = brightness_over_time(config, toss, times)
    frames = []
    for done, nominal in enumerate(kept):
        frames.append(_frame(lab, motion, nominal, float(times[nominal]), float(brightness[nominal])))
        progress.step(done + 1, len(kept), f"toss {toss}")
    end_s = float(times[kept[-1]]) + ARM_AFTER_LAST_FRAME_S
    states = None
    if lab.arm is not None and motion.swing is not None:
        states = lab.arm.states(motion.swing, end_s, generator(config.seed, ARM_NOISE, toss))
    return SyntheticToss(motion, tuple(frames), tuple(dropped), _mono_shots(lab, motion), states)


def brightness_over_time(config: SceneConfig, toss: int, times_s: Float[Array, " n"]) -> Float[Array, " n"]:
    """Brightness of each frame against the first exposure setting: slow waves, `drift` at the most."""
    rng = generator(config.seed, COLOR, toss)
    wave = np.zeros_like(times_s)
    for shortest_s, longest_s in ((1.0, 2.5), (0.6, 1.2)):
        wave += np.sin(2 * np.pi * times_s / rng.uniform(shortest_s, longest_s) + rng.uniform(0, 2 * np.pi))
    return 1 + config.color.drift * wave / max(float(np.abs(wave).max()), 1e-9)


def frame_times(config: SceneConfig, toss: int, end_s: float) -> tuple[Float[Array, " n"], list[int], list[int]]:
    """Mid-exposure times of the nominal grid with jitter (the first is 0), which frames are kept, which dropped."""
    rng = generator(config.seed, TIMES, toss)
    count = int(end_s * config.camera.fps) + 1
    times = np.arange(count) / config.camera.fps + config.camera.time_jitter_s * rng.standard_normal(count)
    times[0] = 0.0
    lost = rng.random(count) < config.camera.dropped_share
    lost[[0, -1]] = False
    return times, np.flatnonzero(~lost).tolist(), np.flatnonzero(lost).tolist()


def _frame(lab: Lab, motion: Motion, nominal: int, time_s: float, brightness: float) -> SyntheticFrame:
    delay_s = lab.config.depth.delay_s
    seen = lab.g_buffer(motion, time_s)
    depth_seen = seen if delay_s == 0 else lab.g_buffer(motion, time_s + delay_s)
    mask = seen.mask([0])
    return SyntheticFrame(
        nominal,
        time_s,
        time_s + delay_s,
        lab.color(motion, time_s, nominal, brightness),
        lab.depth(depth_seen, motion.toss, nominal),
        mask,
        seen.owner > 0 if motion.swing is not None else None,
        np.where(mask, seen.depth_m, 0).astype(np.float32),
        motion.object.at(time_s),
        brightness,
    )


def _mono_shots(lab: Lab, motion: Motion) -> tuple[MonoShot, ...]:
    config = lab.config.mono
    if config is None or (config.tosses is not None and motion.toss not in config.tosses):
        return ()
    fps = lab.config.camera.fps
    shots = []
    for k in range(int((motion.instants.end_s - config.trigger_delay_s) * fps) + 1):
        time_s = k / fps + config.trigger_delay_s
        images = tuple(lab.mono(number, motion, time_s, k) for number in range(len(lab.mono_views)))
        shots.append(MonoShot(time_s, images, motion.object.at(time_s)))
    return tuple(shots)
