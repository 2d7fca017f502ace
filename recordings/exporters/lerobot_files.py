"""The files of a LeRobot v3 dataset: parquet tables with the metadata that its readers look for, and the video."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

from recordings.errors import BadInput

if TYPE_CHECKING:
    import pyarrow as pa

CRF = "18"
"""H.264 quality: visually without loss."""
KEYFRAME_EVERY = 2
"""Readers jump to single frames: the format's own writer uses as short a group of pictures."""
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
IMAGES_SAMPLED = 200
PIXEL_STEP = 4


@dataclass
class Column:
    """One feature. `names`: its elements (none for a plain number; an image's shape). `values`: a row per frame."""

    dtype: str
    names: tuple[Any, ...]
    values: list[Any] = field(default_factory=list)

    def feature(self) -> dict[str, Any]:
        """As meta/info.json says it."""
        if self.dtype == "image":
            return {"dtype": "image", "shape": [*self.names, 1], "names": ["height", "width", "channels"]}
        return {"dtype": self.dtype, "shape": [len(self.names) or 1], "names": list(self.names) or None}

    def hugging_face(self) -> dict[str, Any]:
        """As the `datasets` library says it, in the parquet file's own metadata."""
        if self.dtype == "image":
            return {"_type": "Image"}
        number = {"dtype": self.dtype, "_type": "Value"}
        return number if len(self.names) < 2 else {"feature": number, "length": len(self.names), "_type": "Sequence"}

    def arrow(self) -> pa.Array:
        import pyarrow as pa

        if self.dtype == "image":
            box = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
            return pa.array([{"bytes": data, "path": None} for data in self.values], type=box)
        kind = pa.type_for_alias(self.dtype)
        if not self.names:
            return pa.array(self.values, type=kind)
        if len(self.names) == 1:
            return pa.array([row[0] for row in self.values], type=kind)
        return pa.array(self.values, type=pa.list_(kind, len(self.names)))


def write_data(path: Path, columns: dict[str, Column]) -> None:
    """The table of all frames, one row group per episode."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    lengths = {name: len(column.values) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise BadInput(
            f"not every toss has the same streams ({lengths}); export the tosses that do, or make two sessions"
        )
    features = {name: column.hugging_face() for name, column in columns.items()}
    metadata = {b"huggingface": json.dumps({"info": {"features": features}}).encode()}
    arrays = {name: column.arrow() for name, column in columns.items()}
    table = pa.table(arrays).replace_schema_metadata(metadata)
    episodes = np.array(columns["episode_index"].values)
    starts = np.flatnonzero(np.diff(episodes, prepend=-1))
    path.parent.mkdir(parents=True, exist_ok=True)
    with pq.ParquetWriter(path, table.schema, compression="snappy") as writer:
        for start, stop in zip(starts, [*starts[1:], len(episodes)], strict=True):
            writer.write_table(table.slice(start, stop - start))


def write_tasks(path: Path, tasks: list[str]) -> None:
    """A table that pandas reads as a frame whose index is the task's words."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_kind, "metadata": None}
        for name, kind, numpy_kind in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table.replace_schema_metadata({b"pandas": json.dumps(pandas).encode()}), path)


def write_episodes(path: Path, episodes: list[dict[str, Any]], task: str) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist([{**episode, "tasks": [task]} for episode in episodes]), path)


class Video:
    """An H.264 file, frame k at k / fps. A context."""

    def __init__(self, path: Path, fps: int, width: int, height: int) -> None:
        try:
            import av
        except ImportError as missing:
            raise BadInput(
                "a LeRobot dataset holds video, and PyAV is not installed; run `pip install av`"
            ) from missing
        if width % 2 or height % 2:
            raise BadInput(f"images of {width}x{height} cannot become H.264 video; wanted an even width and height")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._av = av
        self._file: Any = av.open(str(path), "w")
        self._stream: Any = self._file.add_stream("libx264", rate=fps)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
        self._stream.options = {"crf": CRF, "g": str(KEYFRAME_EVERY), "preset": "veryfast"}
        self._size = (height, width)

    def __enter__(self) -> Video:
        return self

    def add(self, rgb: UInt8[Array, "h w 3"]) -> None:
        if rgb.shape[:2] != self._size:
            raise BadInput(f"an image of {rgb.shape[1]}x{rgb.shape[0]} after images of {self._size[1]}x{self._size[0]}")
        frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
        for packet in self._stream.encode(frame):
            self._file.mux(packet)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            for packet in self._stream.encode(None):
                self._file.mux(packet)
        self._file.close()


class Statistics:
    """min, max, mean, std, count and quantiles of every feature, as meta/stats.json keeps them."""

    def __init__(self) -> None:
        self._done: dict[str, dict[str, Any]] = {}
        self._images: dict[str, list[Array]] = {}
        self._seen: dict[str, int] = {}

    def add_image(self, name: str, rgb: UInt8[Array, "h w 3"]) -> None:
        """Every fourth pixel of the first images; colours are counted in 0..1, as readers give them."""
        self._seen[name] = self._seen.get(name, 0) + 1
        kept = self._images.setdefault(name, [])
        if len(kept) < IMAGES_SAMPLED:
            kept.append(rgb[::PIXEL_STEP, ::PIXEL_STEP].reshape(-1, 3))

    def add_column(self, name: str, column: Column) -> None:
        """Numbers only: depth images are left out, lost poses (NaN) are not counted."""
        if column.dtype == "image":
            return
        table = np.array(column.values, dtype=np.float64).reshape(len(column.values), -1)
        table = table[np.isfinite(table).all(axis=1)]
        if len(table):
            self._done[name] = {**_figures(table), "count": [len(table)]}

    def to_json(self) -> dict[str, Any]:
        for name, parts in self._images.items():
            figures = _figures(np.concatenate(parts) / 255.0)
            per_channel = {k: [[[v]] for v in values] for k, values in figures.items()}
            self._done[name] = {**per_channel, "count": [self._seen[name]]}
        return self._done


def _figures(table: Float[Array, "n d"]) -> dict[str, list[float]]:
    figures = {"min": table.min(0), "max": table.max(0), "mean": table.mean(0), "std": table.std(0)}
    figures |= {name: np.quantile(table, share, axis=0) for name, share in QUANTILES.items()}
    return {name: values.tolist() for name, values in figures.items()}
