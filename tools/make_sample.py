"""Makes the session that the repository ships, recordings/samples/box_toss, from the synthetic lab.

python tools/make_sample.py            # about two CPU minutes; replaces the shipped one
python tools/make_sample.py --out OUT  # somewhere else
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

from synthetic.folder import write_session
from synthetic.presets import SAMPLE, SAMPLE_TOSSES

from acquisition.synthetic.lab import Lab
from recordings.errors import TosslabError
from recordings.importers.folder import import_folder
from recordings.progress import Console

SHIPPED = Path(__file__).resolve().parent.parent / "recordings" / "samples" / "box_toss"
LARGEST_BYTES = 12_000_000


def make(out: Path) -> int:
    """Simulate, import as any user would, return the size in bytes. `out` is replaced when all is well."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "layout" / "box_toss"
        truth = write_session(Lab(SAMPLE), range(SAMPLE_TOSSES), folder, Console("sample"))
        session = Path(scratch) / "box_toss"
        import_folder(folder, session, truth)
        size = sum(f.stat().st_size for f in session.rglob("*") if f.is_file())
        if size > LARGEST_BYTES:
            sys.exit(f"the sample has {size} bytes, wanted at most {LARGEST_BYTES}; shrink SAMPLE in presets.py")
        if out.exists():
            shutil.rmtree(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(session, out)
    return size


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=SHIPPED)
    given = parser.parse_args()
    try:
        size = make(given.out)
    except TosslabError as wrong:
        print(wrong, file=sys.stderr)
        return wrong.exit_code
    print(f"{given.out}: {SAMPLE_TOSSES} tosses, {size / 1e6:.1f} MB; the last one is to be held out of learning")
    return 0


if __name__ == "__main__":
    sys.exit(main())
