"""One lens fitted to views of a board, and what it leaves of views kept aside."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from calibration.cameras.bundle import Observations, Scene, Solved, adjust
from calibration.cameras.extrinsics import bad_views, board_pose, whitening
from calibration.cameras.lens_prior import has_k3, k3_share, with_weighed_k3
from calibration.cameras.targets import TargetView, numbered_marks
from recordings.errors import BadInput
from recordings.geometry import CameraModel

LEAST_VIEWS = 5
FOLDS = 4
HUBER = 5.0
"""In standard deviations of what is left over, where that is more than the corners' own: see `solve_lens`. Chosen on
eleven real sets (tools/bench_calibration.py): 3 leaves up to .4 % more of views kept aside, for the far corners of a
board that is a little bent are no outliers."""
STANDARD_ERRORS = 1.0
"""Another lens than the standard one is taken where it leaves so many standard errors less of views kept aside (the
one-standard-error rule: Breiman et al., Classification and Regression Trees, 1984, section 3.4.3)."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A lens fitted to views. `aside_px2`: by the number of each view, the mean square of what a lens fitted without it
    left of a coordinate there, the board's pose found anew; of rejected views as well, for what one lens cannot explain
    another may. `hold_out_px`: root mean square of the others. `k3_held`: Brown's k3, where there is one, is held
    back."""

    solved: Solved
    seen: Observations
    rejected: tuple[int, ...]
    aside_px2: Mapping[int, float]
    hold_out_px: float
    k3_held: bool

    @property
    def model(self) -> CameraModel:
        return self.solved.scene.models[0]

    @staticmethod
    def of(start: CameraModel, views: Sequence[TargetView]) -> Fit:
        """With Brown's k3 held back; or free, where views tell it better than what is known of lenses, and it leaves
        less of those kept aside."""
        held = Fit.by(start, views, k3_held=True)
        if not has_k3(start):
            return held
        numbers = [v for v in range(len(views)) if v not in held.rejected]
        solved, _ = fit_lens(held.model, views, numbers, k3_held=False)
        if k3_share(solved.scene.models[0], float(solved.std("lens", 0)[-1])) < 0.5:
            return held
        free = Fit.by(start, views, k3_held=False)
        return free if gain_by_chance(free.aside_px2, held.aside_px2) > 0 else held

    @staticmethod
    def by(start: CameraModel, views: Sequence[TargetView], k3_held: bool) -> Fit:
        """All views, then without those that do not fit; and each quarter of them kept aside once."""

        def fitted(first: CameraModel, numbers: Sequence[int]) -> tuple[Solved, Observations]:
            return fit_lens(first, views, numbers, k3_held)

        solved, seen = fitted(start, range(len(views)))
        rejected = tuple(v for _, v in bad_views(solved, seen))
        numbers = [v for v in range(len(views)) if v not in rejected]
        if rejected and len(numbers) >= LEAST_VIEWS:
            solved, seen = fitted(start, numbers)
        else:
            rejected, numbers = (), list(range(len(views)))
        squares: dict[int, Float[Array, "n 2"]] = {}
        for fold in range(FOLDS):
            aside = numbers[fold::FOLDS]
            rest, _ = fitted(solved.scene.models[0], [v for v in numbers if v not in aside])
            squares |= squares_aside(rest.scene.models[0], views, aside)
        hold_out = float(np.sqrt(np.concatenate([*squares.values()]).mean()))
        if rejected:
            squares |= squares_aside(solved.scene.models[0], views, rejected)
        return Fit(solved, seen, rejected, {v: float(q.mean()) for v, q in squares.items()}, hold_out, k3_held)


def fit_lens(
    start: CameraModel, views: Sequence[TargetView], numbers: Sequence[int], k3_held: bool, print_m: float | None = None
) -> tuple[Solved, Observations]:
    """As `solve_lens`, but Brown's k3, where it is `k3_held`, is first fitted freely, then held at as much of it as the
    views tell."""
    solved, seen = solve_lens(start, views, numbers, print_m=print_m)
    if not (k3_held and has_k3(start)):
        return solved, seen
    held = with_weighed_k3(start, solved.scene.models[0], float(solved.std("lens", 0)[-1]))
    return solve_lens(held, views, numbers, print_m=print_m, still=1)


def squares_aside(
    model: CameraModel, views: Sequence[TargetView], numbers: Sequence[int]
) -> dict[int, Float[Array, "n 2"]]:
    """What a lens leaves of views, squared, by their number: the board's poses alone are found, on its stated
    layout."""
    solved, seen = solve_lens(model, views, numbers, free_lens=False)
    return {v: solved.residual_px[seen.view == v] ** 2 for v in np.unique(seen.view).tolist()}


def gain_by_chance(one: Mapping[int, float], other: Mapping[int, float]) -> float:
    """By how many standard errors `one` leaves less than `other` of the views that both were kept from (paired; each
    difference in units of what the two leave there, so that no single view decides)."""
    shared = sorted(set(one) & set(other))
    a, b = (np.array([each[v] for v in shared]) for each in (one, other))
    if len(shared) < 2 or np.array_equal(a, b):
        return 0.0
    gain = (b - a) / (a + b)
    return float(gain.mean() / (gain.std(ddof=1) / np.sqrt(len(gain))))


def solve_lens(
    start: CameraModel,
    views: Sequence[TargetView],
    numbers: Sequence[int],
    free_lens: bool = True,
    print_m: float | None = None,
    still: int = 0,
) -> tuple[Solved, Observations]:
    """Lens (where free, without its last `still` numbers) and board poses from the views of these numbers; with
    `print_m`, the standard deviation of where the board's marks lie, also their places.

    A board's corners scatter more than their detector says (blur, light, a board not quite flat), and then most of a
    view is no outlier: where a lens is solved, Huber's weight begins at so many deviations of what is left over.
    """
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
    scene = Scene(
        (start,), one, poses, one, no, free_views, no, lens, np.ones(1), no, shift, print_m, still_numbers=(still,)
    )
    solved = adjust(scene, seen, HUBER)
    if not free_lens:
        return solved, seen
    if solved.scale > 1:
        solved = adjust(solved.scene, seen, HUBER * solved.scale)
    return replace(solved, covariance=solved.covariance * max(1.0, _alike(solved))), seen


def _alike(solved: Solved) -> float:
    """By how much the lens's variance is larger than that of points which err each by itself: those of one view err
    alike. How far each view pulls the lens is what it would move by without that view (the jackknife); the mean over
    all directions of their spread against the formal covariance (the design effect of Rao and Scott, JASA 1981)."""
    lens = solved.blocks["lens", 0]
    pulls = solved.covariance[lens] @ solved.scores / max(solved.scale, 1.0) ** 2
    views, formal = pulls.shape[1], solved.covariance[lens, lens]
    spread = pulls @ pulls.T * views / max(views - 1, 1)
    return float(np.trace(np.linalg.pinv(formal, hermitian=True) @ spread)) / len(formal)
