"""Figures of tosses that are planned and watched, without a recorder.

python tools/bench_toss.py detect [--count 200]     # release and impact of simulated tosses against the truth
python tools/bench_toss.py plans [--count 1000]     # random targets: every accepted plan within its limits

Both take --part K/N: the K-th of N shares of the same draws, for machines that others use too.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from bench_record import share  # noqa: E402

from acquisition.arm.limits import arm_model  # noqa: E402
from acquisition.arm.toss import (  # noqa: E402
    ReleaseDelay,
    Samples,
    TossRefused,
    check_limits,
    draw_target,
    plan_toss,
)
from acquisition.arm.workspace import Space  # noqa: E402
from acquisition.detect import Eye, TossWatcher  # noqa: E402
from acquisition.rig import TossConfig  # noqa: E402
from acquisition.synthetic.lab_config import SyntheticConfig  # noqa: E402
from recordings.geometry import Transform, rotation_exp  # noqa: E402


def bench_detect(count: int, part: str) -> bool:
    """Motions of the simulated lab, depth at thumbnail size, widths at 50 Hz: nothing else is rendered."""
    per_lab = 25
    hits: Counter[str] = Counter()
    early, done = 0, 0
    numbers = share(count, part)
    for seed in sorted({11 + k // per_lab for k in numbers}):
        tosses = [k % per_lab for k in numbers if 11 + k // per_lab == seed]
        for toss, (off, late_s) in zip(tosses, toss_by_toss(seed, tosses)):
            done += 1
            if any(e is None or abs(e) > 1.0 for e in off.values()) or late_s is None or late_s < -0.2:
                print(f"  lab {seed}, toss {toss}: frames off {off}, over {late_s} s after rest")
            for name, error in off.items():
                hits[name] += error is not None and abs(error) <= 1.0
            early += late_s is None or late_s < -0.2
    print(f"toss detection, {done} tosses, within one frame of the truth (wanted: release and impact >= 98 %):")
    for name in ("release", "first impact"):
        print(f"  {name}: {hits[name]} ({100 * hits[name] / done:.1f} %)")
    print(f"  ended before the object was at rest (by more than 0.2 s), or never: {early}")
    return min(hits["release"], hits["first impact"]) >= 0.98 * done


def toss_by_toss(seed: int, tosses: list[int]) -> Any:
    from acquisition.synthetic.show import Show

    show = Show(SyntheticConfig(seed=seed, color_size=(212, 120)))
    base = show.lab.calibrated_world_from_base
    assert base is not None
    eye = Eye(
        show.lab.d455.camera,
        show.lab.calibrated_world_from_d455,
        1,
        arm_model("panda"),
        Transform("world", "base", base.rotation, base.translation_m),
    )
    for toss in tosses:
        motion = show.motion(toss, show.plan(toss))
        rng = np.random.default_rng((seed, toss))
        end_s = motion.instants.end_s
        times_s = np.arange(rng.uniform(0, 1 / 30), end_s, 1 / 30)
        raws = [show.lab.depth(show.lab.g_buffer(motion, t), toss, k) for k, t in enumerate(times_s)]
        swing = motion.swing
        assert swing is not None
        widths = [
            (float(t), swing.finger_width_m(t) + rng.normal(0, 2e-5))
            for t in np.arange(rng.uniform(0, 0.02), end_s, 0.02)
        ]
        eye.learn(raws[:3], 0.001)
        watcher, over_s, given = TossWatcher(), None, 0
        for t, raw in zip(times_s, raws):
            while given < len(widths) and widths[given][0] <= t:
                watcher.width(*widths[given])
                given += 1
            q = swing.q_rad(float(t))
            watcher.saw(eye.see(float(t), raw, 0.001, q, watcher.expected_m(float(t), eye.tool_m(q))))
            if over_s is None and watcher.over(float(t)):
                over_s = float(t)
        found, true = watcher.events(), motion.instants
        off = {
            "release": None if found.release is None else 30 * (found.release.time_s - true.release_s),
            "first impact": None
            if found.first_impact is None
            else 30 * (found.first_impact.time_s - true.first_impact_s),
        }
        yield off, None if over_s is None else over_s - true.rest_s


def bench_plans(count: int, part: str) -> bool:
    """Releases all over the table at up to 1.5 m/s, some of them impossible."""
    good, numbers = True, share(count, part)
    for name in ("panda", "ur5e"):
        model = arm_model(name)
        base = Transform("world", "base", rotation_exp(np.array([0.0, 0.0, -np.pi / 2])), np.array([0.0, 0.6, 0.0]))
        accepted, broken, why = 0, 0, Counter[str]()
        started = time.process_time()
        for number in numbers:
            rng = np.random.default_rng((0, number))
            config = TossConfig(
                position_m=tuple(rng.uniform([-0.25, -0.1, 0.15], [0.25, 0.3, 0.55]).tolist()),
                velocity_m_s=tuple(rng.uniform([-0.6, -1.2, -0.3], [0.6, 0.2, 1.0]).tolist()),
                spin_rad_s=tuple(rng.uniform(-1, 1, 3).tolist()),
                approach=(float(rng.uniform(-0.5, 0.5)), float(rng.uniform(-0.8, 0.2)), -1.0),
                roll_deg=float(rng.uniform(-60, 60)),
                position_spread_m=0.0,
                velocity_spread_m_s=0.0,
            )
            try:
                plan = plan_toss(model, Space.of_table(base), draw_target(config, 0), ReleaseDelay(0.06, 0.01))
            except TossRefused as refused:
                text = str(refused)
                why[text.split(": ")[1].split(" at ")[0] if "refused: " in text else "out of reach"] += 1
                continue
            accepted += 1
            t = plan.trajectory
            ddq = np.gradient(t.dq_rad_s, t.time_s, axis=0)  # from positions and speeds alone, not the planner's own
            breach = check_limits(model, Samples(t.time_s, t.q_rad, t.dq_rad_s, ddq))
            broken += breach is not None
            if breach is not None:
                print(f"  {breach}")
        good &= broken == 0
        print(
            f"{name}: {accepted} of {len(numbers)} random releases accepted, {broken} of them break a limit "
            f"(wanted: 0), {(time.process_time() - started) / len(numbers):.2f} CPU-s each"
        )
        for text, times in why.most_common(8):
            print(f"  refused {times}: {text}")
    return good


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["detect", "plans"])
    parser.add_argument("--count", type=int)
    parser.add_argument("--part", default="1/1", metavar="K/N")
    args = parser.parse_args()
    if args.what == "detect":
        return 0 if bench_detect(args.count or 200, args.part) else 1
    return 0 if bench_plans(args.count or 1000, args.part) else 1


if __name__ == "__main__":
    sys.exit(main())
