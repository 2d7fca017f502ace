"""`toss-session import bundlesdf`: folders of BundleSDF, FoundationPose and YCBInEOAT (rgb, depth, masks, cam_K.txt).

The layout has no times: they are made from `--fps` and the frame numbers, and the session says that they are assumed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform
from recordings.importers import common
from recordings.importers.common import ImportReport, Timed, Warnings
from recordings.importers.images import IMAGE_SUFFIXES, read_depth_png, read_encoded, read_header, read_mask
from recordings.mcap.toss_writer import TossWriter
from recordings.progress import Progress, Silent
from recordings.records import DepthImage, StampedPose
from recordings.session_writer import SessionWriter, write_truth
from recordings.tracks import RigCalibration

DEPTH_UNIT_M = 0.001
LAST_FRAME_NUMBER = 10_000_000
"""A larger file number is a time stamp, not a frame number."""
FAR_M = 8.0
"""Half of the depth beyond this is no table-top scene: most likely another unit (0.25 mm and 0.1 mm are in use)."""


@dataclass(frozen=True, eq=False)
class _Toss:
    """One folder, listed. `frames`: the frame number of each image, which its time is made from."""

    number: int
    folder: Path
    camera: CameraModel
    color: Sequence[Path]
    depth: Sequence[Path]
    frames: Int64[Array, " n"]
    masks: Mapping[int, Path]
    truth: Mapping[int, Path]

    def times_ns(self, fps: float, offset_ns: int = 0) -> Int64[Array, " n"]:
        return np.rint((self.frames - self.frames[0]) * (1e9 / fps)).astype(np.int64) + offset_ns


def import_bundlesdf(
    sources: Sequence[Path], out: Path, fps: float = 30.0, progress: Progress | None = None
) -> ImportReport:
    """Make a session at `out`, one toss per folder (a folder of toss_XX folders stands for all of them).

    Depth is taken as uint16 millimetres, aligned to colour. `annotated_poses/*.txt` (4x4 camera_from_object) become
    truth/. Raises BadInput or WriteFailed; then nothing is left at `out`.
    """
    progress, warnings = progress or Silent(), Warnings()
    if not 0.1 <= fps <= 100_000:
        raise BadInput(f"--fps {fps:g}; wanted the frames per second of the recording, for instance --fps 30")
    tosses = [_list_toss(number, folder, warnings) for number, folder in enumerate(_folders(sources))]
    for toss in tosses[1:]:
        a, b = toss.camera, tosses[0].camera
        if (a.width, a.height) != (b.width, b.height) or not np.allclose(a.K, b.K, rtol=0, atol=1e-3):
            raise BadInput(
                f"{toss.folder} has another camera than {tosses[0].folder}; wanted one cam_K and image size per session"
            )
    offsets = common.clock_offsets_ns({t.number: (0, int(t.times_ns(fps)[-1])) for t in tosses})
    start = common.new_start(
        out,
        "bundlesdf",
        sources[0],
        f"the layout has no times: made from {fps:g} frames per second; every toss starts at clock_offset_ns "
        "of its file",
        object={"name": "object"},
        rig={"cameras": ["d455"], "d455": {"depth_unit_m": DEPTH_UNIT_M, "fps_assumed": fps}},
    )
    start["import"]["sources"] = [t.folder.resolve().name for t in tosses]
    total, done = sum(len(t.color) for t in tosses), 0
    with common.new_session(out, start, RigCalibration({"d455": tosses[0].camera})) as writer:
        for toss in tosses:
            progress.step(done, total, toss.folder.name)
            _write_toss(writer, toss, fps, offsets[toss.number], warnings)
            done += len(toss.color)
        truth = _write_truth(out, tosses, fps, offsets)
    progress.step(total, total)
    return common.report(writer, "bundlesdf", warnings, truth)


def _folders(sources: Sequence[Path]) -> list[Path]:
    folders: list[Path] = []
    for source in sources:
        if not source.is_dir():
            raise BadInput(f"{source} is no folder; wanted one with rgb/, depth/ and cam_K.txt")
        inside = sorted(p for p in source.glob("toss_*") if (p / "rgb").is_dir())
        folders += [source] if (source / "rgb").is_dir() or not inside else inside
    return folders


def _list_toss(number: int, folder: Path, warnings: Warnings) -> _Toss:
    for name in ("rgb", "depth"):
        if not (folder / name).is_dir():
            raise BadInput(f"{folder} has no {name}/; wanted rgb/, depth/, cam_K.txt and masks/ with the first mask")
    color, depth = common.listed(folder / "rgb", IMAGE_SUFFIXES), common.listed(folder / "depth", (".png",))
    if not color:
        raise BadInput(f"{folder / 'rgb'} is empty; wanted images named 000000.png, 000001.png, ...")
    common.same_frames(folder, color, depth)
    header = read_header(common.read_bytes(color[0]), str(color[0]))
    K = _camera_matrix(folder / "cam_K.txt")
    camera = CameraModel("d455", header.width, header.height, K)
    position = {int(p.stem): i for i, p in enumerate(color)}
    masks = _by_frame(folder / "masks", IMAGE_SUFFIXES, position, warnings)
    if not masks:
        warnings.add(f"{folder.name} has no masks/: the object must be found from depth over the table plane")
    truth = _by_frame(folder / "annotated_poses", (".txt",), position, warnings)
    return _Toss(number, folder, camera, color, depth, _frame_numbers(color), masks, truth)


def _camera_matrix(path: Path) -> Float[Array, "3 3"]:
    words = common.read_text(path).split()
    try:
        return np.array([float(word) for word in words]).reshape(3, 3)
    except ValueError as wrong:
        raise BadInput(
            f"{path}: {len(words)} words ({wrong}); wanted a 3x3 camera matrix, three numbers a line"
        ) from wrong


def _frame_numbers(color: Sequence[Path]) -> Int64[Array, " n"]:
    """File numbers count frames (one that is missing leaves a gap in time), unless they are time stamps."""
    numbers = [int(p.stem) for p in color]
    return np.array(numbers if numbers[-1] <= LAST_FRAME_NUMBER else range(len(numbers)), dtype=np.int64)


def _by_frame(
    folder: Path, suffixes: Sequence[str], position: Mapping[int, int], warnings: Warnings
) -> dict[int, Path]:
    """Files beside the images, by position of their frame; those without an image are left out aloud."""
    if not folder.is_dir():
        return {}
    files = common.listed(folder, suffixes)
    unknown = [f.name for f in files if int(f.stem) not in position]
    if unknown:
        warnings.add(
            f"{folder.parent.name}/{folder.name}: {unknown[0]} and {len(unknown) - 1} more have no image: left out"
        )
    return {position[int(f.stem)]: f for f in files if int(f.stem) in position}


def _write_toss(writer: SessionWriter, toss: _Toss, fps: float, offset_ns: int, warnings: Warnings) -> None:
    times_ns = toss.times_ns(fps, offset_ns)
    info = {"clock_offset_ns": offset_ns, "source": toss.folder.resolve().name, "fps_assumed": fps}
    with writer.toss(toss.number, info) as t:
        for position, path in toss.masks.items():
            t.mask(position, read_mask(path, toss.camera.width, toss.camera.height))
        common.write_in_order(_colors(t, toss, times_ns), _depths(t, toss, times_ns, warnings))


def _colors(t: TossWriter, toss: _Toss, times_ns: Int64[Array, " n"]) -> Iterator[Timed]:
    for path, frame, time_ns in zip(toss.color, toss.frames.tolist(), times_ns.tolist(), strict=True):
        yield time_ns, partial(t.color, read_encoded(path, toss.camera, "d455", frame, time_ns))


def _depths(t: TossWriter, toss: _Toss, times_ns: Int64[Array, " n"], warnings: Warnings) -> Iterator[Timed]:
    wanted = (toss.camera.height, toss.camera.width)
    for path, frame, time_ns in zip(toss.depth, toss.frames.tolist(), times_ns.tolist(), strict=True):
        raw = read_depth_png(path)
        if raw.shape != wanted:
            raise BadInput(
                f"{path} is {raw.shape[1]}x{raw.shape[0]}, the colour images {wanted[1]}x{wanted[0]}: depth is "
                "not aligned to colour, which this layout asks for. With both intrinsics and the transform "
                "use `toss-session import folder`"
            )
        seen = raw[raw > 0]
        if len(seen) and float(np.median(seen)) * DEPTH_UNIT_M > FAR_M:
            warnings.add(
                f"{toss.folder.name}/depth/{path.name}: half of the depth is beyond {FAR_M:g} m when read as "
                "millimetres; "
                "is its unit another one (0.25 mm, 0.1 mm)? Convert it to millimetres first"
            )
        yield time_ns, partial(t.depth, DepthImage("d455", frame, time_ns, time_ns, DEPTH_UNIT_M, raw))


def _write_truth(out: Path, tosses: Sequence[_Toss], fps: float, offsets_ns: Mapping[int, int]) -> bool:
    poses = {}
    for toss in tosses:
        times_ns = toss.times_ns(fps, offsets_ns[toss.number])
        if toss.truth:
            poses[toss.number] = [_pose(path, int(times_ns[i])) for i, path in sorted(toss.truth.items())]
    if poses:
        write_truth(out, poses, {"source": "annotated_poses of the imported folders", "accuracy": None})
    return bool(poses)


def _pose(path: Path, time_ns: int) -> StampedPose:
    try:
        matrix = np.array([float(word) for word in common.read_text(path).split()]).reshape(4, 4)
    except ValueError as wrong:
        raise BadInput(f"{path}: {wrong}; wanted a 4x4 matrix camera_from_object, four numbers a line") from wrong
    return StampedPose(time_ns, "d455", "object", Transform.from_matrix("d455", "object", matrix).matrix)
