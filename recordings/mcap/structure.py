"""One pass over the bytes of an MCAP file: every record, every CRC, every index against what it points to."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from recordings.bounded.limits import Budget
from recordings.errors import BadInput
from recordings.mcap import scan as mcap_scan
from recordings.mcap.scan import MESSAGE, Bytes, Record
from recordings.mcap.writer import MAGIC

Severity = Literal["error", "warning", "info"]


@dataclass(frozen=True)
class Finding:
    """One thing that verify noticed. Errors are damage; warnings are what a user should know; info is neither."""

    severity: Severity
    place: str
    text: str


@dataclass
class TopicSeen:
    """What the data section holds of one topic, in the order of the file."""

    bytes: int = 0
    log_ns: list[int] = field(default_factory=list)
    publish_ns: list[int] = field(default_factory=list)
    sequence: list[int] = field(default_factory=list)


@dataclass
class Structure:
    """The outcome of one pass. `own`: tosslab wrote the file, so it must carry all CRCs."""

    name: str
    findings: list[Finding] = field(default_factory=list)
    profile: str = ""
    library: str = ""
    own: bool = False
    size: int = 0
    sha256: str = ""
    topics: dict[str, TopicSeen] = field(default_factory=dict)
    metadata: list[Metadata] = field(default_factory=list)
    attachments: dict[str, int] = field(default_factory=dict)

    @property
    def damaged(self) -> bool:
        return any(f.severity == "error" for f in self.findings)

    def error(self, text: str) -> None:
        self.findings.append(Finding("error", self.name, text))

    def note(self, severity: Severity, text: str) -> None:
        finding = Finding(severity, self.name, text)
        if finding not in self.findings:
            self.findings.append(finding)


def check_structure(path: Path, name: str | None = None) -> Structure:
    """Read the whole file once. Raises BadInput when it cannot be read or is no MCAP file at all."""
    with Bytes(path) as file:
        start, end = file.read(0, 8), file.read(max(0, file.size - 8), 8)
        if file.size == 0:
            raise BadInput(f"{path} is empty (0 bytes); wanted an MCAP file")
        if start != MAGIC and end != MAGIC and not MAGIC.startswith(start):
            raise BadInput(f"{path} is not an MCAP file: it begins with {start!r}")
        seen = Structure(name or path.name, size=file.size)
        _Pass(file, seen).run()
        return seen


class _Pass:
    """State of the walk: definitions by id, where things lie, the running CRC and hash."""

    def __init__(self, file: Bytes, seen: Structure) -> None:
        self.file, self.seen = file, seen
        self.budget = Budget(file.size)
        self.crc, self.sha256 = 0, hashlib.sha256()
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.counts: dict[int, int] = {}
        self.chunk_places: dict[int, tuple[int, int, int, int, int, str]] = {}
        self.places: dict[tuple[int, str], int] = {}
        self.expected_index: dict[int, list[tuple[int, int]]] | None = None
        self.statistics: Statistics | None = None
        self.indexed_chunks = 0

    def run(self) -> None:
        seen = self.seen
        try:
            self._take(MAGIC, 0)
            end = self._data_section(len(MAGIC))
            end = self._summary(end)
            rest = self.file.read(end, 16)
            self._take(rest, end)
            if rest != MAGIC:
                raise ValueError(f"the file does not end with MCAP's mark but with {rest[:8]!r}")
            seen.sha256 = self.sha256.hexdigest()
        except ValueError as wrong:
            seen.error(f"{wrong}; what is behind was not checked. `toss-session recover` saves what can be read")

    def _take(self, data: bytes, offset: int) -> None:
        if self.file.read(offset, len(data)) != data:
            raise ValueError("the file does not begin with MCAP's mark")
        self._feed(data)

    def _feed(self, data: bytes) -> None:
        self.crc = zlib.crc32(data, self.crc)
        self.sha256.update(data)

    def _records(self, offset: int) -> Iterator[Record]:
        while True:
            record = mcap_scan.record_at(self.file, offset)
            yield record
            self._feed(mcap_scan.HEAD.pack(record.opcode, len(record.body)))
            self._feed(record.body)
            offset = record.end

    def _data_section(self, offset: int) -> int:
        first = True
        for record in self._records(offset):
            if first != (record.opcode == Opcode.HEADER):
                raise ValueError(f"the record at byte {record.offset} is {'no' if first else 'a second'} header")
            first = False
            if record.opcode != Opcode.MESSAGE_INDEX:
                self._index_complete(record.offset)
            if record.opcode == Opcode.DATA_END:
                self._data_end(record)
                self._feed(mcap_scan.HEAD.pack(record.opcode, len(record.body)) + record.body)
                return record.end
            self._data_record(record)
        raise AssertionError("record_at ends the walk")

    def _data_record(self, record: Record) -> None:
        seen = self.seen
        if record.opcode == Opcode.HEADER:
            header = mcap_scan.parse(record, Header)
            seen.profile, seen.library = header.profile, header.library
            seen.own = header.profile == "tosslab"
        elif record.opcode == Opcode.CHUNK:
            self._chunk(record)
        elif record.opcode == Opcode.MESSAGE_INDEX:
            self._message_index(record)
        elif record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            self._inner(record.opcode, record.body)
        elif record.opcode == Opcode.ATTACHMENT:
            attachment = mcap_scan.parse_attachment(record)
            if record.body[-4:] == bytes(4):
                self._no_crc(f"the attachment {attachment.name}")
            seen.attachments[attachment.name] = len(attachment.data)
            self.places[Opcode.ATTACHMENT_INDEX, attachment.name] = record.offset
        elif record.opcode == Opcode.METADATA:
            metadata = mcap_scan.parse(record, Metadata)
            seen.metadata.append(metadata)
            self.places[Opcode.METADATA_INDEX, metadata.name] = record.offset
        elif record.opcode in (Opcode.FOOTER, Opcode.STATISTICS, Opcode.CHUNK_INDEX):
            raise ValueError(f"the data section stops at byte {record.offset} without its end mark")

    def _chunk(self, record: Record) -> None:
        try:
            chunk = mcap_scan.parse_chunk(record, self.budget)
            index: dict[int, list[tuple[int, int]]] = {}
            for opcode, at, body in mcap_scan.chunk_records(chunk.raw, self.budget):
                stamp = self._inner(opcode, body)
                if stamp is not None:
                    index.setdefault(stamp[0], []).append((stamp[1], at))
        except ValueError as wrong:
            self.seen.error(f"the chunk at byte {record.offset}: {wrong}")
            self.expected_index = None
            return
        if chunk.crc == 0:
            self._no_crc("a chunk")
        times = [time_ns for entries in index.values() for time_ns, _ in entries]
        if times and (min(times), max(times)) != (chunk.first_ns, chunk.last_ns):
            self.seen.error(f"the chunk at byte {record.offset} says another time span than its messages have")
        self.expected_index = index
        self.chunk_places[record.offset] = (
            record.end - record.offset,
            chunk.first_ns,
            chunk.last_ns,
            chunk.compressed_size,
            len(chunk.raw),
            chunk.compression,
        )

    def _inner(self, opcode: int, body: bytes) -> tuple[int, int] | None:
        """A record inside or outside of a chunk; (channel, log time) of a message."""
        if opcode == Opcode.SCHEMA:
            self._define(self.schemas, mcap_scan.parse(body, Schema))
        elif opcode == Opcode.CHANNEL:
            self._define(self.channels, mcap_scan.parse(body, Channel))
        elif opcode == Opcode.MESSAGE:
            number, sequence, log_ns, publish_ns = MESSAGE.unpack_from(body)
            channel = self.channels.get(number)
            if channel is None:
                raise ValueError(f"a message names channel {number}, which is not defined before it")
            topic = self.seen.topics.setdefault(channel.topic, TopicSeen())
            topic.bytes += len(body) - MESSAGE.size
            topic.log_ns.append(log_ns)
            topic.publish_ns.append(publish_ns)
            topic.sequence.append(sequence)
            self.counts[number] = self.counts.get(number, 0) + 1
            return number, log_ns
        return None

    def _define(self, known: dict[int, Schema] | dict[int, Channel], record: Schema | Channel) -> None:
        if known.setdefault(record.id, record) != record:  # type: ignore[arg-type]
            self.seen.error(f"{type(record).__name__.lower()} {record.id} is defined twice, differently")
        if isinstance(record, Channel) and record.schema_id and record.schema_id not in self.schemas:
            self.seen.error(f"{record.topic} names schema {record.schema_id}, which is not defined before it")

    def _message_index(self, record: Record) -> None:
        index = mcap_scan.parse(record, MessageIndex)
        if self.expected_index is None:
            return
        expected = self.expected_index.pop(index.channel_id, None)
        if expected is None and not index.records:
            return
        if expected is None or sorted(expected) != sorted(tuple(r) for r in index.records):
            self.seen.error(f"the message index at byte {record.offset} does not agree with its chunk")

    def _index_complete(self, offset: int) -> None:
        if self.expected_index and self.seen.own:  # other writers may leave indexes out
            topics = sorted(self.channels[c].topic for c in self.expected_index)
            self.seen.error(f"the chunk before byte {offset} has no message index of {', '.join(topics)}")
        self.expected_index = None

    def _data_end(self, record: Record) -> None:
        crc = mcap_scan.parse(record, DataEnd).data_section_crc
        if crc == 0:
            self._no_crc("the data section")
        elif crc != self.crc:
            self.seen.error("the data section differs from its CRC: bytes were altered after writing")

    def _no_crc(self, what: str) -> None:
        if self.seen.own:
            self.seen.error(f"{what} has no CRC, which tosslab always writes")
        elif what == "the data section":
            self.seen.note("info", "its writer stored no CRC of the data section: only each chunk's was checked")
        else:
            self.seen.note("warning", f"{what} has no CRC: its content cannot be checked")

    def _summary(self, offset: int) -> int:
        start, crc = offset, 0
        for record in self._records(offset):
            if record.opcode == Opcode.FOOTER:
                footer = mcap_scan.parse(record, Footer)
                crc = zlib.crc32(mcap_scan.HEAD.pack(record.opcode, 20) + record.body[:16], crc)
                self._footer(footer, start if record.offset > start else 0, crc)
                self._feed(mcap_scan.HEAD.pack(record.opcode, len(record.body)) + record.body)
                return record.end
            crc = zlib.crc32(mcap_scan.HEAD.pack(record.opcode, len(record.body)) + record.body, crc)
            self._summary_record(record)
        raise AssertionError("record_at ends the walk")

    def _summary_record(self, record: Record) -> None:
        if record.opcode == Opcode.SCHEMA:
            self._define(self.schemas, mcap_scan.parse(record, Schema))
        elif record.opcode == Opcode.CHANNEL:
            self._define(self.channels, mcap_scan.parse(record, Channel))
        elif record.opcode == Opcode.STATISTICS:
            self.statistics = mcap_scan.parse(record, Statistics)
        elif record.opcode == Opcode.CHUNK_INDEX:
            self._chunk_index(mcap_scan.parse(record, ChunkIndex))
        elif record.opcode == Opcode.ATTACHMENT_INDEX:
            self._place(record.opcode, mcap_scan.parse(record, AttachmentIndex))
        elif record.opcode == Opcode.METADATA_INDEX:
            self._place(record.opcode, mcap_scan.parse(record, MetadataIndex))

    def _place(self, opcode: int, index: AttachmentIndex | MetadataIndex) -> None:
        if (opcode, index.name) not in self.places:
            self.seen.error(f"the index names {index.name!r} at byte {index.offset}, where it is not")

    def _chunk_index(self, index: ChunkIndex) -> None:
        self.indexed_chunks += 1
        found = (
            index.chunk_length,
            index.message_start_time,
            index.message_end_time,
            index.compressed_size,
            index.uncompressed_size,
            index.compression,
        )
        if self.chunk_places.get(index.chunk_start_offset) != found:
            self.seen.error(f"the index describes the chunk at byte {index.chunk_start_offset} as it is not")

    def _footer(self, footer: Footer, summary_start: int, crc: int) -> None:
        if footer.summary_start != summary_start:
            self.seen.error(f"the footer looks for the index at byte {footer.summary_start}, it is at {summary_start}")
        if footer.summary_crc == 0 and self.seen.own:
            self.seen.error("the index has no CRC, which tosslab always writes")
        elif footer.summary_crc and footer.summary_crc != crc:
            self.seen.error("the index differs from its CRC")
        if self.indexed_chunks != len(self.chunk_places) and (self.indexed_chunks or self.seen.own):
            self.seen.error(f"{len(self.chunk_places)} good chunks, {self.indexed_chunks} in the index")
        if self.statistics is None:
            self.seen.note("error" if self.seen.own else "warning", "there is no index (no statistics)")
        elif self.statistics.message_count != sum(self.counts.values()) or any(
            self.counts.get(c, 0) != n for c, n in self.statistics.channel_message_counts.items()
        ):
            stated, counted = self.statistics.message_count, sum(self.counts.values())
            self.seen.error(f"the index counts {stated} messages, {counted} could be read")
