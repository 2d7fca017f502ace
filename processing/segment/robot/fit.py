"""Where the robot really stands and how late its clock runs: its drawn links against depth and outline, once a session.

Unknowns: a small motion of the whole robot in the camera frame (6), the delay that is added to an image's time before
the joints are asked (1), and the depth camera's scale, reported / true (1). Gauss-Newton on two kinds of residuals,
robustly weighted, with weak priors:

    depth    n . (p_measured / scale - p_drawn)          inside of the drawn links, in standard deviations
    outline  (edge found - edge drawn) along its normal  where the scene behind the robot is known, in pixels
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array

from processing.segment.background.static_scene import StaticScene
from processing.segment.robot.render import RobotView
from processing.sensor import noise
from processing.sensor.noise import stereo_sigma_m
from recordings.estimation.robust import huber_weight
from recordings.geometry import CameraModel, Transform, rotation_exp, rotation_log
from recordings.records import RgbdFrame
from recordings.robot.arm import ArmPath

DELAY, SCALE = 6, 7
FINGERS = ("panda_leftfinger", "panda_rightfinger")
STEP_NS = 4_000_000
"""Half the time over which a link's velocity is taken."""


@dataclass(frozen=True)
class RobotFitSettings:
    """How the robot's place, delay and the depth's scale are fitted."""

    frames: int = 18
    """Frames of the session that are looked at: half spread evenly, half where the arm is fastest."""
    stride: int = 4
    """Every stride-th pixel of rows and columns gives a depth residual."""
    steps: int = 6
    widest_m: float = 0.04
    """Depth differences beyond this are something else in the first step; it narrows to `narrowest_m`."""
    narrowest_m: float = 0.01
    margin_px: int = 4
    """Depth this near to the drawn outline is not used: a stereo camera fattens edges."""
    reach_px: float = 9.0
    """How far from the drawn outline its edge is looked for in the first step; it narrows to a third."""
    outlines: int = 250
    """Points of the outline used per frame."""
    edge_sigma_px: float = 0.7
    least_difference: float = 30.0
    """The robot's colour differs from the scene behind it at least by this, 0..255."""
    prior_m: float = 0.02
    prior_deg: float = 2.0
    prior_delay_s: float = 0.03
    prior_scale: float = 0.02
    correlated: float = noise.ROBOT_SIGMA_SCALE
    least_samples: int = 400
    """With fewer depth residuals the robot is hardly in view: nothing is fitted."""
    farthest_m: float = 0.06
    farthest_deg: float = 4.0
    farthest_delay_s: float = 0.1
    """A result beyond these is no refinement of a calibration: it is refused and the calibration stays."""


@dataclass(frozen=True, eq=False)
class RobotObservation:
    """One frame of a session and the arm's path in its toss."""

    frame: RgbdFrame
    path: ArmPath


@dataclass(frozen=True, eq=False)
class RobotFit:
    """`camera_from_base` and `delay_s` as refined; `depth_scale` is reported / true depth.

    `sigma`: standard deviations of rotation (rad, 3), translation (m, 3), delay (s), scale. The medians are of absolute
    residuals, before and after. `refused` gives the reason why the calibration was left as it is; None where it was
    refined.
    """

    camera_from_base: Transform
    delay_s: float
    depth_scale: float
    sigma: Float[Array, "8"]
    depth_before_m: float
    depth_after_m: float
    outline_before_px: float
    outline_after_px: float
    depth_samples: int
    outline_samples: int
    refused: str | None = None

    def moved_from(self, calibrated: Transform) -> tuple[float, float]:
        """How far from a calibrated camera_from_base: metres (amid the robot) and degrees."""
        moved, center = self.camera_from_base @ calibrated.inverse(), _center(calibrated)
        shift_m = float(np.linalg.norm(moved.points(center[None])[0] - center))
        return shift_m, float(np.degrees(np.linalg.norm(rotation_log(moved.rotation))))


@dataclass(frozen=True, eq=False)
class _State:
    camera_from_base: Transform
    delay_s: float = 0.0
    scale: float = 1.0

    def moved(self, step: Float[Array, "8"], center_m: Float[Array, "3"]) -> _State:
        """After a step of the eight unknowns; the turn is about `center_m` in the camera frame."""
        turn = rotation_exp(step[:3])
        here = self.camera_from_base
        at = center_m + step[3:6] + turn @ (here.translation_m - center_m)
        there = Transform(here.target, here.source, turn @ here.rotation, at)
        return _State(there, self.delay_s + step[DELAY], self.scale * float(np.exp(step[SCALE])))


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Rows of one kind: residual in standard deviations, its derivative by the unknowns, and itself in own units."""

    r: Float[Array, " n"]
    J: Float[Array, "n 8"]
    raw: Float[Array, " n"]


@dataclass(frozen=True, eq=False)
class _Edges:
    """Where one frame's outline is looked for: its difference from the scene, where that is known, and how far."""

    difference: Float32[Array, "h w"]
    known: Bool[Array, "h w"]
    reach_px: float


def choose_observations(
    counts: Sequence[int], speed: Callable[[int, int], float], settings: RobotFitSettings
) -> list[tuple[int, int]]:
    """(toss position, frame) to look at. `speed(toss, frame)` is the tool's in m/s; NaN where joints are not known."""
    speeds = {(t, i): speed(t, i) for t, n in enumerate(counts) for i in range(n)}
    known = [at for at, v in speeds.items() if np.isfinite(v)]
    even = settings.frames // 2
    chosen = [known[int(k)] for k in np.unique(np.linspace(0, len(known) - 1, min(even, len(known))).round())]
    fast = sorted((at for at in known if at not in chosen), key=lambda at: -speeds[at])
    return sorted(chosen + fast[: settings.frames - len(chosen)])


def fit_robot(
    observations: Sequence[RobotObservation],
    camera: CameraModel,
    camera_from_base: Transform,
    scene: StaticScene,
    settings: RobotFitSettings,
    scale_prior: tuple[float, float] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> RobotFit:
    """Refine the robot's place, its delay and the depth's scale. `scale_prior`: what else is known of the scale, and
    its standard deviation."""
    start = _State(camera_from_base)
    if not observations:
        return _refused(start, "no frame with joint states")
    fine = RobotView(observations[0].path.robot, camera)
    coarse = fine.coarser(settings.stride)
    differences = [difference_from(scene, s.frame) for s in observations]
    state = start
    history: list[tuple[_Residuals, _Residuals]] = []
    for k in range(settings.steps):
        share = k / max(settings.steps - 1, 1)
        gate = settings.widest_m * (settings.narrowest_m / settings.widest_m) ** share
        depth = _joined([_depth_rows(s, coarse, state, gate, settings) for s in observations])
        reach = settings.reach_px * 3.0**-share
        edges = [_Edges(d, scene.known, reach) for d in differences]
        outline = _joined([_outline_rows(s, e, fine, camera, state, settings) for s, e in zip(observations, edges)])
        if len(depth.r) < settings.least_samples:
            return _refused(start, f"only {len(depth.r)} depth samples on the robot")
        history.append((depth, outline))
        step, sigma = _solve(depth, outline, state, start, settings, scale_prior)
        state = state.moved(step, _center(camera_from_base))
        progress(k + 1, settings.steps)
    first, last = history[0], history[-1]
    fit = RobotFit(
        state.camera_from_base,
        state.delay_s,
        state.scale,
        sigma,
        _median(first[0].raw),
        _median(last[0].raw),
        _median(first[1].raw),
        _median(last[1].raw),
        len(last[0].r),
        len(last[1].r),
    )
    return _checked(fit, start, settings)


def _checked(fit: RobotFit, start: _State, s: RobotFitSettings) -> RobotFit:
    shift_m, turn_deg = fit.moved_from(start.camera_from_base)
    if shift_m > s.farthest_m or turn_deg > s.farthest_deg or abs(fit.delay_s) > s.farthest_delay_s:
        why = f"the fit went {1000 * shift_m:.0f} mm, {turn_deg:.1f} deg and {1000 * fit.delay_s:.0f} ms away"
        return _refused(start, why)
    return fit


def _refused(start: _State, why: str) -> RobotFit:
    nan = float("nan")
    return RobotFit(start.camera_from_base, 0.0, 1.0, np.full(8, nan), nan, nan, nan, nan, 0, 0, why)


def _center(camera_from_base: Transform) -> Float[Array, "3"]:
    """A point amid the robot, in the camera frame: turns about it hardly move it."""
    return camera_from_base.points(np.array([[0.25, 0.0, 0.4]]))[0]


def _links(observation: RobotObservation, state: _State, time_ns: int) -> dict[str, Transform]:
    """camera_from_link at an image's time."""
    base = state.camera_from_base
    joined = observation.path.links(time_ns + int(state.delay_s * 1e9))
    root = Transform.identity(base.source, observation.path.robot.root)
    return {name: base @ root @ link for name, link in joined.items()}


def _velocities(
    observation: RobotObservation, state: _State, time_ns: int, view: RobotView, at: Array, points: Array
) -> Float[Array, "n 3"]:
    """Velocity in the camera frame of drawn points, by the motion of their links."""
    early, late = _links(observation, state, time_ns - STEP_NS), _links(observation, state, time_ns + STEP_NS)
    now = _links(observation, state, time_ns)
    out = np.zeros_like(points)
    for number, link in enumerate(view.parts):
        mine = at == number
        if mine.any():
            local = now[link].inverse().points(points[mine])
            out[mine] = (late[link].points(local) - early[link].points(local)) / (2e-9 * STEP_NS)
    return out


def _depth_rows(
    observation: RobotObservation, view: RobotView, state: _State, gate_m: float, s: RobotFitSettings
) -> _Residuals:
    time_ns = observation.frame.depth_time_ns
    leave_out = () if np.isfinite(observation.path.finger_width_m(time_ns)) else FINGERS
    image = view.draw(_links(observation, state, time_ns), leave_out)
    measured = observation.frame.depth_m[:: s.stride, :: s.stride]
    inner = max(1, round(s.margin_px / s.stride))
    solid = cv2.erode((image.depth_m > 0).astype(np.uint8), np.ones((2 * inner + 1,) * 2, np.uint8)) > 0
    use = solid & (measured > 0) & (np.abs(measured / state.scale - image.depth_m) < gate_m)
    rays, normal = view.rays[use].astype(np.float64), image.normal[use].astype(np.float64)
    drawn_m, measured_m = image.depth_m[use].astype(np.float64), measured[use].astype(np.float64)
    points = rays * drawn_m[:, None]
    along = (normal * rays).sum(-1)  # how a change of depth moves the point along the normal
    raw = along * (measured_m / state.scale - drawn_m)
    sigma = np.maximum(stereo_sigma_m(image.depth_m[use]), 0.001) * np.maximum(np.abs(along), 0.2)
    velocity = _velocities(observation, state, time_ns, view, image.part[use], points)
    J = _by_motion(normal, points - _center(state.camera_from_base), velocity)
    J[:, SCALE] = -along * measured_m / state.scale
    return _Residuals(raw / sigma, J / sigma[:, None], raw)


def _by_motion(normal: Array, arm: Array, velocity: Array) -> Float[Array, "n 8"]:
    """Derivative of n . (p_measured - p_drawn) by the robot's motion and its delay."""
    J = np.zeros((len(normal), 8))
    J[:, :3] = -np.cross(arm, normal)
    J[:, 3:6] = -normal
    J[:, DELAY] = -(normal * velocity).sum(-1)
    return J


def _outline_rows(
    observation: RobotObservation,
    edges: _Edges,
    view: RobotView,
    camera: CameraModel,
    state: _State,
    s: RobotFitSettings,
) -> _Residuals:
    time_ns = observation.frame.time_ns
    image = view.draw(_links(observation, state, time_ns), FINGERS)
    outline = _outline(image.depth_m > 0, s.outlines)
    if outline is None:
        return _Residuals(np.zeros(0), np.zeros((0, 8)), np.zeros(0))
    pixels, outward = outline
    offset = edge_offsets(edges.difference, edges.known, pixels, outward, edges.reach_px, s)
    found = np.isfinite(offset)
    pixels, outward, offset = pixels[found], outward[found], offset[found]
    u, v = np.round(pixels).astype(int).T
    points = view.rays[v, u].astype(np.float64) * image.depth_m[v, u][:, None]
    h = 1e-4
    turned = [camera.project(points + h * e) - camera.project(points - h * e) for e in np.eye(3)]
    by_point = np.stack([(t * outward).sum(-1) / (2 * h) for t in turned], -1)  # outline's motion along its normal
    velocity = _velocities(observation, state, time_ns, view, image.part[v, u], points)
    J = _by_motion(by_point, points - _center(state.camera_from_base), velocity)
    return _Residuals(offset / s.edge_sigma_px, J / s.edge_sigma_px, offset)


def _outline(mask: Bool[Array, "h w"], most: int) -> tuple[Float[Array, "n 2"], Float[Array, "n 2"]] | None:
    """Points (x, y) of the mask's outer rim inside the image, and their outward normals; None without any."""
    part = mask.astype(np.uint8)
    rim = mask & (cv2.erode(part, np.ones((3, 3), np.uint8)) == 0)
    rim[:12], rim[-12:], rim[:, :12], rim[:, -12:] = False, False, False, False
    v, u = np.nonzero(rim)
    if len(v) < 30:
        return None
    keep = np.linspace(0, len(v) - 1, min(most, len(v))).astype(int)
    soft = cv2.GaussianBlur(part.astype(np.float32), (0, 0), 2.0)
    dy, dx = np.gradient(soft)
    normal = -np.stack([dx[v, u], dy[v, u]], -1)[keep]
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    good = length[:, 0] > 0.05  # thin parts and corners have no clear normal
    # the rim's pixels lie inside: the outline is half a pixel further out
    normal = normal[good] / length[good]
    return np.stack([u, v], -1)[keep][good].astype(np.float64), normal.astype(np.float64)


def difference_from(scene: StaticScene, frame: RgbdFrame) -> Float32[Array, "h w"]:
    """How far each pixel's colour is from the scene's, after the exposure's change is taken out."""
    color = frame.color_rgb.astype(np.float32)
    level = scene.known & (scene.color_rgb.max(-1) > 20) & (color.max(-1) < 250)
    ratio = color[level].sum(-1) / np.maximum(scene.color_rgb[level].sum(-1), 1.0)
    gain = float(np.median(ratio[:: max(1, len(ratio) // 20000)])) if len(ratio) else 1.0
    return np.abs(color / max(gain, 0.1) - scene.color_rgb).max(-1).astype(np.float32)


def edge_offsets(
    difference: Float32[Array, "h w"],
    known: Bool[Array, "h w"],
    pixels: Float[Array, "n 2"],
    outward: Float[Array, "n 2"],
    reach_px: float,
    s: RobotFitSettings,
) -> Float[Array, " n"]:
    """How far outside of each outline point the image's edge lies (px); NaN where no clear step is found.

    Along the normal the difference from the scene falls from the robot's level to that of the scene: the edge lies
    where it crosses the mean of inside and outside.
    """
    along = np.arange(-reach_px, reach_px + 0.25, 0.5)
    at = pixels[:, None] + outward[:, None] * (along[None, :, None] + 0.5)  # the outline is the rim's outer border
    x, y = at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)
    profile = cv2.remap(difference, x, y, cv2.INTER_LINEAR)
    seen = cv2.remap(known.astype(np.uint8), x, y, cv2.INTER_NEAREST).all(-1)
    ends = 3
    inside, outside = np.median(profile[:, :ends], 1), np.median(profile[:, -ends:], 1)
    threshold = 0.5 * (inside + outside)
    above = profile > threshold[:, None]
    once = (np.diff(above.astype(int), axis=1) != 0).sum(1) == 1
    k = above.shape[1] - 1 - above[:, ::-1].argmax(1)  # the last sample that is still the robot
    k = np.minimum(k, len(along) - 2)
    rows = np.arange(len(k))
    high, low = profile[rows, k], profile[rows, k + 1]
    share = (high - threshold) / np.maximum(high - low, 1e-3)
    clear = seen & once & (inside > s.least_difference) & (outside < 0.4 * inside)
    return np.where(clear, along[k] + 0.5 * np.clip(share, 0, 1), np.nan)


def _joined(parts: Sequence[_Residuals]) -> _Residuals:
    return _Residuals(*(np.concatenate([getattr(p, n) for p in parts]) for n in ("r", "J", "raw")))


def _solve(
    depth: _Residuals,
    outline: _Residuals,
    state: _State,
    start: _State,
    s: RobotFitSettings,
    scale_prior: tuple[float, float] | None,
) -> tuple[Float[Array, "8"], Float[Array, "8"]]:
    """A Gauss-Newton step with Huber weights, and the standard deviations of the eight unknowns."""
    H, g = np.zeros((8, 8)), np.zeros(8)
    for rows in (depth, outline):
        if len(rows.r):
            w = huber_weight(np.abs(rows.r), 1.5) / s.correlated**2
            H += (rows.J * w[:, None]).T @ rows.J
            g += (rows.J * w[:, None]).T @ rows.r
    moved = state.camera_from_base @ start.camera_from_base.inverse()
    center = _center(start.camera_from_base)
    away = np.concatenate([rotation_log(moved.rotation), moved.points(center[None])[0] - center])
    away = np.append(away, [state.delay_s, np.log(state.scale)])
    prior = np.array([np.deg2rad(s.prior_deg)] * 3 + [s.prior_m] * 3 + [s.prior_delay_s, s.prior_scale])
    H += np.diag(prior**-2)
    g += away / prior**2
    if scale_prior is not None:
        H[SCALE, SCALE] += scale_prior[1] ** -2
        g[SCALE] += np.log(state.scale / scale_prior[0]) / scale_prior[1] ** 2
    return -np.linalg.solve(H, g), np.sqrt(np.diag(np.linalg.inv(H)))


def _median(raw: Float[Array, " n"]) -> float:
    return float(np.median(np.abs(raw))) if len(raw) else float("nan")
