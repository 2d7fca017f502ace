"""The phase of every frame of a toss (held, flight, impact, rest), from true or estimated poses."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

Phase = Literal["held", "flight", "impact", "rest"]
PHASES: tuple[Phase, ...] = ("held", "flight", "impact", "rest")
AROUND_IMPACT = 2
"""Frames before and after contact that count as impact."""


def frame_phases(
    time_ns: Int64[Array, " n"], world_from_object: Float[Array, "n 4 4"], center_m: Float[Array, "3"]
) -> list[Phase]:
    """Held until release; impact where neither flight nor rest explains the motion, and two frames around; rest at the
    end. `center_m`: the centre of mass in the object frame. Frames without a pose take their neighbours' phase."""
    from processing.motion.phases import find_phases
    from processing.motion.trajectory import PoseSeries

    known = np.flatnonzero(np.isfinite(world_from_object[:, 0, 0]))
    if len(known) < 5:
        return ["held"] * len(time_ns)
    poses = world_from_object[known]
    center = poses[:, :3, :3] @ center_m + poses[:, :3, 3]
    series = PoseSeries(0, 1e-9 * (time_ns[known] - time_ns[known[0]]), poses[:, :3, :3].copy(), center)
    found = find_phases(series, np.eye(3))
    release = len(known) if found.release is None else found.release
    impact = len(known) if found.first_impact is None else found.first_impact
    rest = len(known) if found.rest is None else found.rest
    touching = np.zeros(len(known), dtype=bool)
    touching[impact:rest] = ~found.in_flight[impact:rest]
    near = np.convolve(touching, np.ones(2 * AROUND_IMPACT + 1), mode="same") > 0
    phases: list[Phase] = []
    for i in range(len(known)):
        calm: Phase = "held" if i < release else "rest" if i >= rest else "flight"
        phases.append("impact" if near[i] and i >= release else calm)
    nearest = np.searchsorted(known, np.arange(len(time_ns))).clip(0, len(known) - 1)
    return [phases[k] for k in nearest]
