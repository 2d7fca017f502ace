"""`export urdf | mjcf | drake-sdf`: simulation-ready assets, as the contact stage wrote them into its stage folder.

The stage that learns the contact model makes the assets (it knows geometry, inertia and friction); here they are found
through the variant's record and copied, so that an export needs nothing but the results folder.
"""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

from recordings.errors import BadInput
from recordings.exporters.common import ExportReport, count_files, new_files, open_results
from recordings.progress import Progress
from recordings.results.folder import Results, VariantRecord
from recordings.session_writer import toss_name

ASSETS = "assets"
"""`<contact stage>/assets/<format>/` holds the asset of a format with its meshes."""


def _export(
    name: str, source: Path, out: Path, variant: str | None, scope: str | None, progress: Progress
) -> ExportReport:
    """Write the asset of a format and its meshes."""
    results = open_results(source)
    folders = _asset_folders(results, results.find(variant, scope), name)
    with new_files(out) as made:
        for where, folder in folders.items():
            shutil.copytree(folder, made / where, dirs_exist_ok=True)
        files = count_files(made)
    return ExportReport(name, out, files)


def _asset_folders(results: Results, record: VariantRecord, name: str) -> dict[str, Path]:
    """The asset's folder by where it goes: "" for the one of the variant, toss_XX where each toss has its own."""
    stages = {"": record.contact} if record.contact else {}
    if not stages and record.scope == "one":
        own = record.extra.get("contact_of_toss") or {}
        stages = {toss_name(int(toss)): str(stage) for toss, stage in own.items()}
    if not stages:
        raise BadInput(
            f"no contact model in these results ({record.name}, scope {record.scope}), and a {name} needs its "
            "inertia and friction; wanted a variant with contact learning, for instance: toss-process SESSION "
            "--variant ours"
        )
    folders = {where: results.path / stage / ASSETS / name for where, stage in stages.items()}
    for folder in folders.values():
        if not folder.is_dir():
            raise BadInput(
                f"the contact model in {folder.parent.parent} has no {name} asset; run toss-process again to make it"
            )
    return folders


export_urdf, export_mjcf, export_drake_sdf = (partial(_export, name) for name in ("urdf", "mjcf", "drake-sdf"))
