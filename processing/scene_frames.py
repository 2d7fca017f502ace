"""The tosses that a session's static scene is learned from: those of the run, and those beside them that fit.

A toss that was not asked for gives frames of the background where it can be read and shows the same scene; where not,
it is left out and said. It never ends a run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from numpy import ndarray as Array

from processing.run import CAMERA, Run
from processing.segment.background.moving_camera import why_other_scene
from processing.segment.background.static_scene import sample_positions
from processing.segment.robot.of_session import RobotOfSession
from processing.segment.robot.render import RobotView
from recordings.errors import TosslabError
from recordings.records import RgbdFrame
from recordings.robot.arm import panda
from recordings.session import RgbdFrames
from recordings.whole_file import file_sha256

LEAST_EACH = 4
"""Of a session with more tosses than give so many frames each, only some are looked at beside those of the run."""


@dataclass(frozen=True, eq=False)
class SceneFrames:
    """Where the scene is looked at: (toss, frame position) in time order within each toss, and what is left out."""

    streams: dict[int, RgbdFrames]
    chosen: list[tuple[int, int]]
    left_out: dict[int, str]


def background_tosses(run: Run) -> tuple[int, ...]:
    """Tosses of the session that are not of the run and may show its background, spread evenly."""
    others = [t for t in run.session.tosses if t not in run.recorded]
    wanted = max(0, run.config.scene.frames // LEAST_EACH - len(run.recorded))
    at = np.unique(np.linspace(0, len(others) - 1, min(wanted, len(others))).round().astype(int))
    return tuple(others[i] for i in at)


def background_keys(run: Run) -> dict[str, str]:
    """Fingerprints of their files, for the stage's key: a file that changes, comes or goes makes another scene."""
    return {f"beside_{t:02d}": _fingerprint(run.session.file(t)) for t in background_tosses(run)}


def _fingerprint(path: Path) -> str:
    try:
        about = path.stat()
        return _sha256(path, about.st_size, about.st_mtime_ns)
    except OSError as refused:
        return f"unreadable: {type(refused).__name__}"


@lru_cache(maxsize=256)
def _sha256(path: Path, size: int, changed_ns: int) -> str:
    """Of a file's content; size and time are asked for so that a changed file is read again."""
    return file_sha256(path)


def scene_frames(run: Run) -> SceneFrames:
    """The frames that the scene is learned from. Raises TosslabError only for tosses of the run."""
    streams = {t: run.session.toss(t).rgbd(CAMERA) for t in run.recorded}
    left_out = {}
    for t in background_tosses(run):
        try:
            streams[t] = run.session.toss(t).rgbd(CAMERA)
        except (TosslabError, OSError) as wrong:
            left_out[t] = f"it cannot be read ({wrong})"
    while True:
        chosen = _sampled(streams, run.config.scene.frames)
        bad = _unfit(run, streams, chosen)
        if not bad:
            return SceneFrames(streams, chosen, left_out)
        left_out |= bad
        streams = {t: s for t, s in streams.items() if t not in bad}


def _sampled(streams: dict[int, RgbdFrames], wanted: int) -> list[tuple[int, int]]:
    numbers = sorted(streams)
    return [(numbers[i], p) for i, p in sample_positions([len(streams[t]) for t in numbers], wanted)]


def _unfit(run: Run, streams: dict[int, RgbdFrames], chosen: Sequence[tuple[int, int]]) -> dict[int, str]:
    """Why tosses beside the run's cannot be used."""
    others = [t for t in streams if t not in run.recorded]
    of_run = [at for at in chosen if at[0] in run.recorded]
    if not others or not of_run:
        return {}
    toss, position = of_run[len(of_run) // 2]
    reference = streams[toss][position]
    robot = RobotOfSession(run.session)
    known = robot.missing(run.recorded) is None
    bad = {}
    for t in others:
        at = [(i, p) for i, p in chosen if i == t]
        try:
            if known and robot.path(t) is None:
                bad[t] = "it has no joint states, so that the robot in it is not known"
                continue
            frames = [streams[i][p] for i, p in at]
            places = [(toss, int(streams[toss].times_ns[position])), *((i, int(streams[i].times_ns[p])) for i, p in at)]
            why = why_other_scene(reference, frames, hidden_by_robot(run, places, robot))
        except (TosslabError, OSError) as wrong:
            why = f"it cannot be read ({wrong})"
        if why is not None:
            bad[t] = why
    return bad


def read(frames: SceneFrames, at: tuple[int, int]) -> RgbdFrame:
    """One of the chosen frames."""
    return frames.streams[at[0]][at[1]]


def hidden_by_robot(
    run: Run, at: Sequence[tuple[int, int]], robot: RobotOfSession | None = None
) -> list[Bool[Array, "h w"]] | None:
    """Where the robot, or what it holds, may stand in front of the scene, at (toss, time); None without a robot."""
    robot = robot or RobotOfSession(run.session)
    if robot.missing(tuple({t for t, _ in at})) is not None:
        return None
    camera, settings = run.camera, run.config.scene
    view = RobotView(panda(), camera)
    return [robot.hides(view, camera, toss, time_ns, settings.robot_margin_px, settings.held_m) for toss, time_ns in at]
