"""The synthetic lab: one config in, tosses with everything that devices would give and everything that is true.

`Lab` is the still part of a session (room, cameras, object); `Lab.plan` makes the motion of one toss; `simulate` renders
a whole toss. A driver that streams calls `Lab.color`, `Lab.depth`, `Lab.mono` at its own times.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8, UInt16
from numpy import ndarray as Array

from acquisition.synthetic import objects, sensors
from acquisition.synthetic.arm import FORWARD_S, Arm, Swing
from acquisition.synthetic.config import CameraConfig, SceneConfig
from acquisition.synthetic.grasp import grasp
from acquisition.synthetic.motion import Instants, Release, Trajectory, unseen_hand
from acquisition.synthetic.optics import Light, Sight, StillPicture, View, picture, sight, still_picture
from acquisition.synthetic.paint import paint_object
from acquisition.synthetic.physics import Table
from acquisition.synthetic.rays import Body, Placed, Standing
from acquisition.synthetic.room import TABLE_HALF_M, build_room
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform, rotation_exp
from recordings.progress import Progress, Silent

MIDDLE_GREY = 0.2
"""Mean linear level of a well exposed picture."""
TRIES = 200
NEAREST_OBJECT_M = 0.3
STILL_SAMPLES_PX = 3_200_000
"""Rays spent on a still picture: 10 a pixel at 640x480."""


@dataclass(frozen=True, eq=False)
class Motion:
    """One toss, before anything is rendered. `free_s`: the fingers have let go (the release, where there is no arm)."""

    toss: int
    object: Trajectory
    instants: Instants
    free_s: float
    swing: Swing | None = None


@dataclass(frozen=True, eq=False)
class SyntheticFrame:
    """One colour image with its depth and what is true about them. Times are true times on the toss's clock."""

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
class SyntheticToss:
    """Everything of one toss."""

    motion: Motion
    frames: tuple[SyntheticFrame, ...]
    dropped: tuple[int, ...]


def generator(*key: int) -> np.random.Generator:
    """The random numbers of one purpose: the same key, the same numbers."""
    return np.random.default_rng(np.random.SeedSequence(key))


ROOM, OBJECT, TOSS, FIXED_PATTERN, STILL, COLOR, DEPTH, MONO, TIMES, ERRORS = range(10)


class Lab:
    """The still part of a session: what stands where, what it looks like."""

    def __init__(self, config: SceneConfig) -> None:
        self.config = config
        self.solid = objects.build(config.object)
        self.mass = objects.mass_properties(self.solid, config.object.mass_kg)
        painted, self.object_tags = paint_object(self.solid, config.object.surface, generator(config.seed, OBJECT))
        self.object = Body("object", painted)
        self.world_from_d455 = look_at(config.camera)
        self.arm = Arm(config.arm, grasp(config.object, self.solid)) if config.arm else None
        self.believed_world_from_d455, self.believed_world_from_base = self._believed()
        facing = self.world_from_d455.rotation[:2, 2]
        room = build_room(config, facing / np.linalg.norm(facing), generator(config.seed, ROOM))
        self.table_tags = room.table_tags
        self.room = Standing([Body("room", mesh) for mesh in room.meshes])
        self.light = Light(config.light)
        self.d455 = View(camera_model(config.camera), self.world_from_d455)
        self._depth_sensor = sensors.DepthSensor(
            config.depth,
            config.camera.width,
            config.camera.height,
            self.d455.camera.fx,
            generator(config.seed, FIXED_PATTERN),
        )

    @cached_property
    def table(self) -> Table:
        return Table(self.solid, self.mass, self.config.contact)

    @cached_property
    def still(self) -> StillPicture:
        """The room in the colour camera."""
        return self._still_of(self.d455, 0)

    @cached_property
    def color_gain(self) -> float:
        """Auto exposure at the start of the session."""
        return MIDDLE_GREY / float(self.still.radiance.mean()) * self.config.color.gain

    def _still_of(self, view: View, number: int) -> StillPicture:
        samples = int(np.clip(STILL_SAMPLES_PX / (view.camera.width * view.camera.height), 4, 16))
        return still_picture(view, self.room, self.light, generator(self.config.seed, STILL, number), samples)

    def _believed(self) -> tuple[Transform, Transform | None]:
        """world_from_d455 and world_from_base as the calibration has them: each off by its own error, and both by one
        of the plane that defines the world."""
        errors, rng = self.config.errors, generator(self.config.seed, ERRORS)
        camera = small_error("d455", errors.camera_m, errors.camera_deg, rng)
        tilt = rng.uniform(0, 2 * np.pi)
        turned = rotation_exp(np.deg2rad(errors.plane_deg) * np.array([np.cos(tilt), np.sin(tilt), 0.0]))
        plane = Transform("world", "world", turned, np.array([0.0, 0.0, errors.plane_m * rng.choice([-1, 1])]))
        if self.arm is None:
            return plane @ self.world_from_d455 @ camera, None
        base = small_error(self.arm.robot.root, errors.base_m, errors.base_deg, rng)
        return plane @ self.world_from_d455 @ camera, plane @ self.arm.world_from_base @ base

    def placed(self, motion: Motion, time_s: float) -> list[Placed]:
        """Everything that moves, at an instant: the object first."""
        found = [Placed(self.object, motion.object.at(time_s))]
        if self.arm is not None and motion.swing is not None:
            found += self.arm.placed(motion.swing, time_s)
        return found

    def color(self, motion: Motion, time_s: float, index: int, brightness: float = 1.0) -> UInt8[Array, "h w 3"]:
        """The colour image whose exposure is centred on `time_s`."""
        config = self.config.color
        rng = generator(self.config.seed, COLOR, motion.toss, index)
        times = exposure_times(time_s, config.exposure_s, config.subframes)
        light = picture(self.d455, self.still, self.light, lambda t: self.placed(motion, t), times, rng)
        signal = sensors.exposed(light, self.color_gain * brightness, config.exposure_s, config.noise, rng)
        return sensors.color_image(signal)

    def sight(self, motion: Motion, time_s: float) -> Sight:
        """What is exactly in front of each pixel of the colour camera."""
        return sight(self.d455, self.still, self.placed(motion, time_s))

    def depth(self, seen: Sight, toss: int, index: int) -> UInt16[Array, "h w"]:
        """The depth image that the sensor makes of a sight."""
        rng = generator(self.config.seed, DEPTH, toss, index)
        return self._depth_sensor.measure(seen.depth_m, seen.facing, self._weakness(seen), rng)

    def _weakness(self, seen: Sight) -> Float32[Array, "h w"]:
        """Dark surfaces return little of the projector's pattern, glossy ones mirror it away or into the lens."""
        weak = np.ones(seen.depth_m.shape, np.float32)
        on_object = seen.mask([0])
        if self.config.object.surface == "dark":
            weak[on_object] = 1.8
        elif self.config.object.surface == "glossy":
            weak[on_object] = 1.3
            weak[on_object & (seen.facing > 0.99)] = 4.0
        return weak

    def plan(self, toss: int) -> Motion:
        """The motion of one toss: drawn again until the camera sees all of it and it ends at rest on the table."""
        rng = generator(self.config.seed, TOSS, toss)
        for _ in range(TRIES):
            motion = self._attempt(toss, rng)
            if motion is not None:
                return motion
        raise BadInput(
            f"seed {self.config.seed}, toss {toss}: none of {TRIES} tosses stays in the camera's view and comes to "
            "rest on the table; lower the speeds, shorten hold and lead-in, or move the camera away"
        )

    def _attempt(self, toss: int, rng: np.random.Generator) -> Motion | None:
        config = self.config.motion
        release = draw_release(self.config, self.object.radius_m, rng)
        release_s, swing = config.hold_s + config.lead_in_s, None
        free_s = release_s
        if self.arm is None:
            before = unseen_hand(release, config.hold_s, config.lead_in_s, 0.001)
        else:
            release_s = config.hold_s + self.arm.config.wind_up_s + FORWARD_S
            free_s = release_s + self.arm.config.finger_open_s
            swing = self.arm.plan(release, rng.uniform(-0.5, 0.5), release_s)
            if swing is None:
                return None
            sideways = rng.uniform(0, 2 * np.pi)
            slip = self.arm.config.slip_m * np.array([np.cos(sideways), 0.0, np.sin(sideways)])
            before, release = self.arm.carry(swing, slip, free_s, 0.004)
        if not self._all_seen(before):
            return None
        after, impact_s, rest_s = self.table.drop(release, free_s, config.longest_free_s, config.rest_s)
        if not (np.isfinite(impact_s) and np.isfinite(rest_s) and self._all_seen(after)):
            return None
        instants = Instants(config.hold_s, release_s, impact_s, rest_s, rest_s + config.rest_s)
        return Motion(toss, before.joined(after), instants, free_s, swing)

    def _all_seen(self, part: Trajectory) -> bool:
        """Whether the object is inside the image, above the table's height and over the table, all the time."""
        camera = self.d455.camera
        for time_s in part.times_s[:: max(1, len(part.times_s) // 40)]:
            corners = part.at(time_s).points(self.object.corners_m)
            local = self.d455.camera_from_world.points(corners)
            if local[:, 2].min() < NEAREST_OBJECT_M or not camera.sees(camera.project(local)).all():
                return False
            if corners[:, 2].min() < -0.03 or (np.abs(corners[:, :2]) > TABLE_HALF_M).any():
                return False
        return True


def look_at(config: CameraConfig) -> Transform:
    """world_from_d455: at a distance, elevation and azimuth from a point above the table's centre, looking at it."""
    azimuth, elevation = np.deg2rad(config.azimuth_deg), np.deg2rad(config.elevation_deg)
    away = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    return aimed("d455", np.array([0.0, 0.0, config.aim_height_m]) + config.distance_m * away, -away)


def aimed(frame: str, position_m: Float[Array, "3"], forward: Float[Array, "3"]) -> Transform:
    """world_from_<frame> of an upright camera at a position that looks along `forward`."""
    z = forward / np.linalg.norm(forward)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return Transform("world", frame, np.stack([x, np.cross(z, x), z], 1), position_m)


def camera_model(config: CameraConfig) -> CameraModel:
    scale = config.width / 640
    dx, dy = config.principal_offset_px
    K = np.array(
        [
            [config.focal_px * scale, 0.0, (config.width - 1) / 2 + dx * scale],
            [0.0, config.focal_px * scale, (config.height - 1) / 2 + dy * scale],
            [0.0, 0.0, 1.0],
        ]
    )
    return CameraModel("d455", config.width, config.height, K, *lens(config.distortion))


def lens(distortion: tuple[float, ...]) -> tuple:
    """Distortion model and coefficients as CameraModel takes them."""
    return ("brown-conrady", distortion) if any(distortion) else ("none", ())


def exposure_times(time_s: float, exposure_s: float, count: int) -> list[float]:
    """Middles of `count` equal parts of the exposure."""
    return [time_s + exposure_s * ((k + 0.5) / count - 0.5) for k in range(count)]


def draw_release(config: SceneConfig, radius_m: float, rng: np.random.Generator) -> Release:
    """A random release state that should end near the target."""
    motion = config.motion
    vary = 1 + motion.spread * np.clip(rng.standard_normal(3), -2, 2)
    forward, upward, spin = np.maximum(vary, 0.1) * [
        motion.forward_speed_m_s,
        motion.upward_speed_m_s,
        motion.spin_rad_s,
    ]
    heading = rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(heading), np.sin(heading), 0.0])
    gravity = config.contact.gravity_m_s2
    fall_m = max(motion.release_height_m - 0.6 * radius_m, 0.0)
    flight_s = (upward + np.sqrt(upward**2 + 2 * gravity * fall_m)) / gravity
    slide_m = 0.5 * forward**2 / (2 * gravity * max(config.contact.friction, 0.05))
    target = np.array([*motion.target_m, 0.0]) + np.append(rng.normal(0, motion.target_spread_m, 2), 0.0)
    start = target - direction * (forward * flight_s + slide_m) + [0.0, 0.0, motion.release_height_m]
    axis = rng.standard_normal(3)
    rotation = rotation_exp(rng.uniform(0, np.pi) * _unit(rng.standard_normal(3)))
    return Release(
        Transform("world", "object", rotation, start),
        forward * direction + [0.0, 0.0, upward],
        spin * _unit(axis),
    )


def small_error(frame: str, length_m: float, angle_deg: float, rng: np.random.Generator) -> Transform:
    """A shift and a turn of exactly these sizes in random directions."""
    shift, axis = _unit(rng.standard_normal(3)), _unit(rng.standard_normal(3))
    return Transform(frame, frame, rotation_exp(np.deg2rad(angle_deg) * axis), length_m * shift)


def _unit(vector: Float[Array, "3"]) -> Float[Array, "3"]:
    return vector / np.linalg.norm(vector)


def brightness_course(config: SceneConfig, toss: int, times_s: Float[Array, " n"]) -> Float[Array, " n"]:
    """Brightness of each frame against the first exposure setting: slow waves, `drift` at the most."""
    rng = generator(config.seed, COLOR, toss)
    wave = sum(
        np.sin(2 * np.pi * times_s / rng.uniform(*periods) + rng.uniform(0, 2 * np.pi))
        for periods in ((1.0, 2.5), (0.6, 1.2))
    )
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


def simulate(
    config: SceneConfig, toss: int = 0, lab: Lab | None = None, progress: Progress | None = None
) -> SyntheticToss:
    """Simulate and render one toss. Several tosses of one session share a `Lab`, which keeps the still pictures."""
    lab = lab or Lab(config)
    progress = progress or Silent()
    motion = lab.plan(toss)
    times, kept, dropped = frame_times(config, toss, motion.instants.end_s)
    brightness = brightness_course(config, toss, times)
    frames = []
    for done, nominal in enumerate(kept):
        frames.append(_frame(lab, motion, nominal, float(times[nominal]), float(brightness[nominal])))
        progress.step(done + 1, len(kept), f"toss {toss}")
    return SyntheticToss(motion, tuple(frames), tuple(dropped))


def _frame(lab: Lab, motion: Motion, nominal: int, time_s: float, brightness: float) -> SyntheticFrame:
    delay_s = lab.config.depth.delay_s
    seen = lab.sight(motion, time_s)
    depth_seen = seen if delay_s == 0 else lab.sight(motion, time_s + delay_s)
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
