"""Random access to an indexed MCAP file: any message by its place in its topic, without reading the whole file.

Everything read is checked against the file's size and each chunk's CRC; whatever is wrong with the bytes comes out as
`DamagedFile`, never as another exception.
"""

from __future__ import annotations

import io
import os
import struct
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Int64
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, ChunkIndex, Metadata, MetadataIndex, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from numpy import ndarray as Array

from recordings.bounded import limits
from recordings.errors import BadInput, DamagedFile
from recordings.mcap.writer import LATEST_NS, MAGIC

CACHED_CHUNKS = 4
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_CHUNK_HEAD = struct.Struct("<BQQQQI")
_INDEX_HEAD = struct.Struct("<BQHI")
RAISED = (
    McapError,
    ValueError,
    KeyError,
    IndexError,
    struct.error,
    EOFError,
    OverflowError,
    MemoryError,
    OSError,
    AssertionError,
)
"""What mcap and Python raise on bytes that are not what they should be."""
T = TypeVar("T")


@dataclass(frozen=True)
class Message:
    """One message, not decoded. `log_time_ns`: when the host received it; `publish_time_ns`: mid-exposure."""

    topic: str
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


def open_unbuffered(path: Path) -> tuple[io.FileIO, int]:
    """A file to read at any place, and its size in bytes. Raises BadInput where it cannot be opened."""
    try:
        file = open(path, "rb", buffering=0)  # noqa: SIM115 (whoever asked closes it)
        return file, os.fstat(file.fileno()).st_size
    except IsADirectoryError as folder:
        raise BadInput(f"{path} is a folder; wanted an .mcap file") from folder
    except OSError as refused:
        raise BadInput(f"{path} cannot be opened: {refused.strerror}") from refused


class McapFile:
    """An MCAP file with an index. Raises BadInput when it is none, DamagedFile when it was cut off or altered.

    Several threads may read at once (a replayed rig has one per device).
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file, self.size = open_unbuffered(path)
        self._guard(self._check_ends, "its beginning or end")
        self.summary: Summary = self._guard(self._read_summary, "its index")
        self._lock = threading.Lock()
        self._cache: OrderedDict[int, bytes | memoryview] = OrderedDict()

    def __enter__(self) -> McapFile:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        self._file.close()

    @cached_property
    def channels(self) -> dict[str, Channel]:
        """Channels by topic. Where several carry one topic (other writers do that), the first that has messages."""
        found: dict[str, Channel] = {}
        for channel in self.summary.channels.values():
            if channel.topic not in found or (self.count(channel.id) and not self.count(found[channel.topic].id)):
                found[channel.topic] = channel
        return found

    @cached_property
    def _ids(self) -> dict[str, frozenset[int]]:
        """All channels of a topic that say the same of their messages as the one in `channels`."""
        ids: dict[str, set[int]] = {}
        for channel in self.summary.channels.values():
            first = self.channels[channel.topic]
            if (channel.schema_id, channel.message_encoding) == (first.schema_id, first.message_encoding):
                ids.setdefault(channel.topic, set()).add(channel.id)
        return {topic: frozenset(numbers) for topic, numbers in ids.items()}

    def schema(self, topic: str) -> Schema | None:
        return self.summary.schemas.get(self.channels[topic].schema_id)

    def count(self, channel_id: int) -> int:
        statistics = self.summary.statistics
        return int(statistics.channel_message_counts.get(channel_id, 0)) if statistics else 0

    def topic_index(self, topic: str) -> TopicIndex:
        """Where every message of a topic lies, in the order of log time. Empty for a topic that is not there."""
        if topic not in self.channels:
            return TopicIndex.empty()
        return self._indexes.get(topic, TopicIndex.empty())

    def read(self, topic: str, position: int) -> Message:
        """The message at a position (0-based, log-time order) of a topic. Raises IndexError behind the last one."""
        index = self.topic_index(topic)
        chunk = self._chunk(int(index.chunk[position]))
        offset = int(index.offset[position])
        return self._guard(lambda: self._cut(topic, chunk, offset), f"message {position} of {topic}")

    def messages(self, topic: str) -> Iterator[Message]:
        for position in range(len(self.topic_index(topic))):
            yield self.read(topic, position)

    def publish_times_ns(self, topic: str) -> Int64[Array, " n"]:
        """Publish time of every message of a topic; of uncompressed chunks only the message heads are read."""
        index = self.topic_index(topic)
        places = zip(index.chunk.tolist(), index.offset.tolist(), strict=True)
        return self._guard(
            lambda: np.array([self._publish_time(c, o) for c, o in places], dtype=np.int64), f"the times of {topic}"
        )

    def metadata(self, name: str) -> list[dict[str, str]]:
        """Every metadata record of that name."""
        places = [m.offset for m in self.summary.metadata_indexes if m.name == name]
        return [self._guard(partial(self._record, o, Metadata), f"metadata {name}").metadata for o in places]

    def attachments(self) -> list[str]:
        return [a.name for a in self.summary.attachment_indexes]

    @cached_property
    def _attachment_places(self) -> dict[str, int]:
        return {a.name: a.offset for a in self.summary.attachment_indexes}

    def attachment(self, name: str) -> bytes | None:
        """The last attachment of that name; None if there is none."""
        if name not in self._attachment_places:
            return None
        record = self._guard(lambda: self._record(self._attachment_places[name], Attachment), f"attachment {name}")
        return bytes(record.data)

    def _check_ends(self) -> None:
        start, end = self._pread(0, 8), self._pread(max(0, self.size - 8), 8)
        if self.size == 0:
            raise BadInput(f"{self.path} is empty (0 bytes); wanted an MCAP file")
        if start != MAGIC[: len(start)]:
            raise BadInput(f"{self.path} is not an MCAP file: it begins with {start[:8]!r}")
        if end != MAGIC or self.size < 8 + 29 + 8:
            raise DamagedFile(
                f"{self.path} was cut off, or is still being written: it has no MCAP end mark. Its complete "
                f"chunks can be saved: `toss-session recover {self.path} NEW.mcap`"
            )

    @cached_property
    def _indexes(self) -> dict[str, TopicIndex]:
        return self._guard(self._read_indexes, "its message index")

    def _guard(self, read: Callable[[], T], what: str) -> T:
        try:
            return read()
        except BadInput:
            raise
        except RAISED as wrong:
            raise DamagedFile(
                f"{self.path}: {what} is damaged ({type(wrong).__name__}: {str(wrong)[:120]}). What can be read can be "
                f"saved: `toss-session recover {self.path} NEW.mcap`"
            ) from wrong

    def _pread(self, offset: int, length: int) -> bytes:
        return os.pread(self._file.fileno(), length, offset)

    def _exactly(self, offset: int, length: int) -> bytes:
        if offset < 0 or length < 0 or offset + length > self.size:
            raise ValueError(f"{length} bytes at {offset} of {self.size}")
        data = self._pread(offset, length)
        if len(data) != length:
            raise ValueError(f"{len(data)} of {length} bytes at {offset}")
        return data

    def _read_summary(self) -> Summary:
        footer = self._exactly(self.size - 37, 29)
        opcode, length, start, _, crc = struct.unpack("<BQQQI", footer)
        if opcode != Opcode.FOOTER or length != 20:
            raise ValueError("no footer")
        if start == 0:
            raise ValueError("no summary")
        block = self._exactly(start, self.size - 37 - start)
        if crc and zlib.crc32(footer[:25], zlib.crc32(block)) != crc:
            raise ValueError("the summary's CRC differs")
        summary = _parse_summary(block + footer + MAGIC)
        limits.Budget(self.size).take(sum(c.uncompressed_size for c in summary.chunk_indexes if c.compression))
        if sum(c.message_index_length for c in summary.chunk_indexes) > self.size:
            raise ValueError("its message indexes are longer than the file")
        for channel in summary.channels.values():
            if channel.schema_id and channel.schema_id not in summary.schemas:
                raise ValueError(f"topic {channel.topic} names a schema that is not there")
        return summary

    def _read_indexes(self) -> dict[str, TopicIndex]:
        """Of every topic, with one read per chunk."""
        topics = {number: topic for topic, numbers in self._ids.items() for number in numbers}
        tables: dict[str, list[Array]] = {}
        rows = 0
        for number, chunk in enumerate(self.summary.chunk_indexes):
            start = chunk.chunk_start_offset + chunk.chunk_length
            block = self._exactly(start, chunk.message_index_length)
            for channel, place in chunk.message_index_offsets.items():
                if channel in topics:
                    table = _message_index(block, place - start, chunk.uncompressed_size)
                    rows += len(table)
                    if rows > self.size // 16:  # an entry has 16 bytes: some are named more than once
                        raise ValueError(f"more messages than {self.size} bytes can index")
                    numbered = np.empty((len(table), 3), dtype=np.int64)
                    numbered[:, 0], numbered[:, 1], numbered[:, 2] = table[:, 0], number, table[:, 1]
                    tables.setdefault(topics[channel], []).append(numbered)
        return {topic: TopicIndex.of(np.concatenate(found)) for topic, found in tables.items()}

    def _record(self, offset: int, kind: type[T]) -> T:
        length = struct.unpack("<Q", self._exactly(offset + 1, 8))[0]
        data = self._exactly(offset, 9 + length)
        if (
            kind is Attachment
            and data[-4:] != bytes(4)
            and zlib.crc32(data[9:-4]) != int.from_bytes(data[-4:], "little")
        ):
            raise ValueError("its CRC differs")
        for record in StreamReader(io.BytesIO(data), skip_magic=True).records:
            if isinstance(record, kind):
                return record
            break
        raise ValueError(f"no {kind.__name__} at {offset}")

    def _chunk_place(self, number: int) -> tuple[ChunkIndex, int]:
        chunk = self.summary.chunk_indexes[number]
        return chunk, chunk.chunk_start_offset + _CHUNK_HEAD.size + 4 + len(chunk.compression.encode()) + 8

    def _chunk(self, number: int) -> bytes | memoryview:
        with self._lock:
            if number in self._cache:
                self._cache.move_to_end(number)
                return self._cache[number]
        data = self._guard(lambda: self._load_chunk(number), f"chunk {number}")
        with self._lock:
            self._cache[number] = data
            while len(self._cache) > CACHED_CHUNKS:
                self._cache.popitem(last=False)
        return data

    def _load_chunk(self, number: int) -> bytes | memoryview:
        chunk, place = self._chunk_place(number)
        whole = self._exactly(chunk.chunk_start_offset, place - chunk.chunk_start_offset + chunk.compressed_size)
        opcode, _, _, _, size, crc = _CHUNK_HEAD.unpack_from(whole)
        if opcode != Opcode.CHUNK or size != chunk.uncompressed_size:
            raise ValueError("the chunk's head and its index disagree")
        data = limits.unpack(chunk.compression, memoryview(whole)[place - chunk.chunk_start_offset :], size)
        if crc and zlib.crc32(data) != crc:
            raise ValueError("the chunk's CRC differs")
        return data

    def _publish_time(self, number: int, offset: int) -> int:
        chunk, place = self._chunk_place(number)
        if chunk.compression:
            head = _MESSAGE_HEAD.unpack_from(self._chunk(number), offset)
        elif offset + _MESSAGE_HEAD.size > chunk.uncompressed_size:
            raise ValueError("a message lies outside its chunk")
        else:
            head = _MESSAGE_HEAD.unpack(self._exactly(place + offset, _MESSAGE_HEAD.size))
        if head[0] != Opcode.MESSAGE or not 0 <= head[5] < LATEST_NS:
            raise ValueError(f"opcode {head[0]}, time {head[5]}")
        return int(head[5])

    def _cut(self, topic: str, chunk: bytes | memoryview, offset: int) -> Message:
        opcode, length, channel, sequence, log_ns, publish_ns = _MESSAGE_HEAD.unpack_from(chunk, offset)
        end = offset + 9 + length
        if opcode != Opcode.MESSAGE or channel not in self._ids[topic] or end > len(chunk) or length < 22:
            raise ValueError("its index points to something else")
        return Message(topic, sequence, log_ns, publish_ns, bytes(chunk[offset + _MESSAGE_HEAD.size : end]))


@dataclass(frozen=True, eq=False)
class TopicIndex:
    """Log time, chunk number and offset within the uncompressed chunk of each message, in log-time order."""

    log_time_ns: Int64[Array, " n"]
    chunk: Int64[Array, " n"]
    offset: Int64[Array, " n"]

    def __len__(self) -> int:
        return len(self.log_time_ns)

    @staticmethod
    def of(table: Int64[Array, "n 3"]) -> TopicIndex:
        """From rows of (log time, chunk, offset) in any order."""
        order = np.argsort(table[:, 0], kind="stable")
        return TopicIndex(table[order, 0], table[order, 1], table[order, 2])

    @staticmethod
    def empty() -> TopicIndex:
        none = np.zeros(0, dtype=np.int64)
        return TopicIndex(none, none, none)


def _message_index(block: bytes, place: int, chunk_size: int) -> Int64[Array, "n 2"]:
    """Log time and offset of each message, from a message index record at `place` of a block."""
    if not 0 <= place <= len(block) - _INDEX_HEAD.size:
        raise ValueError("a message index lies elsewhere than behind its chunk")
    opcode, length, _, size = _INDEX_HEAD.unpack_from(block, place)
    if opcode != Opcode.MESSAGE_INDEX or size != length - 6 or size % 16 or place + 15 + size > len(block):
        raise ValueError("a message index record is malformed")
    table = np.frombuffer(block, dtype="<i8", count=size // 8, offset=place + _INDEX_HEAD.size).reshape(-1, 2)
    if len(table) and (table.min() < 0 or table[:, 1].max() + _MESSAGE_HEAD.size > chunk_size):
        raise ValueError("a message index points out of its chunk")
    return table


def _parse_summary(block: bytes) -> Summary:
    summary = Summary()
    for record in StreamReader(io.BytesIO(block), skip_magic=True, record_size_limit=len(block)).records:
        if isinstance(record, Schema):
            summary.schemas[record.id] = record
        elif isinstance(record, Channel):
            summary.channels[record.id] = record
        elif isinstance(record, Statistics):
            summary.statistics = record
        elif isinstance(record, ChunkIndex):
            summary.chunk_indexes.append(record)
        elif isinstance(record, AttachmentIndex):
            summary.attachment_indexes.append(record)
        elif isinstance(record, MetadataIndex):
            summary.metadata_indexes.append(record)
    if summary.statistics is None:
        raise ValueError("no statistics")
    return summary
