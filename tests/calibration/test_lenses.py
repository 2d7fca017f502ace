"""What a lens may be, and what real boards say: detection, choice of the model, limits of the coefficients."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.cameras.bundle import adjust
from calibration.cameras.extrinsics import calibrate_cameras
from calibration.cameras.intrinsics import calibrate_intrinsics
from calibration.cameras.lens_fit import Fit, solve_lens
from calibration.cameras.lens_prior import bare, with_weighed_k3
from calibration.cameras.lens_support import unsupported
from calibration.cameras.targets import Chessboard, TargetView, find_target
from recordings.geometry import CameraModel

BOARD = Chessboard(9, 6, 0.03)
SIZE = (640, 512)
ZED = np.array([[697.9, 0, 633.0], [0, 697.9, 369.3], [0, 0, 1]])
K = np.array([[518.0, 0, 320], [0, 518.0, 256], [0, 0, 1]])


def picture(camera_from_board, over=4, blur_px=0.8):
    """A chessboard as a camera sees it: `over` x `over` rays a pixel, a lens's blur, some noise."""
    width, height = SIZE
    u, v = np.meshgrid(*((np.arange(n * over) + 0.5) / over - 0.5 for n in SIZE))
    board_from_pixel = np.linalg.inv(K @ camera_from_board[:3, [0, 1, 3]])
    ray = np.einsum("ij,jhw->ihw", board_from_pixel, np.stack([u, v, np.ones_like(u)]))
    x, y = (np.floor(ray[axis] / ray[2] / BOARD.square_m) for axis in (0, 1))
    black = (x >= -1) & (x < BOARD.columns) & (y >= -1) & (y < BOARD.rows) & ((x + y) % 2 == 1)
    grey = cv2.GaussianBlur(np.where(black, 40.0, 200.0), (0, 0), blur_px * over)
    grey = grey.reshape(height, over, width, over).mean(axis=(1, 3))
    return (grey + 1.5 * np.random.default_rng(0).normal(size=grey.shape)).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("turn", [[0.6, 0.0, 0.1], [0.0, 0.7, 0.3], [0.5, -0.5, 1.0]])
def test_corners_of_a_tilted_chessboard_are_not_pulled_along_by_perspective(turn):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), [-0.12, -0.07, 0.7]
    (view,) = find_target(BOARD, [picture(pose)])
    wanted = (view.points_m @ pose[:3, :3].T + pose[:3, 3]) @ K.T
    gap = view.pixels - wanted[:, :2] / wanted[:, 2:]
    assert np.sqrt((gap**2).mean()) < 0.05


def test_a_board_that_is_found_only_at_half_size_has_its_corners_just_as_well(monkeypatch):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([0.5, -0.5, 1.0]).as_matrix(), [-0.12, -0.07, 0.7]
    found_in, image = cv2.findChessboardCornersSB, picture(pose)
    (whole,) = find_target(BOARD, [image])
    monkeypatch.setattr(
        cv2, "findChessboardCornersSB", lambda a, *rest: (False, None) if a.shape == image.shape else found_in(a, *rest)
    )
    (half,) = find_target(BOARD, [image])
    assert half.ids.tolist() == whole.ids.tolist()
    assert np.abs(half.pixels - whole.pixels).max() < 0.02


@pytest.mark.parametrize(
    ("kind", "numbers", "said"),
    [
        ("brown-conrady", (-0.6, 0.0, 0.0, 0.0, 0.0), "folds over at"),
        ("brown-conrady", (-0.06, 0.19, 0.0, 0.0, -0.17), None),
        ("rational", (2.8, 103.7, 0.0, 0.0, 50.7, 2.8, 104.8, 50.3), "drawn to noise"),
        ("rational", (0.3, -0.1, 0.0, 0.0, 0.01, 0.6, -0.15, 0.0), None),
        ("fisheye", (0.05, -0.02, 0.0, 0.0), None),
        ("none", (), None),
    ],
)
def test_a_lens_that_folds_over_or_is_made_of_cancelling_terms_is_unsupported(kind, numbers, said):
    why = unsupported(CameraModel("mono0", *SIZE, K, kind, numbers))
    assert why is None if said is None else said in why


def test_a_lens_that_folds_over_only_where_nothing_was_seen_is_supported_there():
    lens = CameraModel("hand", 1280, 720, ZED, "brown-conrady", (-0.1795, 0.0444, 3e-4, 8e-4, -0.0188))
    assert "folds over at" in unsupported(lens)
    assert unsupported(lens, np.array([[100.0, 360.0], [1200.0, 100.0]])) is None


@pytest.fixture(scope="module")
def noisy_views(geometry):
    """A board in the middle of the image, seen by a lens with little distortion: nothing tells a rational one."""
    rng = np.random.default_rng(2)
    true = geometry.camera("mono0", 620.0, distortion_model="brown-conrady", distortion=(-0.06, 0.08, 0.0, 0.0, 0.0))
    return [geometry.view(true, geometry.tilted(rng, (0.5, 0.8), 0.05), rng) for _ in range(12)]


@pytest.mark.slow
def test_a_lens_drawn_to_noise_is_refused_and_never_chosen_where_another_will_do(noisy_views):
    asked = calibrate_intrinsics("mono0", (640, 480), noisy_views, ("rational",))
    assert unsupported(asked.model) is not None
    assert asked.report.verdict == "refused"
    assert any("ask for a simpler lens" in reason for reason in asked.report.reasons())
    free = calibrate_intrinsics("mono0", (640, 480), noisy_views)
    assert unsupported(free.model) is None
    assert free.report.verdict != "refused"
    assert "rational" in free.report.details["unsupported"]


def opencv_lens(views, size):
    points, pixels = ([getattr(v, part).astype(np.float32) for v in views] for part in ("points_m", "pixels"))
    near = np.array([[600.0, 0, size[0] / 2], [0, 600.0, size[1] / 2], [0, 0, 1]])  # the board is not flat: a start
    _, matrix, bend, *_ = cv2.calibrateCamera(points, pixels, size, near, None, flags=cv2.CALIB_USE_INTRINSIC_GUESS)
    return CameraModel("mono0", *size, matrix, "brown-conrady", tuple(bend.ravel().tolist()))


def rms_px(model, views):
    return float(np.sqrt((solve_lens(model, views, range(len(views)), free_lens=False)[0].residual_px ** 2).mean()))


@pytest.mark.parametrize("seed", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_views_never_seen_are_explained_as_well_as_by_plain_opencv(geometry, seed):
    """With corners of which some are wrong by pixels, and a lens that bends by as much as the noise."""
    rng = np.random.default_rng(seed)
    bend = (-0.05 * seed, 0.03 * seed, 0.0, 0.0, 0.0)
    true = geometry.camera("mono0", 620.0, distortion_model="brown-conrady", distortion=bend)
    views = [geometry.view(true, geometry.tilted(rng, (0.35, 0.6), 0.12), rng) for _ in range(20)]
    known, fresh = views[:10], views[10:]
    known = [replace(v, pixels=v.pixels + 2.0 * (rng.random((len(v), 1)) < 0.01)) for v in known]
    ours = calibrate_intrinsics("mono0", (640, 480), known).model
    assert rms_px(ours, fresh) <= 1.01 * rms_px(opencv_lens(known, (640, 480)), fresh)


def corner_views(geometry, true, rng):
    """Ten views of the image's middle, and one that reaches its corner."""
    far = geometry.pose([np.pi, 0, 0.3], [-0.21, -0.16, 0.5])
    middle = [geometry.view(true, geometry.tilted(rng, (0.55, 0.9), 0.05), rng) for _ in range(10)]
    return middle, geometry.view(true, far, rng)


@pytest.mark.slow
def test_a_corner_of_the_image_that_no_view_reached_is_explained_better_than_by_plain_opencv(geometry):
    """Where k3 is hardly told it is held back: fitted to the noise, it bends what lies farther out by pixels."""
    true = geometry.camera("mono0", 620.0, distortion_model="brown-conrady", distortion=(-0.17, 0.03, 0.0, 0.0, 0.0))
    ours, plain = [], []
    for seed in range(3):
        middle, far = corner_views(geometry, true, np.random.default_rng(seed))
        lens = calibrate_intrinsics("mono0", (640, 480), middle, ("brown-conrady",))
        free = opencv_lens(middle, (640, 480))
        assert abs(lens.model.distortion[4]) < abs(free.distortion[4])
        ours.append(rms_px(lens.model, [far]))
        plain.append(rms_px(free, [far]))
    assert np.linalg.norm(ours) < np.linalg.norm(plain)


@pytest.mark.slow
def test_a_lens_that_bends_by_k3_where_views_reach_is_given_it(geometry):
    rng = np.random.default_rng(1)
    true = geometry.camera("mono0", 400.0, distortion_model="brown-conrady", distortion=(-0.3, 0.2, 0.0, 0.0, -0.1))
    views = [geometry.view(true, geometry.tilted(rng, (0.3, 0.45), 0.1), rng) for _ in range(12)]
    lens = calibrate_intrinsics("mono0", (640, 480), views, ("none", "brown-conrady"))
    assert lens.report.details["lens"] == "brown-conrady"
    assert lens.model.distortion[4] == pytest.approx(-0.1, abs=0.03)


@pytest.mark.parametrize(
    ("k3", "distance_m", "sigma_px", "held"), [(-0.35, (0.3, 0.45), 0.5, False), (0.0, (0.8, 1.0), 0.1, True)]
)
def test_k3_is_free_where_views_tell_it_and_leave_less_of_those_aside_so(geometry, k3, distance_m, sigma_px, held):
    """At this image's corner (r = 1) the first is seven times as large as it is among lenses; the second's views do not
    reach far enough to tell it."""
    rng = np.random.default_rng(0)
    true = geometry.camera("mono0", 400.0, distortion_model="brown-conrady", distortion=(-0.3, 0.2, 0.0, 0.0, k3))
    views = [geometry.view(true, geometry.tilted(rng, distance_m, 0.1), rng, sigma_px) for _ in range(12)]
    fit = Fit.of(bare(true, "brown-conrady"), views)
    assert fit.k3_held is held
    assert abs(fit.model.distortion[4] - k3) < 0.01


def lens_told_by(k3):
    return CameraModel("mono0", 640, 480, K, "brown-conrady", (-0.1, 0.05, 0.0, 0.0, k3))


def test_k3_counts_by_how_well_views_tell_it():
    start = bare(lens_told_by(0.0), "brown-conrady")
    sure, half, not_told = (with_weighed_k3(start, lens_told_by(-0.2), std).distortion[4] for std in (1e-4, 0.2, 20.0))
    assert sure == pytest.approx(-0.2, rel=1e-3)
    assert -0.15 < half < -0.05
    assert abs(not_told) < 1e-4


@pytest.mark.slow
def test_where_points_of_a_view_err_alike_the_focal_lengths_deviation_says_so(geometry):
    """Each view's corners are drawn out along its own direction by a part in a thousand, as by motion or light."""
    true, far = geometry.camera("mono0", 620.0), []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        views = [geometry.view(true, geometry.tilted(rng, (0.4, 0.7), 0.1), rng) for _ in range(12)]
        views = [replace(v, pixels=v.pixels @ (np.eye(2) + rng.normal(0, 2e-3, (2, 2)))) for v in views]
        lens = calibrate_intrinsics("mono0", (640, 480), views, ("none",))
        far.append(100 * (lens.model.fx / true.fx - 1) / lens.report.uncertainty["focal_percent"])
    assert np.sqrt(np.mean(np.square(far))) < 1.5


def test_points_that_err_each_by_itself_leave_the_formal_deviation_as_it_is(geometry):
    true, wider = geometry.camera("mono0", 620.0), []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        views = [geometry.view(true, geometry.tilted(rng, (0.4, 0.7), 0.1), rng) for _ in range(12)]
        solved, seen = solve_lens(true, views, range(12))
        wider.append(solved.std("lens", 0)[0] / adjust(solved.scene, seen).std("lens", 0)[0])
    assert np.mean(wider) < 1.1


def bowed(board_m, mm_in_a_metre):
    """Chessboard corners of a board of this width, bowed across it by so much of its diagonal (root mean square)."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.5, 0.5, 14) * board_m, np.linspace(-0.3, 0.3, 9) * board_m))
    bow = x**2 - (x**2).mean()
    z = bow / bow.std() * 1e-3 * mm_in_a_metre * np.hypot(board_m, 0.6 * board_m)
    return np.stack([x, y, np.zeros_like(x)], -1), np.stack([x, y, z], -1)


def test_the_focal_lengths_deviation_says_what_a_large_board_bowed_by_a_millimetre_in_a_metre_does(geometry):
    flat, bent = bowed(0.7, 1.0)
    true, far = geometry.camera("mono0", 900.0), []
    for seed in range(3):
        rng, views = np.random.default_rng(seed), []
        for _ in range(14):
            place = geometry.tilted(rng, (1.0, 1.8), 0.1)
            pixels = true.project(bent @ place[:3, :3].T + place[:3, 3])
            seen = true.sees(pixels)
            pixels = pixels[seen] + 0.1 * rng.normal(size=(int(seen.sum()), 2))
            covariance = np.tile(0.01 * np.eye(2), (len(pixels), 1, 1))
            views.append(TargetView(np.flatnonzero(seen), flat[seen], pixels, covariance))
        lens = calibrate_intrinsics("mono0", (640, 480), views, ("none",))
        far.append(100 * (lens.model.fx / true.fx - 1) / lens.report.uncertainty["focal_percent"])
    assert np.sqrt(np.mean(np.square(far))) < 1.5, far


def test_lenses_solved_together_keep_k3_where_their_own_views_told_nothing_of_it(geometry):
    rng = np.random.default_rng(0)
    bend = {"distortion_model": "brown-conrady", "distortion": (-0.1, 0.02, 0.0, 0.0, 0.0)}
    pair = {name: geometry.camera(name, 600.0, **bend) for name in ("mono0", "mono1")}
    beside = geometry.pose([0, 0.1, 0], [-0.1, 0, 0])
    poses = [geometry.tilted(rng, (0.5, 0.8), 0.08) for _ in range(8)]
    views = {"mono0": [geometry.view(pair["mono0"], p, rng) for p in poses]}
    views["mono1"] = [geometry.view(pair["mono1"], beside @ p, rng) for p in poses]
    placed = calibrate_cameras(pair, views, "mono0", freed=("mono0", "mono1"))
    for name, model in placed.models.items():
        assert model.distortion[4] == 0.0
        assert model.fx != pair[name].fx
        assert model.fx == pytest.approx(600.0, rel=5e-3)
