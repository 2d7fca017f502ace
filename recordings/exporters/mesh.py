"""`export mesh`: the shape as Wavefront OBJ, metres, in the object frame of the exported poses."""

from __future__ import annotations

from pathlib import Path

from recordings.exporters.common import ExportReport, new_files, open_results
from recordings.progress import Progress
from recordings.results.folder import Results, VariantRecord
from recordings.results.shape_file import obj_text
from recordings.session_writer import toss_name
from recordings.tracks import ObjectShape


def export_mesh(source: Path, out: Path, variant: str | None, scope: str | None, progress: Progress) -> ExportReport:
    """Write `shape.obj`; where every toss has its own shape (scope one), `toss_XX/shape.obj`."""
    results = open_results(source)
    record = results.find(variant, scope)
    with new_files(out) as made:
        for where, shape in shapes(results, record).items():
            (made / where).mkdir(parents=True, exist_ok=True)
            (made / where / "shape.obj").write_text(obj_text(shape))
        count = len(list(made.rglob("shape.obj")))
    return ExportReport("mesh", out, count, _notes(record))


def shapes(results: Results, record: VariantRecord) -> dict[str, ObjectShape]:
    """The shapes of a variant by folder: "" for the one of scope all, "toss_XX" for those of scope one."""
    if record.scope == "one":
        return {toss_name(t.toss): results.shape(record.name, "one", t.toss) for t in record.tosses}
    return {"": results.shape(record.name, "all")}


def _notes(record: VariantRecord) -> tuple[str, ...]:
    if record.scope == "one" or record.shared_object_frame or len(record.tosses) == 1:
        return ()
    return ("the tosses of this variant do not share an object frame: the shape is in that of one toss only",)
