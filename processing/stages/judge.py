"""Stage `judge`: how well shapes and poses explain the raw images, without truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from processing.engine.parts import side_by_side
from processing.images import Images, track_and_image_keys
from processing.refine.image_residuals import ROWS, Explained, explain, pooled, read_rows
from processing.run import Run
from processing.store import Done
from recordings.results.folder import read_shape, read_track
from recordings.whole_file import write_json

VERSION = 5


@dataclass(frozen=True)
class JudgeResult:
    """Means over the frames looked at (`frames`): absolute depth residual (m), 1 - IoU of the outline, colour residual
    (grey levels of 255); None where no frame tells. `lost`: frames without a pose."""

    depth_m: float | None
    mask: float | None
    color: float | None
    frames: int
    lost: int


def judge(
    run: Run, name: str, tracks: Mapping[int, Done], shapes: Mapping[int, Done], images: Mapping[int, Images],
    each_frame: bool = False,
) -> Done[JudgeResult]:  # fmt: skip
    """Residuals of every toss's shape at its track's poses on its raw images, in some frames or in `each_frame`;
    `residuals.npz` keeps them by frame."""
    config = run.config.cycle.judge
    config = replace(config, every=1) if each_frame else config
    inputs = {**{f"shape_{t:02d}": s.key for t, s in shapes.items()}, **track_and_image_keys(tracks, images)}

    def compute(folder: Path) -> JudgeResult:
        def explained(toss: int) -> Explained:
            body, track = read_shape(shapes[toss].folder), read_track(tracks[toss].folder, toss)
            seen = images[toss].open()
            return explain(body, track, seen.frames, seen.masks, run.camera, config)

        parts: list[Explained] = []
        progress = run.progress(f"{name}: residuals on the raw images")
        for toss, part in zip(tracks, side_by_side(explained, list(tracks)), strict=True):
            parts.append(part)
            progress.step(len(parts), len(tracks), f"toss {toss}")
        every = pooled(parts)
        with open(folder / ROWS, "wb") as out:
            np.savez(out, rows=every.rows)
        found = every.means()
        write_json(folder / "means.json", found.to_json())
        depth_m, mask, color = (x if np.isfinite(x) else None for x in (found.depth_m, found.mask, found.color))
        return JudgeResult(depth_m, mask, color, found.frames, found.lost)

    return run.store.run("judge", VERSION, config, inputs, JudgeResult, compute)


def residuals(judged: Done[JudgeResult]) -> Explained:
    """The residuals of single frames that the stage keeps."""
    return Explained(read_rows(judged.folder), judged.result.lost)
