"""Lenses from real boards against cv2.calibrateCamera, on views that neither has seen, and against what is published.

TOSSLAB_CALIBRATION_SETS=FOLDER python tools/bench_calibration.py          # FOLDER/OWNER/REPOSITORY: clones
python tools/bench_calibration.py barry-left paper                         # some
python tools/bench_calibration.py --partitions 6 paper                     # shuffled six times, means by view

Each fifth of a set's views, in their order (or shuffled: `--partitions`, for one partition alone moves a difference by
as much as it is), is kept aside once (the outer hold-out); from the rest come our lens (`calibrate_intrinsics` with its
own choice of a model), OpenCV's on the same corners, and OpenCV's on the corners that
its examples find. Each leaves a residual on the views aside, where only the board's pose is found: `aside`, root mean
square in px on our corners. `z`: by how many standard errors ours leaves less than OpenCV's, view by view (below -2:
worse beyond chance). `published` is the residual that the published lens itself leaves of all views.
`barry-pair`: both cameras of the stereo set solved together, rotation between them against the published one.
`paper-hand`: a camera in a robot's hand, by `calibrate_hand_eye` with our lens and with the published one, against the
published place.
"""

from __future__ import annotations

import argparse
import os
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

from calibration.cameras.extrinsics import LEAST_POINTS, calibrate_cameras
from calibration.cameras.intrinsics import Lens, calibrate_intrinsics
from calibration.cameras.lens_fit import gain_by_chance, squares_aside
from calibration.cameras.poses import angle_deg
from calibration.cameras.targets import Charuco, Chessboard, TargetView, find_target
from calibration.hand_eye import LensAccuracy, calibrate_hand_eye
from recordings.geometry import CameraModel

SETS = Path(os.environ.get("TOSSLAB_CALIBRATION_SETS", Path.home() / ".cache" / "tosslab-calibration"))
OUTER = 5
Images = list[UInt8[Array, "h w"]]


@dataclass(frozen=True)
class RealSet:
    """Where a set's pictures lie, its board, and the lens published with it: fx, fy, cx, cy and OpenCV's
    distortion (empty: none is)."""

    pictures: str
    board: Chessboard | Charuco
    published: tuple[float, ...] = ()

    def images(self) -> Images:
        """Grey images in the order of their numbers; of a video all."""
        if self.pictures.endswith(".mp4"):
            return video(SETS / self.pictures)
        found = sorted(SETS.glob(self.pictures), key=lambda p: [int(n) for n in re.findall(r"\d+", p.name)])
        return [cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) for p in found]


def video(path: Path) -> Images:
    """Grey frames, inverted: caliscope's board is printed white on black."""
    reader, out = cv2.VideoCapture(str(path)), []
    while True:
        some, image = reader.read()
        if not some:
            return out
        out.append(255 - cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


BARRY = Chessboard(9, 6, 0.03)
PAPER = "MaartenJongeneel/Paper-Tracking/calibratecam"
CALISCOPE = "mprib/caliscope/tests/sessions/charuco_calibration/calibration/extrinsic"
HAND = "koide3/st_handeye_graph/calibration_data"
INVERTED = Charuco(4, 5, 0.054, 0.75 * 0.054, "DICT_4X4_1000")
ZED = (698.345, 698.345, 633.04, 369.262, -0.175930, 0.028741, 0.0, 1.29e-4, -2.85e-4)
REAL = {
    "barry-left": RealSet(
        "Barry-Liang/stereoCalibrate/left*.jpg",
        BARRY,
        (518.0516, 518.0516, 313.8813, 249.3885, -0.055059, 0.078368, 0.0, 0.0, -0.139904, 0.0, 0.0, -0.141299),
    ),
    "barry-right": RealSet(
        "Barry-Liang/stereoCalibrate/right*.jpg",
        BARRY,
        (518.0516, 518.0516, 327.5944, 261.4995, -0.080942, 0.205089, 0.0, 0.0, -0.227916, 0.0, 0.0, -0.063691),
    ),
    "sourish-left": RealSet("sourishg/stereo-calibration/calib_imgs/1/left*.jpg", Chessboard(9, 6, 0.02423)),
    "sourish-right": RealSet("sourishg/stereo-calibration/calib_imgs/1/right*.jpg", Chessboard(9, 6, 0.02423)),
    "paper": RealSet(
        f"{PAPER}/intrinsics/chessboard-*.jpg",
        Chessboard(14, 9, 0.05),
        (899.2183, 898.6074, 629.4798, 354.7511, 0.003806, 0.0, 0.0, 0.0, 0.0),
    ),
    "hand-a": RealSet(f"{HAND}/calib_a/*_image.jpg", Chessboard(11, 9, 0.03), ZED),
    "hand-b": RealSet(f"{HAND}/calib_b/*_image.jpg", Chessboard(11, 9, 0.03), ZED),
    "caliscope-0": RealSet(
        f"{CALISCOPE}/cam_0.mp4",
        INVERTED,
        (903.5501, 907.8789, 618.3086, 394.2132, -0.332099, 0.046420, -0.004296, 0.004113, 0.066568),
    ),
    "caliscope-1": RealSet(
        f"{CALISCOPE}/cam_1.mp4",
        INVERTED,
        (760.3306, 761.0215, 630.0835, 372.2112, 0.098575, -0.219684, 0.000411, -0.002605, 0.080664),
    ),
    "caliscope-2": RealSet(
        f"{CALISCOPE}/cam_2.mp4",
        INVERTED,
        (650.8019, 654.4652, 647.3392, 392.1911, 0.180399, -0.256038, 0.003210, 0.002238, 0.124023),
    ),
    "caliscope-3": RealSet(
        f"{CALISCOPE}/cam_3.mp4",
        INVERTED,
        (639.8834, 639.5401, 657.2702, 336.2648, 0.168890, -0.226565, 0.001429, 0.000415, 0.106110),
    ),
}


def usual_corners(board: Chessboard, images: Images, views: Sequence[TargetView]) -> list[TargetView]:
    """The same boards with the corners of OpenCV's examples: findChessboardCorners, cornerSubPix with 11 x 11."""
    out = []
    for image, view in zip(images, views, strict=True):
        some, corners = cv2.findChessboardCorners(image, (board.columns, board.rows))
        if not some or not len(view):
            continue
        end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
        pixels = cv2.cornerSubPix(image, corners, (11, 11), (-1, -1), end).reshape(-1, 2).astype(np.float64)
        out.append(TargetView(view.ids, view.points_m, pixels, view.covariance_px2))
    return out


def opencv_lens(name: str, size: tuple[int, int], views: Sequence[TargetView], flags: int = 0) -> CameraModel:
    """cv2.calibrateCamera as it is: Brown's five numbers (less by `flags`), plain least squares."""
    points, pixels = ([getattr(v, part).astype(np.float32) for v in views] for part in ("points_m", "pixels"))
    _, matrix, bend, *_ = cv2.calibrateCamera(points, pixels, size, None, None, flags=flags)
    return CameraModel(name, *size, matrix, "brown-conrady", tuple(bend.ravel().tolist()))


Aside = dict[int, float]


def outer_hold_out(
    views: Sequence[TargetView], ways: Mapping[str, Callable[[Sequence[int]], CameraModel]], partitions: int | None
) -> dict[str, Aside]:
    """By way of fitting (a lens from views of these numbers), the mean square that it leaves of each view aside; over
    so many random partitions its mean (None: one, in the views' order)."""
    count, found = len(views), {way: defaultdict[int, list[float]](list) for way in ways}
    orders = [np.arange(count)]
    if partitions is not None:
        orders = [np.random.default_rng(seed).permutation(count) for seed in range(partitions)]
    for aside in (sorted(part.tolist()) for order in orders for part in np.array_split(order, OUTER)):
        rest = [v for v in range(count) if v not in aside]
        for way, fit in ways.items():
            for v, squares in squares_aside(fit(rest), views, aside).items():
                found[way][v].append(float(squares.mean()))
    return {way: {v: float(np.mean(q)) for v, q in left.items()} for way, left in found.items()}


def rms(aside: Aside) -> float:
    """Of all views aside, each as heavy as another."""
    return float(np.sqrt(np.mean([*aside.values()])))


def row(name: str, partitions: int | None = None) -> str:
    """One set: the outer hold-out, and the focal length of all views against the published one."""
    real = REAL[name]
    images = real.images()
    if not images:
        return f"{name:14s} skipped: no {real.pictures} under {SETS}; set TOSSLAB_CALIBRATION_SETS"
    found = find_target(real.board, images)
    size = (images[0].shape[1], images[0].shape[0])
    views = [v for v in found if len(v) >= LEAST_POINTS]
    ways = {
        "ours": lambda rest: calibrate_intrinsics(name, size, [views[v] for v in rest]).model,
        "cv2": lambda rest: opencv_lens(name, size, [views[v] for v in rest]),
    }
    usual = usual_corners(real.board, images, found) if isinstance(real.board, Chessboard) else []
    if len(usual) == len(views):
        ways["usual"] = lambda rest: opencv_lens(name, size, [usual[v] for v in rest])
    aside = outer_hold_out(views, ways, partitions)
    lens, plain = calibrate_intrinsics(name, size, views), opencv_lens(name, size, views)
    text = f"{name:14s} {len(views):3d} views  aside " + "  ".join(f"{way} {rms(a):.4f}" for way, a in aside.items())
    text += f"  z {gain_by_chance(aside['ours'], aside['cv2']):+.1f} | {focal(lens)}; cv2 {plain.fx:.2f}"
    if "usual" in ways:
        text += f", usual {opencv_lens(name, size, usual).fx:.2f}"
    return text + against(real, lens, size, views)


def focal(lens: Lens) -> str:
    """Our focal length with twice its deviation."""
    two = 0.02 * lens.report.uncertainty["focal_percent"] * lens.model.fx
    return f"{lens.model.distortion_model} f {lens.model.fx:.2f} +- {two:.2f}"


def against(real: RealSet, lens: Lens, size: tuple[int, int], views: Sequence[TargetView]) -> str:
    """The published lens: whether our focal length is within .3 % of it or within twice our deviation, and what the
    published lens leaves of the views."""
    if not real.published:
        return ""
    known = published_lens(real, size)
    left = {v: float(q.mean()) for v, q in squares_aside(known, views, range(len(views))).items()}
    off = 100 * (lens.model.fx / known.fx - 1)
    held = abs(off) < max(0.3, 2 * lens.report.uncertainty["focal_percent"])
    text = f"; published {known.fx:.2f} (leaves {rms(left):.4f}): {off:+.2f} % {'held' if held else 'NOT HELD'}"
    if not any(real.published[5:]):  # one number of distortion, or none: its own model, fitted to these views
        same = opencv_lens("color", size, views, cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST)
        text += f", with the published lens's own model {same.fx:.2f} ({100 * (same.fx / known.fx - 1):+.2f} %)"
    return text


def published_lens(real: RealSet, size: tuple[int, int]) -> CameraModel:
    """As it was published with the set."""
    fx, fy, cx, cy, *bend = real.published
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return CameraModel("color", *size, matrix, "brown-conrady" if len(bend) == 5 else "rational", tuple(bend))


def pair() -> str:
    """The stereo set's cameras solved together: rotation from left to right against extrinsics.yml. What the commands
    `intrinsics`, then `cameras` do is the last of the three."""
    sides = {"mono0": REAL["barry-left"], "mono1": REAL["barry-right"]}
    seen = {name: find_target(real.board, real.images()) for name, real in sides.items()}
    if not all(seen.values()):
        return f"barry-pair     skipped: no {sides['mono0'].pictures} under {SETS}; set TOSSLAB_CALIBRATION_SETS"
    lenses = {name: calibrate_intrinsics(name, (640, 512), views).model for name, views in seen.items()}
    file = cv2.FileStorage(str(SETS / "Barry-Liang/stereoCalibrate/extrinsics.yml"), cv2.FILE_STORAGE_READ)
    published = file.getNode("R").mat()
    text = "barry-pair    "
    for kind, freed in (("each lens alone", ()), ("lenses solved together", tuple(lenses)), ("then as fixed", ())):
        placed = calibrate_cameras(lenses, seen, "mono0", None, freed=freed)
        lenses = placed.models
        (left_from_right,) = (t for t in placed.transforms if t.source == "mono1")
        off = float(np.linalg.norm(cv2.Rodrigues(left_from_right.rotation @ published)[0]))
        focals = "/".join(f"{placed.models[n].fx:.2f}" for n in lenses)
        stated = placed.report.uncertainty["mono1"]["direction_deg"]
        text += f" {kind}: {np.degrees(off):.3f} deg from the published rotation (stated {stated:.3f}), f {focals};"
    return text + f" cv2.stereoCalibrate: {opencv_pair(seen, published):.3f} deg"


def hand() -> str:
    """The camera in the robot's hand against eMc.yaml, with the lens of the set's own views and with camera.xml's."""
    real, lens_views = RealSet(f"{PAPER}/extrinsics/chessboard-*.jpg", REAL["paper"].board), REAL["paper"]
    images = real.images()
    if not images:
        return f"paper-hand     skipped: no {real.pictures} under {SETS}; set TOSSLAB_CALIBRATION_SETS"
    found, size = find_target(real.board, images), (images[0].shape[1], images[0].shape[0])
    own = calibrate_intrinsics("color", size, find_target(lens_views.board, lens_views.images()))
    folder = SETS / PAPER / "extrinsics"
    base_from_tool = np.array([visp_pose(folder / f"pose_fPe_{k:02d}.yaml") for k in range(1, len(images) + 1)])
    text = "paper-hand    "
    published = published_lens(lens_views, size)
    for name, lens, accuracy in (
        ("our lens", own.model, LensAccuracy.stated(own.report.uncertainty)),
        ("published lens", published, LensAccuracy()),
    ):
        text += f" {name}: {hand_against(lens, accuracy, found, base_from_tool, visp_pose(folder / 'eMc.yaml'))};"
    return text


def hand_against(
    lens: CameraModel,
    accuracy: LensAccuracy,
    found: Sequence[TargetView],
    base_from_tool: Float[Array, "n 4 4"],
    published_tool_from_camera: Float[Array, "4 4"],
) -> str:
    """How far the camera stands from its published place, and twice the deviation stated for it."""
    solved = calibrate_hand_eye(lens, found, base_from_tool, "eye-in-hand", lens=accuracy)
    gap = solved.camera_from_mount @ published_tool_from_camera
    sure = solved.report.uncertainty
    return (
        f"{1e3 * np.linalg.norm(gap[:3, 3]):.2f} mm (+- {2 * sure['position_mm']:.2f}), "
        f"{angle_deg(gap[:3, :3]):.3f} deg (+- {2 * sure['direction_deg']:.3f}) from the published place, "
        f"{solved.report.residuals['rms_px']:.2f} px, aside {solved.report.hold_out['rms_px']:.2f} px "
        f"{solved.report.hold_out['median_mm']:.2f} mm, {solved.report.verdict}"
    )


def visp_pose(path: Path) -> Float[Array, "4 4"]:
    """A pose as ViSP writes it: metres, then a rotation vector."""
    numbers = [float(n) for n in re.findall(r"-?\d+\.\d+(?:e-?\d+)?", path.read_text())]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(np.array(numbers[3:]))[0], numbers[:3]
    return pose


def opencv_pair(seen: Mapping[str, Sequence[TargetView]], published: Float[Array, "3 3"]) -> float:
    """How far OpenCV's own stereo calibration on our corners turns from the published rotation, deg."""
    points = [v.points_m.astype(np.float32) for v in seen["mono0"]]
    pixels = [[v.pixels.astype(np.float32) for v in views] for views in seen.values()]
    plain = [opencv_lens(name, (640, 512), views) for name, views in seen.items()]
    known = [part for m in plain for part in (m.K, np.array(m.distortion))]
    found = cv2.stereoCalibrate(points, *pixels, *known, (640, 512), flags=cv2.CALIB_USE_INTRINSIC_GUESS)
    return float(np.degrees(np.linalg.norm(cv2.Rodrigues(found[5].T @ published)[0])))


WITHIN_RIGS = {"barry-pair": pair, "paper-hand": hand}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", help=f"of {', '.join([*REAL, *WITHIN_RIGS])}; all where none is named")
    parser.add_argument("--partitions", type=int, metavar="N", help="random ones, instead of one in order")
    args = parser.parse_args()
    for name in args.sets or [*REAL, *WITHIN_RIGS]:
        print(WITHIN_RIGS[name]() if name in WITHIN_RIGS else row(name, args.partitions), flush=True)
