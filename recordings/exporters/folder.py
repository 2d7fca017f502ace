"""`export folder`: a session as the folder layout, the inverse of `import folder`.

Images keep their bytes, depth its numbers, times their nanoseconds: what the layout counts from is taken off again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.exporters.common import ExportReport, count_files, new_files, open_recording, write_document
from recordings.exporters.images import depth_png, image_file
from recordings.geometry import CameraModel
from recordings.mcap.codec import encode_mask
from recordings.progress import Progress
from recordings.records import ArmStates, EncodedImage
from recordings.session import Frames, Session, Toss
from recordings.session_writer import toss_name
from recordings.tracks import RigCalibration

CAMERA = "d455"
SAME = 1e-9
"""A number of the calibration that differs by less from the one that was imported is that one."""


def export_folder(source: Path, out: Path, variant: str | None, scope: str | None, progress: Progress) -> ExportReport:
    """Write session.json, toss_XX/, mono/ and calibration/ of a session (or of the one that results were made from)."""
    session = open_recording(source, variant, scope)
    notes: list[str] = []
    with new_files(out) as made:
        for done, number in enumerate(session.tosses):
            progress.step(done, len(session.tosses), f"toss {number}")
            _write_toss(made, session.toss(number), notes)
        write_document(made / "session.json", _document(session))
        _write_mono_cameras(made, session)
        _write_views(made, session)
        files = count_files(made)
    progress.step(len(session.tosses), len(session.tosses))
    session.close()
    return ExportReport("folder", out, files, tuple(dict.fromkeys(notes)))


def _document(session: Session) -> dict[str, Any]:
    imported = session.start.get("import") or {}
    document = dict(imported.get("document") or {}) if imported.get("layout") == "folder" else {}
    if not document:
        document = {
            "object": session.object_name,
            "world": "z up, table top is the plane z = 0, metres",
            "camera_frame": "OpenCV: x right, y down, z forward",
            "arm": (session.start.get("rig") or {}).get("arm"),
        }
    calibration = session.calibration
    camera = _camera(calibration.camera(CAMERA), document.get("camera") or {})
    camera |= {"depth_unit_m": _depth_unit(session), "depth_invalid": 0}
    camera["depth_aligned_to_color"] = f"{CAMERA}_depth" not in calibration.cameras
    document["camera"] = camera
    if not camera["depth_aligned_to_color"]:
        document["depth_camera"] = _camera(calibration.camera(f"{CAMERA}_depth"), {})
        document["T_camera_depth"] = calibration.transform(CAMERA, f"{CAMERA}_depth").matrix.tolist()
    for key, source in (("T_world_camera", CAMERA), ("T_world_base", "base")):
        found = calibration.find("world", source)
        if found is not None:
            document[key] = _kept(found.matrix, document.get(key))
    document.setdefault("table_tags", _table_tags(calibration))
    return document


def _camera(model: CameraModel, given: Mapping[str, Any]) -> dict[str, Any]:
    numbers = model.distortion or (0.0,) * 5
    camera = {**given, "K": _kept(model.K, given.get("K")), "width": model.width, "height": model.height}
    camera["distortion"] = _kept(np.array(numbers), given.get("distortion"))
    if model.distortion_model == "fisheye":
        camera["distortion_model"] = "fisheye"
    return camera


def _kept(values: Array, given: Any) -> Any:
    """The imported numbers where nothing was calibrated since."""
    if given is not None and np.shape(given) == values.shape and np.allclose(given, values, rtol=0, atol=SAME):
        return given
    return values.tolist()


def _depth_unit(session: Session) -> float:
    units = {session.toss(n).depth(CAMERA)[0].unit_m for n in session.tosses if len(session.toss(n).depth(CAMERA))}
    if len(units) > 1:
        raise BadInput(f"the tosses have depth in different units ({sorted(units)} m); the layout has one for all")
    return units.pop() if units else 0.001


def _table_tags(calibration: RigCalibration) -> dict[str, Any]:
    tags = [
        {"id": t.tag_id, "size_m": t.size_m, "T_world_tag": t.world_from_tag.matrix.tolist()}
        for t in calibration.table_tags
    ]
    return {"family": calibration.tag_family, "tags": tags}


def _write_toss(made: Path, toss: Toss, notes: list[str]) -> None:
    colors, depths = toss.color(CAMERA), toss.depth(CAMERA)
    if len(colors) == 0:
        raise BadInput(f"{toss.path.name} has no images of {CAMERA}; the folder layout is made of images")
    folder = made / toss_name(toss.index)
    clock_ns = int(toss.info.get("clock_offset_ns", colors.times_ns[0]))
    numbers = _numbers(colors, toss)
    for image, number in zip(colors, numbers, strict=True):
        _write(folder / "rgb", number, image_file(image))
    _write_stamps(folder / "timestamps.txt", colors.times_ns - clock_ns)
    paired = np.array_equal(colors.times_ns, depths.times_ns)
    depth_numbers = numbers if paired else range(len(depths))
    for i, number in enumerate(depth_numbers):
        _write(folder / "depth", number, (".png", depth_png(depths[i].raw)))
    if not paired:
        _write_stamps(folder / "depth_timestamps.txt", depths.times_ns - clock_ns)
    _write_mask(folder, toss, notes)
    write_document(folder / "toss.json", _about(toss, len(colors), clock_ns))
    arm = toss.arm_states()
    if arm is not None:
        (folder / "arm.csv").write_text(arm_csv(arm, clock_ns))
    _write_mono(made / "mono" / folder.name, toss, clock_ns)


def _numbers(colors: Frames[EncodedImage], toss: Toss) -> Sequence[int]:
    """File numbers: those of the imported files, else by position (a device's frame numbers start anywhere)."""
    return [image.index for image in colors] if "source" in toss.info else range(len(colors))


def _write(folder: Path, number: int, file: tuple[str, bytes]) -> None:
    suffix, data = file
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{number:06d}{suffix}").write_bytes(data)


def _write_stamps(path: Path, times_ns: Int64[Array, " n"]) -> None:
    path.write_text("".join(f"{line}\n" for line in seconds(times_ns, 6)))


def seconds(times_ns: Int64[Array, " n"], decimals: int) -> list[str]:
    """Times as decimal seconds without rounding: at least `decimals` of them, up to 9 where nanoseconds ask for it."""
    while decimals < 9 and bool((times_ns % 10 ** (9 - decimals)).any()):
        decimals += 3
    texts = []
    for t in times_ns.tolist():
        whole, rest = divmod(abs(t), 1_000_000_000)
        texts.append(f"{'-' if t < 0 else ''}{whole}.{rest:09d}"[: decimals - 9 or None])
    return texts


def _write_mask(folder: Path, toss: Toss, notes: list[str]) -> None:
    masks = toss.masks()
    if 0 in masks:
        (folder / "mask_first.png").write_bytes(encode_mask(masks[0]))
    if set(masks) - {0}:
        notes.append("the layout holds the mask of the first frame only; the session's other masks are left out")


def _about(toss: Toss, frames: int, clock_ns: int) -> dict[str, Any]:
    given = toss.info.get("toss_json")
    if given:
        return dict(given)
    release_ns = toss.window().release_time_ns
    about: dict[str, Any] = {"frames": frames}
    if release_ns is not None:
        about["release_time_s"] = (release_ns - clock_ns) / 1e9
    return about


def arm_csv(arm: ArmStates, clock_ns: int) -> str:
    """arm.csv of the layout; floats as Python prints them, so that they come back to the last bit."""
    joints = arm.q_rad.shape[1]
    header = ["time_s", *(f"q{i + 1}" for i in range(joints)), *(f"dq{i + 1}" for i in range(joints))]
    columns = [arm.q_rad, arm.dq_rad_s]
    if np.isfinite(arm.finger_width_m).any():
        header.append("finger_width_m")
        columns.append(arm.finger_width_m[:, None])
    rows = np.hstack(columns).tolist()
    times = seconds(arm.time_ns - clock_ns, 3)
    lines = [",".join(header), *(",".join([t, *map(repr, row)]) for t, row in zip(times, rows, strict=True))]
    return "".join(f"{line}\n" for line in lines)


def _mono_names(toss: Toss) -> list[str]:
    return [name for name in toss.cameras() if len(toss.mono(name))]


def _write_mono(folder: Path, toss: Toss, clock_ns: int) -> None:
    """One timestamps.txt where all cameras have the same times, else one in each camera's folder."""
    streams = {name: toss.mono(name) for name in _mono_names(toss)}
    first = next(iter(streams.values()), None)
    if first is None:
        return
    together = all(np.array_equal(s.times_ns, first.times_ns) for s in streams.values())
    for name, stream in streams.items():
        for image, number in zip(stream, _numbers(stream, toss), strict=True):
            _write(folder / name, number, image_file(image))
        _write_stamps((folder if together else folder / name) / "timestamps.txt", stream.times_ns - clock_ns)


def _write_mono_cameras(made: Path, session: Session) -> None:
    names = [n for n in session.calibration.cameras if n not in (CAMERA, f"{CAMERA}_depth")]
    if not names:
        return
    document = dict((session.start.get("import") or {}).get("mono_document") or {})
    document["cameras"] = [{"name": n, **_camera(session.calibration.camera(n), {})} for n in names]
    if session.start.get("board"):
        document["calibration_board"] = session.start["board"]
    write_document(made / "mono" / "cameras.json", document)


def _write_views(made: Path, session: Session) -> None:
    path = session.path / "calibration.mcap"
    if not path.exists():
        return
    views = Toss(path)
    for image in views.color(CAMERA):
        _write_view(made, image.index, "rgb", image_file(image))
    for depth in views.depth(CAMERA):
        _write_view(made, depth.index, "depth", (".png", depth_png(depth.raw)))
    for name in _mono_names(views):
        for image in views.mono(name):
            _write_view(made, image.index, name, image_file(image))
    views.close()


def _write_view(made: Path, number: int, name: str, file: tuple[str, bytes]) -> None:
    suffix, data = file
    folder = made / "calibration" / f"view_{number:02d}"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}{suffix}").write_bytes(data)
