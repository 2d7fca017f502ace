"""The exporters by name, imported when asked for."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Protocol

from recordings.errors import BadInput
from recordings.exporters.common import ExportReport
from recordings.progress import Progress, Silent

EXPORTERS = {
    "folder": "recordings.exporters.folder:export_folder",
    "bundlesdf": "recordings.exporters.bundlesdf:export_bundlesdf",
    "tum": "recordings.exporters.tum:export_tum",
    "bop": "recordings.exporters.bop:export_bop",
    "mesh": "recordings.exporters.mesh:export_mesh",
    "urdf": "recordings.exporters.asset:export_urdf",
    "mjcf": "recordings.exporters.asset:export_mjcf",
    "drake-sdf": "recordings.exporters.asset:export_drake_sdf",
    "video": "recordings.exporters.video:export_video",
    "rrd": "recordings.exporters.rrd:export_rrd",
    "lerobot": "recordings.exporters.lerobot:export_lerobot",
    "mcap": "recordings.exporters.mcap:export_mcap",
}


class Exporter(Protocol):
    """What every exporter is: a function of where from, where to, which results."""

    def __call__(
        self, source: Path, out: Path, variant: str | None, scope: str | None, progress: Progress
    ) -> ExportReport: ...


def export(
    name: str,
    source: Path,
    out: Path,
    variant: str | None = None,
    scope: str | None = None,
    progress: Progress | None = None,
) -> ExportReport:
    """Export a session or its results in the named format. Raises BadInput for an unknown one."""
    if name not in EXPORTERS:
        raise BadInput(f"no export '{name}'; there are {', '.join(EXPORTERS)}")
    module, function = EXPORTERS[name].split(":")
    exporter: Exporter = getattr(import_module(module), function)
    return exporter(source, out, variant, scope, progress or Silent())
