"""`export rrd`: what `toss-view` shows, as one file for the rerun viewer."""

from __future__ import annotations

from pathlib import Path

from recordings.exporters.common import ExportReport, new_file
from recordings.progress import Progress


def export_rrd(source: Path, out: Path, variant: str | None, scope: str | None, progress: Progress) -> ExportReport:
    """Write OUT (a file). `source` is a session, one toss's file or a results folder."""
    from recordings.view.draw import Choice, save_rrd  # brings rerun

    save_rrd(source, new_file(out), Choice(variant=variant, scope=scope), progress=progress)
    return ExportReport("rrd", out, 1)
