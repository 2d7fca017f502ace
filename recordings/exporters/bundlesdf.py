"""`export bundlesdf`: one folder per toss with rgb/, depth/ (uint16 mm, aligned to colour), masks/ and cam_K.txt."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, UInt16
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.exporters.common import ExportReport, count_files, new_files, open_recording
from recordings.exporters.images import depth_png, image_file
from recordings.mcap.codec import encode_mask
from recordings.progress import Progress
from recordings.results.folder import Results
from recordings.session import Session, Toss
from recordings.session_writer import toss_name

CAMERA = "d455"
MM = 1000.0


def export_bundlesdf(
    source: Path, out: Path, variant: str | None, scope: str | None, progress: Progress
) -> ExportReport:
    """Write OUT/toss_XX/{rgb,depth,masks}/%06d and cam_K.txt; masks of every frame from results.

    Depth in millimetres is kept to the last bit, any other unit is rounded to millimetres and the report says so.
    """
    results = Results.open(source) if Results.is_results(source) else None
    record = results.find(variant, scope) if results is not None else None
    session = open_recording(source, variant, scope)
    notes: list[str] = []
    numbers = [t.toss for t in record.tosses] if record is not None else session.tosses
    with new_files(out) as made:
        for done, number in enumerate(numbers):
            progress.step(done, len(numbers), f"toss {number}")
            toss = session.toss(number)
            if results is not None and record is not None:
                masks: Mapping[int, Bool[Array, "h w"]] = dict(
                    enumerate(results.masks(record.name, record.scope, number))
                )
            else:
                masks = toss.masks()
            _write_toss(made / toss_name(number), session, toss, masks, notes)
        files = count_files(made)
    progress.step(len(numbers), len(numbers))
    session.close()
    return ExportReport("bundlesdf", out, files, tuple(dict.fromkeys(notes)))


def _write_toss(
    folder: Path, session: Session, toss: Toss, masks: Mapping[int, Bool[Array, "h w"]], notes: list[str]
) -> None:
    camera = session.calibration.camera(CAMERA)
    if camera.distortion_model != "none":
        notes.append("cam_K.txt has no place for lens distortion: images are kept as they are, distorted")
    for name in ("rgb", "depth", "masks"):
        (folder / name).mkdir(parents=True)
    (folder / "cam_K.txt").write_text("".join(" ".join(map(repr, row)) + "\n" for row in camera.K.tolist()))
    colors, frames = toss.color(CAMERA), toss.rgbd(CAMERA)
    depths, exact = toss.depth(CAMERA), _depth_is_exact(toss)
    position = {time_ns: k for k, time_ns in enumerate(depths.times_ns.tolist())}
    if frames.without_depth:
        notes.append(f"{folder.name}: {len(frames.without_depth)} colour images have no depth image: all 0 there")
    imported = "source" in toss.info
    for i, image in enumerate(colors):
        name = f"{image.index if imported else i:06d}"
        suffix, data = image_file(image)
        (folder / "rgb" / f"{name}{suffix}").write_bytes(data)
        if exact and i not in frames.without_depth:
            raw = depths[position[int(frames.depth_times_ns[i])]].raw
        else:
            raw = _millimetres(frames[i].depth_m, notes)
        (folder / "depth" / f"{name}.png").write_bytes(depth_png(raw))
        if i in masks:
            (folder / "masks" / f"{name}.png").write_bytes(encode_mask(masks[i]))
    if not exact:
        notes.append("depth was converted to millimetres, aligned to colour: what was finer is rounded")


def _depth_is_exact(toss: Toss) -> bool:
    """Whether depth is in millimetres and aligned to colour already; otherwise it is converted."""
    depths = toss.depth(CAMERA)
    return len(depths) > 0 and depths[0].unit_m == 1 / MM and f"{CAMERA}_depth" not in toss.calibration.cameras


def _millimetres(depth_m: Float32[Array, "h w"], notes: list[str]) -> UInt16[Array, "h w"]:
    depth_mm = np.rint(depth_m.astype(np.float64) * MM)
    beyond = depth_mm > np.iinfo(np.uint16).max
    if beyond.any():
        notes.append("depth beyond 65.5 m has no place in the layout: 0 there")
        depth_mm[beyond] = 0
    if not np.isfinite(depth_mm).all():
        raise BadInput("depth holds NaN or infinity; run `toss-session verify` on the session")
    return depth_mm.astype(np.uint16)
