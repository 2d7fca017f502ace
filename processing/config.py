"""All settings of the pipeline in one value. Each part is documented where it is used."""

from __future__ import annotations

from dataclasses import dataclass, field

from processing.segment.background import BackgroundSettings
from processing.segment.static_scene import SceneSettings
from processing.track.frame_to_model import FrameToModelSettings


@dataclass(frozen=True)
class Config:
    """What each stage is run with; saved beside its result in stage.json."""

    scene: SceneSettings = field(default_factory=SceneSettings)
    masks: BackgroundSettings = field(default_factory=BackgroundSettings)
    frame_to_model: FrameToModelSettings = field(default_factory=FrameToModelSettings)
