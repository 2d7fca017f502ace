"""rollouts.npz: what toss-view shows as a ghost beside the track."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from processing.contact.learn.learn import ContactLearning
from processing.contact.physics.plane import Plane
from processing.contact.report.rollout_errors import Evaluation, world_poses
from recordings.session_writer import toss_name


def write_rollouts(folder: Path, learning: ContactLearning, evaluation: Evaluation, plane: Plane) -> Path:
    """`rollouts.npz`: per toss `toss_XX.world_from_object` (t, 4, 4) and `toss_XX.time_s` (t,), which counts from the
    toss's first pose; `toss` lists the numbers."""
    poses = world_poses(learning, evaluation, plane)
    content: dict[str, Any] = {"format_version": np.array(1), "toss": np.array(sorted(poses))}
    for toss, start_s in zip(evaluation.errors.tosses, evaluation.start_time_s):
        content[f"{toss_name(toss)}.world_from_object"] = poses[toss]
        content[f"{toss_name(toss)}.time_s"] = start_s + evaluation.errors.step_s * np.arange(len(poses[toss]))
    path = folder / "rollouts.npz"
    np.savez(path, **content)
    return path
