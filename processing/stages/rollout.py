"""Stage `rollout`, the paper's Figure 4: learned on all tosses but the last, all rolled out from their release."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from processing.run import CAMERA, Run
from processing.store import Done
from recordings.errors import BadInput
from recordings.results.folder import read_shape, read_track, write_contact
from recordings.whole_file import write_json

VERSION = 7


@dataclass(frozen=True)
class RolloutResult:
    """How many tosses were rolled out; or why none was."""

    tosses: int = 0
    kept_out: str | None = None


def roll_out(run: Run, name: str, tracks: Mapping[int, Done], shape: Done) -> Done[RolloutResult]:
    """Contact learned anew on the row's last tracks and shape, the last toss left out."""
    inputs = {"shape": shape.key, **{f"track_{t:02d}": d.key for t, d in tracks.items()}}
    inputs |= {"calibration": run.keys["calibration"], "object": run.keys["physics"]}

    def compute(folder: Path) -> RolloutResult:
        from processing.contact.physics.inertia import physics_of_session
        from processing.contact.physics.plane import calibrated_plane
        from processing.contact.report.figure4 import learn_figure_4
        from processing.contact.report.rollouts_file import write_rollouts

        try:
            figure, found = learn_figure_4(
                {t: read_track(d.folder, t) for t, d in tracks.items()},
                read_shape(shape.folder),
                run.session.calibration.transform("world", CAMERA),
                calibrated_plane(run.session.calibration),
                physics_of_session(run.session.start),
                run.config.contact,
                run.progress(f"{name}: rollouts"),
            )
        except BadInput as why:
            return RolloutResult(kept_out=str(why))
        write_contact(folder, found.model)
        write_rollouts(folder, found.fused, figure.estimated, figure.plane)
        write_json(folder / "rollout.json", figure.to_json())
        return RolloutResult(len(figure.estimated.errors.tosses))

    return run.store.run("rollout", VERSION, run.config.contact, inputs, RolloutResult, compute)
