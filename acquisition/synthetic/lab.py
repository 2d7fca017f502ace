"""`Lab`: the still part of a session (room, cameras, object, arm), and what each device sees at any time of a toss.

A driver that streams calls `color`, `g_buffer` and `depth`, `mono` at its own times; `scene.simulate` does so frame by
frame.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from numpy import ndarray as Array

from acquisition.synthetic.arm import Arm
from acquisition.synthetic.board import board_body
from acquisition.synthetic.config import MonoConfig, SceneConfig
from acquisition.synthetic.objects import shapes as objects
from acquisition.synthetic.objects.grasp import grasp
from acquisition.synthetic.objects.paint import paint_object
from acquisition.synthetic.objects.textures import WHITE
from acquisition.synthetic.planner import Motion, Planner
from acquisition.synthetic.random_draws import (
    COLOR,
    DEPTH,
    ERRORS,
    FIXED_PATTERN,
    MONO,
    MONO_PLACES,
    OBJECT,
    ROOM,
    STILL,
    exposure_times,
    generator,
    small_error,
)
from acquisition.synthetic.render import sensors
from acquisition.synthetic.render.cameras import MONO_NAMES, camera_model, look_at, mono_model, mono_pose
from acquisition.synthetic.render.optics import (
    GBuffer,
    Light,
    Placement,
    StillPicture,
    View,
    picture,
    render_g_buffer,
    still_picture,
)
from acquisition.synthetic.render.rays import Body, Placed, Standing
from acquisition.synthetic.render.room import build_room
from recordings.errors import BadInput
from recordings.geometry import Transform, rotation_exp

MIDDLE_GREY = 0.2
"""Mean linear level of a well exposed picture."""
BRIGHTEST = 0.95
"""Level that white paper reaches at the most."""
STILL_SAMPLES = (1, 16)
"""Fewest and most rays a pixel."""


class Lab:
    """What stands where and what it looks like. Everything follows from the config and its seed."""

    def __init__(self, config: SceneConfig) -> None:
        self.config = config
        self.solid = objects.build(config.object)
        self.mass = objects.mass_properties(self.solid, config.object.mass_kg)
        painted, self.object_tags = paint_object(self.solid, config.object.surface, generator(config.seed, OBJECT))
        self.object = Body("object", painted)
        self.world_from_d455 = look_at(config.camera)
        self.d455 = View(camera_model(config.camera), self.world_from_d455)
        room = build_room(config, self.world_from_d455.rotation[:2, 2], generator(config.seed, ROOM))
        self.table_tags = room.table_tags
        self.room = Standing([Body("room", mesh) for mesh in room.meshes])
        self.light = Light(config.light)
        self.arm = Arm(config.arm, grasp(config.object, self.solid)) if config.arm else None
        self.calibrated_world_from_d455, self.calibrated_world_from_base = self._calibrated()
        self.planner = Planner(config, self.solid, self.mass, self.object, self.d455, self.arm)
        fixed = generator(config.seed, FIXED_PATTERN)
        size = (config.camera.width, config.camera.height)
        self._depth_sensor = sensors.DepthSensor(config.depth, *size, self.d455.camera.fx, fixed)

    def _calibrated(self) -> tuple[Transform, Transform | None]:
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

    @cached_property
    def mono_views(self) -> tuple[View, ...]:
        """The ground-truth cameras; none where the config has none."""
        if self.config.mono is None:
            return ()
        places = [generator(self.config.seed, MONO_PLACES, k) for k in range(len(MONO_NAMES))]
        return tuple(
            View(mono_model(k, self.config.mono, rng), mono_pose(k, self.config.camera, self.config.mono, rng))
            for k, rng in enumerate(places)
        )

    @cached_property
    def still(self) -> StillPicture:
        """The room in the colour camera."""
        return self._still_of(self.d455, 0)

    @cached_property
    def mono_stills(self) -> tuple[StillPicture, ...]:
        """The room in each ground-truth camera."""
        return tuple(self._still_of(view, k + 1) for k, view in enumerate(self.mono_views))

    @cached_property
    def color_gain(self) -> float:
        """Auto exposure at the start of the session."""
        return self._auto_gain(self.still) * self.config.color.gain

    @cached_property
    def mono_gains(self) -> tuple[float, ...]:
        return tuple(self._auto_gain(still) for still in self.mono_stills)

    def _auto_gain(self, still: StillPicture) -> float:
        """A middle grey on average, but white paper in full light is not blown out: bloomed tags would have shrunk."""
        light = self.config.light
        whitest = WHITE * (light.key + light.fill + light.ambient)
        return min(MIDDLE_GREY / float(still.radiance.mean()), BRIGHTEST / whitest)

    def _still_of(self, view: View, number: int) -> StillPicture:
        samples = int(np.clip(self.config.still_rays / (view.camera.width * view.camera.height), *STILL_SAMPLES))
        return still_picture(view, self.room, self.light, generator(self.config.seed, STILL, number), samples)

    def plan(self, toss: int) -> Motion:
        """The motion of a toss."""
        return self.planner.plan(toss)

    def placed(self, motion: Motion, time_s: float) -> list[Placed]:
        """Everything that moves, at an instant: the object first, then the arm's links."""
        found = [Placed(self.object, motion.object.at(time_s))]
        if self.arm is not None and motion.swing is not None:
            found += self.arm.placed(motion.swing, time_s)
        return found

    def color(self, motion: Motion, time_s: float, index: int, brightness: float = 1.0) -> UInt8[Array, "h w 3"]:
        """The colour image whose exposure is centred on `time_s`."""
        rng = generator(self.config.seed, COLOR, motion.toss, index)
        return self._color(lambda t: self.placed(motion, t), time_s, brightness, rng)

    def _color(
        self, moving: Placement, time_s: float, brightness: float, rng: np.random.Generator
    ) -> UInt8[Array, "h w 3"]:
        config = self.config.color
        times = exposure_times(time_s, config.exposure_s, config.subframes)
        light = picture(self.d455, self.still, self.light, moving, times, rng)
        signal = sensors.exposed(light, self.color_gain * brightness, config.exposure_s, config.noise, rng)
        return sensors.color_image(signal)

    def g_buffer(self, motion: Motion, time_s: float) -> GBuffer:
        """What is exactly in front of each pixel of the colour camera."""
        return render_g_buffer(self.d455, self.still, self.placed(motion, time_s))

    def depth(self, seen: GBuffer, toss: int, index: int) -> UInt16[Array, "h w"]:
        """The depth image that the sensor makes of a G-buffer."""
        rng = generator(self.config.seed, DEPTH, toss, index)
        return self._depth_sensor.measure(seen.depth_m, seen.facing, self._weakness(seen), rng)

    def _weakness(self, seen: GBuffer) -> Float32[Array, "h w"]:
        """Dark surfaces return little of the projector's pattern, glossy ones mirror it away or into the lens."""
        weak = np.ones(seen.depth_m.shape, np.float32)
        on_object = seen.mask([0])
        if self.config.object.surface == "dark":
            weak[on_object] = 1.8
        elif self.config.object.surface == "glossy":
            weak[on_object] = 1.3
            weak[on_object & (seen.facing > 0.99)] = 4.0
        return weak

    def mono(self, number: int, motion: Motion, time_s: float, index: int) -> UInt8[Array, "h w"]:
        """The image of ground-truth camera `number` whose exposure is centred on `time_s`."""
        rng = generator(self.config.seed, MONO, motion.toss, index, number)
        return self._mono(number, lambda t: self.placed(motion, t), time_s, rng)

    def _mono(self, number: int, moving: Placement, time_s: float, rng: np.random.Generator) -> UInt8[Array, "h w"]:
        config = self.mono_config
        times = exposure_times(time_s, config.exposure_s, config.subframes)
        light = picture(self.mono_views[number], self.mono_stills[number], self.light, moving, times, rng)
        gain = self.mono_gains[number]
        return sensors.mono_image(sensors.exposed(sensors.grey(light), gain, config.exposure_s, config.noise, rng))

    @property
    def mono_config(self) -> MonoConfig:
        if self.config.mono is None:
            raise BadInput("this synthetic lab has no ground-truth cameras; set SceneConfig.mono to a MonoConfig")
        return self.config.mono

    @cached_property
    def _board(self) -> Body:
        return board_body()

    def board_view(
        self, number: int, world_from_board: Transform
    ) -> tuple[UInt8[Array, "h w 3"], UInt16[Array, "h w"], list[Array]]:
        """The calibration board at rest, seen by all cameras: colour, depth in the device's unit, mono images."""
        placed = [Placed(self._board, Transform("world", "body", *_parts(world_from_board)))]
        seen = render_g_buffer(self.d455, self.still, placed)
        rngs = [generator(self.config.seed, MONO_PLACES, 1000 + number, k) for k in range(2 + len(self.mono_views))]
        plain = np.ones(seen.depth_m.shape, np.float32)
        depth = self._depth_sensor.measure(seen.depth_m, seen.facing, plain, rngs[0])
        color = self._color(lambda t: placed, 0.0, 1.0, rngs[1])
        monos = [self._mono(k, lambda t: placed, 0.0, rngs[2 + k]) for k in range(len(self.mono_views))]
        return color, depth, monos


def _parts(transform: Transform) -> tuple[Array, Array]:
    return transform.rotation, transform.translation_m
