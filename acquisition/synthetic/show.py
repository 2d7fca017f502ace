"""What the simulated devices show: the scene's cameras and arm behind a `SyntheticConfig`, rendered toss by toss.

With `pictures = "pool"` nothing is rendered: noisy pictures of the right size in turn, for rates and endurance.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.arm.toss import TossPlan
from acquisition.devices import JointTrajectory
from acquisition.synthetic.arm import FORWARD_S, OPEN_M, READY_RAD, Swing
from acquisition.synthetic.board import board_before, held_board_poses
from acquisition.synthetic.config import (
    ArmConfig,
    CameraConfig,
    ColorConfig,
    DepthConfig,
    MonoConfig,
    MotionConfig,
    ObjectConfig,
    SceneConfig,
)
from acquisition.synthetic.motion import Instants, Trajectory
from acquisition.synthetic.performance import Performance, Reel, perform
from acquisition.synthetic.planner import Motion
from acquisition.synthetic.random_draws import BOARD, generator
from acquisition.synthetic.render.cameras import MONO_NAMES
from recordings.geometry import CameraModel, Transform
from recordings.progress import Progress
from recordings.tracks import RigCalibration

if TYPE_CHECKING:
    from acquisition.synthetic.lab import Lab
    from acquisition.synthetic.lab_config import SyntheticConfig

GRIPPER = 80
STILL_RAYS = 700_000
POOL = 6
VIEW_S = 3.0
"""How long the board is held in one place."""
GOES_S = 0.15
"""Half the time that the arm needs from one view to the next."""
SAMPLES_HZ = 1000


@dataclass(frozen=True, eq=False)
class CommandedSwing(Swing):
    """The arm on a commanded trajectory; the fingers begin to open at `release_s`, whatever was planned."""

    trajectory: JointTrajectory | None = None

    def q_rad(self, time_s: float) -> Float[Array, "7"]:
        assert self.trajectory is not None
        return self.trajectory.at(time_s)[0]

    def dq_rad_s(self, time_s: float) -> Float[Array, "7"]:
        assert self.trajectory is not None
        return self.trajectory.at(time_s)[1]


def scene_config(config: SyntheticConfig) -> SceneConfig:
    """The scene of a synthetic rig: an arm that tosses, grey cameras, the device settings of the rig."""
    width, height = config.color_size
    mono_width, mono_height = config.mono_size
    return SceneConfig(
        seed=config.seed,
        object=ObjectConfig(config.object, config.object_size_m, config.surface, mass_kg=0.2),
        arm=ArmConfig(),
        motion=MotionConfig(
            release_height_m=0.3,
            forward_speed_m_s=0.7,
            upward_speed_m_s=0.45,
            spin_rad_s=4.0,
            hold_s=0.12,
            rest_s=0.5,
        ),
        camera=CameraConfig(
            width=width, height=height, focal_px=config.color_focal_px, distance_m=0.95, fps=config.fps
        ),
        color=ColorConfig(subframes=config.subframes, exposure_s=0.004),
        depth=DepthConfig(delay_s=config.depth_delay_ms * 1e-3),
        mono=MonoConfig(width=mono_width, height=mono_height, subframes=config.subframes),
        still_rays=STILL_RAYS,
    )


class Show:
    """Plans, renders and describes; everything follows from the config."""

    depth_unit_m = 0.001

    def __init__(self, config: SyntheticConfig) -> None:
        self.config = config
        self.scene = scene_config(config)
        self.color_exposure_s = self.scene.color.exposure_s
        self.mono_exposure_s = self.scene.mono.exposure_s if self.scene.mono else 0.001

    @property
    def rendered(self) -> bool:
        return self.config.pictures == "rendered"

    @cached_property
    def lab(self) -> Lab:
        from acquisition.synthetic.lab import Lab

        return Lab(self.scene)

    @cached_property
    def held_width_m(self) -> float:
        return self.lab.arm.held.width_m if self.rendered and self.lab.arm is not None else 0.05

    def phases_s(self) -> dict[str, float]:
        """When each stream is exposed within a frame."""
        trigger_s = self.scene.mono.trigger_delay_s if self.scene.mono else 0.0
        grey = dict.fromkeys(MONO_NAMES[: self.config.mono_cameras], trigger_s)
        return {"d455/color": 0.0, "d455/depth": self.scene.depth.delay_s, **grey}

    def cameras(self) -> dict[str, CameraModel]:
        if not self.rendered:
            return {"d455": _plain_camera("d455", self.config.color_size, 390.0)} | {
                name: _plain_camera(name, self.config.mono_size, 1370.0)
                for name in MONO_NAMES[: self.config.mono_cameras]
            }
        views = {v.camera.frame: v.camera for v in self.lab.mono_views[: self.config.mono_cameras]}
        return {"d455": self.lab.d455.camera, **views}

    def calibration(self) -> RigCalibration:
        """What this lab believes to know of itself, made just now."""
        made = {"source": "simulated lab: its own values, with the errors of SceneConfig.errors"}
        if not self.rendered:
            return RigCalibration(self.cameras(), created_unix_s=time.time(), residuals=made)
        lab = self.lab
        transforms = [lab.calibrated_world_from_d455]
        if lab.calibrated_world_from_base is not None:
            t = lab.calibrated_world_from_base
            transforms.append(Transform("world", "base", t.rotation, t.translation_m))
        transforms += [v.world_from_camera for v in lab.mono_views[: self.config.mono_cameras]]
        return RigCalibration(
            self.cameras(), tuple(transforms), lab.table_tags, created_unix_s=time.time(), residuals=made
        )

    def plan(self, toss: int) -> TossPlan:
        """A toss that stays in view, as the scene's own planner finds it."""
        if not self.rendered:
            return _standing_plan(self.config.gripper_delay_ms * 1e-3)
        motion, arm = self.lab.plan(toss), self.lab.arm
        swing = motion.swing
        assert swing is not None
        assert arm is not None
        times_s = np.arange(0, motion.instants.end_s, 1 / SAMPLES_HZ)
        q = np.array([swing.q_rad(t) for t in times_s])
        dq = np.gradient(q, times_s, axis=0)
        dq[[0, -1]] = 0
        tool = arm.world_from_tool(swing.q_rad(swing.release_s))
        velocity = _tool_velocity(self.lab, swing)
        return TossPlan(
            JointTrajectory(times_s, q, dq),
            swing.release_s,
            swing.release_s - self.config.gripper_delay_ms * 1e-3,
            tool,
            velocity[:3],
            velocity[3:],
            self.config.gripper_delay_sigma_ms * 1e-3,
        )

    def perform(self, toss: int, plan: TossPlan, progress: Progress | None = None) -> Performance:
        """What happens when the arm follows a plan, with a gripper that takes its own time; rendered."""
        if not self.rendered:
            return self._standing(plan)
        return perform(self.lab, self.motion(toss, plan), self.config.fps, progress)

    def _standing(self, plan: TossPlan) -> Performance:
        """The pool's pictures, in turn."""
        return Performance(
            _standing_motion(plan.trajectory), {name: Reel(np.zeros(0), [], p, p) for name, p in self._pool.items()}
        )

    @cached_property
    def _pool(self) -> dict[str, list[Array]]:
        rng = generator(self.config.seed, 81)
        pictures = {}
        for name in self.phases_s():
            size = self.config.mono_size if name.startswith("mono") else self.config.color_size
            draw = _depth if name.endswith("depth") else _texture
            pictures[name] = [draw(rng, *size, name) for _ in range(POOL)]
        return pictures

    def motion(self, toss: int, plan: TossPlan) -> Motion:
        """What arm and object do, not rendered."""
        drawn_ms = generator(self.config.seed, GRIPPER, toss).normal(
            self.config.gripper_delay_ms, self.config.gripper_delay_sigma_ms
        )
        release_s = plan.command_s + max(drawn_ms, 5.0) * 1e-3
        open_s = self.lab.arm.config.finger_open_s if self.lab.arm else 0.04
        swing = CommandedSwing(
            release_s,
            *plan.trajectory.at(release_s),
            np.zeros(7),
            FORWARD_S,
            open_s,
            self.held_width_m,
            plan.trajectory,
        )
        return self.lab.planner.follow(toss, swing)

    def board_views(self, progress: Progress) -> Performance:
        """The calibration board, held still in one place after the other, before each camera in turn; all look."""
        rng = generator(self.config.seed, BOARD)
        views = [self.lab.d455, *self.lab.mono_views[: self.config.mono_cameras]]
        turns = [divmod(k, len(views)) for k in range(self.config.board_views)]
        poses = [board_before(views[v].camera, views[v].world_from_camera, 2 * turn, rng) for turn, v in turns]
        return self._views(poses, None, progress)

    def hand_eye_views(self, progress: Progress) -> Performance:
        """The board in the arm's hand, in one pose of the arm after the other. The arm itself is not drawn."""
        assert self.lab.arm is not None
        base = self.lab.arm.world_from_base
        world_from_base = Transform("world", "base", base.rotation, base.translation_m)
        rng = generator(self.config.seed, BOARD)
        _, held = held_board_poses(world_from_base, self.lab.world_from_d455, self.config.board_views, rng)
        times_s = np.array([VIEW_S * k + at for k in range(len(held)) for at in (GOES_S, VIEW_S - GOES_S)])
        q = np.repeat([one.q_rad for one in held], 2, axis=0)
        stops = JointTrajectory(times_s, q, np.zeros_like(q))
        return self._views([one.world_from_board for one in held], stops, progress)

    def _views(self, poses: list[Transform], arm: JointTrajectory | None, progress: Progress) -> Performance:
        pictures: dict[str, list[Array]] = {name: [] for name in self.phases_s()}
        frames = round(VIEW_S * self.config.fps)
        for number, world_from_board in enumerate(poses):
            color, depth, monos = self.lab.board_view(number, world_from_board)
            shown = {"d455/color": color, "d455/depth": depth, **dict(zip(MONO_NAMES, monos))}
            for name, reel in pictures.items():
                reel += [_stirred(shown[name], k) for k in range(2)] * (frames // 2)
            progress.step(number + 1, len(poses), "views of the board")
        times_s = np.arange(len(pictures["d455/color"])) / self.config.fps
        phases_s = self.phases_s()
        reels = {n: Reel(times_s + phases_s[n], p, p[:2], p[-2:]) for n, p in pictures.items()}
        return Performance(_standing_motion(arm), reels)

    def is_of(self, performance: Performance, trajectory: JointTrajectory) -> bool:
        """Whether a performance was made for this trajectory."""
        swing = performance.motion.swing
        own = swing.trajectory if isinstance(swing, CommandedSwing) else None
        return (
            own is not None
            and len(own.time_s) == len(trajectory.time_s)
            and np.array_equal(own.q_rad, trajectory.q_rad)
        )

    def start_rad(self, performance: Performance | None) -> Float[Array, " j"]:
        swing = performance.motion.swing if performance is not None else None
        return swing.q_rad(0.0) if swing is not None else READY_RAD

    def width_m(self, performance: Performance, time_s: float) -> float:
        swing = performance.motion.swing
        return OPEN_M if swing is None else swing.finger_width_m(time_s)


def _tool_velocity(lab: Lab, swing: Swing) -> Float[Array, "6"]:
    """Linear and angular velocity of the tool at the planned release, in the world."""
    from recordings.geometry import rotation_log

    assert lab.arm is not None
    h = 1e-4
    early, late = (lab.arm.world_from_tool(swing.q_rad(swing.release_s + d)) for d in (-h, h))
    spin = early.rotation @ rotation_log(early.rotation.T @ late.rotation) / (2 * h)
    return np.concatenate([(late.translation_m - early.translation_m) / (2 * h), spin])


def _standing_plan(delay_s: float) -> TossPlan:
    """The arm stands for two seconds; the gripper opens in the middle."""
    q = np.stack([READY_RAD, READY_RAD])
    stand = JointTrajectory(np.array([0.0, 2.0]), q, np.zeros_like(q))
    tool = Transform("world", "tool", np.eye(3), np.zeros(3))
    return TossPlan(stand, 1.0, 1.0 - delay_s, tool, np.zeros(3), np.zeros(3))


def _stirred(picture: Array, variant: int) -> Array:
    """The same picture, one grey level off in a few pixels: no camera sends the same one twice."""
    if variant == 0:
        return picture
    other = picture.copy()
    other[::16, ::16] ^= 1
    return other


def _standing_motion(trajectory: JointTrajectory | None) -> Motion:
    """The object stays where it is, whatever the arm does (None: it stands)."""
    if trajectory is None:
        q = np.stack([READY_RAD, READY_RAD])
        trajectory = JointTrajectory(np.array([0.0, 2.0]), q, np.zeros_like(q))
    swing = CommandedSwing(1.0, trajectory.q_rad[0], np.zeros(7), np.zeros(7), FORWARD_S, 0.04, 0.05, trajectory)
    still = Trajectory(
        np.array([0.0, 1.0]),
        np.zeros((2, 3)),
        np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        np.zeros((2, 3)),
        np.zeros((2, 3)),
    )
    return Motion(0, still, Instants(0.0, 1.0, 1.3, 1.6, 2.0), 1.04, swing)


def _texture(rng: np.random.Generator, width: int, height: int, name: str) -> Array:
    """A picture with the texture and noise of a real sensor."""
    channels = 3 if name.endswith("color") else 1
    coarse = rng.integers(40, 200, (max(height // 40, 2), max(width // 40, 2), channels), dtype=np.uint8)
    image = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC).reshape(height, width, channels)
    noisy = image + rng.normal(0, 2.5, image.shape)
    return np.ascontiguousarray(noisy.clip(0, 255).astype(np.uint8).squeeze())


def _depth(rng: np.random.Generator, width: int, height: int, name: str) -> Array:
    distance_m = np.linspace(1.4, 0.6, height)[:, None] + np.zeros((1, width))
    depth = np.rint(1000 * (distance_m + rng.normal(0, 0.0015, (height, width)) * distance_m**2))
    depth[cv2.resize(rng.random((12, 16)), (width, height)) > 0.75] = 0
    return depth.astype(np.uint16)


def _plain_camera(frame: str, size: tuple[int, int], focal_px: float) -> CameraModel:
    width, height = size
    K = np.array([[focal_px, 0.0, (width - 1) / 2], [0.0, focal_px, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return CameraModel(frame, width, height, K, "none", ())
