"""How far the stamps of a recorded session of the simulated lab are from its true exposures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.bounded.documents import read_json
from recordings.session import Session
from recordings.sync import clock_offset_ns


def stamp_errors_ms(session: Path, truth: Path) -> dict[str, Float[Array, " n"]]:
    """By topic and over all tosses: stamps, with the offsets that `toss-calibrate time` found, less true mid-exposures.

    Of a session that one run of toss-record wrote; `truth` is what `write_sidecar` wrote.
    """
    opened = Session.open(session)
    anchor = opened.start["clock"]["anchor"]
    began_host_ns = anchor["host_monotonic_ns"] - anchor["session_ns"]
    errors: dict[str, list[float]] = {}
    for number in opened.tosses:
        folder = truth / f"toss_{number:02d}"
        first_host_ns = read_json(folder / "toss_gt.json")["first_color_exposed_host_ns"]
        exposures = read_json(folder / "exposures_ns.json")
        for topic, exposed_ns in exposures.items():
            stream = "mono" if topic.startswith("/mono") else "d455"
            offset_ns = clock_offset_ns(opened.calibration.residuals, stream)
            for message in opened.toss(number).file.messages(topic):
                true_ns = first_host_ns + exposed_ns[str(message.sequence)] - began_host_ns
                errors.setdefault(topic, []).append((message.publish_time_ns + offset_ns - true_ns) / 1e6)
    return {topic: np.array(values) for topic, values in errors.items()}
