"""Random damage through reader, verify and recover: one family of errors, no hang, nothing altered passes for whole."""

from __future__ import annotations

import gc
import time
from pathlib import Path

import numpy as np
import pytest

from recordings.errors import TosslabError
from recordings.mcap.codec import decode_image
from recordings.mcap.file import McapFile
from recordings.mcap.recover import recover_file
from recordings.mcap.structure import check_structure
from recordings.session import Session
from recordings.verify.verify import verify

LONGEST_S = 1.0
Content = frozenset[tuple[object, ...]]


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """One random accident: flipped bits, bytes of chance, zeros, a cut, a hole, an insertion, a repeated part."""
    at = int(rng.integers(len(data)))
    length = int(min(len(data) - at, 2 ** rng.integers(0, 13)))
    chance = rng.bytes(length)
    kind = int(rng.integers(8))
    if kind <= 1:
        return data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :]
    if kind == 2:
        return data[:at] + bytes([int(rng.integers(256))]) + data[at + 1 :]
    spoilt = {
        3: data[:at],
        4: data[:at] + chance + data[at + length :],
        5: data[:at] + bytes(length) + data[at + length :],
        6: data[:at] + data[at + length :],
        7: data[: at + length] + data[at:],
    }
    return spoilt[kind]


def messages(path: Path) -> Content:
    with McapFile(path) as file:
        return frozenset(
            (m.topic, m.sequence, m.log_time_ns, m.publish_time_ns, m.data)
            for topic in file.channels
            for m in file.messages(topic)
        )


def attached(path: Path) -> Content:
    with McapFile(path) as file:
        return frozenset((name, file.attachment(name)) for name in file.attachments())


def read_everything(path: Path) -> None:
    session = Session.open(path)
    try:
        toss = session.toss(session.tosses[0])
        for frame in toss.rgbd():
            assert frame.depth_m.shape == frame.color_rgb.shape[:2]
        for image in toss.mono("mono0"):
            decode_image(image)
        _ = toss.arm_states(), toss.events(), toss.command(), toss.health(), toss.poses(), toss.masks(), toss.streams()
        _ = toss.window(), session.name, session.object_name
    finally:
        session.close()


def one_round(data: bytes, folder: Path, whole: Content, whole_attached: Content) -> dict[str, int]:
    """Everything that may be done with a damaged file; which of the three said it is good."""
    path, out = folder / "toss_00.mcap", folder / "saved.mcap"
    path.write_bytes(data)
    out.unlink(missing_ok=True)
    outcome = dict.fromkeys(("read", "verified", "recovered"), 0)
    began = time.thread_time()
    try:
        read_everything(path)
        outcome["read"] = 1
    except TosslabError:
        pass
    spent = [time.thread_time() - began]
    began = time.thread_time()
    try:
        if verify(path).ok:
            outcome["verified"] = 1
            assert messages(path) == whole, "verify accepted an altered message"
            assert attached(path) == whole_attached, "verify accepted an altered attachment"
    except TosslabError:
        pass
    spent.append(time.thread_time() - began)
    began = time.thread_time()
    try:
        recover_file(path, out)
        outcome["recovered"] = 1
    except TosslabError:
        assert not out.exists()
    spent.append(time.thread_time() - began)
    if outcome["recovered"]:
        assert not check_structure(out).damaged, check_structure(out).findings
        assert messages(out) <= whole, "recover passed on an altered message"
    assert path.read_bytes() == data
    assert max(spent) < LONGEST_S, f"read, verify, recover took {spent} s"
    return outcome


def fuzz(small_file: Path, folder: Path, count: int, seed: int) -> dict[str, int]:
    data, whole, whole_attached = small_file.read_bytes(), messages(small_file), attached(small_file)
    total = dict.fromkeys(("read", "verified", "recovered"), 0)
    gc.collect()
    gc.freeze()  # what the tests before left is not searched for garbage while reading is timed
    for i in range(count):
        rng = np.random.default_rng([seed, i])
        spoilt = damaged(data, rng)
        for _ in range(int(rng.integers(3))):
            spoilt = damaged(spoilt, rng) if spoilt else spoilt
        try:
            outcome = one_round(spoilt, folder, whole, whole_attached)
        except Exception as wrong:
            raise AssertionError(f"mutation {i} of seed {seed}: {type(wrong).__name__}: {wrong}") from wrong
        total = {name: n + outcome[name] for name, n in total.items()}
    gc.unfreeze()
    return total


def test_150_random_accidents_give_plain_errors_and_nothing_altered_passes(small_file, tmp_path):
    total = fuzz(small_file, tmp_path, 150, seed=1)
    assert total["recovered"] > 120
    assert total["verified"] < 20


@pytest.mark.slow
def test_20000_random_accidents_give_plain_errors_and_nothing_altered_passes(small_file, tmp_path):
    total = fuzz(small_file, tmp_path, 10_000, seed=2)  # for each of the two kinds of file
    assert total["recovered"] > 8_000


def test_a_cut_at_any_byte_is_named_and_everything_before_it_is_saved(small_file, tmp_path):
    data, whole = small_file.read_bytes(), messages(small_file)
    rng = np.random.default_rng(5)
    saved = []
    for cut in sorted({*range(64), *rng.integers(0, len(data), 60).tolist(), *range(len(data) - 50, len(data))}):
        path, out = tmp_path / "cut.mcap", tmp_path / "saved.mcap"
        path.write_bytes(data[:cut])
        out.unlink(missing_ok=True)
        with pytest.raises(TosslabError, match=r"0 bytes|recover"):
            Session.open(path)
        if cut == 0:
            continue
        report = recover_file(path, out)
        assert messages(out) <= whole
        saved.append(sum(report.kept.values()))
    assert saved == sorted(saved)
    assert saved[-1] == len(whole)
