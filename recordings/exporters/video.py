"""`export video`: a film of every toss, the colour image with the object's outline and the scene in 3D beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recordings.errors import BadInput
from recordings.exporters.common import ExportReport, new_files, open_recording, open_results
from recordings.film.file import movie_codec, write_gif, write_mp4
from recordings.film.film import Film
from recordings.progress import Progress
from recordings.results.folder import Results, VariantRecord
from recordings.session import Session
from recordings.session_writer import toss_name
from recordings.tracks import ObjectTrack

SLOWED = 4
"""A toss lasts a second: it is shown this many times as long."""
CODEC_NAMES = {"libx264": "H.264", "mpeg4": "MPEG-4 part 2"}


def export_video(source: Path, out: Path, variant: str | None, scope: str | None, progress: Progress) -> ExportReport:
    """Write `toss_XX.mp4`, or `toss_XX.gif` where PyAV is missing: one frame for every colour frame."""
    results = open_results(source)
    record = results.find(variant, scope)
    session = open_recording(results.path, record.name, record.scope)
    codec = movie_codec()
    try:
        with new_files(out) as made:
            tracks = results.tracks(record.name, record.scope)
            for k, (toss, track) in enumerate(tracks.items()):
                _write(made, _film(results, record, session, track), codec)
                progress.step(k + 1, len(tracks), f"toss {toss}")
    finally:
        session.close()
    return ExportReport("video", out, len(tracks), _notes(codec))


def _film(results: Results, record: VariantRecord, session: Session, track: ObjectTrack) -> Film:
    if track.toss not in session.tosses:
        raise BadInput(f"{session.path} has no toss {track.toss}, of which these results are; it has {session.tosses}")
    has_shape = (record.toss(track.toss).shape or record.shape) is not None
    shape = results.shape(record.name, record.scope, track.toss) if has_shape else None
    return Film(session.toss(track.toss), record.calibration, track, shape, f"{SLOWED} times slower")


def _write(folder: Path, film: Film, codec: str | None) -> None:
    times_s = SLOWED * 1e-9 * (film.track.time_ns - film.track.time_ns[0]).astype(np.float64)
    name = toss_name(film.track.toss)
    if codec is None:
        write_gif(folder / f"{name}.gif", film, times_s)
    else:
        write_mp4(folder / f"{name}.mp4", film, times_s, codec)


def _notes(codec: str | None) -> tuple[str, ...]:
    said = "GIF, because PyAV is not installed; for MP4: pip install av" if codec is None else CODEC_NAMES[codec]
    return (f"{said}; {SLOWED} times slower than it was", "outline: green tracked, orange interpolated, none: lost")
