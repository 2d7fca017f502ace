"""Contact learning: tracks and a prior shape in, geometry and friction with intervals out."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from processing.contact.friction.estimate import (
    FRICTION_UNSEEN,
    ForecastFriction,
    Interval,
    frames_are_slow,
    friction_by_forecasts,
)
from processing.contact.friction.forecast import Law, RigidBody
from processing.contact.friction.plane_forecast import plane_by_forecasts
from processing.contact.learn import data_checks as checks
from processing.contact.learn.dissipation_weight import HeldOut, Sweep, SweepConfig, sweep_weights
from processing.contact.learn.fit import FRICTION, Fit, FitConfig, Model, fit
from processing.contact.learn.intervals import Spread, bootstrap, curvature, extents, plane_sensitivity
from processing.contact.learn.prepared import Prepared, no_contact, prepare, starts, transitions
from processing.contact.learn.prior import Frame, Prior, learned_shape
from processing.contact.learn.touch import plane_by_touch
from processing.contact.learn.unexplained import unexplained_rows
from processing.contact.physics.geometry import GeometryName
from processing.contact.physics.inertia import Physics
from processing.contact.physics.loss import REFERENCE_MASS_KG, Body, StepData, Weights, contact_loss, find_contacts
from processing.contact.physics.plane import Plane
from processing.motion.trajectory import PoseSeries, Steps
from recordings.progress import Progress, Silent
from recordings.tracks import ContactModel, ObjectShape


@dataclass(frozen=True)
class ContactConfig:
    """The settings of contact learning."""

    fit: FitConfig = field(default_factory=FitConfig)
    sweep: SweepConfig = field(default_factory=SweepConfig)
    weights: Weights | None = None
    """None: chosen by held-out rollouts (SweepConfig). `Weights()` are the paper's."""
    penetration: float = 1.0
    """Weight of the fourth term where the weights are chosen. 1 is the paper's; free points of a vision mesh at 30 Hz
    want Vysics' 20, else single corners reach through the plane to meet an impact between two frames. (A box at 30 Hz
    is 1 to 3 % too large with 1; with 20 it is as much too small where poses are 3 mm off, which rollouts mind.)"""
    one_toss_dissipation: float = 30.0
    """Of a single toss, from which nothing can be held out."""
    friction_by_forecasts: bool = True
    """Where frames are far apart, the weights are chosen and there are tosses enough: estimate.py instead of the
    loss's."""
    bootstrap_repeats: int = 16
    rollout_steps: int = 80
    rollout_step_s: float = 1 / 148
    seed: int = 0


@dataclass(frozen=True, eq=False)
class ContactLearning:
    """What was learned, and all that a reader needs to judge it. Points and shape are in the object frame."""

    model: ContactModel
    shape: ObjectShape
    geometry: GeometryName
    friction: Interval
    extents: tuple[Interval, ...]
    spread: Spread
    weights: Weights
    sweep: Sweep | None
    fit: Fit
    fitted: Model
    frame: Frame
    tosses: tuple[int, ...]
    left_out: Mapping[int, str]
    duplicates: tuple[tuple[int, ...], ...]
    transitions: int
    unexplained: Mapping[int, tuple[int, ...]]
    solver_failures: int
    touched: Bool[Array, " v"]
    plane_sensitivity: Mapping[str, float]
    checks: Mapping[str, float | None]
    noise: Mapping[int, tuple[float, float]]
    prepared: Prepared
    data: StepData
    cpu_seconds: float
    seconds: float
    law: Law | None = None
    """Friction and restitution where they were found by forecasts: rollouts then obey them. None: inelastic."""
    restitution: Interval | None = None
    """The law's, with its interval; it cannot be below 0 or above 1."""

    @property
    def untouched_vertices(self) -> tuple[int, ...]:
        """Points that no contact ever touched: they are where the prior has them."""
        return tuple(int(i) for i in np.flatnonzero(~self.touched))

    def body(self) -> Body:
        """The learned body about the prior's centre of mass, for rollouts."""
        return self.fitted.numbers(self.fit.parameters)


def learn_contact(
    tracks: Sequence[PoseSeries],
    prior: Prior,
    physics: Physics,
    plane: Plane | None = None,
    config: ContactConfig | None = None,
    progress: Progress | None = None,
) -> ContactLearning:
    """Learn geometry and friction from `world_from_object` tracks.

    Raises BadInput for data that contradict themselves (see data_checks), and for no contact.
    """
    began = time.perf_counter()
    plane, config, progress = plane or Plane(), config or ContactConfig(), progress or Silent()
    inertia = REFERENCE_MASS_KG / physics.mass_kg * prior.frame.inertia(physics.inertia_kgm2)
    fitted = Model(prior.geometry, inertia, config.fit, prior.sigma_m)
    groups = checks.duplicate_groups(tracks)
    again = {t for group in groups for t in group[1:]}
    prepared = prepare([t for t in tracks if t.toss not in again], prior.frame, plane, inertia)
    found = _check_together(tracks, prepared, prior, inertia, fitted)
    steps = transitions(prepared)
    _require_contact(steps, prepared)
    progress.step(1, 6, "data checked")
    sweep, weights = _choose_weights(fitted, steps, prepared, config, progress)
    data = StepData(steps, config.fit.device)
    started = time.process_time()
    fits = [fit(fitted, fitted.start(), data, weights)]
    unexplained = unexplained_rows(data, fitted.numbers(fits[0].parameters), prior.geometry.contacts)
    if bool(unexplained.any()):
        data.weight[unexplained] = 0.0
        fits.append(fit(fitted, fits[0].parameters, data, weights))
    optimum = fits[-1].parameters
    slow = slow_friction(fitted, optimum, prepared, config)
    cpu_seconds = time.process_time() - started
    progress.step(3, 6, "fitted")
    found |= _slow_plane(fitted, optimum, prepared, prior, slow, config.seed)
    if len(prepared.tracks) < 2 or config.bootstrap_repeats < 2:
        spread = curvature(fitted, optimum, data, weights)
    else:
        spread = bootstrap(fitted, optimum, data, weights, config.bootstrap_repeats, config.seed)
    progress.step(4, 6, "intervals")
    sensitivity = plane_sensitivity(fitted, optimum, data, weights)
    progress.step(5, 6, "sensitivity")
    last, spread = with_friction(fits[-1], spread, slow, prepared, config)
    optimum = last.parameters
    body = fitted.numbers(optimum)
    touched = touched_points(fitted, body, data, weights)
    checks.check_plane(_rest_heights(prepared, body.points_m.cpu().numpy()), "the learned shape")
    model, shape, friction, sizes = results_of(fitted, optimum, spread, slow, prior, physics, plane, touched)
    left_out = {**prepared.left_out, **dict.fromkeys(sorted(again), "the same recording as another toss")}
    progress.step(6, 6, "learned")
    return ContactLearning(
        model=model,
        shape=shape,
        geometry=prior.geometry.name,
        friction=friction,
        extents=sizes,
        spread=spread,
        weights=weights,
        sweep=sweep,
        fit=last,
        fitted=fitted,
        frame=prior.frame,
        tosses=tuple(t.toss for t in prepared.tracks),
        left_out=left_out,
        duplicates=tuple(groups),
        transitions=len(steps),
        unexplained=_by_toss(steps, unexplained.cpu().numpy()),
        solver_failures=fits[-1].last_failures,
        touched=touched,
        plane_sensitivity=sensitivity,
        checks=found,
        noise={s.states.toss: (s.noise.position_m, s.noise.rotation_rad) for s in prepared.smoothed},
        prepared=prepared,
        data=data,
        cpu_seconds=cpu_seconds,
        seconds=time.perf_counter() - began,
        law=None if slow is None else slow.law,
        restitution=None if slow is None else slow.restitution,
    )


def _check_together(
    tracks: Sequence[PoseSeries], prepared: Prepared, prior: Prior, inertia: Float[Array, "3 3"], fitted: Model
) -> dict[str, float | None]:
    """Checks over all usable tosses; what they measured goes into the result."""
    usable = {t.toss for t in prepared.tracks}
    checks.check_velocities([t for t in tracks if t.toss in usable])
    fall = checks.check_fall(prepared.tracks)
    angle = checks.check_orientations(prepared.tracks, inertia)
    height = None
    if prior.measured:
        points = fitted.numbers(fitted.start()).points_m.cpu().numpy()
        height = checks.check_plane(_rest_heights(prepared, points), "the prior shape")
    plane = plane_by_touch(prepared.tracks, [s.phases.release or 0 for s in prepared.smoothed])
    touched_m, std_m = (None, None) if plane is None else (plane.height_m, plane.std_m)
    if not prior.measured:
        checks.check_touched_plane(touched_m, std_m)
    return {
        "fall_m_s2": fall,
        "impact_misfit": angle,
        "prior_rest_height_m": height,
        "plane_by_touch_m": touched_m,
        "plane_by_touch_std_m": std_m,
    }


def _rest_heights(prepared: Prepared, points_m: Float[Array, "v 3"]) -> dict[int, float]:
    found = {}
    for track, smoothed in zip(prepared.tracks, prepared.smoothed):
        height = checks.lowest_point_m(track, points_m, smoothed.phases)
        if height is not None:
            found[track.toss] = height
    return found


def _require_contact(steps: Steps, prepared: Prepared) -> None:
    """Raises BadInput where flight explains everything."""
    touching = [s for s in prepared.smoothed if not s.phases.in_flight.all()]
    if len(steps) == 0 or not touching:
        raise no_contact(len(prepared.tracks), len(steps))


def _choose_weights(
    fitted: Model, steps: Steps, prepared: Prepared, config: ContactConfig, progress: Progress
) -> tuple[Sweep | None, Weights]:
    if config.weights is not None:
        return None, config.weights
    if len(prepared.tracks) < 3:
        return None, Weights(dissipation=config.one_toss_dissipation, penetration=config.penetration)
    start, begin = starts(prepared, config.rollout_step_s, fitted.inertia_kgm2)
    held_out = HeldOut(prepared.tracks, start, begin, config.rollout_steps, config.rollout_step_s)
    sweep = sweep_weights(
        fitted,
        steps,
        held_out,
        config.sweep,
        lambda done, total: progress.step(1, 6, f"weights {done}/{total}"),
        Weights(penetration=config.penetration),
    )
    return sweep, Weights(dissipation=sweep.chosen.dissipation, penetration=config.penetration)


def forecasts_are_wanted(prepared: Prepared, config: ContactConfig) -> bool:
    """Whether friction is to be found by forecasts, because frames are too far apart for the loss."""
    return config.weights is None and config.friction_by_forecasts and frames_are_slow(prepared.tracks)


def slow_friction(
    fitted: Model, optimum: Float[Array, " p"], prepared: Prepared, config: ContactConfig
) -> ForecastFriction | None:
    """The friction by forecasts where it is better than the loss's; None where it is not, or not asked for."""
    if not forecasts_are_wanted(prepared, config):
        return None
    return friction_by_forecasts(_as_rigid(fitted, optimum), prepared.tracks, prepared.smoothed)


def _as_rigid(fitted: Model, optimum: Float[Array, " p"]) -> RigidBody:
    """The learned body."""
    body = fitted.numbers(optimum)
    return RigidBody(body.points_m.cpu().numpy(), fitted.geometry.contacts, body.inertia_kgm2.cpu().numpy())


def _slow_plane(
    fitted: Model,
    optimum: Float[Array, " p"],
    prepared: Prepared,
    prior: Prior,
    slow: ForecastFriction | None,
    seed: int,
) -> dict[str, float | None]:
    """The plane's height where frames are too far apart for touches: of a box of unknown size, by forecasts. Raises
    BadInput as check_touched_plane does."""
    if slow is None or prior.measured or fitted.geometry.name != "box":
        return {}
    plane = plane_by_forecasts(_as_rigid(fitted, optimum), prepared.tracks, prepared.smoothed, slow.law, seed)
    if plane is None:
        return {}
    checks.check_touched_plane(plane.height_m, plane.std_m)
    return {"plane_by_touch_m": plane.height_m, "plane_by_touch_std_m": plane.std_m}


def with_friction(
    done: Fit, spread: Spread, slow: ForecastFriction | None, prepared: Prepared, config: ContactConfig
) -> tuple[Fit, Spread]:
    """A fit with the friction by forecasts, where there is one, and the intervals' method. Where it was wanted and no
    toss flies and hits the plane, nothing is known of it: what any friction may be stands there, for the loss's is far
    off (0 +- .35 for .69)."""
    if slow is None and not forecasts_are_wanted(prepared, config):
        return done, spread
    friction = FRICTION_UNSEEN if slow is None else slow.friction
    parameters = done.parameters.copy()
    parameters[FRICTION] = friction.value**0.5
    if slow is None:
        spread = replace(spread, friction=friction.high - friction.value, friction_seen=False)
    else:
        spread = replace(spread, method=f"{spread.method}; friction by forecasts")
    return replace(done, parameters=parameters), spread


def touched_points(fitted: Model, body: Body, data: StepData, weights: Weights) -> Bool[Array, " v"]:
    """Points that carried an impulse, or were pushed out of the plane, in some transition that was learned from."""
    impulses = contact_loss(data, body, fitted.geometry.contacts, weights).impulses
    found = find_contacts(data.rotation, data.position_m, body, fitted.geometry.contacts)
    carried = torch.zeros_like(found.height_m, dtype=torch.bool)
    carried[impulses.rows] = impulses.impulse[..., 2] > 1e-6
    learned = (carried | (found.height_m < 0)) & (data.weight > 0)[:, None]
    touched = np.zeros(len(body.points_m), dtype=bool)
    touched[found.index[learned].cpu().numpy()] = True
    return touched


def _by_toss(steps: Steps, unexplained: Bool[Array, " n"]) -> dict[int, tuple[int, ...]]:
    """Frames of the transitions that were left out, by toss."""
    found: dict[int, list[int]] = {}
    for toss, frame in zip(steps.toss[unexplained].tolist(), steps.frame[unexplained].tolist()):
        found.setdefault(toss, []).append(frame)
    return {toss: tuple(frames) for toss, frames in found.items()}


def results_of(
    fitted: Model,
    optimum: Float[Array, " p"],
    spread: Spread,
    slow: ForecastFriction | None,
    prior: Prior,
    physics: Physics,
    plane: Plane,
    touched: Bool[Array, " v"],
) -> tuple[ContactModel, ObjectShape, Interval, tuple[Interval, ...]]:
    """What a parameter vector stands for, in the object frame, with its intervals."""
    body = fitted.numbers(optimum)
    points = body.points_m.cpu().numpy()
    mu = float(body.friction)
    friction = Interval(mu, max(mu - spread.friction, 0.0), mu + spread.friction) if slow is None else slow.friction
    sizes = tuple(
        Interval(float(x), float(max(x - w, 0.0)), float(x + w)) for x, w in zip(extents(points), spread.extents_m)
    )
    frame = prior.frame
    inertia = physics.mass_kg / REFERENCE_MASS_KG * body.inertia_kgm2.cpu().numpy()
    model = ContactModel(
        object_frame=prior.object_frame,
        support_vertices_m=frame.back(points),
        pieces=prior.geometry.pieces(),
        friction=mu,
        friction_low=friction.low,
        friction_high=friction.high,
        mass_kg=physics.mass_kg,
        inertia_kgm2=frame.axes @ inertia @ frame.axes.T,
        center_of_mass_m=frame.back(np.zeros((1, 3)))[0],
        physics_source=physics.source,
        plane_normal_world=np.asarray(plane.normal_world, dtype=np.float64),
        plane_offset_m=plane.offset_m,
    )
    return model, learned_shape(prior, points, touched), friction, sizes
