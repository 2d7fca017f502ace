"""The reader: any message by its place, only the bytes it needs, every fault a plain message."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as PlainWriter

from recordings.errors import BadInput, DamagedFile
from recordings.mcap.file import McapFile
from recordings.mcap.writer import McapWriter

COUNT, SIZE = 400, 50_000


@pytest.fixture(scope="module")
def large(tmp_path_factory) -> Path:
    """20 MB: a camera of 400 messages and a clock of 4000."""
    path = tmp_path_factory.mktemp("large") / "large.mcap"
    with McapWriter(path) as writer:
        camera, clock = writer.channel("/camera", "x", 0), writer.channel("/clock", "x", 0)
        for i in range(COUNT):
            writer.message(camera, i * 10**7, i * 10**7 - (i > 0) * 500, i, i.to_bytes(2, "little") * (SIZE // 2))
            for k in range(10):
                writer.message(clock, i * 10**7 + k * 10**6, i * 10**7 + k * 10**6, i * 10 + k, b"tick")
        writer.finish()
    return path


@pytest.fixture
def bytes_read(monkeypatch) -> list[int]:
    """Counts every byte that is read from here on."""
    read: list[int] = []
    real = os.pread

    def counted(file: int, length: int, offset: int) -> bytes:
        data = real(file, length, offset)
        read.append(len(data))
        return data

    monkeypatch.setattr(os, "pread", counted)
    return read


def test_opening_reads_only_the_index(large, bytes_read):
    with McapFile(large) as file:
        assert set(file.channels) == {"/camera", "/clock"}
    assert sum(bytes_read) < 40_000 < large.stat().st_size / 400


def test_one_message_costs_one_chunk(large, bytes_read):
    with McapFile(large) as file:
        file.topic_index("/camera")
        before = sum(bytes_read)
        message = file.read("/camera", 217)
        assert (message.sequence, message.data[:2]) == (217, (217).to_bytes(2, "little"))
        assert sum(bytes_read) - before < 1.3 * 2**20


def test_the_times_of_a_stream_cost_its_heads_only(large, bytes_read):
    with McapFile(large) as file:
        times_ns = file.publish_times_ns("/camera")
        np.testing.assert_array_equal(times_ns[1:], np.arange(1, COUNT) * 10**7 - 500)
        np.testing.assert_array_equal(file.topic_index("/camera").log_time_ns, np.arange(COUNT) * 10**7)
    assert sum(bytes_read) < 200_000


def test_a_time_is_found_without_reading_messages(large, bytes_read):
    with McapFile(large) as file:
        position = int(np.searchsorted(file.topic_index("/camera").log_time_ns, 1_500_000_000))
        assert file.read("/camera", position).log_time_ns == 1_500_000_000
    assert sum(bytes_read) < 1.5 * 2**20


def test_reading_in_order_reads_each_chunk_once(large, bytes_read):
    with McapFile(large) as file:
        assert [m.sequence for m in file.messages("/camera")] == list(range(COUNT))
    assert sum(bytes_read) < 1.1 * large.stat().st_size


def test_several_threads_read_at_once(large):
    with McapFile(large) as file, ThreadPoolExecutor(4) as pool:

        def numbers(seed: int) -> bool:
            wanted = np.random.default_rng(seed).permutation(COUNT)[:100]
            return all(file.read("/camera", int(i)).sequence == i for i in wanted)

        assert all(pool.map(numbers, range(8)))


def test_messages_out_of_order_come_in_the_order_of_their_log_time(tmp_path):
    with McapWriter(tmp_path / "a.mcap") as writer:
        channel = writer.channel("/a", "x", 0)
        for time_ns in (5, 3, 9, 1):
            writer.message(channel, time_ns, time_ns, time_ns, b"")
        writer.finish()
    with McapFile(tmp_path / "a.mcap") as file:
        assert [m.sequence for m in file.messages("/a")] == [1, 3, 5, 9]
        assert file.topic_index("/none").log_time_ns.size == 0
        with pytest.raises(IndexError):
            file.read("/a", 4)


@pytest.mark.parametrize("compression", list(CompressionType))
def test_files_of_mcaps_own_writer_are_read(tmp_path, compression):
    with open(tmp_path / "a.mcap", "wb") as out:
        writer = PlainWriter(out, compression=compression, chunk_size=1000)
        writer.start()
        schema = writer.register_schema("s", "jsonschema", b"{}")
        channels = [writer.register_channel("/a", "json", schema) for _ in range(2)]
        for i in range(100):
            writer.add_message(channels[i % 2], i, b"x" * 100, i, i)
        writer.add_metadata("about", {"k": "v"})
        writer.finish()
    with McapFile(tmp_path / "a.mcap") as file:
        assert [m.sequence for m in file.messages("/a")] == list(range(100))
        assert file.metadata("about") == [{"k": "v"}]


@pytest.mark.parametrize(
    "content, kind, message",
    [
        (b"", BadInput, "is empty"),
        (b"PK\x03\x04 and so on" * 9, BadInput, "is not an MCAP file: it begins with b'PK"),
        (b"\x89MCAP0\r\n", DamagedFile, "was cut off.*toss-session recover"),
        (b"\x89MCAP0\r\n" + b"\x00" * 99, DamagedFile, "was cut off.*toss-session recover"),
        (b"\x89MCAP0\r\n" * 9, DamagedFile, "its index is damaged"),
    ],
)
def test_what_is_no_whole_mcap_file_is_named(tmp_path, content, kind, message):
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(kind, match=message):
        McapFile(tmp_path / "a.mcap")


def test_folders_missing_and_locked_files_are_named(tmp_path):
    with pytest.raises(BadInput, match="is a folder; wanted an .mcap file"):
        McapFile(tmp_path)
    with pytest.raises(BadInput, match="cannot be opened: No such file"):
        McapFile(tmp_path / "none.mcap")
    if os.geteuid() != 0:
        (tmp_path / "locked.mcap").touch(mode=0o000)
        with pytest.raises(BadInput, match="cannot be opened: Permission denied"):
            McapFile(tmp_path / "locked.mcap")


def test_a_flipped_bit_is_found_when_its_chunk_is_read(large, tmp_path):
    data = bytearray(large.read_bytes())
    data[9_000_000] ^= 4
    (tmp_path / "b.mcap").write_bytes(data)
    with McapFile(tmp_path / "b.mcap") as file, pytest.raises(DamagedFile, match=r"chunk \d+ is damaged .*CRC differs"):
        list(file.messages("/camera"))
    with McapFile(tmp_path / "b.mcap") as file:
        assert file.read("/camera", 0).sequence == 0


def test_a_flipped_bit_in_an_attachment_is_found(tmp_path):
    with McapWriter(tmp_path / "a.mcap") as writer:
        writer.attachment("calibration.json", "application/json", b'{"focal": 400}')
        writer.finish()
    data = (tmp_path / "a.mcap").read_bytes().replace(b"400", b"401")
    (tmp_path / "a.mcap").write_bytes(data)
    with (
        McapFile(tmp_path / "a.mcap") as file,
        pytest.raises(DamagedFile, match="attachment calibration.json is damaged"),
    ):
        file.attachment("calibration.json")
