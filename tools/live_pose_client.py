"""An example of a client of the live pose (docs/live_pose.md): prints where the object is, as it comes.

python tools/live_pose_client.py sessions/first [--frames 100]
"""

from __future__ import annotations

import argparse
import json
import socket
import sys
import time
from pathlib import Path


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("session", type=Path)
    parser.add_argument("--frames", type=int, default=0, help="end after so many (default: never)")
    parser.add_argument("--wait", type=float, default=60.0, help="seconds to wait for the live pose to begin")
    args = parser.parse_args()
    about = args.session / "results" / "live" / "pose.json"
    ends = time.monotonic() + args.wait
    while not about.exists():
        if time.monotonic() > ends:
            print(f"{about} is not there: record with `toss-record --live pose {args.session}`", file=sys.stderr)
            return 2
        time.sleep(0.2)
    found = json.loads(about.read_text())
    seen = 0
    with socket.create_connection((found["host"], found["port"])) as server, server.makefile("r") as lines:
        for line in lines:
            pose = json.loads(line)
            at = pose["position_m"]
            where = "lost" if at is None else " ".join(f"{1e3 * x:+8.1f}" for x in at) + " mm"
            print(f"{pose['time_ns'] / 1e9:10.3f} s  {pose['status']:<12} {where}  {pose['latency_ms']:5.1f} ms")
            seen += 1
            if seen == args.frames:
                return 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
