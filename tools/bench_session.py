"""The session's figures, each beside what was wanted and beside a plain mcap loop in the same run.

python tools/bench_session.py            # all, about five minutes
python tools/bench_session.py --quick    # shorter recordings, a smaller file, fewer kills
python tools/bench_session.py write      # one of: codec align write read info kill

CPU seconds are of the whole process with all its threads. The 20,000 mutations are tests/recordings/test_fuzz.py.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage  # noqa: E402
from mcap.reader import make_reader  # noqa: E402
from session_load import (  # noqa: E402
    ARM_HZ,
    FPS,
    MONO_SIZE,
    MONOS,
    Pixels,
    alone,
    arm_batch,
    calibration,
    paced,
    raw_mb_per_s,
    write_frame,
    write_ours,
    write_plain,
)

from recordings.alignment.align import align_depth  # noqa: E402
from recordings.geometry import CameraModel, Transform  # noqa: E402
from recordings.mcap.codec import decode_image  # noqa: E402
from recordings.mcap.depth_codec import pack_depth, unpack_depth  # noqa: E402
from recordings.mcap.recover_session import recover  # noqa: E402
from recordings.mcap.writer import CHUNK_BYTES, CHUNK_NS  # noqa: E402
from recordings.records import EncodedImage  # noqa: E402
from recordings.schemas.tosslab_pb2 import DepthImage as DepthMessage  # noqa: E402
from recordings.session import Session  # noqa: E402
from recordings.session_writer import SessionWriter  # noqa: E402

DATA = Path(os.environ.get("TOSSLAB_DATA", ROOT.parent / "shared" / "data"))


@dataclass(frozen=True)
class Row:
    figure: str
    got: str
    plain: str
    wanted: str


def best_ms(work: Callable[[], object], times: int = 15) -> float:
    spent = []
    for _ in range(times):
        began = time.thread_time()
        work()
        spent.append(time.thread_time() - began)
    return min(spent) * 1e3


def bench_codec(_: Path, quick: bool) -> Iterator[Row]:
    for name, pattern in (("cube_dev", "toss_0[0-4]"), ("lab_dev", "toss_0*"), ("jack_push", "")):
        folders = sorted((DATA / name).glob(pattern)) if pattern else [DATA / name]
        files = [f for folder in folders for f in sorted((folder / "depth").glob("*.png"))[5 :: 40 if quick else 15]]
        if not files:
            yield Row(f"depth codec on {name}", "no data (TOSSLAB_DATA)", "", "")
            continue
        ours, png, unpack, sizes = [], [], [], []
        for file in files:
            raw = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            packed = pack_depth(raw)
            assert (unpack_depth(packed, *raw.shape) == raw).all()
            sizes.append((len(packed), len(cv2.imencode(".png", raw)[1])))
            ours.append(best_ms(lambda raw=raw: pack_depth(raw)))
            png.append(best_ms(lambda raw=raw: cv2.imencode(".png", raw)))
            unpack.append(best_ms(lambda packed=packed, raw=raw: unpack_depth(packed, *raw.shape)))
        kb = np.mean(sizes, axis=0) / 1e3
        larger = max(a / b for a, b in sizes)
        yield Row(
            f"depth codec on {name}, {len(files)} frames",
            f"{np.mean(ours):.2f} ms, {kb[0]:.1f} kB (unpack {np.mean(unpack):.2f} ms); "
            f"{np.mean(png) / np.mean(ours):.1f} x faster, at most {larger:.2f} of PNG's size",
            f"PNG {np.mean(png):.2f} ms, {kb[1]:.1f} kB",
            "3 x faster than PNG, not larger",
        )


def bench_align(_: Path, quick: bool) -> Iterator[Row]:
    """Depth of the sensor's size seen from the colour camera."""
    depth_camera, color = (
        CameraModel(name, w, h, np.array([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1]]), "none", ())
        for name, w, h, f in (("depth", 848, 480, 425.0), ("color", 640, 480, 386.0))
    )
    color_from_depth = Transform("color", "depth", np.eye(3), np.array([0.059, 0.0, 0.0]))
    depth_m = np.full((480, 848), 0.8, np.float32)
    spent = best_ms(lambda: align_depth(depth_m, depth_camera, color, color_from_depth), 6 if quick else 15)
    yield Row("align 848x480 depth to 640x480 colour", f"{spent:.1f} ms", "", "60 ms")


def bench_write(folder: Path, quick: bool) -> Iterator[Row]:
    seconds = 3.0 if quick else 10.0
    for width, height in ((640, 480), (848, 480)):
        pixels = Pixels.of(width, height)
        plain_path = folder / "plain.mcap"
        plain = alone(write_plain, plain_path, pixels, seconds)
        plain_text = write_cost(plain, seconds, plain_path)
        plain_path.unlink()
        for lossless in (False, True):
            out = folder / f"ours_{lossless}"
            ours = alone(write_ours, out, pixels, seconds, lossless)
            yield Row(
                f"write {width}x{height} RGBD + 3 mono, mono {'lossless (zstd)' if lossless else 'JPEG 95'}, "
                f"{raw_mb_per_s(width, height):.0f} MB raw/s",
                write_cost(ours, seconds, out / "toss_00.mcap"),
                plain_text,
                "<= 0.5 CPU-s/s, < 400 MB",
            )
            shutil.rmtree(out)


def write_cost(spent: tuple[float, float, float], seconds: float, path: Path) -> str:
    cpu_s, wall_s, rss_mb = spent
    size_mb = path.stat().st_size / 1e6
    per_s = f"{cpu_s / seconds:.2f} CPU-s/s ({wall_s / seconds:.2f} s wall/s), {size_mb / seconds:.0f} MB/s"
    return f"{per_s}, {rss_mb:.0f} MB RSS"


def bench_read(folder: Path, quick: bool) -> Iterator[Row]:
    pixels = Pixels.of(640, 480)
    write_as_fast_as_possible(folder / "read", pixels, 60 if quick else 240)
    path = folder / "read" / "toss_00.mcap"
    works = {"ours": read_ours, "plain": read_plain, "checked": lambda p: read_plain(p, validate_crcs=True)}
    spent = {name: min(cpu_s(work, path) for _ in range(4)) for name, work in works.items()}
    images = 5 * (60 if quick else 240)
    against = (
        f"{spent['ours'] / spent['plain']:.2f} of plain, {spent['ours'] / spent['checked']:.2f} of plain with CRCs"
    )
    yield Row(
        f"read and decode {images} images in order, every CRC checked",
        f"{spent['ours']:.2f} CPU-s ({images / spent['ours']:.0f}/s, {against})",
        f"make_reader {spent['plain']:.2f} CPU-s, with validate_crcs {spent['checked']:.2f}",
        "at least as fast as the plain loop",
    )
    shutil.rmtree(folder / "read")


def cpu_s(work: Callable[[Path], object], path: Path) -> float:
    began = time.process_time()
    work(path)
    return time.process_time() - began


def write_as_fast_as_possible(folder: Path, pixels: Pixels, frames: int) -> None:
    with SessionWriter(folder, {}, calibration(640, 480)) as session:
        with session.toss(0) as toss:
            for i in range(frames):
                write_frame(toss, pixels, i, lossless=False)
        session.finish()


def read_ours(path: Path) -> None:
    with Session.open(path) as session:
        toss = session.toss(0)
        streams = [toss.color(), *(toss.mono(n) for n in MONOS)]
        depths = toss.depth()
        for i in range(len(depths)):
            _ = depths[i].raw
            for stream in streams:
                decode_image(stream[i])


def read_plain(path: Path, validate_crcs: bool = False) -> None:
    """The same pixels by mcap's reader and the generated protobuf classes."""
    with open(path, "rb") as file:
        for schema, _, message in make_reader(file, validate_crcs=validate_crcs).iter_messages():
            if schema.name == "foxglove.CompressedImage":
                image = cv2.imdecode(
                    np.frombuffer(CompressedImage.FromString(message.data).data, np.uint8), cv2.IMREAD_UNCHANGED
                )
                _ = cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if image.ndim == 3 else image
            elif schema.name == "tosslab.DepthImage":
                box = DepthMessage.FromString(message.data)
                unpack_depth(box.data, box.height, box.width)


def bench_info(folder: Path, quick: bool) -> Iterator[Row]:
    size = 200_000_000 if quick else 2_000_000_000
    big = folder / "big"
    with SessionWriter(big, {"object": {"name": "bench"}}, calibration(640, 480)) as session:
        with session.toss(0) as toss:
            noise = os.urandom(313_000)
            for i in range(size // 1_050_000):
                time_ns = i * 10**9 // FPS
                for name in MONOS:
                    toss.mono(EncodedImage(name, i, time_ns, time_ns, "jpeg", *MONO_SIZE, noise))
                toss.color(EncodedImage("d455", i, time_ns, time_ns, "jpeg", 640, 480, noise[:94_000]))
                toss.arm(arm_batch(i))
        session.finish()
    path = big / "toss_00.mcap"
    for target in (path, big):
        cpu_s, wall_s, rss_mb = of_command("info", str(target))
        yield Row(
            f"toss-session info on {'a file' if target == path else 'a session'} of {path.stat().st_size / 1e9:.1f} GB",
            f"{cpu_s:.2f} CPU-s, {wall_s:.2f} s, {rss_mb:.0f} MB RSS",
            "",
            "< 2 s, < 300 MB",
        )
    cpu_s, wall_s, rss_mb = of_command("verify", str(path))
    yield Row("toss-session verify on that file", f"{cpu_s:.1f} CPU-s, {wall_s:.1f} s, {rss_mb:.0f} MB RSS", "", "")
    shutil.rmtree(big)


def of_command(*arguments: str) -> tuple[float, float, float]:
    """CPU, wall and peak RSS of `python arguments`, its start included."""
    began = time.monotonic()
    program = "import sys; from recordings.cli_session import main; sys.exit(main(sys.argv[1:]))"
    child = subprocess.Popen(
        [sys.executable, "-c", program, *arguments], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(child.pid, 0)
    assert os.waitstatus_to_exitcode(status) in (0, 1), status
    return usage.ru_utime + usage.ru_stime, time.monotonic() - began, usage.ru_maxrss / 1024


def bench_kill(folder: Path, quick: bool) -> Iterator[Row]:
    """A writer in a process of its own is killed at a random instant while it writes its second toss."""
    kills = 8 if quick else 50
    rng = np.random.default_rng(1)
    pixels = Pixels.of(640, 480)
    recovered = identical = 0
    lost = []
    for i in range(kills):
        session, saved = folder / f"killed_{i}", folder / f"saved_{i}"
        accepted, sha256 = killed(session, pixels, float(rng.uniform(0.0, 1.5)))
        reports = {r.source: r for r in recover(session, saved)}
        identical += reports["toss_00.mcap"].sha256 == sha256
        kept = reports["toss_01.mcap"].kept if "toss_01.mcap" in reports else {}
        lost.append([max(0, n - kept.get(topic, 0)) for topic, n in accepted.items()])
        with Session.open(saved) as opened:
            recovered += opened.stop["status"] == "recovered"
            if kept:
                assert len(opened.toss(1).color()) == kept["/d455/color"]
        shutil.rmtree(session)
        shutil.rmtree(saved)
    images, samples = np.array([r[:-1] for r in lost]).sum(axis=1), np.array([r[-1] for r in lost])
    yield Row(
        f"kill -9 at {kills} random instants",
        f"{recovered} of {kills} recover, {identical} finished tosses byte-identical; lost of what was accepted: at "
        f"most {images.max()} images, {samples.max()} arm samples (mean {images.mean():.2f} and {samples.mean():.1f})",
        "",
        f"all recover; at most the open chunk ({CHUNK_BYTES >> 20} MiB or {CHUNK_NS // 10**6} ms) is lost",
    )


def killed(folder: Path, pixels: Pixels, after_s: float) -> tuple[dict[str, int], str]:
    """Messages by topic that the writer had accepted of its second toss when it was killed; sha256 of its first."""
    read_end, write_end = os.pipe()
    child = os.fork()
    if child == 0:
        victim(folder, pixels, write_end)
    os.close(write_end)
    with os.fdopen(read_end) as pipe:
        sha256 = pipe.readline().strip()
        time.sleep(after_s)
        os.kill(child, signal.SIGKILL)
        frames = len(pipe.read().splitlines())
    os.waitpid(child, 0)
    topics = ("/d455/color", "/d455/depth", *(f"/{name}/image" for name in MONOS))
    return {**dict.fromkeys(topics, frames), "/arm/joint_states": frames * ARM_HZ // FPS}, sha256


def victim(folder: Path, pixels: Pixels, pipe: int) -> None:
    session = SessionWriter(folder, {}, calibration(640, 480))
    with session.toss(0) as toss:
        for i in range(5):
            write_frame(toss, pixels, i, lossless=False)
    os.write(pipe, f"{toss.sha256}\n".encode())
    second = session.toss(1)

    def frame(i: int) -> None:
        write_frame(second, pixels, i, lossless=False)
        os.write(pipe, b"accepted\n")

    paced(1e6, frame)


PARTS = {
    "codec": bench_codec,
    "align": bench_align,
    "write": bench_write,
    "read": bench_read,
    "info": bench_info,
    "kill": bench_kill,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="which to run; all by default")
    parser.add_argument("--quick", action="store_true", help="shorter, smaller, fewer")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    print("| figure | tosslab | plain mcap | wanted |\n|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory(prefix="bench_session_") as folder:
        for name in args.parts or PARTS:
            for row in PARTS[name](Path(folder), args.quick):
                print(f"| {row.figure} | {row.got} | {row.plain} | {row.wanted} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
