"""Stage `scene`: what the camera sees without the object."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from processing.engine.parts import side_by_side
from processing.run import CAMERA, Run
from processing.scene_frames import background_keys, hidden_by_robot, read, scene_frames
from processing.segment.background.static_scene import (
    calibrated_table_depth,
    learn_scene,
    seen_table_depth,
)
from processing.store import Done
from recordings.records import RgbdFrame

VERSION = 11


@dataclass(frozen=True)
class SceneResult:
    """`left_out`: tosses beside the run's that were of no use, and why; `known_share`: of the pixels."""

    frames: int
    tosses: tuple[int, ...]
    left_out: Mapping[str, str]
    pixels_with_depth: int
    known_share: float
    robot_left_out: bool


def learn_static_scene(run: Run) -> Done[SceneResult]:
    """From frames of all tosses of the run, and of those beside them in the session that can be read and show the
    same. Depth is as reported."""
    inputs = {name: run.keys[name] for name in ("calibration", *(f"toss_{t:02d}" for t in run.recorded))}
    inputs |= background_keys(run)
    return run.store.run("scene", VERSION, run.config.scene, inputs, SceneResult, lambda folder: _learn(run, folder))


def scene_notes(scene: Done[SceneResult]) -> tuple[str, ...]:
    """Which tosses of the session, not of the run, were of no use for the scene, and why."""
    return tuple(f"toss {t} gives no frames of the background: {why}" for t, why in scene.result.left_out.items())


def _learn(run: Run, folder: Path) -> SceneResult:
    found = scene_frames(run)
    progress = run.progress("static scene")

    def frames() -> Iterator[RgbdFrame]:
        for done, frame in enumerate(side_by_side(lambda at: read(found, at), found.chosen)):
            progress.step(done, len(found.chosen))
            yield frame

    hidden = hidden_by_robot(run, [(t, int(found.streams[t].times_ns[i])) for t, i in found.chosen])
    table = calibrated_table_depth(run.session.calibration, CAMERA)
    # a plane that only depth tells helps to learn what is beneath the object; nobody takes it for a calibrated table
    seen = seen_table_depth([read(found, at).depth_m for at in found.chosen[:: max(1, len(found.chosen) // 9)]],
                            run.camera) if table is None else table  # fmt: skip
    scene = learn_scene(frames(), seen, run.config.scene, hidden, [t for t, _ in found.chosen])
    scene = replace(scene, table_depth_m=np.zeros_like(scene.table_depth_m)) if table is None else scene
    scene.write(folder)
    return SceneResult(
        frames=len(found.chosen),
        tosses=tuple(sorted(found.streams)),
        left_out={str(t): why for t, why in found.left_out.items()},
        pixels_with_depth=int((scene.depth_m > 0).sum()),
        known_share=round(float(scene.known.mean()), 4),
        robot_left_out=hidden is not None,
    )
