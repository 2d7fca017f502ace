"""The recorder's figures. Each prints what was got and what was wanted.

python tools/bench_record.py rates [--seconds 60]       # the lab's rates: nothing unaccounted, CPU, queues
python tools/bench_record.py soak [--seconds 600]       # half rate: growth of memory; finished takes make room
python tools/bench_record.py kill [--count 100]         # kill -9 at random instants: recovery, resuming
python tools/bench_record.py clock                      # mapping error on drifting clocks under load, steps, wraps
python tools/bench_record.py times [--part 1/2]         # stamps after toss-calibrate time against true mid-exposures
python tools/bench_record.py tags                       # what JPEG does to tag corners in mono images, size and cost
python tools/bench_record.py faults                     # the injected faults, as tests/acquisition/test_faults.py

kill and times take --part K/N: the K-th of N shares of the same draws, for machines that others use too.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from acquisition.drivers.synthetic import SyntheticLab, SyntheticThrower  # noqa: E402
from acquisition.operator import Nobody  # noqa: E402
from acquisition.rig import DeviceEntry, RecordingConfig, Rig  # noqa: E402
from acquisition.run import Options, SessionRun  # noqa: E402
from acquisition.streaming.clock import ClockMapper, SessionClock  # noqa: E402
from acquisition.streaming.recorder import Recorder  # noqa: E402
from acquisition.synthetic.lab_config import SyntheticConfig  # noqa: E402
from acquisition.verdict import Verdict  # noqa: E402
from recordings.progress import Silent  # noqa: E402
from recordings.session import Session  # noqa: E402
from recordings.session_resume import next_toss, resume_session  # noqa: E402
from recordings.session_writer import SessionWriter  # noqa: E402
from recordings.verify.verify import verify  # noqa: E402
from recordings.whole_file import file_sha256  # noqa: E402

LAB = SyntheticConfig(pictures="pool", color_size=(848, 480), mono_size=(1440, 1080))
TINY = SyntheticConfig(pictures="pool", color_size=(212, 120), mono_size=(160, 120), mono_cameras=1)


class Quiet(Nobody):
    """Says nothing, keeps every take: the counts are what is looked at."""

    def say(self, text: str) -> None:
        pass

    def decide(self, verdict: Verdict) -> Any:
        return "accept"


def rig(config: SyntheticConfig, **recording: Any) -> Rig:
    monos = tuple(DeviceEntry(f"mono{k}", "mono", "synthetic", rate_hz=config.fps) for k in range(config.mono_cameras))
    devices = (
        DeviceEntry("d455", "rgbd", "synthetic", rate_hz=config.fps),
        *monos,
        DeviceEntry("arm", "arm", "synthetic", rate_hz=1000.0),
        DeviceEntry("gripper", "gripper", "synthetic", rate_hz=50.0),
    )
    return Rig("bench", devices, Path("bench.toml"), "panda", recording=RecordingConfig(countdown_s=0.0, **recording))


def record(
    config: SyntheticConfig,
    folder: Path,
    seconds: float,
    tosses: int,
    each: Any = None,
    warm_up_s: float = 2.0,
    **recording: Any,
) -> Any:
    """Takes of a fixed length; `each(run, report)` after every one. Returns report, tallies, clocks, recorder."""
    lab, a_rig = SyntheticLab(config), rig(config, **recording)
    thrower = SyntheticThrower(lab)
    thrower.prepare(0, 0, Silent())
    devices = {d.name: lab.device(d.name, d.kind, d.rate_hz) for d in a_rig.devices}
    recorder = Recorder(a_rig, devices, SessionClock(time.monotonic_ns(), time.time_ns()))
    with recorder:
        time.sleep(warm_up_s)
        with SessionWriter(folder, {"object": {"name": "bench"}}, lab.show.calibration()) as session:
            run = SessionRun(recorder, thrower, session, lab.show.calibration(), Quiet(), Silent())
            reports = []
            for toss in range(tosses):
                report = run.record(Options(1, toss, fixed_s=seconds))
                reports += report.takes
                if each is not None:
                    each(session, toss, report)
            session.finish()
        clocks = recorder.clocks()
    return reports, recorder.tallies(), clocks, recorder


def bench_rates(seconds: float) -> bool:
    with tempfile.TemporaryDirectory(dir=os.environ.get("TMPDIR")) as place:
        folder = Path(place) / "session"
        before = resource.getrusage(resource.RUSAGE_SELF)
        started = time.monotonic()
        reports, tallies, clocks, recorder = record(LAB, folder, seconds, 1)
        wall_s = time.monotonic() - started
        after = resource.getrusage(resource.RUSAGE_SELF)
        cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        session = Session.open(folder)
        counts = {topic: info.count for topic, info in session.toss(0).streams().items()}
        take = reports[0]
        good = True
        print(f"{seconds:g} s at the lab's rates, {wall_s:.0f} s in all, {take.bytes / 1e6 / seconds:.0f} MB/s on disk")
        for topic, tally in take.counts.items():
            whole = tallies[topic]
            unaccounted = whole.received - whole.written - whole.dropped_total - whole.idle
            same = counts.get(topic, 0) == tally.written
            good &= unaccounted == 0 and same
            fullest, held = recorder.queues[topic].fullest, counts.get(topic, 0)
            print(
                f"  {topic:<20} received {whole.received:>6} = written {whole.written:>6} + dropped "
                f"{whole.dropped_total:>4} + before and after {whole.idle:>5} + unaccounted {unaccounted}; "
                f"in file {held:>6}, missed {whole.missed}, fullest queue {fullest}"
            )
        for name, clock in clocks.items():
            print(f"  clock {name}: sigma {1e3 * clock['sigma_s']:.4f} ms, drift {1e6 * clock['drift']:+.2f} ppm")
        print(f"  CPU {cpu_s / wall_s:.2f} s per second, machine load {os.getloadavg()[0]:.1f} (wanted: 0 unaccounted)")
    return good


def bench_soak(seconds: float) -> bool:
    config = replace(LAB, fps=15.0)
    sizes: list[float] = []

    def each(session: SessionWriter, toss: int, report: Any) -> None:
        path = session.folder / f"toss_{toss:02d}.mcap"
        assert path.stat().st_size > 1e6
        with open("/proc/self/statm") as file:
            sizes.append(int(file.read().split()[1]) * resource.getpagesize() / 1e6)
        os.truncate(path, 0)  # a finished take makes room for the next one; its sha256 stays in the session

    with tempfile.TemporaryDirectory(dir=os.environ.get("TMPDIR")) as place:
        takes = max(int(seconds / 12), 3)
        reports, tallies, _, _ = record(config, Path(place) / "session", 12.0, takes, each)
    settled = sizes[len(sizes) // 4 :]
    growth = settled[-1] - settled[0]
    unaccounted = sum(t.received - t.written - t.dropped_total - t.idle for t in tallies.values())
    lost = sum(t.dropped_total + t.missed for r in reports for t in r.counts.values())
    print(
        f"{takes * 12} s at half rate: RSS {settled[0]:.0f} -> {settled[-1]:.0f} MB, growth {growth:+.1f} (wanted < 50)"
    )
    print(f"  unaccounted {unaccounted}, counted as lost {lost}")
    return growth < 50 and unaccounted == 0


def share(count: int, part: str) -> range:
    """The numbers of the K-th of N shares, for `part` = "K/N"."""
    k, n = (int(number) for number in part.split("/"))
    return range((k - 1) * count // n, k * count // n)


def bench_kill(count: int, part: str) -> bool:
    numbers, good, cut = share(count, part), 0, 0
    for k in numbers:
        with tempfile.TemporaryDirectory(dir=os.environ.get("TMPDIR")) as place:
            folder = Path(place) / "session"
            after_s = random.Random(k).uniform(0.0, 4.0)
            killed_after(folder, after_s)
            sealed = {p.name: file_sha256(p) for p in folder.glob("toss_*.mcap") if finished(p)}
            session, recovered = resume_session(folder)
            with session:
                with session.toss(next_toss(folder)) as toss:
                    toss.dropped("/d455/color", 0)
                session.finish()
            untouched = all(file_sha256(folder / name) == sha for name, sha in sealed.items())
            whole = verify(folder).ok
            good += untouched and whole
            cut += len(recovered)
            if not (untouched and whole):
                print(f"  kill {k} after {after_s:.3f} s: untouched {untouched}, whole {whole}: {verify(folder)}")
    print(f"kill -9 at {len(numbers)} random instants: {good} sessions recovered with all files, finished tosses")
    print(f"  untouched, resumed (wanted: all); {cut} of the kills cut a file off")
    return good == len(numbers)


def finished(path: Path) -> bool:
    """Whether a file was closed; one that was only just made has no byte yet."""
    return path.stat().st_size > 0 and verify(path).ok


def killed_after(folder: Path, seconds: float) -> None:
    """A process of its own records short takes until it is killed, `seconds` after its session began."""
    child = os.fork()
    if child == 0:
        try:
            record(TINY, folder, 0.8, 1000, warm_up_s=0.3)
        finally:
            os._exit(1)
    while not (folder / "session.json").exists():
        time.sleep(0.01)
    time.sleep(seconds)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)


def bench_clock() -> bool:
    worst, missed, steps = 0.0, 0, 0
    for seed in range(10):
        _, error_ms = clock_run(seed)
        worst = max(worst, float(error_ms[300:].std()))
    for seed in range(20):
        for by_ns in (3e6, -3e6, 20e6, -20e6, 5e8, -5e8, 3.6e12, -3.6e12):
            mapper, _ = clock_run(100 + seed, 20.0, (300, by_ns))
            steps += 1
            missed += not (len(mapper.steps) == 1 and abs(mapper.steps[0].by_ns - by_ns) < 2e6)
    wraps = 0
    for seed in range(10):
        wrap_ns = 2**32 * 1000
        mapper, _ = clock_run(seed, 20.0, None, wrap_ns, wrap_ns - (seed + 2) * 10**9)
        wraps += mapper.wraps == 1 and not mapper.steps
    print(f"clock mapping, 25 ppm, 30 % of frames held up: worst std {worst:.4f} ms after 10 s (wanted <= 0.05)")
    print(f"  steps seen {steps - missed} of {steps}, wraps {wraps} of 10 (wanted: all)")
    return worst <= 0.05 and missed == 0 and wraps == 10


def clock_run(
    seed: int, seconds: float = 60.0, step: Any = None, wrap_ns: int | None = None, starts_ns: int = 5 * 10**9
) -> tuple[ClockMapper, np.ndarray]:
    rng = np.random.default_rng(seed)
    mapper, errors = ClockMapper(wrap_ns), []
    for k in range(int(seconds * 30)):
        true_ns = k / 30 * 1e9 + rng.normal(0, 2e5)
        device_ns = starts_ns + true_ns * (1 + 25e-6) + (step[1] if step and k >= step[0] else 0.0)
        latency_ns = 4e6 + rng.exponential(1e6) + (rng.random() < 0.3) * rng.exponential(10e6)
        stamp_ns = int(device_ns) // 1000 * 1000
        unwrapped = mapper.add(stamp_ns % wrap_ns if wrap_ns else stamp_ns, int(10**12 + true_ns + latency_ns), k)
        line = mapper.line()
        assert line is not None
        errors.append((line.host_ns(unwrapped) - 10**12 - true_ns) / 1e6)
    return mapper, np.array(errors)


LABS = (
    {
        "seed": 31,
        "skew_ppm": [40.0, -35.0, 25.0, -31.0],
        "latency_ms": 5.4,
        "mono_latency_ms": 16.0,
        "latency_jitter_ms": 2.0,
        "depth_delay_ms": 6.0,
    },
    {
        "seed": 32,
        "skew_ppm": [-60.0, 45.0, 45.0, 20.0],
        "latency_ms": 9.0,
        "mono_latency_ms": 1.2,
        "latency_jitter_ms": 4.0,
        "depth_delay_ms": -4.0,
    },
)
"""What is wrong with the clocks of a lab; two grey cameras on one trigger, one frame in a hundred lost."""


def lab_toml(wrong: dict[str, Any]) -> str:
    """A rig file of that lab. It states the D455's latency, which no data can tell, and nothing of the others."""
    entries = [("d455", "rgbd", 30, wrong["latency_ms"]), ("mono0", "mono", 30, 0.0), ("mono1", "mono", 30, 0.0)]
    entries += [("arm", "arm", 1000, 0.0), ("gripper", "gripper", 50, 0.0)]
    devices = "".join(
        f'[devices.{name}]\nkind = "{kind}"\ndriver = "synthetic"\nrate_hz = {rate}\nlatency_ms = {latency}\n'
        for name, kind, rate, latency in entries
    )
    simulation = "".join(f"{key} = {value}\n" for key, value in wrong.items())
    return (
        f'name = "times"\nrobot = "panda"\n{devices}[recording]\ncountdown_s = 0\nqueue_s = 4\nlongest_gap_s = 3\n'
        f"[simulation]\n{simulation}mono_cameras = 2\ncolor_size = [560, 400]\ncolor_focal_px = 640.0\n"
        "mono_size = [480, 360]\ndropped_share = 0.01\n"
    )


def bench_times(part: str) -> bool:
    """A toss of each lab, recorded, calibrated by its own motion, compared with the simulation's exposures."""
    from synthetic.stamp_errors import stamp_errors_ms

    from acquisition.cli import main as toss_record
    from calibration.cli import main as toss_calibrate

    good = True
    for number in share(len(LABS), part):
        with tempfile.TemporaryDirectory() as place:
            rig_file, out, truth = Path(place) / "lab.toml", Path(place) / "out", Path(place) / "out_truth"
            rig_file.write_text(lab_toml(LABS[number]))
            assert toss_record(["--rig", str(rig_file), "--yes", str(out)]) == 0
            before = stamp_errors_ms(out, truth)
            size_m = json.loads((truth / "object_tags.json").read_text())["tags"][0]["size_m"]
            assert toss_calibrate(["time", str(out), "--tag-size", str(size_m)]) == 0
            after = stamp_errors_ms(out, truth)
        print(f"stamps after toss-calibrate time, lab {number + 1}: {LABS[number]} (wanted: all within 1 ms)")
        for topic, errors in after.items():
            worst = float(np.abs(errors).max())
            good &= worst <= 1.0
            print(
                f"  {topic:<13} {len(errors)} frames: mean {errors.mean():+.3f} (before {before[topic].mean():+.3f}), "
                f"std {errors.std():.3f}, worst {worst:.3f} ms"
            )
    return good


def bench_tags() -> bool:
    """Corners of the same images raw and compressed; the scene is rendered at the lab's size with its noise."""
    from acquisition.synthetic.config import MonoConfig
    from acquisition.synthetic.lab import Lab
    from acquisition.synthetic.show import scene_config
    from calibration.tags.detect import detect_tags

    config = SyntheticConfig(seed=5)
    scene = scene_config(config)
    lab = Lab(replace(scene, mono=MonoConfig(subframes=2), still_rays=3_000_000))
    motion = lab.plan(0)
    raw = [
        lab.mono(camera, motion, float(t), k)
        for camera in range(3)
        for k, t in enumerate(np.linspace(0.2, motion.instants.end_s, 4))
    ]
    reference = detect_tags(raw, jobs=1)
    again = detect_tags([_noisier(image, k) for k, image in enumerate(raw)], jobs=1)
    print(f"tag corners, {len(raw)} mono images of 1440x1080, {sum(map(len, reference))} tags (wanted: < 0.02 px)")
    print(f"  one more grey level of noise moves them by {_moved(reference, again):.4f} px (sigma a coordinate)")
    for quality in (90, 95, 98, 100):
        started = time.process_time()
        data = [cv2.imencode(".jpg", i, [cv2.IMWRITE_JPEG_QUALITY, quality])[1] for i in raw]
        cpu_ms = 1e3 * (time.process_time() - started) / len(raw)
        found = detect_tags([cv2.imdecode(d, cv2.IMREAD_UNCHANGED) for d in data], jobs=1)
        size = np.mean([len(d) for d in data]) / 1e3
        print(f"  JPEG {quality}: {_moved(reference, found):.4f} px, {size:.0f} kB, {cpu_ms:.1f} ms")
    import zstandard

    started = time.process_time()
    sizes = [len(zstandard.ZstdCompressor(level=1).compress(i.tobytes())) for i in raw]
    cpu_ms = 1e3 * (time.process_time() - started) / len(raw)
    print(f"  zstd-1 (lossless): 0 px, {np.mean(sizes) / 1e3:.0f} kB, {cpu_ms:.1f} ms")
    return True


def _noisier(image: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 1.0, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def _moved(before: Any, after: Any) -> float:
    """Standard deviation, per coordinate, of how far the corners of the same tags moved."""
    moved = []
    for a, b in zip(before, after):
        there = {t.tag_id: t.corners_px for t in b}
        moved += [there[t.tag_id] - t.corners_px for t in a if t.tag_id in there]
    return float(np.std(np.concatenate(moved)))


def bench_faults() -> bool:
    command = [sys.executable, "-m", "pytest", "-q", "tests/acquisition/test_faults.py"]
    return subprocess.run(command, cwd=ROOT, check=False).returncode == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", default="all")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--count", type=int)
    parser.add_argument("--part", default="1/1", metavar="K/N")
    args = parser.parse_args()
    benches = {
        "clock": bench_clock,
        "tags": bench_tags,
        "times": lambda: bench_times(args.part),
        "rates": lambda: bench_rates(args.seconds or 60.0),
        "soak": lambda: bench_soak(args.seconds or 600.0),
        "kill": lambda: bench_kill(args.count or 100, args.part),
        "faults": bench_faults,
    }
    chosen = list(benches) if args.what == "all" else [args.what]
    results = [benches[name]() for name in chosen]
    return 0 if all(results) else 1


if __name__ == "__main__":
    sys.exit(main())
