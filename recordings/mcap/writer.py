"""An MCAP file that can be cut off at any byte: small chunks, errors that stay, fsync from another thread.

The record layouts are those of the `mcap` package. What is our own: when a chunk is closed (1 MiB or 250 ms), that it
repeats the schemas and channels of its messages (so each chunk can be read when all others are lost), that chunks of
messages that were compressed already stay uncompressed, and that a refused write is never forgotten.
"""

from __future__ import annotations

import struct
import threading
import time
import zlib
from collections.abc import Mapping
from pathlib import Path

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from recordings.errors import BadInput, WriteFailed
from recordings.mcap.sink import Sink

MAGIC = b"\x89MCAP0\r\n"
CHUNK_BYTES = 1 << 20
CHUNK_NS = 250_000_000
LATEST_NS = 1 << 63
SYNC_EVERY_S = 1.0
WATCH_EVERY_S = 0.05
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_CHUNK_HEAD = struct.Struct("<BQQQQI")
_FOOTER_HEAD = struct.Struct("<BQQQ")


class McapWriter:
    """Writes one MCAP file. Thread-safe; a context manager whose exit without `finish` leaves a recoverable file.

    Raises BadInput when the path exists, WriteFailed at the first refused write and at every call after it.
    """

    def __init__(self, path: Path, profile: str = "tosslab", library: str = "tosslab") -> None:
        self._lock = threading.RLock()
        self._sink = Sink(path)
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._definitions: dict[int, bytes] = {}
        self._accepted: dict[int, int] = {}
        self._kept: dict[int, int] = {}
        self._chunk = _Chunk()
        self._chunk_indexes: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._compressor = zstandard.ZstdCompressor(level=1)
        self._stop = threading.Event()
        self._write_records(MAGIC, Header(profile, library))
        self._watcher = threading.Thread(target=self._watch, name=f"sync {path.name}", daemon=True)
        self._watcher.start()

    def __enter__(self) -> McapWriter:
        return self

    def __exit__(self, *exc: object) -> None:
        self.abandon()

    @property
    def counts(self) -> dict[str, int]:
        """Messages accepted so far, by topic."""
        with self._lock:
            return {self._channels[i].topic: n for i, n in self._accepted.items()}

    @property
    def kept(self) -> dict[str, int]:
        """Messages in the chunks that the disk took, by topic."""
        with self._lock:
            return {self._channels[i].topic: n for i, n in self._kept.items()}

    @property
    def path(self) -> Path:
        return self._sink.path

    @property
    def bytes_written(self) -> int:
        return self._sink.position

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        with self._lock:
            number = len(self._schemas) + 1
            self._schemas[number] = Schema(id=number, name=name, encoding=encoding, data=data)
            return number

    def channel(self, topic: str, message_encoding: str, schema: int, metadata: Mapping[str, str] | None = None) -> int:
        """A new channel; `schema` 0 means that its messages have none."""
        with self._lock:
            number = len(self._channels) + 1
            channel = Channel(
                id=number,
                topic=topic,
                message_encoding=message_encoding,
                schema_id=schema,
                metadata=dict(metadata or {}),
            )
            self._channels[number] = channel
            self._definitions[number] = (_serialized(self._schemas[schema]) if schema else b"") + _serialized(channel)
            self._accepted[number] = self._kept[number] = 0
            return number

    def message(
        self,
        channel: int,
        log_time_ns: int,
        publish_time_ns: int,
        sequence: int,
        data: bytes,
        *,
        compress: bool = False,
    ) -> None:
        """Append one message. `compress`: its bytes gain from zstd (raw images), so its chunk is compressed.

        Raises BadInput for a time that no file can hold (before 0 or beyond 63 bits).
        """
        if not (0 <= log_time_ns < LATEST_NS and 0 <= publish_time_ns < LATEST_NS):
            topic = self._channels[channel].topic
            raise BadInput(f"{topic}: times {log_time_ns} and {publish_time_ns} ns; wanted 0 to {LATEST_NS - 1}")
        with self._lock:
            self._sink.check()
            if channel not in self._chunk.index:
                self._chunk.append(self._definitions[channel])
            self._chunk.add_message(channel, log_time_ns, publish_time_ns, sequence & 0xFFFFFFFF, data, compress)
            self._accepted[channel] += 1
            if self._chunk.full():
                self._close_chunk()

    def attachment(self, name: str, media_type: str, data: bytes, log_time_ns: int = 0) -> None:
        with self._lock:
            self._close_chunk()
            record = Attachment(create_time=0, log_time=log_time_ns, name=name, media_type=media_type, data=data)
            offset, length = self._write_records(record)
            self._attachments.append(
                AttachmentIndex(
                    offset=offset,
                    length=length,
                    create_time=0,
                    log_time=log_time_ns,
                    data_size=len(data),
                    name=name,
                    media_type=media_type,
                )
            )

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        with self._lock:
            self._close_chunk()
            offset, length = self._write_records(Metadata(name=name, metadata=dict(values)))
            self._metadata.append(MetadataIndex(offset=offset, length=length, name=name))

    def finish(self) -> str:
        """Close the file with its summary, sync it and return its sha256 as hex. Raises a latched WriteFailed."""
        try:
            with self._lock:
                self._sink.check()
                self._close_chunk()
                self._write_records(DataEnd(self._sink.crc))
                self._write_summary()
                self._stop.set()
        except WriteFailed:
            self.abandon()
            raise
        self._end_watch()
        self._sink.sync()
        self._sink.close()
        self._chunk_indexes.clear()  # a session keeps its writers for their counts
        self._sink.raise_latched()
        return self._sink.sha256

    def abandon(self) -> None:
        """Stop without a summary: what was accepted is flushed, `toss-session recover` reads the file. Never raises."""
        if self._stop.is_set():
            return
        with self._lock:
            try:
                self._close_chunk()
            except WriteFailed:
                pass  # latched in the sink; every later call says so again
            self._stop.set()
        self._end_watch()
        self._sink.sync()
        self._sink.close()

    def _end_watch(self) -> None:
        """Never called with the lock held: the watcher may be waiting for it."""
        self._stop.set()
        if threading.current_thread() is not self._watcher:
            self._watcher.join()

    def _watch(self) -> None:
        """Close chunks by age and fsync about once a second, so that a crash costs little; errors are latched."""
        synced_s = time.monotonic()
        while not self._stop.wait(WATCH_EVERY_S):
            with self._lock:
                if self._stop.is_set() or self._sink.error is not None:
                    continue
                if self._chunk.old():
                    try:
                        self._close_chunk()
                    except WriteFailed:
                        continue  # latched: the next call of the owner raises it
            if time.monotonic() - synced_s >= SYNC_EVERY_S:
                self._sink.sync()
                synced_s = time.monotonic()

    def _close_chunk(self) -> None:
        chunk, self._chunk = self._chunk, _Chunk()
        if chunk.size == 0:
            return
        raw = b"".join(chunk.parts)
        data, compression = (self._compressor.compress(raw), "zstd") if chunk.compress else (raw, "")
        name = compression.encode()
        head = _CHUNK_HEAD.pack(
            Opcode.CHUNK, 40 + len(name) + len(data), chunk.first_ns, chunk.last_ns, len(raw), zlib.crc32(raw)
        )
        start = self._sink.position
        self._sink.write(head, struct.pack("<I", len(name)), name, struct.pack("<Q", len(data)), data)
        end = self._sink.position
        offsets = {}
        index_bytes = RecordBuilder()
        for channel, records in chunk.index.items():
            offsets[channel] = end + index_bytes.count
            MessageIndex(channel_id=channel, records=records).write(index_bytes)
            self._kept[channel] += len(records)
        self._sink.write(index_bytes.end())
        self._chunk_indexes.append(
            ChunkIndex(
                chunk_length=end - start,
                chunk_start_offset=start,
                compression=compression,
                compressed_size=len(data),
                message_end_time=chunk.last_ns,
                message_start_time=chunk.first_ns,
                message_index_length=self._sink.position - end,
                message_index_offsets=offsets,
                uncompressed_size=len(raw),
            )
        )

    def _write_records(self, *records: McapRecord | bytes) -> tuple[int, int]:
        """Offset and length of what was written."""
        offset = self._sink.position
        for record in records:
            if isinstance(record, bytes):
                self._sink.write(record)
                continue
            self._sink.write(_serialized(record))
        return offset, self._sink.position - offset

    def _write_summary(self) -> None:
        start = self._sink.position
        builder = RecordBuilder()
        groups: list[tuple[Opcode, list[McapRecord]]] = [
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, list(self._channels.values())),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, list(self._chunk_indexes)),
            (Opcode.ATTACHMENT_INDEX, list(self._attachments)),
            (Opcode.METADATA_INDEX, list(self._metadata)),
        ]
        offsets = []
        for opcode, records in groups:
            group_start = builder.count
            for record in records:
                record.write(builder)
            if records:
                offsets.append(SummaryOffset(opcode, start + group_start, builder.count - group_start))
        offsets_start = start + builder.count
        for offset in offsets:
            offset.write(builder)
        data = builder.end()
        crc = zlib.crc32(_FOOTER_HEAD.pack(Opcode.FOOTER, 20, start, offsets_start), zlib.crc32(data))
        self._sink.write(data)
        self._write_records(Footer(start, offsets_start, crc), MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._kept),
            chunk_count=len(self._chunk_indexes),
            message_count=sum(self._kept.values()),
            message_end_time=max((c.message_end_time for c in self._chunk_indexes), default=0),
            message_start_time=min((c.message_start_time for c in self._chunk_indexes), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


class _Chunk:
    """The open chunk: records waiting to be written, at most CHUNK_BYTES or CHUNK_NS of them."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0
        self.index: dict[int, list[tuple[int, int]]] = {}
        self.first_ns = 0
        self.last_ns = 0
        self.compress = False
        self.opened_s = time.monotonic()

    def add_message(
        self, channel: int, log_ns: int, publish_ns: int, sequence: int, data: bytes, compress: bool
    ) -> None:
        head = _MESSAGE_HEAD.pack(Opcode.MESSAGE, 22 + len(data), channel, sequence, log_ns, publish_ns)
        self.first_ns = min(self.first_ns, log_ns) if self.index else log_ns
        self.last_ns = max(self.last_ns, log_ns) if self.index else log_ns
        self.index.setdefault(channel, []).append((log_ns, self.size))
        self.compress |= compress
        self.append(head)
        self.append(data)

    def append(self, part: bytes) -> None:
        if self.size == 0:
            self.opened_s = time.monotonic()
        self.parts.append(part)
        self.size += len(part)

    def full(self) -> bool:
        return self.size >= CHUNK_BYTES or self.last_ns - self.first_ns >= CHUNK_NS

    def old(self) -> bool:
        return self.size > 0 and time.monotonic() - self.opened_s >= CHUNK_NS / 1e9


def _serialized(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
