"""All settings of the pipeline in one value. Each part is documented where it is used."""

from __future__ import annotations

from dataclasses import dataclass, field

from processing.backends import Backends
from processing.baselines.frame_to_model import FrameToModelSettings
from processing.contact.learn.from_tracks import TracksConfig
from processing.field.learn import LearnConfig
from processing.given_masks import DEFAULT_MASKS, GivenMasks
from processing.refine.joint import JointConfig
from processing.segment.background.follow import BackgroundSettings
from processing.segment.background.static_scene import SceneSettings
from processing.segment.detect.detection import FindSettings
from processing.sensor.still import StillSettings
from processing.stages.rig import RigSettings
from processing.stages.second_pass import CycleConfig
from processing.track.registration.register import RegisterConfig
from processing.track.track_toss import TrackConfig


@dataclass(frozen=True)
class Config:
    """What each stage is run with; saved beside its result in stage.json."""

    backends: Backends = field(default_factory=Backends)
    still: StillSettings = field(default_factory=StillSettings)
    scene: SceneSettings = field(default_factory=SceneSettings)
    rig: RigSettings = field(default_factory=RigSettings)
    masks: BackgroundSettings = field(default_factory=BackgroundSettings)
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
