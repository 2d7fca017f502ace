"""How a toss is looked at while the next one is prepared: the pipeline's settings, made light."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from processing.config import Config, RigSettings
from processing.field.fuse import FuseConfig
from processing.segment.robot.fit import RobotFitSettings
from processing.track.beam import BeamConfig
from processing.track.hypotheses import HypothesisConfig
from processing.track.joint_refinement import GraphConfig
from processing.track.registration.register import RegisterConfig


@dataclass(frozen=True)
class LiveConfig:
    """What the follower is told."""

    memory_gb: float = 6.0
    """Memory that it may take (data, not mapped files); beyond it ends and says so."""
    poll_s: float = 0.2
    """How often it looks for a finished toss."""
    before_release_s: float = 0.25
    after_rest_s: float = 0.15
    """Frames from so long before the release until so long after the rest are looked at: what an arm does before, and
    waiting, is left to the pipeline."""
    least_thrown: int = 12
    """Fewer frames between the two are no toss: all are looked at."""
    field_views: int = 14
    """Frames of a toss that the shape so far is fused from."""
    fuse: FuseConfig = field(default_factory=lambda: FuseConfig(voxel_m=0.003, most_cells=400_000))
    register: RegisterConfig = field(default_factory=lambda: RegisterConfig(most_keyframes=12, many=24))
    late_s: float = 20.0
    """Behind the oldest finished toss by more, it says by how much."""
    left_view_px: int = 2
    """A mask this near to the image's edge is cut by it."""
    blurred: float = 0.35
    """Of the gradients along the motion to those across it: less, over several frames, is blur."""
    blur_px: float = 6.0
    """Motion from frame to frame below which nothing is called blurred."""
    most_blurred: float = 0.15
    """Share of the tracked frames that may be."""
    most_flagged: float = 0.25
    """Share of the seen frames that may be interpolated or lost before it is said."""


def light(config: Config) -> Config:
    """The settings of the stages for a first look: fewer frames of the scene, a narrower beam, neither windows nor
    crossovers, a shorter refinement. What comes of them is shown and then made anew by the pipeline's own settings."""
    schedule = ((1, 2, 0.006, 0.4, 0.008, 0.3), (0, 3, 0.004, 0.3, 0.005, 0.5), (0, 3, 0.0035, 0.1, 0.002, 0.8))
    graph = GraphConfig(loops=4, schedule=schedule)
    track = replace(
        config.track,
        beam=BeamConfig(width=2, branches=2),
        windows=replace(config.track.windows, rounds=0),
        crossover=replace(config.track.crossover, rounds=0),
        hypotheses=HypothesisConfig(graph=graph),
    )
    robot = RobotFitSettings(frames=6, steps=4, stride=6, outlines=150)
    return replace(
        config,
        scene=replace(config.scene, frames=20),
        rig=RigSettings(robot=robot, scale=config.rig.scale),
        track=track,
    )
