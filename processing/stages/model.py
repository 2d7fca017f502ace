"""Stage `model`: a shape that was learned before, brought into this results folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from processing.run import Run
from processing.store import Done
from recordings.results.folder import read_shape, write_shape
from recordings.whole_file import file_sha256

VERSION = 2


@dataclass(frozen=True)
class ModelResult:
    """The stage folder it comes from, and its vertices."""

    source: str
    vertices: int


def bring_model(run: Run, model: Path) -> Done[ModelResult]:
    """`model`: a stage's folder with shape.ply and shape.json. Raises BadInput where there is none."""
    shape = read_shape(model)

    def compute(folder: Path) -> ModelResult:
        write_shape(folder, shape)
        return ModelResult(model.name, len(shape.vertices_m))

    return run.store.run("model", VERSION, {}, {"shape": file_sha256(model / "shape.ply")}, ModelResult, compute)
