"""The writer: files that others read, chunks small enough to lose, errors that stay."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from recordings.errors import BadInput, WriteFailed
from recordings.mcap.file import McapFile
from recordings.mcap.recover import recover_file
from recordings.mcap.structure import check_structure
from recordings.mcap.writer import CHUNK_BYTES, CHUNK_NS, McapWriter


def filled(path: Path, count: int = 10, size: int = 100, step_ns: int = 1_000_000) -> str:
    with McapWriter(path) as writer:
        channel = writer.channel("/a", "x", writer.schema("s", "y", b"definition"), {"k": "v"})
        writer.metadata("about", {"a": "b"})
        writer.attachment("note.txt", "text/plain", b"hello", 5)
        for i in range(count):
            writer.message(channel, i * step_ns, i * step_ns + 1, i, bytes([i % 256]) * size)
        return writer.finish()


def test_mcaps_own_reader_reads_it_with_all_checks(tmp_path):
    filled(tmp_path / "a.mcap", 2000, 3000)
    with open(tmp_path / "a.mcap", "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        read = [(m.sequence, m.log_time, m.publish_time, m.data[0]) for _, _, m in reader.iter_messages()]
        assert read == [(i, i * 10**6, i * 10**6 + 1, i % 256) for i in range(2000)]
        statistics = reader.get_summary().statistics
        assert (statistics.message_count, statistics.attachment_count, statistics.metadata_count) == (2000, 1, 1)
        assert [a.data for a in reader.iter_attachments()] == [b"hello"]
    with open(tmp_path / "a.mcap", "rb") as file:
        assert sum(1 for _ in StreamReader(file, validate_crcs=True).records) > 2000


def test_finish_gives_the_files_sha256(tmp_path):
    sha256 = filled(tmp_path / "a.mcap")
    assert sha256 == hashlib.sha256((tmp_path / "a.mcap").read_bytes()).hexdigest()


def test_no_chunk_is_longer_than_a_mebibyte_or_250_ms(tmp_path):
    filled(tmp_path / "big.mcap", 300, 20_000, step_ns=1000)
    filled(tmp_path / "slow.mcap", 300, 100, step_ns=10_000_000)
    with McapFile(tmp_path / "big.mcap") as big, McapFile(tmp_path / "slow.mcap") as slow:
        assert len(big.summary.chunk_indexes) >= 5
        assert max(c.uncompressed_size for c in big.summary.chunk_indexes) < CHUNK_BYTES + 21_000
        assert len(slow.summary.chunk_indexes) >= 11
        spans = [c.message_end_time - c.message_start_time for c in slow.summary.chunk_indexes]
        assert max(spans) <= CHUNK_NS


def test_a_quiet_channel_reaches_the_disk_after_250_ms_without_another_message(tmp_path):
    with McapWriter(tmp_path / "a.mcap") as writer:
        writer.message(writer.channel("/a", "x", 0), 1, 1, 1, b"only one")
        before = writer.bytes_written
        deadline = time.monotonic() + 5
        while writer.bytes_written == before and time.monotonic() < deadline:
            time.sleep(0.02)
        assert b"only one" in (tmp_path / "a.mcap").read_bytes()


def test_every_chunk_can_be_read_when_all_others_are_lost(tmp_path):
    filled(tmp_path / "a.mcap", 200, 20_000)
    with McapFile(tmp_path / "a.mcap") as file:
        chunks = file.summary.chunk_indexes
    data = (tmp_path / "a.mcap").read_bytes()
    last = chunks[-1].chunk_start_offset
    (tmp_path / "b.mcap").write_bytes(data[:60] + bytes(last - 60) + data[last : last + chunks[-1].chunk_length])
    report = recover_file(tmp_path / "b.mcap", tmp_path / "c.mcap")
    assert report.kept["/a"] > 0
    with McapFile(tmp_path / "c.mcap") as saved:
        assert saved.schema("/a").data == b"definition"
        assert [m.sequence for m in saved.messages("/a")][-1] == 199


def test_raw_images_are_compressed_and_compressed_ones_are_not(tmp_path):
    for name, compress in (("plain.mcap", False), ("zstd.mcap", True)):
        with McapWriter(tmp_path / name) as writer:
            writer.message(writer.channel("/a", "x", 0), 1, 1, 1, bytes(100_000), compress=compress)
            writer.finish()
    assert (tmp_path / "plain.mcap").stat().st_size > 100_000
    assert (tmp_path / "zstd.mcap").stat().st_size < 2_000


def test_an_existing_file_is_refused_and_untouched(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"precious")
    with pytest.raises(BadInput, match="exists already; nothing was written"):
        McapWriter(tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == b"precious"


def test_a_folder_without_permission_is_named(tmp_path, monkeypatch):
    (tmp_path / "locked").mkdir(mode=0o500)
    if os.geteuid() == 0:  # root may write everywhere: let the system refuse as it does to others

        def refuse(*_: object, **__: object) -> int:
            raise PermissionError(13, "Permission denied")

        monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(WriteFailed, match=r"locked/a\.mcap cannot be created: Permission denied"):
        McapWriter(tmp_path / "locked" / "a.mcap")


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(WriteFailed, match=r"a\.mcap cannot be created: No such file"):
        McapWriter(tmp_path / "none" / "a.mcap")


@pytest.mark.parametrize("log_ns, publish_ns", [(-1, 0), (0, -1), (1 << 63, 0), (0, 1 << 64)])
def test_a_time_that_no_file_can_hold_is_refused(tmp_path, log_ns, publish_ns):
    with McapWriter(tmp_path / "a.mcap") as writer:
        channel = writer.channel("/a", "x", 0)
        with pytest.raises(BadInput, match="/a: times"):
            writer.message(channel, log_ns, publish_ns, 0, b"")
        writer.message(channel, 1, 1, 0, b"good")
        writer.finish()


def test_frame_numbers_wrap_at_32_bits(tmp_path):
    with McapWriter(tmp_path / "a.mcap") as writer:
        writer.message(writer.channel("/a", "x", 0), 1, 1, (1 << 32) + 5, b"")
        writer.finish()
    with McapFile(tmp_path / "a.mcap") as file:
        assert file.read("/a", 0).sequence == 5


def write_on(writer: McapWriter, channel: int) -> None:
    for i in range(100):
        writer.message(channel, i, i, i, bytes(100_000))


def test_a_full_disk_is_said_at_once_again_and_at_the_end(tmp_path, full_disk):
    path = tmp_path / "a.mcap"
    writer = McapWriter(path)
    channel = writer.channel("/a", "x", 0)
    full_disk(3_000_000)
    with pytest.raises(WriteFailed, match="the disk refused a write .*File too large"):
        write_on(writer, channel)
    for attempt in (lambda: writer.message(channel, 1, 1, 1, b""), writer.finish, lambda: writer.metadata("a", {})):
        with pytest.raises(WriteFailed, match="the disk refused a write"):
            attempt()
    writer.abandon()
    with pytest.raises(WriteFailed, match="the disk refused a write"):
        writer.finish()
    full_disk(1 << 40)
    kept = recover_file(path, tmp_path / "b.mcap").kept["/a"]
    assert kept == writer.kept["/a"]
    assert writer.counts["/a"] > kept > 15


def test_dev_full_is_reported(tmp_path, monkeypatch):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    real_open = os.open
    monkeypatch.setattr(os, "open", lambda *_, **__: real_open("/dev/full", os.O_WRONLY))
    with pytest.raises(WriteFailed, match="No space left on device"):
        McapWriter(tmp_path / "a.mcap").finish()


def test_a_failed_fsync_is_not_swallowed_by_finish(tmp_path, monkeypatch):
    writer = McapWriter(tmp_path / "a.mcap")
    writer.message(writer.channel("/a", "x", 0), 1, 1, 1, b"")

    def broken(_: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", broken)
    with pytest.raises(WriteFailed, match="Input/output error"):
        writer.finish()
    with pytest.raises(WriteFailed, match="Input/output error"):
        writer.finish()


def test_a_finished_or_abandoned_writer_takes_nothing_more(tmp_path):
    for name, end in (("a.mcap", McapWriter.finish), ("b.mcap", McapWriter.abandon)):
        writer = McapWriter(tmp_path / name)
        channel = writer.channel("/a", "x", 0)
        writer.message(channel, 1, 1, 1, b"")
        end(writer)
        size = (tmp_path / name).stat().st_size
        for attempt in (lambda w=writer, c=channel: w.message(c, 1, 1, 1, b""), writer.finish):
            with pytest.raises(WriteFailed, match="is closed already"):
                attempt()
        writer.abandon()
        assert (tmp_path / name).stat().st_size == size


def test_leaving_without_finish_leaves_what_recover_reads(tmp_path):
    with McapWriter(tmp_path / "a.mcap") as writer:
        writer.message(writer.channel("/a", "x", 0), 1, 1, 1, b"kept")
    assert check_structure(tmp_path / "a.mcap").damaged
    assert recover_file(tmp_path / "a.mcap", tmp_path / "b.mcap").kept == {"/a": 1}


WRITE_FOR_EVER = """
import sys, time
sys.path.insert(0, sys.argv[2])
from pathlib import Path
from recordings.mcap.writer import McapWriter
writer = McapWriter(Path(sys.argv[1]))
channel = writer.channel("/a", "x", 0)
print("go", flush=True)
for i in range(10**9):
    writer.message(channel, i * 5_000_000, i, i, i.to_bytes(4, "little") * 10_000)
    print(i, flush=True)
    time.sleep(0.001)
"""


@pytest.mark.parametrize("delay_s", [0.0, 0.07, 0.31])
def test_kill_9_costs_at_most_one_open_chunk(tmp_path, delay_s):
    path = tmp_path / "a.mcap"
    root = str(Path(__file__).resolve().parents[2])
    program = [sys.executable, "-c", textwrap.dedent(WRITE_FOR_EVER), str(path), root]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout.readline() == "go\n"
        time.sleep(delay_s)
        child.send_signal(signal.SIGKILL)
        accepted = len(child.stdout.read().splitlines())
    report = recover_file(path, tmp_path / "b.mcap")
    with McapFile(tmp_path / "b.mcap") as saved:
        got = [int.from_bytes(m.data[:4], "little") for m in saved.messages("/a")]
    assert got == list(range(len(got)))
    assert accepted - len(got) <= CHUNK_BYTES // 40_000 + 2
    assert report.kept.get("/a", 0) == len(got)
