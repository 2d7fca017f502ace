"""`toss-session import folder`: the folder layout into a session (that of `cube_dev` and `lab_dev`).

Each toss of the layout has its own clock starting at 0. On the session clock toss k starts at `clock_offset_ns` of its
file's info, so that the clock grows over the session; `export folder` takes the offset off again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.geometry import CameraModel
from recordings.importers import common
from recordings.importers.common import ImportReport, Timed, Warnings
from recordings.importers.folder_layout import Layout, read_layout
from recordings.importers.images import IMAGE_SUFFIXES, read_depth_png, read_encoded, read_mask
from recordings.importers.truth_folder import import_truth, read_truth_folder
from recordings.mcap.toss_writer import TossWriter
from recordings.progress import Progress, Silent
from recordings.records import ArmStates, DepthImage, TossEvent
from recordings.session_writer import SessionWriter

ARM_JOINTS = {"franka_panda": tuple(f"panda_joint{i}" for i in range(1, 8))}
ARM_BATCH = 50
VIEW_STEP_NS = 1_000_000_000
OWN_TIMES = ". Wanted the same numbers in both, or depth_timestamps.txt with one time per depth image"
"""Without own times a depth image belongs to the colour image of its number."""
CLOCK = "every toss has its own clock starting at 0; toss k starts at clock_offset_ns of its file"


@dataclass(frozen=True, eq=False)
class _Images:
    """Image files and their times on the toss's own clock."""

    paths: Sequence[Path]
    time_ns: Int64[Array, " n"]


@dataclass(frozen=True, eq=False)
class _Toss:
    """One toss of the layout, listed and timed but not read. Times are on its own clock."""

    number: int
    folder: Path
    color: Sequence[Path]
    color_ns: Int64[Array, " n"]
    depth: Sequence[Path]
    depth_ns: Int64[Array, " m"]
    mono: dict[str, _Images] = field(default_factory=dict)
    arm: ArmStates | None = None
    about: dict[str, Any] = field(default_factory=dict)

    def span_ns(self) -> tuple[int, int]:
        times = [self.color_ns, self.depth_ns, *(m.time_ns for m in self.mono.values())]
        times += [self.arm.time_ns] if self.arm is not None else []
        return min(int(t[0]) for t in times if len(t)), max(int(t[-1]) for t in times if len(t))


def import_folder(source: Path, out: Path, truth: Path | None = None, progress: Progress | None = None) -> ImportReport:
    """Make a session at `out` from a folder layout; `truth` is a folder of the `*_truth` layout, read into truth/.

    Raises BadInput (source) or WriteFailed (disk); then nothing is left at `out`.
    """
    progress = progress or Silent()
    warnings = Warnings()
    layout = read_layout(source, warnings)
    tosses = [_list_toss(folder, number, layout, warnings) for number, folder in _toss_folders(source)]
    true = read_truth_folder(truth) if truth is not None else None
    offsets = common.clock_offsets_ns({t.number: t.span_ns() for t in tosses})
    total, done = sum(len(t.color) for t in tosses), 0
    with common.new_session(out, _start(out, layout, warnings), layout.calibration) as writer:
        for toss in tosses:
            progress.step(done, total, f"toss {toss.number}")
            _write_toss(writer, toss, layout, offsets[toss.number], warnings)
            done += len(toss.color)
        _write_views(writer, layout, warnings)
        if true is not None:
            times = {t.number: t.color_ns + offsets[t.number] for t in tosses}
            import_truth(true, out, times, offsets, warnings)
    progress.step(total, total)
    return common.report(writer, "folder", warnings, truth is not None)


def _start(out: Path, layout: Layout, warnings: Warnings) -> dict[str, Any]:
    camera = layout.document["camera"]
    start = common.new_start(out, "folder", layout.source, CLOCK, object=dict(layout.object))
    start["rig"] = {
        "cameras": sorted({"d455", *layout.mono}),
        "d455": {k: v for k, v in camera.items() if k not in ("K", "distortion", "width", "height")},
        "arm": layout.document.get("arm"),
    }
    start["import"] |= {"document": dict(layout.document), "warnings": list(warnings.all())}
    if layout.mono:
        left = {k: v for k, v in layout.mono_document.items() if k not in ("cameras", "calibration_board")}
        start["import"]["mono_document"] = left
        start["board"] = layout.mono_document.get("calibration_board")
    return start


def _toss_folders(source: Path) -> list[tuple[int, Path]]:
    found = [p for p in source.glob("toss_*") if p.is_dir() and p.name[5:].isdigit()]
    if not found:
        raise BadInput(f"{source} has no tosses; wanted folders toss_00, toss_01, ... with rgb/ and depth/ in them")
    by_number: dict[int, Path] = {}
    for folder in found:
        other = by_number.setdefault(int(folder.name[5:]), folder)
        if other is not folder:
            raise BadInput(f"{source} has toss {int(folder.name[5:])} twice: {other.name} and {folder.name}")
    return sorted(by_number.items())


def _list_toss(folder: Path, number: int, layout: Layout, warnings: Warnings) -> _Toss:
    color = _images(folder / "rgb", IMAGE_SUFFIXES)
    depth = _images(folder / "depth", (".png",))
    color_ns = _stamps(folder / "timestamps.txt", len(color), "colour images")
    own_times = folder / "depth_timestamps.txt"
    if own_times.exists():
        depth_ns = _stamps(own_times, len(depth), "depth images")
    else:
        common.same_frames(folder, color, depth, OWN_TIMES)
        depth_ns = color_ns
    mono = _list_mono(layout, folder.name)
    about = common.read_json_object(folder / "toss.json") if (folder / "toss.json").exists() else {}
    if about.get("frames") not in (None, len(color)):
        warnings.add(f"{folder.name}: toss.json says {about['frames']} frames, {len(color)} colour images are there")
    arm = _read_arm(folder / "arm.csv", str(layout.document.get("arm") or "franka_panda"))
    return _Toss(number, folder, color, color_ns, depth, depth_ns, mono, arm, about)


def _images(folder: Path, suffixes: Sequence[str]) -> Sequence[Path]:
    if not folder.is_dir():
        raise BadInput(f"{folder} is missing; wanted a folder of images")
    found = common.listed(folder, suffixes)
    if not found:
        raise BadInput(f"{folder} is empty; wanted images named 000000{suffixes[0]}, 000001{suffixes[0]}, ...")
    return found


def _stamps(path: Path, count: int, what: str) -> Int64[Array, " n"]:
    times_ns = common.read_stamps_ns(path)
    if len(times_ns) != count:
        raise BadInput(f"{path} has {len(times_ns)} lines for {count} {what}; wanted one time per image")
    return times_ns


def _list_mono(layout: Layout, toss: str) -> dict[str, _Images]:
    """mono/toss_XX/<camera>/, with one timestamps.txt for all cameras or one in a camera's own folder."""
    folder = layout.source / "mono" / toss
    if not folder.is_dir():
        return {}
    cameras = sorted(p.name for p in folder.iterdir() if p.is_dir())
    unknown = sorted(set(cameras) - set(layout.mono))
    if unknown:
        raise BadInput(f"{folder}: cameras {unknown} are not in mono/cameras.json, which has {sorted(layout.mono)}")
    found = {}
    for camera in cameras:
        paths, own = _images(folder / camera, IMAGE_SUFFIXES), folder / camera / "timestamps.txt"
        times = own if own.exists() else folder / "timestamps.txt"
        found[camera] = _Images(paths, _stamps(times, len(paths), f"images of {camera}"))
    return found


def _read_arm(path: Path, arm: str) -> ArmStates | None:
    """arm.csv: time_s, q1.., dq1.., finger_width_m (optional). Times to the nanosecond, numbers to the last bit."""
    if not path.exists():
        return None
    lines = [line.split(",") for line in common.read_text(path).splitlines() if line.strip()]
    header = [word.strip() for word in lines[0]]
    joints = sum(1 for name in header if name.startswith("q") and name[1:].isdigit())
    wanted = ["time_s", *(f"q{i + 1}" for i in range(joints)), *(f"dq{i + 1}" for i in range(joints))]
    if joints == 0 or header not in (wanted, [*wanted, "finger_width_m"]):
        raise BadInput(f"{path}: its header is {','.join(header)[:120]}; wanted time_s,q1..,dq1..,finger_width_m")
    if len(lines) == 1:
        raise BadInput(f"{path} has a header and no samples; remove the file, or give the arm's samples")
    for i, row in enumerate(lines[1:], 2):
        if len(row) != len(header):
            raise BadInput(f"{path}:{i} has {len(row)} values; wanted {len(header)}")
    times_ns = [common.seconds_to_ns(row[0], f"{path}:{i}") for i, row in enumerate(lines[1:], 2)]
    try:
        values = np.array([row[1:] for row in lines[1:]], dtype=np.float64)
    except ValueError as wrong:
        raise BadInput(f"{path}: {wrong}; wanted numbers") from wrong
    names = ARM_JOINTS.get(arm, ())
    if len(names) != joints:
        names = tuple(f"joint{i + 1}" for i in range(joints))
    width_m = values[:, 2 * joints] if header[-1] == "finger_width_m" else np.full(len(values), np.nan)
    stamps = common.growing(np.array(times_ns, dtype=np.int64), str(path))
    return ArmStates(stamps, names, values[:, :joints], values[:, joints : 2 * joints], width_m)


def _write_toss(writer: SessionWriter, toss: _Toss, layout: Layout, offset_ns: int, warnings: Warnings) -> None:
    info = {"clock_offset_ns": offset_ns, "source": toss.folder.name, "toss_json": toss.about}
    first_mask = toss.folder / "mask_first.png"
    mask = read_mask(first_mask, layout.color.width, layout.color.height) if first_mask.exists() else None
    if mask is not None and not mask.any():
        empty = "mask_first.png is empty, so it was left out"
        warnings.add(f"{toss.folder.name}: {empty}")
        mask, info = None, {**info, "warnings": [empty]}
    with writer.toss(toss.number, info) as t:
        if mask is not None:
            t.mask(0, mask)
        mono = [
            _images_in_time(t, m.paths, layout.calibration.camera(camera), camera, m.time_ns + offset_ns, grey=True)
            for camera, m in toss.mono.items()
        ]
        common.write_in_order(
            _images_in_time(t, toss.color, layout.color, "d455", toss.color_ns + offset_ns),
            _depths_in_time(t, toss.depth, layout, toss.depth_ns + offset_ns),
            _arm_in_time(t, toss.arm, offset_ns),
            _release(t, toss, offset_ns),
            *mono,
        )


def _images_in_time(
    t: TossWriter,
    paths: Sequence[Path],
    model: CameraModel,
    camera: str,
    times_ns: Int64[Array, " n"],
    *,
    grey: bool = False,
) -> Iterator[Timed]:
    write = t.mono if grey else t.color
    for path, time_ns in zip(paths, times_ns.tolist(), strict=True):
        image = read_encoded(path, model, camera, int(path.stem), time_ns, grey=grey)
        yield time_ns, partial(write, image)


def _depths_in_time(
    t: TossWriter, paths: Sequence[Path], layout: Layout, times_ns: Int64[Array, " n"]
) -> Iterator[Timed]:
    wanted = (layout.depth.height, layout.depth.width)
    for path, time_ns in zip(paths, times_ns.tolist(), strict=True):
        raw = read_depth_png(path)
        if raw.shape != wanted:
            raise BadInput(
                f"{path} is {raw.shape[1]}x{raw.shape[0]}, its camera {wanted[1]}x{wanted[0]}; where depth is "
                "not aligned to colour, session.json says so (depth_aligned_to_color false) and gives "
                "depth_camera and T_camera_depth"
            )
        image = DepthImage("d455", int(path.stem), time_ns, time_ns, layout.depth_unit_m, raw)
        yield time_ns, partial(t.depth, image)


def _arm_in_time(t: TossWriter, arm: ArmStates | None, offset_ns: int) -> Iterator[Timed]:
    if arm is None:
        return
    arm = replace(arm, time_ns=arm.time_ns + offset_ns)
    for i in range(0, len(arm.time_ns), ARM_BATCH):
        batch = arm.part(slice(i, i + ARM_BATCH))
        yield int(batch.time_ns[0]), partial(t.arm, batch)


def _release(t: TossWriter, toss: _Toss, offset_ns: int) -> Iterator[Timed]:
    release_s = toss.about.get("release_time_s")
    if release_s is None:
        return
    if not isinstance(release_s, (int, float)) or not np.isfinite(release_s):
        raise BadInput(f"{toss.folder / 'toss.json'}: release_time_s {release_s!r}; wanted seconds on the toss's clock")
    time_ns = round(release_s * 1e9) + offset_ns
    yield time_ns, partial(t.event, TossEvent(time_ns, "release", "import"))


def _write_views(writer: SessionWriter, layout: Layout, warnings: Warnings) -> None:
    """calibration/view_XX/{rgb,depth,mono0,...}.png into calibration.mcap, view k at k seconds."""
    folder = layout.source / "calibration"
    views = sorted(p for p in folder.glob("view_*") if p.is_dir() and p.name[5:].isdigit()) if folder.is_dir() else []
    if not views:
        return
    with writer.calibration_views() as t:
        for view in views:
            number = int(view.name[5:])
            _write_view(t, view, layout, number, number * VIEW_STEP_NS, warnings)


def _write_view(t: TossWriter, view: Path, layout: Layout, number: int, time_ns: int, warnings: Warnings) -> None:
    for path in sorted(p for p in view.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES):
        if path.stem == "rgb":
            t.color(read_encoded(path, layout.color, "d455", number, time_ns))
        elif path.stem == "depth":
            t.depth(DepthImage("d455", number, time_ns, time_ns, layout.depth_unit_m, read_depth_png(path)))
        elif path.stem in layout.mono:
            model = layout.calibration.camera(path.stem)
            t.mono(read_encoded(path, model, path.stem, number, time_ns, grey=True))
        else:
            warnings.add(f"calibration/{view.name}/{path.name} belongs to no known camera, so it was left out")
