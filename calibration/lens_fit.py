"""One lens fitted to views of a board in one way, and what it leaves of views kept aside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.bundle import Observations, Scene, Solved, adjust
from calibration.extrinsics import bad_views, board_pose, whitening
from calibration.targets import TargetView, numbered_marks
from recordings.errors import BadInput
from recordings.geometry import CameraModel

LEAST_VIEWS = 5
FOLDS = 4
HUBER = 3.0


@dataclass(frozen=True)
class Way:
    """How a lens is fitted: `huber` in standard deviations (None: plain least squares), `print_m` the deviation
    of the board's marks from their places (None: they lie where they are said to)."""

    huber: float | None
    print_m: float | None = None

    @property
    def name(self) -> str:
        """As the report has it."""
        if self.print_m is not None:
            return "print left open"
        return "least squares" if self.huber is None else "robust"


@dataclass(frozen=True, eq=False)
class Fit:
    way: Way
    solved: Solved
    seen: Observations
    rejected: tuple[int, ...]
    hold_out_px: float

    @property
    def model(self) -> CameraModel:
        return self.solved.scene.models[0]

    @staticmethod
    def of(start: CameraModel, views: Sequence[TargetView], way: Way, rejected: Sequence[int] | None = None) -> Fit:
        """All views, then without those that do not fit (`rejected`: known already); each quarter kept aside once."""
        left_out = tuple(rejected or ())
        numbers = [v for v in range(len(views)) if v not in left_out]
        solved, seen = _solve(start, views, numbers, way)
        if rejected is None:
            bad = tuple(v for _, v in bad_views(solved, seen))
            kept = [v for v in numbers if v not in bad]
            if bad and len(kept) >= LEAST_VIEWS:
                left_out, numbers = bad, kept
                solved, seen = _solve(start, views, numbers, way)
        gaps = []
        for fold in range(FOLDS):
            aside = numbers[fold::FOLDS]
            rest, _ = _solve(solved.scene.models[0], views, [v for v in numbers if v not in aside], way)
            gaps.append(pose_only(rest.scene.models[0], views, aside)[0].residual_px)
        return Fit(way, solved, seen, left_out, float(np.sqrt((np.concatenate(gaps) ** 2).mean())))


def pose_only(model: CameraModel, views: Sequence[TargetView], numbers: Sequence[int]) -> tuple[Solved, Observations]:
    """What a lens leaves of views it may not have seen: the board's poses alone are found, on its stated layout."""
    return _solve(model, views, numbers, Way(HUBER), free_lens=False)


def _solve(
    start: CameraModel, views: Sequence[TargetView], numbers: Sequence[int], way: Way, free_lens: bool = True
) -> tuple[Solved, Observations]:
    """Lens (where free) and board poses from the views of these numbers, and where the board's marks are."""
    poses, chosen = np.tile(np.eye(4), (len(views), 1, 1)), []
    for v in numbers:
        found = board_pose(start, views[v])
        if found:
            poses[v] = found[0]
            chosen.append(v)
    if not chosen:
        raise BadInput(f"no pose of the board fits the views of {start.frame}; is its layout as stated?")
    counts = [len(views[v]) for v in chosen]
    marks, many = numbered_marks([(0, view) for view in views])
    seen = Observations(
        np.zeros(sum(counts), dtype=np.int64),
        np.repeat(chosen, counts),
        np.zeros(sum(counts), dtype=np.int64),
        np.concatenate([views[v].points_m for v in chosen]),
        np.concatenate([views[v].pixels for v in chosen]),
        whitening(np.concatenate([views[v].covariance_px2 for v in chosen])),
        np.concatenate([marks[v] for v in chosen]),
    )
    one, no = np.eye(4)[None], np.zeros(1, dtype=bool)
    free_views, lens = np.isin(np.arange(len(views)), chosen), np.array([free_lens])
    shift = np.zeros((many, 3))
    scene = Scene((start,), one, poses, one, no, free_views, no, lens, np.ones(1), no, shift, way.print_m)
    return adjust(scene, seen, way.huber), seen
