"""Calibration targets: AprilTag grid, ChArUco board, chessboard. What they look like and where an image shows them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray as Array

from calibration.tags.detect import Response, TagDetection, detect_tags
from recordings.errors import BadInput
from recordings.progress import Progress

CORNERS = 0.5 * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
"""Of a tag of side 1 in its own frame (x right, y down, z into the paper), in the detector's order."""
NOT_TURNED = 1e-3
"""R R^T may differ from 1 by this."""
CORNER_SIGMA_PX = 0.1
"""Of a chessboard's corner: OpenCV gives none."""
CORNER_WINDOW = 0.35
"""Half the window in which a corner is refined, as a share of the smallest distance to a neighbour in the image: on
real boards .2 scatters more, .5 is no better and reaches the next corner sooner."""
WINDOW_PX = (2, 12)


@dataclass(frozen=True, eq=False)
class Tags:
    """AprilTags at known places of a board (or of any body): `board_from_tag` by id, 4x4."""

    family: str
    size_m: Mapping[int, float]
    board_from_tag: Mapping[int, Float[Array, "4 4"]]

    def corners_m(self, tag_id: int) -> Float[Array, "4 3"]:
        place = self.board_from_tag[tag_id]
        return self.size_m[tag_id] * CORNERS @ place[:3, :3].T + place[:3, 3]


@dataclass(frozen=True)
class Charuco:
    """A chessboard of columns x rows squares with markers in the white ones (OpenCV's CharucoBoard).

    The board's frame is OpenCV's: origin at the first square's outer corner, x along the columns, z into the board.
    `dictionary` by OpenCV's name, for instance DICT_5X5_100; `legacy`: the pattern of OpenCV before 4.6.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str = "DICT_5X5_100"
    legacy: bool = False


@dataclass(frozen=True)
class Chessboard:
    """A plain chessboard, counted in inner corners. It must be seen whole; columns and rows must differ, and one of
    them be odd and the other even, or the board reads the same upside down."""

    columns: int
    rows: int
    square_m: float


Target = Tags | Charuco | Chessboard


@dataclass(frozen=True, eq=False)
class TargetView:
    """A target in one image: numbers of its points, where they are on the board, in the image, and how surely."""

    ids: Int[Array, " n"]
    points_m: Float[Array, "n 3"]
    pixels: Float[Array, "n 2"]
    covariance_px2: Float[Array, "n 2 2"]
    marks: Int[Array, " n"] | None = None
    """Which printed mark each point belongs to (a tag has four points); None: each is one of its own."""

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def printed(self) -> Int[Array, " n"]:
        """The printed mark of each point."""
        return self.ids if self.marks is None else self.marks


NOTHING = TargetView(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2, 2)))


def numbered_marks(views: Sequence[tuple[int, TargetView]]) -> tuple[list[Int[Array, " n"]], int]:
    """The printed mark of every point of every view, counted from 0, and how many there are. Each view comes with the
    number of the thing that the marks are printed on: marks of the first thing are counted first."""
    marks = [(thing << 32) + view.printed.astype(np.int64) for thing, view in views]
    known = np.unique(np.concatenate([np.zeros(0, np.int64), *marks]))
    return [np.searchsorted(known, mine).astype(np.int64) for mine in marks], len(known)


class TargetViews(list[TargetView]):
    """The target in every image, in the images' order. `lost`: on how many the tag detector died."""

    def __init__(self, views: Iterable[TargetView], lost: int = 0) -> None:
        super().__init__(views)
        self.lost = lost


def find_target(
    target: Target,
    images: Sequence[UInt8[Array, "h w"]],
    response: Response = "linear",
    cache: Path | None = None,
    progress: Progress | None = None,
) -> TargetViews:
    """The target in every image; views without points where it is not seen."""
    if isinstance(target, Tags):
        lists = detect_tags(
            images, target.family, cache, progress, response=response, total=len(images), refinement="pattern"
        )
        return TargetViews((tag_view(target, tags) for tags in lists), len(lists.lost))
    if isinstance(target, Charuco):
        return TargetViews(_find_charuco(target, images))
    return TargetViews(_find_chessboard(target, image) for image in images)


def tag_view(target: Tags, found: Sequence[TagDetection]) -> TargetView:
    """The target's own tags among those found. A tag seen twice in one image is left out: one of them is wrong."""
    ids = [t.tag_id for t in found]
    mine = [t for t in found if t.tag_id in target.board_from_tag and ids.count(t.tag_id) == 1]
    if not mine:
        return NOTHING
    return TargetView(
        np.concatenate([4 * t.tag_id + np.arange(4) for t in mine]),
        np.concatenate([target.corners_m(t.tag_id) for t in mine]),
        np.concatenate([t.corners_px for t in mine]),
        np.concatenate([t.covariance_px2 for t in mine]),
        np.repeat([t.tag_id for t in mine], 4),
    )


def _find_charuco(target: Charuco, images: Sequence[UInt8[Array, "h w"]]) -> list[TargetView]:
    import cv2

    name = getattr(cv2.aruco, target.dictionary, None)
    if name is None:
        raise BadInput(f"unknown marker dictionary '{target.dictionary}'; wanted one of OpenCV's, e.g. DICT_5X5_100")
    board = cv2.aruco.CharucoBoard(
        (target.columns, target.rows), target.square_m, target.marker_m, cv2.aruco.getPredefinedDictionary(name)
    )
    board.setLegacyPattern(target.legacy)
    detector, corners_m = cv2.aruco.CharucoDetector(board), np.array(board.getChessboardCorners(), dtype=np.float64)
    views = []
    for image in images:
        pixels, ids, _, _ = detector.detectBoard(image)
        if ids is None or len(ids) < 4:
            views.append(NOTHING)
            continue
        ids = ids.ravel().astype(np.int64)
        views.append(TargetView(ids, corners_m[ids], pixels.reshape(-1, 2).astype(np.float64), _plain(len(ids))))
    return views


def _find_chessboard(target: Chessboard, image: UInt8[Array, "h w"]) -> TargetView:
    pixels = _sector_corners(target, image)
    if pixels is None:
        return NOTHING
    y, x = np.divmod(np.arange(target.columns * target.rows), target.columns)
    points_m = target.square_m * np.stack([x, y, np.zeros_like(x)], -1).astype(np.float64)
    shape = (target.rows, target.columns, 2)
    return TargetView(np.arange(len(x)), points_m, _refined(image, pixels.reshape(shape)), _plain(len(x)))


def _sector_corners(target: Chessboard, image: UInt8[Array, "h w"]) -> Float[Array, "n 2"] | None:
    """Corners by OpenCV's sector-based detector; where it sees none, in the image at half size, at last with its
    contrast evened out (of 41 real views in lamp light 33, 40 and 41 are found so). cv2.findChessboardCorners finds all
    41 too, but in shaded ones whole rows of corners beside their places."""
    import cv2

    smaller = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    thorough = cv2.CALIB_CB_EXHAUSTIVE
    tries = (
        (image, 1.0, cv2.CALIB_CB_ACCURACY),
        (smaller, 2.0, thorough),
        (smaller, 2.0, thorough | cv2.CALIB_CB_NORMALIZE_IMAGE),
    )
    for seen, scale, flags in tries:
        found, pixels = cv2.findChessboardCornersSB(seen, (target.columns, target.rows), None, flags)
        if found:
            return scale * (pixels.reshape(-1, 2).astype(np.float64) + 0.5) - 0.5
    return None


def _refined(image: UInt8[Array, "h w"], pixels: Float[Array, "r c 2"]) -> Float[Array, "n 2"]:
    """Corners moved to where the grey values' gradients point to (Foerstner 1987). What the sector-based detector finds
    is pulled along by perspective: by .1 px, which is 1 % in focal length (25 real pairs of views). A corner that moves
    by more than its window was drawn to another one and stays."""
    import cv2

    gaps = np.concatenate([np.linalg.norm(np.diff(pixels, axis=axis), axis=-1).ravel() for axis in (0, 1)])
    half = int(np.clip(round(CORNER_WINDOW * float(gaps.min())), *WINDOW_PX))
    start = np.ascontiguousarray(pixels.reshape(-1, 1, 2), dtype=np.float32)
    moved = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), (3, 60, 1e-4))
    stays = np.linalg.norm(moved - start, axis=-1, keepdims=True) > half
    return np.where(stays, start, moved).reshape(-1, 2).astype(np.float64)


def _plain(count: int) -> Float[Array, "n 2 2"]:
    return np.tile(CORNER_SIGMA_PX**2 * np.eye(2), (count, 1, 1))


def target_from_document(document: Mapping[str, Any], where: str) -> Target:
    """A session's `board`: AprilTags {family, tags: [{id, size_m, T_board_tag}]}, or {kind: charuco, columns, rows,
    square_m, marker_m, dictionary} or {kind: chessboard, columns, rows, square_m}. Raises BadInput."""
    try:
        kind = document.get("kind", "tags" if "tags" in document else None)
        if kind == "tags":
            tags = list(document["tags"])
            sizes_m = {int(t["id"]): float(t["size_m"]) for t in tags}
            places = {int(t["id"]): np.array(t["T_board_tag"], dtype=np.float64) for t in tags}
            _check_tags(sizes_m, places, where)
            return Tags(str(document.get("family", "tag36h11")), sizes_m, places)
        if kind not in ("charuco", "chessboard"):
            raise BadInput(f"{where}: a calibration board of kind {kind!r}; wanted tags, charuco or chessboard")
        sizes = (int(document["columns"]), int(document["rows"]), float(document["square_m"]))
        if min(sizes[:2]) < 2 or not 0 < sizes[2] < np.inf:
            raise BadInput(
                f"{where}: a board of {sizes[0]} x {sizes[1]} squares of {sizes[2]:g} m; wanted two or more each way, "
                "and square_m above 0"
            )
        if kind == "charuco":
            dictionary = str(document.get("dictionary", "DICT_5X5_100"))
            return Charuco(*sizes, float(document["marker_m"]), dictionary, bool(document.get("legacy", False)))
        return Chessboard(*sizes)
    except (KeyError, TypeError, ValueError) as wrong:
        raise BadInput(f"{where}: the calibration board: {type(wrong).__name__} {wrong}; see README.md") from wrong


def _check_tags(size_m: Mapping[int, float], board_from_tag: Mapping[int, Array], where: str) -> None:
    """Raises BadInput naming the tag whose size or place cannot be."""
    for tag, place in board_from_tag.items():
        turn = place[:3, :3] if place.shape == (4, 4) else np.zeros((3, 3))
        if not 0 < size_m[tag] < np.inf:
            raise BadInput(f"{where}: tag {tag} of the board has size_m {size_m[tag]:g}; wanted metres above 0")
        if not np.isfinite(place).all() or np.abs(turn @ turn.T - np.eye(3)).max() > NOT_TURNED:
            raise BadInput(
                f"{where}: T_board_tag of tag {tag} is no pose; wanted a 4x4 of finite numbers (rotation, metres)"
            )
