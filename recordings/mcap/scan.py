"""An MCAP file record by record, as it lies on disk: what `verify` and `recover` stand on.

Unlike `McapFile` it needs no index, and it finds its way again behind bytes that are no record.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, McapRecord, Metadata, Schema

from recordings.bounded.limits import MOST_CHUNK_BYTES, SEARCHED_TIMES, Budget, unpack
from recordings.errors import BadInput
from recordings.mcap.file import RAISED, open_unbuffered

HEAD = struct.Struct("<BQ")
MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")
_KNOWN = frozenset(int(o) for o in Opcode)
_FIXED_LENGTH = {int(Opcode.FOOTER): 20, int(Opcode.DATA_END): 4}
_BLOCK = 1 << 20
_REBUILT: dict[int, type[McapRecord]] = {
    int(Opcode.METADATA): Metadata,
    int(Opcode.SCHEMA): Schema,
    int(Opcode.CHANNEL): Channel,
}
_ANCHORS = (Opcode.CHUNK, Opcode.ATTACHMENT, *_REBUILT)
_LONGEST_CHUNK_HEAD = 9 + _CHUNK.size + 4 + 8 + 8
R = TypeVar("R", bound=McapRecord)


class Bytes:
    """A file opened for reading at any place. Raises BadInput when it cannot be opened.

    `searched` counts the bytes that were read to find records again.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.searched = 0
        self._file, self.size = open_unbuffered(path)

    def __enter__(self) -> Bytes:
        return self

    def __exit__(self, *exc: object) -> None:
        self._file.close()

    def read(self, offset: int, length: int) -> bytes:
        """Up to `length` bytes: fewer at the end of the file."""
        try:
            return os.pread(self._file.fileno(), max(0, min(length, self.size - offset)), offset)
        except OSError as refused:
            raise BadInput(f"{self.path} cannot be read at byte {offset}: {refused.strerror}") from refused

    def exactly(self, offset: int, length: int) -> bytes:
        data = self.read(offset, length)
        if len(data) != length:
            raise ValueError(f"the file ends within the {length} bytes at {offset}")
        return data


@dataclass(frozen=True)
class Record:
    """One record: `body` is what follows its opcode and length."""

    opcode: int
    offset: int
    body: bytes

    @property
    def end(self) -> int:
        return self.offset + HEAD.size + len(self.body)


@dataclass(frozen=True)
class Chunk:
    """A chunk's content, decompressed and compared with its CRC. `crc` is the stated one, 0 where none was stated."""

    first_ns: int
    last_ns: int
    crc: int
    compression: str
    compressed_size: int
    raw: bytes


def record_at(file: Bytes, offset: int) -> Record:
    """The record at an offset. Raises ValueError when there is none, or it is cut off."""
    opcode, length = HEAD.unpack(file.exactly(offset, HEAD.size))
    if opcode not in _KNOWN and opcode < 0x80:
        raise ValueError(f"no record at byte {offset}: opcode 0x{opcode:02x}")
    left = file.size - offset - HEAD.size
    if length > left:
        raise ValueError(f"the file ends within the record at byte {offset} (its length is {length}, {left} are left)")
    if _FIXED_LENGTH.get(opcode, length) != length:
        raise ValueError(f"the record at byte {offset} has an impossible length ({length})")
    return Record(opcode, offset, file.exactly(offset + HEAD.size, length))


def parse(record: Record | bytes, kind: type[R]) -> R:
    """A record as mcap's class. Raises ValueError when its bytes are malformed."""
    body = record if isinstance(record, bytes) else record.body
    try:
        parsed = kind.read(ReadDataStream(io.BytesIO(body)))  # type: ignore[attr-defined]
    except RAISED as wrong:
        raise ValueError(f"a malformed {kind.__name__} record ({type(wrong).__name__}: {str(wrong)[:80]})") from wrong
    return parsed


def parse_attachment(record: Record) -> Attachment:
    """An attachment whose CRC agrees (0 means that none was stated)."""
    attachment = parse(record, Attachment)
    crc = struct.unpack("<I", record.body[-4:])[0]
    if crc and zlib.crc32(record.body[:-4]) != crc:
        raise ValueError(f"the attachment {attachment.name[:40]!r} differs from its CRC")
    return attachment


def parse_chunk(record: Record, budget: Budget) -> Chunk:
    """Raises ValueError when the chunk cannot be decompressed, differs from its CRC or is too much for the file."""
    body = record.body
    try:
        first_ns, last_ns, size, crc = _CHUNK.unpack_from(body, 0)
        (name_length,) = struct.unpack_from("<I", body, _CHUNK.size)
        data_at = _CHUNK.size + 4 + name_length + 8
        name = body[_CHUNK.size + 4 : data_at - 8].decode()
        (data_length,) = struct.unpack_from("<Q", body, data_at - 8)
    except (struct.error, UnicodeDecodeError) as wrong:
        raise ValueError(f"a chunk with a malformed head ({wrong})") from wrong
    if data_at + data_length != len(body):
        raise ValueError(f"a chunk of {len(body)} bytes whose head says {data_at + data_length}")
    if name:
        budget.take(size)
    raw = bytes(unpack(name, body[data_at:], size))
    if crc and zlib.crc32(raw) != crc:
        raise ValueError("a chunk that differs from its CRC")
    return Chunk(first_ns, last_ns, crc, name, data_length, raw)


def chunk_records(raw: bytes, budget: Budget) -> Iterator[tuple[int, int, bytes]]:
    """(opcode, offset, body) of the records inside a chunk. Raises ValueError when they do not fill it exactly."""
    at = 0
    while at < len(raw):
        if at + HEAD.size > len(raw):
            raise ValueError("a chunk that ends within a record's head")
        opcode, length = HEAD.unpack_from(raw, at)
        end = at + HEAD.size + length
        if end > len(raw) or (opcode == Opcode.MESSAGE and length < MESSAGE.size):
            raise ValueError("a chunk whose records do not fit into it")
        budget.record()
        yield opcode, at, raw[at + HEAD.size : end]
        at = end


def find_again(file: Bytes, offset: int, *, loose_messages: bool = False) -> int:
    """The offset of the next record that proves itself, at or behind `offset`; the file's size where there is none.

    Chunks and attachments prove themselves by lengths that add up, schemas, channels and metadata by being rebuilt
    byte for byte. `loose_messages`: also messages outside of chunks, by the record that follows. The search ends where
    too many bytes were read for what proved to be no record.
    """
    wanted = [*_ANCHORS, Opcode.MESSAGE] if loose_messages else list(_ANCHORS)
    while offset + HEAD.size <= file.size:
        data = file.read(offset, _BLOCK + HEAD.size)
        block = np.frombuffer(data, dtype=np.uint8)
        for start in np.flatnonzero(np.isin(block[: min(_BLOCK, len(block) - 8)], wanted)).tolist():
            length = HEAD.unpack_from(data, start)[1]
            if not 0 < length <= file.size - offset - start - HEAD.size:
                continue
            if file.searched > SEARCHED_TIMES * max(file.size, _BLOCK):
                return file.size
            if _proves_itself(file, offset + start):
                return int(offset + start)
        offset += _BLOCK
    return file.size


def _proves_itself(file: Bytes, offset: int) -> bool:
    opcode, length = HEAD.unpack(file.exactly(offset, HEAD.size))
    file.searched += _LONGEST_CHUNK_HEAD + (0 if opcode == Opcode.CHUNK else length)
    if opcode == Opcode.CHUNK:
        return _chunk_adds_up(file.read(offset + HEAD.size, min(length, _LONGEST_CHUNK_HEAD)), length)
    try:
        record = record_at(file, offset)
        if opcode == Opcode.ATTACHMENT:
            return len(parse_attachment(record).data) > 0
        if opcode in _REBUILT:
            return _rebuilt(record)
        return len(record.body) >= MESSAGE.size and record_at(file, record.end).opcode in _KNOWN
    except ValueError:
        return False


def _chunk_adds_up(head: bytes, length: int) -> bool:
    if len(head) < _CHUNK.size + 12:
        return False
    (name_length,) = struct.unpack_from("<I", head, _CHUNK.size)
    at = _CHUNK.size + 4 + name_length
    if name_length > 8 or at + 8 > len(head) or _CHUNK.unpack_from(head)[2] > MOST_CHUNK_BYTES:
        return False
    return bool(at + 8 + struct.unpack_from("<Q", head, at)[0] == length)


def _rebuilt(record: Record) -> bool:
    builder = RecordBuilder()
    parse(record, _REBUILT[record.opcode]).write(builder)
    return builder.end()[HEAD.size :] == record.body
