"""ROS bags of a stranger: `rosbags` unpacks whatever a bag holds, so its readers get bounded decompressors here.

Of a bag of ROS 1 the reader is specialised; in those of ROS 2 the package's tables of decompressors are replaced, and
the quality-of-service texts, which nobody here reads and which are YAML of any size, are not parsed.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing
from functools import cache, partial
from pathlib import Path
from typing import Any

from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import reader as rosbag1_reader
from rosbags.rosbag2 import reader as rosbag2_reader
from rosbags.rosbag2 import storage_mcap, storage_sqlite3

from recordings.bounded.limits import MOST_CHUNK_BYTES, Budget, unpack, unpack_some
from recordings.bounded.yaml_file import parse_yaml
from recordings.errors import BadInput
from recordings.mcap.scan import Bytes, chunk_records, parse_chunk, record_at

SUSPICIOUS_TIMES = 50
"""A chunk that unpacks to more than this many times its size is counted through before it is given to `rosbags`."""
_MCAP_CHUNK = 0x06
_INDEX_ENTRY_BYTES = 12


class BoundedBag1(Reader1):
    """A bag of ROS 1 whose chunks unpack to what its size allows, and whose index holds what fits into the file."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._file_bytes = path.stat().st_size
        self._budget = Budget(self._file_bytes)

    def read_chunk(self) -> Any:
        chunk = super().read_chunk()
        names = {function: name for name, function in rosbag1_reader.decompressors.items()}
        name = names[chunk.decompressor]
        return chunk if name == "none" else chunk._replace(decompressor=partial(self._unpack, name))

    def read_index_data(self, pos: int, indexes: Any) -> None:
        super().read_index_data(pos, indexes)
        entries = sum(len(index) for index in indexes.values())
        if entries * _INDEX_ENTRY_BYTES > self._file_bytes:
            raise ValueError(f"its index names more messages than {self._file_bytes} bytes can hold")

    def _unpack(self, name: str, data: bytes) -> bytes:
        raw = unpack_some(name, data)
        self._budget.take(len(raw))
        return raw


@cache
def bound_ros2() -> None:
    """Give `rosbags` bounded decompressors for MCAP chunks and for zstd files and messages. Once is enough."""
    storage_mcap.DECOMPRESSORS["lz4"] = lambda data, size: bytes(unpack("lz4", data, size))
    storage_mcap.DECOMPRESSORS["zstd"] = lambda data, size: bytes(unpack("zstd", data, size))
    vars(rosbag2_reader)["zstd"] = _BoundedZstd
    for module in (rosbag2_reader, storage_mcap, storage_sqlite3):
        vars(module)["parse_qos"] = lambda _: []


class _BoundedZstd:
    """What `rosbags` uses of the module zstd."""

    @staticmethod
    def decompress(data: bytes) -> bytes:
        return unpack_some("zstd", data)

    @staticmethod
    def open(file: Any, mode: str) -> Any:
        raise BadInput(
            f"{file.name}: a whole file packed by zstd; unpack it (`zstd -d {Path(file.name).name}`) and remove "
            "compression_mode from metadata.yaml"
        )


def check_bag2(path: Path) -> None:
    """Look at a bag of ROS 2 before `rosbags` does. Raises BadInput, ValueError, sqlite3.Error."""
    bound_ros2()
    if path.is_dir():
        metadata = path / "metadata.yaml"
        if metadata.is_file():
            parse_yaml(metadata.read_bytes(), str(metadata))
        parts = [p for p in path.iterdir() if p.suffix in (".mcap", ".db3")]
    else:
        parts = [path]
    for part in parts:
        (_check_mcap if part.suffix == ".mcap" else check_sqlite)(part)


def check_sqlite(path: Path) -> None:
    """Tables that hold rows, not views or expressions that make them up. Raises BadInput, sqlite3.Error."""
    with closing(sqlite3.connect(f"file:{path}?mode=ro&immutable=1", uri=True)) as database:
        database.execute("pragma trusted_schema = off")
        for kind, name, sql in database.execute("select type, name, sql from sqlite_master limit 1000").fetchall():
            if kind == "view" or (kind == "table" and _made_up(database, name, str(sql))):
                raise BadInput(f"{path}: its {kind} {name[:40]!r} computes its rows; wanted plain tables")


def _made_up(database: sqlite3.Connection, name: str, sql: str) -> bool:
    """Virtual tables, and generated columns (hidden 2 or 3 in table_xinfo)."""
    quoted = name.replace('"', '""')
    columns = database.execute(f'pragma table_xinfo("{quoted}")').fetchall()
    return "virtual" in sql.lower().split()[:2] or any(column[6] in (2, 3) for column in columns)


def _check_mcap(path: Path) -> None:
    """Every chunk's declared size within the file's budget; chunks of a suspicious size are counted through."""
    with Bytes(path) as file:
        budget, unpacking, offset = Budget(file.size), Budget(file.size), 8
        while offset < file.size - 8:
            opcode, length = file.read(offset, 1), int.from_bytes(file.read(offset + 1, 8), "little")
            if opcode[0] == _MCAP_CHUNK:
                declared = int.from_bytes(file.read(offset + 9 + 16, 8), "little")
                if declared > MOST_CHUNK_BYTES:
                    raise BadInput(f"{path}: a chunk that declares {declared} bytes; wanted {MOST_CHUNK_BYTES} at most")
                if declared > length:
                    budget.take(declared)
                if declared > SUSPICIOUS_TIMES * length:
                    for _ in chunk_records(parse_chunk(record_at(file, offset), unpacking).raw, unpacking):
                        pass
            offset += 9 + length
