"""Which records of a damaged MCAP file are whole, and what is known of the others. Nothing is written here."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, MessageIndex, Metadata, Schema, Statistics

from recordings.bounded.limits import Budget
from recordings.mcap import scan as mcap_scan
from recordings.mcap.scan import MESSAGE, Bytes, Record
from recordings.mcap.writer import MAGIC

_KEPT = (Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.MESSAGE)


@dataclass(frozen=True)
class SavedMessage:
    """A message as it was written, with the number of its channel in the damaged file."""

    channel: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes
    compressed: bool


@dataclass
class Survey:
    """What a walk over the file found.

    `lost`: messages by channel number that bad chunks held, where their index tells; `stated`: messages by channel
    number that the file's own statistics count; `damage`: (first byte, end, what).
    """

    profile: str = ""
    library: str = ""
    whole_ending: bool = False
    offsets: list[int] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    lost: dict[int, int] = field(default_factory=dict)
    stated: dict[int, int] = field(default_factory=dict)
    loose_messages: int = 0
    damage: list[tuple[int, int, str]] = field(default_factory=list)

    @property
    def skipped_bytes(self) -> int:
        return sum(end - start for start, end, _ in self.damage)


def survey(file: Bytes) -> Survey:
    """Walk over every record, past whatever is damaged."""
    return _Walk(file).run()


def saved(file: Bytes, found: Survey) -> Iterator[SavedMessage | Attachment | Metadata]:
    """What can be kept, in the order of the file."""
    budget = Budget(file.size)
    for offset in found.offsets:
        record = mcap_scan.record_at(file, offset)
        if record.opcode == Opcode.ATTACHMENT:
            yield mcap_scan.parse_attachment(record)
        elif record.opcode == Opcode.METADATA:
            yield mcap_scan.parse(record, Metadata)
        elif record.opcode == Opcode.MESSAGE:
            yield _message(record.body, compressed=False)
        else:
            chunk = mcap_scan.parse_chunk(record, budget)
            for opcode, _, body in mcap_scan.chunk_records(chunk.raw, budget):
                if opcode == Opcode.MESSAGE:
                    yield _message(body, compressed=chunk.compression != "")


class _Walk:
    def __init__(self, file: Bytes) -> None:
        self.file = file
        self.found = Survey()
        self.budget = Budget(file.size)
        self.chunks = 0
        self.messages = 0
        self.after_bad_chunk = False
        self.found_again = False
        self.lost_track = False
        self.proved = True
        self.statistics: Statistics | None = None
        self.doubtful: dict[type, dict[int, Schema] | dict[int, Channel]] = {Schema: {}, Channel: {}}

    def run(self) -> Survey:
        start = self.file.read(0, len(MAGIC))
        offset = len(MAGIC)
        if start != MAGIC:
            offset = self._without_mark()
        while offset < self.file.size and not self.found.whole_ending:
            offset = self._step(offset)
        damage = self.found.damage
        if not self.found.whole_ending and not (damage and damage[-1][1] == self.file.size):
            damage.append((self.file.size, self.file.size, "the file ends without its index"))
        self._definitions()
        self.found.loose_messages = self.messages
        return self.found

    def _without_mark(self) -> int:
        """Where to begin when the first bytes are damaged: at the header, if that is still there."""
        what = "the file does not begin with MCAP's mark"
        try:
            if mcap_scan.parse(mcap_scan.record_at(self.file, len(MAGIC)), Header):
                self.found.damage.append((0, len(MAGIC), what))
                return len(MAGIC)
        except ValueError:
            pass
        return self._skip(0, what, from_byte=1)

    def _step(self, offset: int) -> int:
        try:
            record = mcap_scan.record_at(self.file, offset)
        except ValueError as wrong:
            return self._skip(offset, str(wrong))
        try:
            self._take(record)
        except ValueError as wrong:
            self.after_bad_chunk = record.opcode == Opcode.CHUNK
            return self._behind(record, str(wrong))
        self.found_again = False
        if record.opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            self.proved = True
        return record.end

    def _behind(self, record: Record, what: str) -> int:
        """Past a bad record: its end where another one begins there, else wherever one is found."""
        self.lost_track = True
        try:
            mcap_scan.record_at(self.file, record.end)
        except ValueError:
            return self._skip(record.offset, what)
        self._damaged(record.offset, record.end, what)
        return record.end

    def _damaged(self, start: int, end: int, what: str) -> None:
        """Definitions alone do not end a damaged place: they are found inside a chunk that was cut off, too."""
        if self.found.damage and not self.proved:
            start, _, what = self.found.damage.pop()
        self.found.damage.append((start, end, what))
        self.proved = False

    def _skip(self, offset: int, what: str, from_byte: int | None = None) -> int:
        begin = offset + 1 if from_byte is None else from_byte
        end = mcap_scan.find_again(self.file, begin, loose_messages=self.chunks == 0 and self.messages > 0)
        self._damaged(offset, end, what)
        self.found_again = self.lost_track = True
        return end

    def _take(self, record: Record) -> None:
        opcode, found = record.opcode, self.found
        if opcode == Opcode.CHUNK:
            self._chunk(record)
        elif opcode == Opcode.HEADER:
            header = mcap_scan.parse(record, Header)
            found.profile, found.library = header.profile, header.library
        elif opcode == Opcode.SCHEMA:
            self._define(mcap_scan.parse(record, Schema))
        elif opcode == Opcode.CHANNEL:
            self._define(mcap_scan.parse(record, Channel))
        elif opcode == Opcode.ATTACHMENT:
            mcap_scan.parse_attachment(record)
            if found.profile == "tosslab" and record.body[-4:] == bytes(4):
                raise ValueError("an attachment without its CRC, which tosslab always writes")
        elif opcode == Opcode.METADATA:
            mcap_scan.parse(record, Metadata)
        elif opcode == Opcode.MESSAGE:
            self._loose_message(record)
        elif opcode == Opcode.MESSAGE_INDEX and self.after_bad_chunk:
            index = mcap_scan.parse(record, MessageIndex)
            found.lost[index.channel_id] = found.lost.get(index.channel_id, 0) + len(index.records)
        elif opcode == Opcode.STATISTICS:
            self.statistics = mcap_scan.parse(record, Statistics)
            found.stated = dict(self.statistics.channel_message_counts)
        elif opcode == Opcode.FOOTER:
            found.whole_ending = self.file.read(record.end, 16) == MAGIC
        if opcode in _KEPT:
            found.offsets.append(record.offset)

    def _loose_message(self, record: Record) -> None:
        """A message outside of chunks has no CRC: amid damage it is believed only in a file that has no chunks."""
        if len(record.body) < MESSAGE.size:
            raise ValueError(f"a message of {len(record.body)} bytes at byte {record.offset}")
        if self.lost_track and (self.chunks or not self.messages):
            raise ValueError(f"what looks like a message at byte {record.offset}, outside of the chunks")
        self.messages += 1

    def _chunk(self, record: Record) -> None:
        chunk = mcap_scan.parse_chunk(record, self.budget)
        if chunk.crc == 0 and self.found.profile == "tosslab":
            raise ValueError("a chunk without its CRC, which tosslab always writes")
        definitions: list[Schema | Channel] = []
        for opcode, _, body in mcap_scan.chunk_records(chunk.raw, self.budget):
            if opcode == Opcode.SCHEMA:
                definitions.append(mcap_scan.parse(body, Schema))
            elif opcode == Opcode.CHANNEL:
                definitions.append(mcap_scan.parse(body, Channel))
        for definition in definitions:
            known = (self.found.schemas if isinstance(definition, Schema) else self.found.channels).get(definition.id)
            if known is not None and known != definition:
                kind = type(definition).__name__.lower()
                raise ValueError(
                    f"a chunk that defines {kind} {definition.id} otherwise than before: of another recording"
                )
        for definition in definitions:
            self._define(definition)
        self.chunks += 1
        self.after_bad_chunk = False

    def _define(self, record: Schema | Channel) -> None:
        """The first definition counts; one that was found again amid damage only where there is no other."""
        if self.found_again:
            self.doubtful[type(record)].setdefault(record.id, record)  # type: ignore[arg-type]
        elif isinstance(record, Schema):
            self.found.schemas.setdefault(record.id, record)
        else:
            self.found.channels.setdefault(record.id, record)

    def _definitions(self) -> None:
        self.found.schemas = {**self.doubtful[Schema], **self.found.schemas}  # type: ignore[dict-item]
        self.found.channels = {**self.doubtful[Channel], **self.found.channels}  # type: ignore[dict-item]


def _message(body: bytes, compressed: bool) -> SavedMessage:
    channel, sequence, log_ns, publish_ns = MESSAGE.unpack_from(body)
    return SavedMessage(channel, sequence, log_ns, publish_ns, body[MESSAGE.size :], compressed)
