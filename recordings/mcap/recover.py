"""A new, whole, indexed file from a damaged one: everything that lies in complete chunks, and a report of the rest."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from mcap.records import Attachment, Metadata

from recordings.bounded.documents import FORMAT_VERSION, as_dict, json_object
from recordings.errors import BadInput, DamagedFile, TosslabError, WriteFailed
from recordings.mcap.salvage import SavedMessage, Survey, saved, survey
from recordings.mcap.scan import Bytes
from recordings.mcap.writer import LATEST_NS, MAGIC, McapWriter
from recordings.tracks import RigCalibration

STOP = "tosslab.stop"
REPORT = "tosslab.recovered"
CALIBRATION = "calibration.json"


@dataclass(frozen=True)
class Recovered:
    """What recover kept and lost.

    `lost`: messages by topic that are known to be gone (from statistics or from the index of a bad chunk);
    `missing_numbers`: steps in the frame numbers of what was kept, which hold also what was dropped while recording;
    `damage`: places and reasons. `sha256` is the new file's.
    """

    source: str
    out: str
    kept: Mapping[str, int]
    lost: Mapping[str, int]
    missing_numbers: Mapping[str, int]
    skipped_bytes: int
    damage: tuple[str, ...]
    notes: tuple[str, ...] = ()
    sha256: str = field(default="", compare=False)

    def to_json(self) -> dict[str, object]:
        return asdict(self)

    @property
    def whole(self) -> bool:
        return not self.damage and not self.lost


def recover_file(source: Path, out: Path) -> Recovered:
    """Write `out` from what is whole in `source`, which stays as it is.

    Raises BadInput when `out` exists or `source` is no MCAP file, WriteFailed when the disk refuses.
    """
    if out.exists() or out.is_symlink():
        raise BadInput(f"{out} exists already; nothing was written. Choose another name or remove it")
    with Bytes(source) as file:
        if file.size == 0:
            raise BadInput(f"{source} is empty (0 bytes): there is nothing to recover")
        found = survey(file)
        if not found.offsets and not MAGIC.startswith(file.read(0, 8)):
            raise BadInput(f"{source} is not an MCAP file: it begins with {file.read(0, 8)!r} and holds no whole chunk")
        try:
            with McapWriter(out, found.profile, found.library or "tosslab recover") as writer:
                return _Rewriting(source, file, found, writer).run()
        except (WriteFailed, DamagedFile):
            out.unlink(missing_ok=True)
            raise


class _Rewriting:
    """Carries the definitions over and counts what comes along."""

    def __init__(self, source: Path, file: Bytes, found: Survey, writer: McapWriter) -> None:
        self.source, self.file, self.found, self.writer = source, file, found, writer
        self.schemas: dict[tuple[str, str, bytes], int] = {}
        self.channels: dict[int, int | None] = {}
        self.same: dict[tuple[object, ...], int] = {}
        self.kept_by_channel: dict[int, int] = {}
        self.numbers: dict[str, list[int]] = {}
        self.undefined: dict[int, int] = {}
        self.impossible = 0
        self.attached: set[str] = set()
        self.mended: list[str] = []
        self.metadata: dict[str, dict[str, str]] = {}

    def run(self) -> Recovered:
        for item in saved(self.file, self.found):
            if isinstance(item, Attachment):
                self.attached.add(item.name)
                self.writer.attachment(item.name, item.media_type, item.data, item.log_time)
            elif isinstance(item, Metadata):
                self._metadata(item)
            else:
                self._message(item)
        self._own_metadata()
        self._calibration_from_session()
        report = self._report()
        self._say(report)
        sha256 = self.writer.finish()
        return replace(report, sha256=sha256)

    def _metadata(self, item: Metadata) -> None:
        self.metadata.setdefault(item.name, dict(item.metadata))
        self.writer.metadata("tosslab.stop_before" if item.name == STOP else item.name, item.metadata)

    def _own_metadata(self) -> None:
        """tosslab's own record, where just that one was lost."""
        ours = self.found.profile == "tosslab" or any(
            s.name.startswith("tosslab.") for s in self.found.schemas.values()
        )
        if "tosslab" in self.metadata or not ours:
            return
        stem = self.source.stem
        number = stem[5:] if stem.startswith("toss_") else ""
        info = {"toss": int(number)} if number.isdigit() else {}
        kind = "calibration" if stem == "calibration" else "toss"
        self.writer.metadata("tosslab", {"format_version": str(FORMAT_VERSION), "kind": kind, "info": json.dumps(info)})

    def _calibration_from_session(self) -> None:
        """The session's own calibration.json, where the file's copy was lost and that one is whole."""
        sibling = self.source.parent / CALIBRATION
        if CALIBRATION in self.attached or "tosslab" not in self.metadata or not sibling.is_file():
            return
        try:
            RigCalibration.read(sibling)
            data = sibling.read_bytes()
        except (TosslabError, OSError):
            return
        self.writer.attachment(CALIBRATION, "application/json", data)
        self.mended.append(f"its {CALIBRATION} was lost; the session's, which lies beside it, was taken")

    def _message(self, item: SavedMessage) -> None:
        if item.channel not in self.channels:
            self.channels[item.channel] = self._channel(item.channel)
        channel = self.channels[item.channel]
        if channel is None:
            self.undefined[item.channel] = self.undefined.get(item.channel, 0) + 1
            return
        if item.log_time_ns >= LATEST_NS or item.publish_time_ns >= LATEST_NS:
            self.impossible += 1
            return
        self.writer.message(
            channel, item.log_time_ns, item.publish_time_ns, item.sequence, item.data, compress=item.compressed
        )
        self.kept_by_channel[item.channel] = self.kept_by_channel.get(item.channel, 0) + 1
        self.numbers.setdefault(self.found.channels[item.channel].topic, []).append(item.sequence)

    def _channel(self, number: int) -> int | None:
        """The channel's number in the new file; None where its definition, or its schema's, was lost."""
        channel = self.found.channels.get(number)
        if channel is None or (channel.schema_id and channel.schema_id not in self.found.schemas):
            return None
        schema = 0
        if channel.schema_id:
            known = self.found.schemas[channel.schema_id]
            same = (known.name, known.encoding, bytes(known.data))
            if same not in self.schemas:
                self.schemas[same] = self.writer.schema(*same)
            schema = self.schemas[same]
        key = (channel.topic, channel.message_encoding, schema, tuple(sorted(channel.metadata.items())))
        if key not in self.same:
            self.same[key] = self.writer.channel(channel.topic, channel.message_encoding, schema, channel.metadata)
        return self.same[key]

    def _report(self) -> Recovered:
        damage = tuple(f"bytes {a} to {b}: {what}" for a, b, what in self.found.damage)
        notes = list(self.mended)
        notes += [f"{n} messages of channel {c}, whose definition is lost" for c, n in self.undefined.items()]
        notes += [f"{self.impossible} messages with impossible times"] if self.impossible else []
        if self.found.damage and not self.found.stated:
            notes.append(
                "the file's own counts are gone: what its last, open chunk held (at most 1 MiB or 250 ms) is unknown"
            )
        if self.found.loose_messages:
            notes.append(
                f"{self.found.loose_messages} messages lay outside of chunks, without a CRC that would tell alterations"
            )
        return Recovered(
            str(self.source.name),
            str(self.writer.path.name),
            self.writer.counts,
            self._lost(),
            {t: n for t, s in self.numbers.items() if (n := missing_numbers(s))},
            self.found.skipped_bytes,
            damage,
            tuple(notes),
        )

    def _lost(self) -> dict[str, int]:
        lost: dict[str, int] = {}
        for number in {*self.found.stated, *self.found.lost, *self.undefined}:
            known = self.found.channels.get(number)
            topic = known.topic if known else f"channel {number}"
            by_statistics = self.found.stated.get(number, 0) - self.kept_by_channel.get(number, 0)
            count = (
                by_statistics if self.found.stated else self.found.lost.get(number, 0) + self.undefined.get(number, 0)
            )
            if count > 0:
                lost[topic] = lost.get(topic, 0) + count
        return lost

    def _say(self, report: Recovered) -> None:
        """The recovered flag, and a stop record that agrees with what the new file holds."""
        before = _streams(self.metadata.get(STOP, {}))
        streams = {}
        for topic in sorted({*report.kept, *report.lost}):
            kept, dropped = report.kept.get(topic, 0), report.lost.get(topic, 0) + before.get(topic, 0)
            streams[topic] = {"received": kept + dropped, "written": kept, "dropped": dropped}
        if "tosslab" in self.metadata or self.found.profile == "tosslab":
            self.writer.metadata(STOP, {"status": "recovered", "streams": json.dumps(streams)})
        self.writer.metadata(REPORT, {"from": report.source, "report": json.dumps(report.to_json())})


def _streams(stop: Mapping[str, str]) -> dict[str, int]:
    """What was dropped by topic before the damage, as far as the stop record can be read."""
    counts = {topic: as_dict(c).get("dropped") for topic, c in json_object(stop.get("streams", "{}")).items()}
    return {topic: n for topic, n in counts.items() if isinstance(n, int)}


def missing_numbers(sequence: list[int]) -> int:
    """How many numbers are left out between consecutive ones; a step back or of over 10,000 is no count."""
    steps = [(b - a) % (1 << 32) for a, b in zip(sequence, sequence[1:], strict=False)]
    return sum(step - 1 for step in steps if 1 < step <= 10_000)
