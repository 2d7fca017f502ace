"""All settings of the pipeline in one value. Each part is documented where it is used."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from processing.backends import Backends
from processing.baselines.frame_to_model import FrameToModelSettings
from processing.contact.learn.from_tracks import TracksConfig
from processing.field.learn import LearnConfig
from processing.given_masks import DEFAULT_MASKS, GivenMasks
from processing.refine.icp import IcpConfig
from processing.refine.image_residuals import JudgeConfig
from processing.refine.joint import JointConfig
from processing.refine.redrawn_frames import RedrawConfig
from processing.segment.background.depth_delay import DepthDelaySettings
from processing.segment.background.depth_scale import DepthScaleSettings
from processing.segment.background.follow import BackgroundSettings
from processing.segment.background.static_scene import SceneSettings
from processing.segment.detect.detection import FindSettings
from processing.segment.learned.masks import LearnedSettings
from processing.segment.robot.fit import RobotFitSettings
from processing.sensor.render import RendererName
from processing.sensor.still import StillSettings
from processing.track.registration.register import RegisterConfig
from processing.track.track_toss import TrackConfig


@dataclass(frozen=True)
class RigSettings:
    """How the rig is checked against the recording."""

    robot: RobotFitSettings = field(default_factory=RobotFitSettings)
    scale: DepthScaleSettings = field(default_factory=DepthScaleSettings)


SecondPassStart = Literal["anew", "poses", "shape"]


@dataclass(frozen=True)
class CycleConfig:
    """The cycle's settings. Passes are compared by the mean over depth, outline, colour and contact of how much larger
    their residuals are, as a share."""

    icp: IcpConfig = field(default_factory=IcpConfig)
    redraw: RedrawConfig = field(default_factory=RedrawConfig)
    judge: JudgeConfig = field(default_factory=JudgeConfig)
    renderer: RendererName = "raycast"
    start: SecondPassStart = "shape"
    """`anew` (the paper): the second pass is given the first pose only. `poses`: the poses at which the shape was drawn
    are refined, only lost frames are sought. `shape`: the same, and the shape's own surface and colours take part;
    where no frame looks, it stays."""
    apart_mask: float = 0.12
    """A toss whose outline the common shape misses by more (1 - IoU, median over frames) is not of that shape."""
    much_worse: float = 0.02
    """A second pass whose residuals on the raw images are larger by more than this is kept out, and said to be ..."""
    far_deg: float = 2.0
    """... and so is one that refines the first pass's poses and turns them by more (median over frames): those err by 2
    to 3 degrees, the surface free; what pulls farther is an error of the shape (docs/decisions/second-pass.md)."""
    most_passes: int = 3
    """After the second one, where passes go on until they converge."""
    same_rotation_deg: float = 0.05
    same_translation_m: float = 0.0001
    same_shape_m: float = 0.0001
    """Passes end when poses and shape change by less than these (medians over frames, mean over the surface)."""


@dataclass(frozen=True)
class Config:
    """What each stage is run with; saved beside its result in stage.json."""

    backends: Backends = field(default_factory=Backends)
    still: StillSettings = field(default_factory=StillSettings)
    scene: SceneSettings = field(default_factory=SceneSettings)
    rig: RigSettings = field(default_factory=RigSettings)
    masks: BackgroundSettings = field(default_factory=BackgroundSettings)
    learned_masks: LearnedSettings = field(default_factory=LearnedSettings)
    depth_delay: DepthDelaySettings = field(default_factory=DepthDelaySettings)
    find: FindSettings = field(default_factory=FindSettings)
    given_masks: GivenMasks = DEFAULT_MASKS
    """Which of the session's masks are used: see processing.given_masks."""
    track: TrackConfig = field(default_factory=TrackConfig)
    register: RegisterConfig = field(default_factory=RegisterConfig)
    shape: LearnConfig = field(default_factory=LearnConfig)
    cycle: CycleConfig = field(default_factory=CycleConfig)
    joint: JointConfig = field(default_factory=JointConfig)
    contact: TracksConfig = field(default_factory=TracksConfig)
    frame_to_model: FrameToModelSettings = field(default_factory=FrameToModelSettings)
