"""`export mcap`: every toss as an MCAP file that holds depth as foxglove.RawImage 16UC1 in zstd chunks.

Everything else is copied byte for byte: topics, times, sequence numbers, metadata, attachments. The copies open in any
viewer, and in tosslab too.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from pathlib import Path

from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from recordings.exporters.common import ExportReport, new_files, open_recording
from recordings.mcap import codec
from recordings.mcap.file import McapFile, Message
from recordings.mcap.writer import McapWriter
from recordings.progress import Progress

DEPTH_SCHEMA = "tosslab.DepthImage"


def export_mcap(source: Path, out: Path, variant: str | None, scope: str | None, progress: Progress) -> ExportReport:
    """Write OUT/toss_XX.mcap (and calibration.mcap where there is one)."""
    session = open_recording(source, variant, scope)
    files = [session.file(n) for n in session.tosses]
    views = session.path / "calibration.mcap"
    files += [views] if views.exists() else []
    session.close()
    with new_files(out) as made:
        for done, file in enumerate(files):
            progress.step(done, len(files), file.name)
            copy_standard(file, made / file.name)
    progress.step(len(files), len(files))
    return ExportReport("mcap", out, len(files))


def copy_standard(source: Path, target: Path) -> None:
    """Copy one file, its depth in the standard schema."""
    with McapFile(source) as file, McapWriter(target) as writer:
        for name in dict.fromkeys(m.name for m in file.summary.metadata_indexes):
            for values in file.metadata(name):
                writer.metadata(name, values)
        for attachment in file.summary.attachment_indexes:
            writer.attachment(attachment.name, attachment.media_type, file.attachment(attachment.name) or b"")
        _copy_messages(file, writer)
        writer.finish()


def _copy_messages(file: McapFile, writer: McapWriter) -> None:
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    for message in _in_order(file):
        found = file.schema(message.topic)
        own = found is not None and found.name == DEPTH_SCHEMA
        if message.topic not in channels:
            name = RawImage.DESCRIPTOR.full_name if own or found is None else found.name
            if name not in schemas:
                data = codec.schema_descriptor(RawImage) if own or found is None else found.data
                schemas[name] = writer.schema(name, "protobuf", data)
            channel = file.channels[message.topic]
            channels[message.topic] = writer.channel(
                message.topic, channel.message_encoding, schemas[name], channel.metadata
            )
        payload = _standard_depth(message) if own else message.data
        raw = own or (found is not None and found.name == RawImage.DESCRIPTOR.full_name)
        writer.message(
            channels[message.topic],
            message.log_time_ns,
            message.publish_time_ns,
            message.sequence,
            payload,
            compress=raw,
        )


def _in_order(file: McapFile) -> Iterator[Message]:
    streams = [file.messages(topic) for topic in file.channels if len(file.topic_index(topic))]
    return heapq.merge(*streams, key=lambda m: m.log_time_ns)


def _standard_depth(message: Message) -> bytes:
    camera = message.topic.split("/")[1]
    image = codec.read_depth(message, camera, DEPTH_SCHEMA, 0.001)
    height, width = image.raw.shape
    raw = RawImage(
        frame_id=f"{camera}_depth",
        width=width,
        height=height,
        encoding="16UC1",
        step=2 * width,
        data=image.raw.astype("<u2").tobytes(),
    )
    raw.timestamp.seconds, raw.timestamp.nanos = divmod(image.time_ns, 1_000_000_000)
    return raw.SerializeToString()
