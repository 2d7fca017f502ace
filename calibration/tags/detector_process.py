"""The process that pupil-apriltags lives in: images come on stdin, tags go out on stdout (see tags.DetectorChild).

The library corrupts the heap when a detector is deleted, and now and then on busy images: one detector per process,
never deleted, and the process leaves without tidying up. Whoever started it survives its death.
"""

from __future__ import annotations

import os
import struct
import sys

import numpy as np

HEADER = struct.Struct("<ii")
COUNT = struct.Struct("<i")
TAG_VALUES = 11
"""id, hamming, decision margin, then four corners x, y in the detector's own pixels (centre of the first at 0.5)."""


def serve(family: str, decimate: float) -> None:
    """Answer images until stdin ends."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what the library prints must not stand between two answers
    from pupil_apriltags import Detector

    detect = Detector(families=family, nthreads=1, quad_decimate=decimate).detect
    while header := sys.stdin.buffer.read(HEADER.size):
        height, width = HEADER.unpack(header)
        image = np.frombuffer(sys.stdin.buffer.read(height * width), np.uint8).reshape(height, width)
        rows = [[t.tag_id, t.hamming, t.decision_margin, *t.corners.ravel()] for t in detect(image.copy())]
        replies.write(COUNT.pack(len(rows)) + np.array(rows, np.float64).tobytes())
        replies.flush()
    os._exit(0)


if __name__ == "__main__":
    serve(sys.argv[1], float(sys.argv[2]))
