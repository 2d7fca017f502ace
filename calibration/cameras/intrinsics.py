"""Lenses: focal lengths, principal point and distortion of one camera from views of a board of known layout.

    lens = calibrate_intrinsics("mono0", (1440, 1080), views)
    lens.model, lens.report.verdict

Several lens models are fitted with the board's marks where its layout has them, and judged on views kept aside, where
only the board's pose is found. (Its marks free as well, real boards turn out bent by a millimetre in a metre, explain
their views by a third better, and the focal length moves by .3 to 2 %: nothing but the board tells which is right, so
that step counts into the deviation.) Brown's lens is the standard, its k3 as far as views tell it (`lens_prior.py`);
another is taken where it does better by a standard error. A lens whose numbers the image circle does not support is
refused. Figures on real boards: tools/bench_calibration.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from calibration.cameras.bundle import Solved
from calibration.cameras.extrinsics import AS_GOOD, LEAST_POINTS, PRINT_M, judge_print
from calibration.cameras.lens_fit import (
    LEAST_VIEWS,
    STANDARD_ERRORS,
    Fit,
    fit_lens,
    gain_by_chance,
    solve_lens,
    squares_aside,
)
from calibration.cameras.lens_prior import bare
from calibration.cameras.lens_support import unsupported
from calibration.cameras.projection_derivatives import lens_numbers, with_lens
from calibration.cameras.targets import TargetView
from calibration.report import Finding, Report, limit
from recordings.errors import BadInput
from recordings.geometry import COEFFICIENTS, CameraModel, DistortionModel

GOOD_VIEWS = 10
GOOD_PX, WORST_PX = 0.5, 2.0
GOOD_FOCAL_PERCENT, WORST_FOCAL_PERCENT = 0.3, 2.0
STANDARD: DistortionModel = "brown-conrady"
FLATNESS = 1e-3
"""How far a board's marks may lie beside its layout, of its diagonal (standard deviation by axis): three real boards of
.3, .4 and .8 m were bent by 1.1, .3 and 1.1 mm in a metre (tools/bench_calibration.py)."""
CELLS = 6
LEAST_COVERAGE = 0.6
LEAST_TILT_DEG = 15.0
ALPHAS = (0.0, 0.25, 0.5, 0.75, 1.0)
SAME_MATRIX = 0.01
DRAWS = 60


@dataclass(frozen=True, eq=False)
class Lens:
    """A calibrated lens. `residual_px`, `pixels`: (n, 2) seen minus predicted, and where."""

    model: CameraModel
    report: Report
    residual_px: Float[Array, "n 2"]
    pixels: Float[Array, "n 2"]


def calibrate_intrinsics(
    camera: str,
    size: tuple[int, int],
    views: Sequence[TargetView],
    lens_models: Sequence[DistortionModel] = ("none", "brown-conrady", "rational"),
    given: CameraModel | None = None,
    anew: bool = False,
) -> Lens:
    """`size`: width and height. `given`: what the camera is said to be (a start, and judged against the result); it is
    kept where it explains the views as well as a fitted lens, unless `anew`.

    Raises BadInput where there are too few views to try.
    """
    used = [view for view in views if len(view) >= LEAST_POINTS]
    if len(used) < LEAST_VIEWS:
        raise BadInput(
            f"{camera} shows the board in {len(used)} of {len(views)} views; wanted at least {LEAST_VIEWS}, better 30: "
            "`toss-record --calibration board`"
        )
    first = given if given is not None and given.distortion_model == "none" else _first_guess(camera, size, used)
    fits = {kind: Fit.of(bare(first, kind), used) for kind in lens_models}
    kind = _chosen(fits)
    fit = fits[kind]
    opened = _open_print(fit, used)
    fits_size = given is not None and (given.width, given.height) == size
    kept = _kept(camera, given, fit, opened, used) if given is not None and fits_size else None
    if kept is not None and not anew:
        return kept
    findings = [*_judge(camera, fit, opened, used, size), *judge_print(opened)]
    findings += _against_given(camera, given, fit.model)
    if kept is not None:
        findings.append(_no_better(camera, _uncertainty(fit, opened)))
    report = Report(
        "intrinsics",
        {"rms_px": fit.solved.rms_px, "views": len(np.unique(fit.seen.view)), "points": len(fit.seen)},
        {"rms_px": fit.hold_out_px, "rms_px_by_lens": {k: f.hold_out_px for k, f in fits.items()}},
        _uncertainty(fit, opened),
        tuple(findings),
        {
            "lens": kind,
            "unsupported": {k: why for k, f in fits.items() if (why := _unsupported(f)) is not None},
            "coverage": coverage(fit.seen.pixels, size),
            "rejected_views": sorted(fit.rejected),
        },
    )
    return Lens(fit.model, report, fit.solved.residual_px, fit.seen.pixels)


def as_good_alone(lens: Lens, other: CameraModel, views: Sequence[TargetView]) -> bool:
    """Whether another lens is supported and explains this camera's views as well as `lens` did those kept aside."""
    rejected = lens.report.details["rejected_views"]
    used = [view for view in views if len(view) >= LEAST_POINTS]
    squares = squares_aside(other, used, [v for v in range(len(used)) if v not in rejected])
    rms_px = float(np.sqrt(np.concatenate([*squares.values()]).mean()))
    seen = np.concatenate([view.pixels for view in used])
    return unsupported(other, seen) is None and rms_px <= float(lens.report.hold_out["rms_px"])


def _open_print(fit: Fit, views: Sequence[TargetView]) -> Solved:
    """The views with the board's marks free to lie elsewhere, which judges the board: a bent or wrongly printed one."""
    numbers = [v for v in range(len(views)) if v not in fit.rejected]
    board_m = float(np.linalg.norm(np.ptp(np.concatenate([views[v].points_m for v in numbers]), axis=0)))
    return fit_lens(fit.model, views, numbers, fit.k3_held, max(PRINT_M, FLATNESS * board_m))[0]


def _kept(camera: str, given: CameraModel, fit: Fit, opened: Solved, views: Sequence[TargetView]) -> Lens | None:
    """The given lens, where it explains the views as well as the fitted one does views that it has not seen: few views,
    or views of the image's middle only, know a lens less well than its maker."""
    numbers = [v for v in range(len(views)) if v not in fit.rejected]
    solved, seen = solve_lens(given, views, numbers, free_lens=False)
    if solved.rms_px > AS_GOOD * fit.hold_out_px:
        return None
    text = (
        f"{camera}: the given lens explains the views as well ({solved.rms_px:.4f} px) as one fitted to them does "
        f"views kept aside ({fit.hold_out_px:.4f} px): kept; `--anew` takes the fitted one"
    )
    report = Report(
        "intrinsics",
        {"rms_px": solved.rms_px, "views": len(np.unique(seen.view)), "points": len(seen)},
        {"rms_px": solved.rms_px, "fitted_rms_px": fit.hold_out_px},
        {f"fitted_{name}": value for name, value in _uncertainty(fit, opened).items()},
        (
            Finding("note", text),
            *limit(solved.rms_px, f"{camera}'s residual", "px", GOOD_PX, WORST_PX),
            *_judge_views(camera, fit, views, (given.width, given.height)),
        ),
        {
            "lens": "given",
            "coverage": coverage(seen.pixels, (given.width, given.height)),
            "rejected_views": sorted(fit.rejected),
        },
    )
    return Lens(given, report, solved.residual_px, seen.pixels)


def _no_better(camera: str, uncertainty: Mapping[str, float]) -> Finding:
    open_by = uncertainty["focal_percent"]
    return Finding(
        "warning",
        f"{camera}: the lens given before explains these views as well as the fitted one; they leave focal "
        f"lengths open by {open_by:.2f} % (this camera alone): without --anew the given one is kept",
    )


def coverage(pixels: Float[Array, "n 2"], size: tuple[int, int]) -> float:
    """Share of a 6 x 6 grid over the image that holds points."""
    cell = np.floor(pixels / np.array(size) * CELLS).clip(0, CELLS - 1).astype(int)
    return len(np.unique(cell[:, 0] * CELLS + cell[:, 1])) / CELLS**2


def _first_guess(camera: str, size: tuple[int, int], views: Sequence[TargetView]) -> CameraModel:
    """Zhang's closed form for flat boards, the centre as the principal point."""
    flat = [v for v in views if np.ptp(v.points_m[:, 2]) < 1e-9]
    width, height = size
    K = np.array([[1.2 * width, 0, (width - 1) / 2], [0, 1.2 * width, (height - 1) / 2], [0, 0, 1.0]])
    if len(flat) >= LEAST_VIEWS:
        points = [np.ascontiguousarray(v.points_m - v.points_m[0], dtype=np.float32) for v in flat]
        found = cv2.initCameraMatrix2D(points, [v.pixels.astype(np.float32) for v in flat], size, 1.0)
        if np.isfinite(found).all() and 0.2 * width < found[0, 0] < 20 * width:
            K[0, 0] = K[1, 1] = found[0, 0]
    return CameraModel(camera, width, height, K)


def _chosen(fits: Mapping[DistortionModel, Fit]) -> DistortionModel:
    """Of the lenses that their image circles support (of all where none is): the standard one, where no other does
    better by a standard error on views kept aside."""
    fine = {kind: f for kind, f in fits.items() if _unsupported(f) is None} or fits
    order = sorted(fine, key=lambda kind: COEFFICIENTS[kind])
    taken = STANDARD if STANDARD in fine else order[0]
    for kind in order:
        gain = gain_by_chance(fine[kind].aside_px2, fine[taken].aside_px2)
        if kind != taken and gain > STANDARD_ERRORS:
            taken = kind
    return taken


def _unsupported(fit: Fit) -> str | None:
    """Why the circle in which points were seen does not support the lens fitted to them."""
    return unsupported(fit.model, fit.seen.pixels)


def _judge(camera: str, fit: Fit, opened: Solved, views: Sequence[TargetView], size: tuple[int, int]) -> list[Finding]:
    found = limit(fit.solved.rms_px, f"{camera}'s residual", "px", GOOD_PX, WORST_PX)
    found += limit(fit.hold_out_px, f"{camera}'s residual on views kept aside", "px", GOOD_PX, WORST_PX)
    focal = _uncertainty(fit, opened)["focal_percent"]
    why, at_corners = _unsupported(fit), unsupported(fit.model)
    if why is None and at_corners is not None:
        text = f"{camera}: no point was seen that far out, but {at_corners}"
        found.append(Finding("warning", f"{text}; show the board in the corners, or use the middle only"))
    if why is not None:
        found.append(Finding("refused", f"{camera}: {why}; ask for a simpler lens, or show the board up to the edges"))
    found += limit(focal, f"the deviation of {camera}'s focal length", "%", GOOD_FOCAL_PERCENT, WORST_FOCAL_PERCENT)
    by_print = _moved_by_print(fit, opened)
    if by_print > GOOD_FOCAL_PERCENT:
        text = f"{camera}: a board not quite flat or as laid out would explain {by_print:.1f} % of focal length"
        found.append(Finding("warning", f"{text}, which the deviation counts; use a board on a stiff, flat plate"))
    if fit.rejected:
        found.append(Finding("note", f"{camera}: {len(fit.rejected)} views left out for their residuals"))
    return found + _judge_views(camera, fit, views, size)


def _judge_views(camera: str, fit: Fit, views: Sequence[TargetView], size: tuple[int, int]) -> list[Finding]:
    """Whether there are enough views, all over the image and tilted."""
    found = []
    if len(views) < GOOD_VIEWS:
        found.append(Finding("warning", f"{camera} has {len(views)} views, wanted {GOOD_VIEWS} or more"))
    share = coverage(fit.seen.pixels, size)
    if share < LEAST_COVERAGE:
        text = f"{camera}: the board was seen in {100 * share:.0f} % of the image, wanted {100 * LEAST_COVERAGE:.0f} %"
        found.append(
            Finding("warning", f"{text}; the lens is guessed elsewhere: show the board {_bare_parts(fit, size)}")
        )
    tilt = _tilts_deg(fit)
    if np.ptp(tilt) < LEAST_TILT_DEG:
        text = f"{camera}: the board was tilted by {tilt.min():.0f}..{tilt.max():.0f} deg only"
        found.append(
            Finding("warning", f"{text}: focal length and distance are hard to tell apart; tilt it up to 45 deg")
        )
    return found


def _bare_parts(fit: Fit, size: tuple[int, int]) -> str:
    """Where in the image there are the fewest points."""
    side = np.floor(fit.seen.pixels / np.array(size) * 3).clip(0, 2).astype(int)
    counts = np.zeros((3, 3))
    np.add.at(counts, (side[:, 1], side[:, 0]), 1)
    names = np.array(
        [[f"{v} {h}".strip() for h in ("left", "", "right")] for v in ("upper", "", "lower")], dtype=object
    )
    names[1, 1] = "in the middle"
    empty = names[counts < 0.03 * counts.sum()]
    return ", ".join(empty.tolist()) or "nearer, so that it fills the image"


def _tilts_deg(fit: Fit) -> Float[Array, " v"]:
    """Angle between the board's normal and the optical axis, per view."""
    poses = fit.solved.scene.rig_from_body[np.unique(fit.seen.view)]
    return np.degrees(np.arccos(np.abs(poses[:, 2, 2]).clip(0, 1)))


def _moved_by_print(fit: Fit, opened: Solved) -> float:
    """By how many percent the focal length moves when the board's marks may lie elsewhere."""
    return 100 * abs(opened.scene.models[0].fx / fit.model.fx - 1)


def _uncertainty(fit: Fit, opened: Solved) -> dict[str, float]:
    """Standard deviations; what the board's marks may be off counts into the focal length's."""
    std, model = fit.solved.std("lens", 0), fit.model
    of_pixels = 100 * float(max(std[0] / model.fx, std[1] / model.fy))
    return {
        "focal_percent": float(np.hypot(of_pixels, _moved_by_print(fit, opened))),
        "principal_point_px": float(np.hypot(std[2], std[3])),
        "projection_px": _projection_spread_px(fit),
    }


def _projection_spread_px(fit: Fit) -> float:
    """How far pixels move among lenses drawn from the covariance, over the whole image, after the rotation that
    explains most of it (a camera's pose would take that up): root mean square over grid and draws."""
    model, where = fit.model, fit.solved.blocks["lens", 0]
    u, v = np.meshgrid(np.linspace(0, model.width - 1, 7), np.linspace(0, model.height - 1, 5))
    pixels = np.stack([u.ravel(), v.ravel()], -1)
    rays = model.rays(pixels)
    rays = rays[np.isfinite(rays).all(axis=1)]
    turned = [model.project(rays + 1e-5 * np.cross(np.eye(3)[k], rays)) - model.project(rays) for k in range(3)]
    basis = np.linalg.qr(np.stack(turned, -1).reshape(-1, 3))[0]
    chance = np.random.default_rng(0)
    numbers, root = lens_numbers(model), _root(fit.solved.covariance[where, where])
    squares = []
    for _ in range(DRAWS):
        drawn = numbers.copy()
        drawn[: len(root)] += root @ chance.normal(size=len(root))
        drawn[2:4] = drawn[2:4].clip(0, [model.width - 1, model.height - 1])
        gap = (with_lens(model, drawn).project(rays) - model.project(rays)).ravel()
        squares.append(((gap - basis @ (basis.T @ gap)) ** 2).mean())
    return float(np.sqrt(2 * np.mean(squares)))


def _root(covariance: Float[Array, "k k"]) -> Float[Array, "k k"]:
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(values.clip(0))


def _against_given(camera: str, given: CameraModel | None, fitted: CameraModel) -> list[Finding]:
    if given is None or (given.width, given.height) != (fitted.width, fitted.height):
        return []
    alpha = new_matrix_alpha(given, fitted)
    if alpha is not None:
        return [
            Finding(
                "warning",
                f"{camera}: the intrinsics given so far (focal length {given.fx:.1f}) are those of "
                f"getOptimalNewCameraMatrix (alpha {alpha:g}) with the distortion kept: that matrix belongs to "
                f"undistorted images, which have no distortion; the camera's own focal length is {fitted.fx:.1f}",
            )
        ]
    change = 100 * abs(fitted.fx / given.fx - 1)
    if change > WORST_FOCAL_PERCENT:
        return [Finding("note", f"{camera}: the focal length changed by {change:.1f} % against the one given so far")]
    return []


def new_matrix_alpha(given: CameraModel, fitted: CameraModel) -> float | None:
    """The alpha with which cv2.getOptimalNewCameraMatrix of the fitted lens gives the matrix that was `given` together
    with a distortion; None where it does not, or where `given` has no distortion."""
    if not any(given.distortion) or given.distortion_model == "fisheye" or _same(given.K, fitted.K):
        return None
    bend = np.array(given.distortion)
    for alpha in ALPHAS:
        new, _ = cv2.getOptimalNewCameraMatrix(fitted.K, bend, (given.width, given.height), alpha)
        if _same(new, given.K):
            return alpha
    return None


def _same(a: Float[Array, "3 3"], b: Float[Array, "3 3"]) -> bool:
    scale = np.array([b[0, 0], b[1, 1], b[0, 0], b[1, 1]])
    return bool(np.abs((a - b)[[0, 1, 0, 1], [0, 1, 2, 2]] / scale).max() < SAME_MATRIX)
