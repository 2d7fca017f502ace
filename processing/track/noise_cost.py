"""What depth's noise makes views cost at their true poses, and the tracker's thresholds raised by it.

The costs of pairs of views were told apart on depth as fine as `noise.FINE`. Where a session's depth is worse, the true
poses cost more: thresholds that stay where they were call frames lost that lie within a degree. The cost up to which a
pair fixes how one view is turned against the other stays: noise says no more of turns for being known.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from processing.sensor.noise import FINE, DepthNoise
from processing.track import kernels as k
from processing.track.schedule import USUAL_DISTANCE_M
from processing.track.track_toss import TrackConfig


def pair_cost(noise: DepthNoise, scale_m: float, window_px: int) -> float:
    """Mean cost (0..1) of the points of one view on another's surface at the true poses: that of `kernels.pair_terms`,
    min(r^2 / 9, 1) / 2 of a normal residual r between two surfaces, each smoothed by planes over windows of half width
    `window_px`. `scale_m`: of residuals, at USUAL_DISTANCE_M; residual and scale grow alike with the distance."""
    window = float((2 * window_px + 1) ** 2)
    smooth_m = noise.sigma_at_1m * USUAL_DISTANCE_M**2 * min(1.0, noise.patch_px / window) ** 0.5
    return 0.5 * _mean_truncated_square(2**0.5 * smooth_m / (3 * scale_m))


def at_noise(config: TrackConfig, noise: DepthNoise) -> TrackConfig:
    """The settings for a session whose depth errs so."""
    scale_m, window_px = config.hypotheses.graph.schedule[-1][k.GEOMETRY_M], config.view.window_px
    more = max(0.0, pair_cost(noise, scale_m, window_px) - pair_cost(FINE, scale_m, window_px))
    flags, beam, graph = config.flags, config.beam, config.hypotheses.graph
    flags = replace(flags, tracked_cost=flags.tracked_cost + more, unfit_cost=flags.unfit_cost + more)
    return replace(
        config,
        view=replace(config.view, turn_share=noise.turn_share),
        flags=flags,
        beam=replace(beam, uncertain_cost=beam.uncertain_cost + more, search=beam.search + more, lost=beam.lost + more),
        hypotheses=replace(
            config.hypotheses, depth_noise=noise, graph=replace(graph, sure_cost=graph.sure_cost + more)
        ),
    )


def _mean_truncated_square(sigma: float) -> float:
    """E[min(x^2, 1)] of a normal variable of this standard deviation."""
    from scipy.special import erf

    if sigma <= 0:
        return 0.0
    inside = float(erf(1 / (sigma * 2**0.5)))
    density = float(np.exp(-0.5 / sigma**2) / (sigma * (2 * np.pi) ** 0.5))
    return sigma**2 * (inside - 2 * density) + 1 - inside
