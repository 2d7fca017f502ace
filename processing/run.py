"""What a stage may know of the run that it is part of."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

from processing.backends import settings_of
from processing.config import Config
from processing.sensor.noise import PUBLISHED, DepthNoise
from processing.sensor.still import Kept
from processing.store import Store, plain
from processing.track.noise_cost import at_noise
from recordings.geometry import CameraModel, Transform
from recordings.notices import Notice
from recordings.progress import Progress
from recordings.session import Session

CAMERA = "d455"
"""The camera that everything is tracked in."""
MakeProgress = Callable[[str], Progress]
Item = TypeVar("Item", bound=Hashable)
Found = TypeVar("Found")
First = TypeVar("First")
Second = TypeVar("Second")


@dataclass(frozen=True)
class StartPose:
    """A pose given for one frame of a toss (`--start truth`); the track's object frame is then that pose's."""

    frame: int
    camera_from_object: Transform

    @property
    def digest(self) -> str:
        """sha256 of the pose and its frame."""
        return hashlib.sha256(self.camera_from_object.matrix.tobytes() + bytes([self.frame % 256])).hexdigest()


@dataclass(frozen=True, eq=False)
class Run:
    """One session being processed into one results folder. `tosses` are those that take part in anything; `keys` are
    sha256 of what comes from the session (`toss_XX`, `calibration`, `physics`)."""

    session: Session
    tosses: tuple[int, ...]
    store: Store
    config: Config
    tracker: str
    device: str
    progress: MakeProgress
    keys: Mapping[str, str]
    starts: Mapping[int, StartPose] = field(default_factory=dict)
    warnings: tuple[Notice, ...] = ()
    kept: Mapping[int, Kept] = field(default_factory=dict)
    """Of tosses with long still stretches, the frames that are worked on (`sensor/still.py`)."""
    lost: tuple[int, ...] = ()
    """Tosses in which the object is not seen: they show the scene and the robot only."""
    noise: DepthNoise = PUBLISHED
    """How this session's depth errs (stage `noise`)."""

    @property
    def recorded(self) -> tuple[int, ...]:
        """All tosses of the run, with those in which the object is not seen."""
        return tuple(sorted((*self.tosses, *self.lost)))

    @property
    def camera(self) -> CameraModel:
        """The intrinsics of CAMERA."""
        return self.session.calibration.camera(CAMERA)

    @property
    def world_from_camera(self) -> Transform | None:
        """Where CAMERA stands to the table; None where that is not calibrated."""
        return self.session.calibration.find("world", CAMERA)


def toss_keys(run: Run, toss: int) -> dict[str, str]:
    """The inputs of a stage that reads the images of one toss."""
    name = f"toss_{toss:02d}"
    return {name: run.keys[name], "calibration": run.keys["calibration"]}


def matcher_settings(run: Run, config: Any) -> dict[str, Any]:
    """The settings of a stage that matches features: its own, and the matcher where it is not the default."""
    return {**plain(config), **settings_of(run.config.backends.matcher, run.config.backends)}


def with_noise(run: Run, noise: DepthNoise) -> Run:
    """The run in which depth is believed as far as this session's noise allows."""
    return replace(run, noise=noise, config=replace(run.config, track=at_noise(run.config.track, noise)))


def each(run: Run, items: Iterable[Item], call: Callable[[Item], Found]) -> dict[Item, Found]:
    """The call of every item, side by side where the run may: none of them needs what another one makes."""
    return run.store.engine.each(items, call)


def both(run: Run, first: Callable[[], First], second: Callable[[], Second]) -> tuple[First, Second]:
    """Two calls side by side, neither of which needs what the other one makes."""
    found: dict[int, Any] = run.store.engine.each((0, 1), lambda k: (first, second)[k]())
    return found[0], found[1]
