"""All settings of the pipeline in one value. Each part is documented where it is used."""

from __future__ import annotations

from dataclasses import dataclass, field

from processing.field.learn import LearnConfig
from processing.segment.background import BackgroundSettings
from processing.segment.static_scene import SceneSettings
from processing.track.frame_to_model import FrameToModelSettings
from processing.track.register import RegisterConfig
from processing.track.sequence import TrackConfig


@dataclass(frozen=True)
class Config:
    """What each stage is run with; saved beside its result in stage.json."""

    scene: SceneSettings = field(default_factory=SceneSettings)
    masks: BackgroundSettings = field(default_factory=BackgroundSettings)
    track: TrackConfig = field(default_factory=TrackConfig)
    register: RegisterConfig = field(default_factory=RegisterConfig)
    shape: LearnConfig = field(default_factory=LearnConfig)
    frame_to_model: FrameToModelSettings = field(default_factory=FrameToModelSettings)
