"""What a session holds for calibration: views of a board, tags in its tosses; as arrays, ready to solve."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int64, UInt8
from numpy import ndarray as Array

from calibration.cameras.targets import NOTHING, Tags, Target, TargetView, find_target, tag_view, target_from_document
from calibration.tags.detect import Refinement, Response, TagDetection, TagLists, detect_tags
from recordings.errors import BadInput
from recordings.mcap import codec
from recordings.progress import Progress
from recordings.session import Frames, Session, Toss
from recordings.tracks import RigCalibration

COLOR = "d455"
SAME_VIEW_NS = 100_000_000
TOGETHER_NS = 5_000_000
VIEWS_FILE = "calibration.mcap"


def response_of(camera: str) -> Response:
    """The D455's colour images are sRGB, the ground-truth cameras' are linear."""
    return "srgb" if camera == COLOR else "linear"


def grey_images(toss: Toss, camera: str) -> tuple[Int64[Array, " n"], Sequence[UInt8[Array, "h w"]]]:
    """Stamps and grey images of a camera, decoded when asked for."""
    frames: Frames[Any] = toss.color(camera) if camera == COLOR else toss.mono(camera)
    return frames.times_ns, _Grey(frames)


class _Grey(Sequence):
    def __init__(self, frames: Frames[Any]) -> None:
        self._frames = frames

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, position: Any) -> Any:
        image = codec.decode_image(self._frames[int(position)])
        return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image

    def __iter__(self) -> Iterator[Any]:
        return (self[k] for k in range(len(self)))


@dataclass(frozen=True, eq=False)
class BoardViews:
    """`board[camera][k]` and `table[camera][k]` are of instant k (`times_ns[k]`); `spread_ns`: how far apart the stamps
    of one instant lie at most; `lost`: images on which the tag detector died."""

    times_ns: Int64[Array, " v"]
    board: Mapping[str, list[TargetView]]
    table: Mapping[str, list[TargetView]]
    sizes: Mapping[str, tuple[int, int]]
    spread_ns: int
    lost: int = 0

    @property
    def seen_at_all(self) -> bool:
        return any(len(view) for views in self.board.values() for view in views)


def read_board_views(session: Session, cache: Path | None, progress: Progress | None = None) -> BoardViews:
    """The board in calibration.mcap. Raises BadInput where there are no views or the board is not described."""
    path = session.path / VIEWS_FILE
    if not path.exists():
        raise BadInput(
            f"{session.path} has no {VIEWS_FILE}; record one: `toss-record --calibration board {session.path}`"
        )
    target = board_of(session)
    table = table_target(session.calibration)
    with Toss(path) as toss:
        found, lost = {}, 0
        for camera in toss.cameras():
            times_ns, images = grey_images(toss, camera)
            board, on_table, dead = _find_both(target, table, images, camera, cache, progress)
            lost += dead
            size = images[0].shape[::-1] if len(images) else (0, 0)
            found[camera] = (times_ns, board, on_table, size)
    if not found:
        raise BadInput(f"{path} has no images; wanted views of the calibration board by the cameras")
    instants, spread_ns = _instants({camera: f[0] for camera, f in found.items()})
    return BoardViews(
        np.array([when for when, _ in instants], dtype=np.int64),
        {c: [f[1][at[c]] if c in at else NOTHING for _, at in instants] for c, f in found.items()},
        {c: [f[2][at[c]] if c in at else NOTHING for _, at in instants] for c, f in found.items()},
        {c: (int(f[3][0]), int(f[3][1])) for c, f in found.items()},
        spread_ns,
        lost,
    )


def _find_both(
    target: Target,
    table: Tags | None,
    images: Sequence[UInt8[Array, "h w"]],
    camera: str,
    cache: Path | None,
    progress: Progress | None,
) -> tuple[list[TargetView], list[TargetView], int]:
    """The board and the table's tags in every image, and on how many images the tag detector died."""
    response = response_of(camera)
    if isinstance(target, Tags) and (table is None or table.family == target.family):
        lists = detect_tags(
            images, target.family, cache, progress, response=response, total=len(images), refinement="pattern"
        )
        on_table = [tag_view(table, tags) if table else NOTHING for tags in lists]
        return [tag_view(target, tags) for tags in lists], on_table, len(lists.lost)
    board = find_target(target, images, response, cache, progress)
    if table is None:
        return board, [NOTHING] * len(images), board.lost
    on_table = find_target(table, images, response, cache, progress)
    return board, on_table, board.lost + on_table.lost


def _instants(times_ns: Mapping[str, Int64[Array, " n"]]) -> tuple[list[tuple[int, dict[str, int]]], int]:
    """Images of one view: nearer than 0.1 s, at most one per camera."""
    every = sorted((int(t), camera, k) for camera, times in times_ns.items() for k, t in enumerate(times))
    instants: list[tuple[int, dict[str, int]]] = []
    spread = 0
    for when, camera, k in every:
        if instants and when - instants[-1][0] < SAME_VIEW_NS and camera not in instants[-1][1]:
            instants[-1][1][camera] = k
            spread = max(spread, when - instants[-1][0])
        else:
            instants.append((when, {camera: k}))
    return instants, spread


def board_of(session: Session) -> Target:
    """The calibration board that session.json describes under `board`."""
    document = session.start.get("board")
    if not isinstance(document, Mapping):
        raise BadInput(
            f"{session.path}: session.json describes no calibration board; wanted start.board with {{family, tags}} "
            "or {kind: charuco | chessboard, columns, rows, square_m, ...}"
        )
    return target_from_document(document, str(session.path / "session.json"))


def table_target(calibration: RigCalibration) -> Tags | None:
    """The tags on the table at their given places, points in the world; None where there are none."""
    if not calibration.table_tags:
        return None
    return Tags(
        calibration.tag_family,
        {t.tag_id: t.size_m for t in calibration.table_tags},
        {t.tag_id: t.world_from_tag.matrix for t in calibration.table_tags},
    )


@dataclass(frozen=True, eq=False)
class TossTags:
    """Tags in one toss: stamps and tags per image by camera. `lost`: images on which the detector died."""

    toss: int
    times_ns: Mapping[str, Int64[Array, " n"]]
    tags: Mapping[str, TagLists]

    @property
    def lost(self) -> int:
        return sum(len(lists.lost) for lists in self.tags.values())

    def of_object(self, ids: Sequence[int] | None, table: Tags | None) -> Mapping[str, list[list[TagDetection]]]:
        """The tags of the object: those of the given ids, or all that are not on the table."""
        fixed = set(table.board_from_tag) if table else set()

        def mine(tag: TagDetection) -> bool:
            return tag.tag_id in ids if ids is not None else tag.tag_id not in fixed

        return {c: [[t for t in tags if mine(t)] for tags in lists] for c, lists in self.tags.items()}


def read_toss_tags(
    session: Session,
    number: int,
    cache: Path | None,
    progress: Progress | None = None,
    refinement: Refinement = "edges",
) -> TossTags:
    """All tags in all cameras of a toss."""
    toss = session.toss(number)
    times, tags = {}, {}
    for camera in toss.cameras():
        times[camera], images = grey_images(toss, camera)
        tags[camera] = detect_tags(
            images,
            session.calibration.tag_family,
            cache,
            progress,
            response=response_of(camera),
            total=len(images),
            refinement=refinement,
        )
    return TossTags(number, times, tags)


def mono_cameras(session: Session, cameras: Sequence[str]) -> list[str]:
    return [c for c in sorted(cameras) if c != COLOR and c in session.calibration.cameras]


def camera_from_rig(calibration: RigCalibration, cameras: Sequence[str], rig: str) -> dict[str, Float[Array, "4 4"]]:
    """Places of the cameras whose place is known, in the rig's frame (for instance `d455`)."""
    out = {}
    for camera in cameras:
        found = calibration.find(camera, rig)
        if found is not None:
            out[camera] = found.matrix
    return out
