"""How soon a toss is judged while the recorder holds its rates, and how good the live pose is. Prints what was got and
what was wanted.

python tools/bench_live.py toss SESSION [--tosses 10]      # from the finished file to the verdict, alone on the machine
python tools/bench_live.py rates SESSION [--tosses 10]     # the same while another process records at the lab's rates
python tools/bench_live.py pose SESSION [--learn 3] [--tosses 2]    # the causal pose against the smoothed one
python tools/bench_live.py growth SESSION                  # CPU seconds of a look for 2, 5, 10, 20 tosses

SESSION is a finished one; its tosses are handed over one by one, each when the one before was judged. `rates` counts
the drops of bench_record's recorder (848x480 colour and depth, three grey cameras of 1440x1080, 1 kHz of joint states).
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import processing  # noqa: E402, F401, I001 (before numpy: as in toss-process, its BLAS works in one thread)
import cv2  # noqa: E402
import numpy as np  # noqa: E402

from processing.config import Config  # noqa: E402
from processing.live import bounds  # noqa: E402
from processing.live.config import LiveConfig  # noqa: E402
from processing.live.look import Looker  # noqa: E402
from processing.live.pose.front import PoseFront  # noqa: E402
from processing.live.together import Joined, Together  # noqa: E402
from processing.live.watch import finished_tosses  # noqa: E402
from processing.run import CAMERA  # noqa: E402
from processing.segment.background.static_scene import StaticScene  # noqa: E402
from processing.segment.robot.of_session import Rig  # noqa: E402
from recordings.geometry import rotation_angle_rad  # noqa: E402
from recordings.progress import Silent  # noqa: E402
from recordings.session import Session  # noqa: E402
from recordings.tracks import ObjectShape  # noqa: E402

FIRST_S, TENTH_S = 5.0, 8.0
NEAR_DEG, NEAR_MM, SHARE, LATENCY_MS = 3.0, 5.0, 0.95, 40.0
AFTER_IMPACT = 2


@dataclass
class Look:
    """One toss: seconds and CPU seconds of its look, and what it was joined as."""

    toss: int
    seconds: float
    cpu_s: float
    joined: Joined


def looks(session: Path, tosses: int, scratch: Path) -> Iterator[tuple[Look, Looker, Together]]:
    """The follower's own two steps, toss by toss, with warm kernels (the first toss is looked at once before)."""
    cv2.setNumThreads(1)
    live, files = LiveConfig(), finished_tosses(session)
    with Session.open(session) as opened:
        calibration = opened.calibration
    warm = Looker(session, scratch / "warm", Config(), live, lambda _: Silent())
    together = Together(calibration, CAMERA, live)
    for toss in list(files)[:2]:
        together.add(warm.look(toss, files[toss], lambda _: None))
    looker = Looker(session, scratch / "looked", Config(), live, lambda _: Silent())
    together = Together(calibration, CAMERA, live)
    for toss in list(files)[:tosses]:
        wall, cpu = time.monotonic(), time.process_time()
        joined = together.add(looker.look(toss, files[toss], lambda _: None))
        yield Look(toss, time.monotonic() - wall, time.process_time() - cpu, joined), looker, together


def bench_toss(session: Path, tosses: int) -> bool:
    """Wanted: 5 s for the first toss, 8 s for the tenth."""
    good = True
    with tempfile.TemporaryDirectory() as place:
        for number, (look, _, together) in enumerate(looks(session, tosses, Path(place))):
            wanted = FIRST_S + (TENTH_S - FIRST_S) * min(number, 9) / 9
            good &= look.seconds <= wanted
            report = together.report(look.joined, look.seconds)
            print(f"  {look.seconds:6.2f} s, {look.cpu_s:6.2f} CPU-s (wanted {wanted:.1f} s)  {report.text()}")
    print(f"a toss's verdict after its file is whole: {'within' if good else 'beyond'} what is wanted")
    return good


def bench_rates(session: Path, tosses: int) -> bool:
    """The same beside a recorder at the lab's rates, and that one's drops (wanted: none)."""
    command = [sys.executable, str(ROOT / "tools" / "bench_record.py"), "rates", "--seconds", str(12 * tosses)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as recorder:
        time.sleep(5.0)
        bounds.come_last()
        good = bench_toss(session, tosses)
        said, _ = recorder.communicate()
    drops = [int(n) for n in re.findall(r"dropped\s+(\d+)", said)]
    print(said.rstrip())
    print(f"drops beside it: {sum(drops)} (wanted: 0)")
    return good and bool(drops) and not any(drops)


def bench_pose(session: Path, learn: int, tosses: int) -> bool:
    """Each frame's pose from those before it, beside the smoothed track of the same toss, by frames outside two after
    an impact; and its CPU time."""
    with tempfile.TemporaryDirectory() as place:
        made = list(looks(session, learn + tosses, Path(place)))
        looker, together = made[-1][1], made[-1][2]
        shape = _shape_of(together, learn)
        assert looker.shared is not None
        background = StaticScene.read(looker.shared.scene.folder)
        scale = Rig.read(looker.shared.rig.folder).depth_scale
    within, cpu_ms, lost = list[bool](), list[float](), 0
    with Session.open(session) as opened:
        calibration = opened.calibration
        camera, world = calibration.camera(CAMERA), calibration.find("world", CAMERA)
        for look, _, _ in made[learn:]:
            front = PoseFront(camera, shape, background, world, depth_scale=scale)
            track, impact = look.joined.track, look.joined.instants.impact
            at = {int(t): i for i, t in enumerate(track.time_ns)}
            for frame in opened.toss(look.toss).rgbd(CAMERA):
                began = time.process_time()
                pose = front.see(frame)
                cpu_ms.append(1e3 * (time.process_time() - began))
                i = at.get(frame.time_ns)
                if i is None or track.status[i] != "tracked":
                    continue
                if impact is not None and impact <= i <= impact + AFTER_IMPACT:
                    continue
                lost += pose.camera_from_object is None
                within.append(_near(pose.camera_from_object, track.camera_from_object[i], together))
    good = bool(np.mean(within) >= SHARE and np.median(cpu_ms) <= LATENCY_MS)
    print(
        f"live pose: {100 * np.mean(within):.1f} % of {len(within)} frames within {NEAR_DEG:g} deg and "
        f"{NEAR_MM:g} mm of"
    )
    print(
        f"  the smoothed pose (wanted {100 * SHARE:g} %), {lost} lost; CPU time a frame: median "
        f"{np.median(cpu_ms):.1f},"
    )
    print(f"  90 % {np.quantile(cpu_ms, 0.9):.1f} ms (wanted {LATENCY_MS:g} ms; the first frame, located anew:")
    print(f"  {max(cpu_ms):.0f} ms)")
    return good


def _shape_of(together: Together, learn: int) -> ObjectShape:
    """The shape from the first tosses alone."""
    first = dict(list(together.tosses.items())[:learn])
    before = Together(together.calibration, together.camera, together.config, first)
    before.fuse()
    assert before.shape is not None
    return before.shape


def _near(pose: np.ndarray | None, smoothed: np.ndarray, together: Together) -> bool:
    if pose is None or together.shape is None:
        return False
    center = 0.5 * (together.shape.vertices_m.min(0) + together.shape.vertices_m.max(0))
    turn = np.degrees(rotation_angle_rad(pose[:3, :3].T @ smoothed[:3, :3]))
    shift = np.linalg.norm((pose[:3, :3] - smoothed[:3, :3]) @ center + pose[:3, 3] - smoothed[:3, 3])
    return bool(turn < NEAR_DEG and 1e3 * shift < NEAR_MM)


def bench_growth(session: Path) -> bool:
    """CPU seconds per frame of a look: wanted the same however many tosses there are."""
    with tempfile.TemporaryDirectory() as place:
        found = [look for look, _, _ in looks(session, 20, Path(place))]
    for count in (2, 5, 10, 20):
        if count > len(found):
            break
        part = found[:count]
        frames = sum(len(look.joined.track.status) for look in part)
        cpu_s = sum(look.cpu_s for look in part)
        print(f"  {len(part):2d} tosses: {cpu_s:6.1f} CPU-s, {1e3 * cpu_s / frames:5.1f} ms a frame")
    return True


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("toss", "rates", "pose", "growth"))
    parser.add_argument("session", type=Path)
    parser.add_argument("--tosses", type=int)
    parser.add_argument("--learn", type=int, default=3)
    args = parser.parse_args()
    run = {
        "toss": lambda: bench_toss(args.session, args.tosses or 10),
        "rates": lambda: bench_rates(args.session, args.tosses or 10),
        "pose": lambda: bench_pose(args.session, args.learn, args.tosses or 2),
        "growth": lambda: bench_growth(args.session),
    }[args.what]
    return 0 if run() else 1


if __name__ == "__main__":
    sys.exit(main())
