"""Makes a simulated session in the folder layout, and its truth beside it (OUT_truth).

python tools/make_synthetic.py --preset mug-plain --out OUT            # 3 tosses
python tools/make_synthetic.py --preset spin-20 --out OUT --seed 7 --tosses 10
python tools/make_synthetic.py --list
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from synthetic.folder import write_session
from synthetic.presets import described, preset

from acquisition.synthetic.lab import Lab
from recordings.errors import TosslabError
from recordings.progress import Console


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", help="name of the scene; --list shows them")
    parser.add_argument("--out", type=Path, help="new folder; the truth goes to OUT_truth")
    parser.add_argument("--seed", type=int, help="another room, look and tosses of the same preset")
    parser.add_argument("--tosses", type=int, default=3)
    parser.add_argument("--list", action="store_true", help="list the presets")
    given = parser.parse_args()
    if given.list:
        print("\n".join(described()))
        return 0
    if not given.preset or not given.out:
        parser.error("wanted --preset NAME --out DIR, or --list")
    try:
        lab = Lab(preset(given.preset, given.seed))
        truth = write_session(lab, range(given.tosses), given.out, Console(given.preset))
    except TosslabError as wrong:
        print(wrong, file=sys.stderr)
        return wrong.exit_code
    print(f"{given.out} and {truth}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
