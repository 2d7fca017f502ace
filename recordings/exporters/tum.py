"""`export tum`: one trajectory file per toss, as evo reads it, and the status of every line beside it."""

from __future__ import annotations

from pathlib import Path

from recordings.exporters.common import ExportReport, new_files, open_results
from recordings.geometry import Transform
from recordings.progress import Progress
from recordings.session_writer import toss_name
from recordings.tracks import ObjectTrack

LOST = "nan nan nan nan nan nan nan"


def export_tum(source: Path, out: Path, variant: str | None, scope: str | None, progress: Progress) -> ExportReport:
    """Write `toss_XX.txt` (`time_s tx ty tz qx qy qz qw` of `d455_from_object`) and `toss_XX.status.txt`.

    `time_s` counts from the toss's first colour frame. Every frame has its line; a lost one is `time_s nan nan ...`.
    """
    tracks = open_results(source).tracks(variant, scope)
    with new_files(out) as made:
        for toss, track in tracks.items():
            (made / f"{toss_name(toss)}.txt").write_text(tum_text(track))
            (made / f"{toss_name(toss)}.status.txt").write_text("".join(f"{s}\n" for s in track.status))
    lost = sum(int(track.lost.sum()) for track in tracks.values())
    notes = (f"{lost} of {sum(len(t.status) for t in tracks.values())} frames are lost: nan lines",) if lost else ()
    return ExportReport("tum", out, 2 * len(tracks), notes)


def tum_text(track: ObjectTrack) -> str:
    """The lines of one toss. Times to the nanosecond, positions to 1 nm, quaternions x y z w."""
    lines = []
    for i, time_ns in enumerate(track.time_ns.tolist()):
        pose = track.pose(i)
        lines.append(f"{_seconds(time_ns - int(track.time_ns[0]))} {LOST if pose is None else _words(pose)}")
    return "".join(f"{line}\n" for line in lines)


def _seconds(time_ns: int) -> str:
    return f"{time_ns // 1_000_000_000}.{time_ns % 1_000_000_000:09d}"


def _words(pose: Transform) -> str:
    w, x, y, z = pose.quaternion_wxyz
    tx, ty, tz = pose.translation_m
    return f"{tx:.9f} {ty:.9f} {tz:.9f} {x:.12f} {y:.12f} {z:.12f} {w:.12f}"
