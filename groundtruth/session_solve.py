"""Where the tagged body was in every frame of the ground-truth cameras: one factor graph over all tosses.

Unknown are the body's pose at every instant, the place of each tag on it (its layout), the cameras' places as far as
the calibration leaves them open, and how each camera moved from toss to toss. What is measured are tag corners; in
flight three poses in a row lie on an arc, where the data do not say otherwise (a robust weight: hands, impacts).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int64
from numpy import ndarray as Array

from groundtruth import se3
from groundtruth.factors import Between
from groundtruth.flight import FlightConfig, Order, arcs_of, center_of_mass
from groundtruth.graph import Graph, Solution, SolverConfig, Undetermined, covariances, solve
from groundtruth.session_detections import Detections, Roles, TagSeen
from groundtruth.tagslam.config import BodyEntry, CameraEntry, TagEntry, TagSlamConfig
from groundtruth.tagslam.initialisation import Initialisation, chain
from groundtruth.tagslam.problem import Key, Observation, Problem, camera_key, planar_poses, tag_key
from groundtruth.tagslam.solve import TagSlamSettings, build_graph, initialise
from groundtruth.tagslam.yaml_pieces import NoisyPose
from groundtruth.tension import Tension, tension
from recordings.constants import MAD_TO_SIGMA
from recordings.progress import Progress, Silent
from recordings.tracks import RigCalibration

WORLD, BODY = "world", "tagged"
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Between pupil-apriltags' tag frame (y down) and TagSLAM's (y up)."""


@dataclass(frozen=True)
class SolveConfig:
    camera_sigma: tuple[float, float] = (0.001, 0.0005)
    """Of a camera's place in the calibration, rad and m."""
    table_sigma: tuple[float, float] = (0.005, 0.0005)
    """Of a table tag's place, rad and m."""
    layout_sigma: tuple[float, float] = (0.005, 0.0005)
    """Of a tag's place on the body, where the layout is given."""
    false_alarm: float = 0.02
    """A camera is taken to stand elsewhere than calibrated when its place would be contradicted as much by chance in no
    more than this share of sessions without a bump (`Tension.chance` over the cameras tested); tags and other cameras
    then place it. Of 555 simulated one-toss sessions (tools/bench_bumps.py; 109 on fresh seeds) 5 of 187 without a
    bump name a camera (3 of 36 fresh ones); of bumps by 1-2, 2-3, 3-4, 4-6 mm 17, 48, 91, 99 % are named; poses are
    within two stated deviations in 98 % or more of the sessions of every kind."""
    loose_factor: float = 50.0
    """Its place in the calibration then counts with as many times its standard deviation."""
    drift_sigma: tuple[float, float] = (0.0005, 0.0003)
    """How far a camera may move from toss to toss without it being told, rad and m."""
    corner_floor_px: float = 0.08
    """Standard deviation that a corner has at least: lens and printing are not perfect."""
    huber_px: float = 3.0
    flight: FlightConfig = field(default_factory=FlightConfig)


@dataclass(frozen=True, eq=False)
class BodyTrack:
    """The body in one toss at its cameras' instants. Covariance: (rotation, translation) in the body's own frame.
    `on_arc[k]`: poses k-1, k, k+1 are flight. `tags`, `cameras`: how many saw it."""

    time_ns: Int64[Array, " n"]
    world_from_tagged: Float[Array, "n 4 4"]
    covariance: Float[Array, "n 6 6"]
    on_arc: Bool[Array, " n"]
    tags: tuple[int, ...]
    cameras: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Corner:
    """One tag's corners in one image against the solution: seen, and what is left (seen - projected)."""

    toss: int
    camera: str
    time_ns: int
    tag_id: int
    seen_px: Float[Array, "4 2"]
    left_px: Float[Array, "4 2"]
    sigma_px: float


@dataclass(frozen=True, eq=False)
class Solved:
    """`layout`: tagged_from_tag (pupil-apriltags' tag frame). `cameras`: world_from_camera and its covariance.
    `moved[(camera, toss)]`: how far it stood from its place, rad and m. `unplaced`: what nothing connects.
    `table_off_m`: how far each table tag lies from its place in the calibration."""

    tracks: Mapping[int, BodyTrack]
    layout: Mapping[int, Float[Array, "4 4"]]
    sizes_m: Mapping[int, float]
    cameras: Mapping[str, Float[Array, "4 4"]]
    camera_covariance: Mapping[str, Float[Array, "6 6"]]
    moved: Mapping[tuple[str, int], tuple[float, float]]
    center_m: Float[Array, "3"]
    corners: tuple[Corner, ...]
    unplaced: tuple[str, ...]
    table_off_m: Mapping[int, float] = field(default_factory=dict)
    arcs: int = 0
    displaced: tuple[str, ...] = ()
    """Cameras that do not stand where the calibration has them; what was seen placed them."""
    tension: float = 1.0
    """By how many standard deviations the other places are contradicted; deviations are as many times wider."""
    by_chance: float = 1.0
    """How likely they are contradicted as much where no camera was bumped."""


def solve_session(
    detections: Detections,
    roles: Roles,
    sizes_m: Mapping[int, float],
    calibration: RigCalibration,
    layout: Mapping[int, Float[Array, "4 4"]] | None = None,
    config: SolveConfig | None = None,
    progress: Progress | None = None,
) -> Solved:
    """Raises Undetermined, in words of cameras, tags and instants, where something is not fixed by what was seen."""
    config, progress = config or SolveConfig(), progress or Silent()
    problem = _problem(detections, roles, sizes_m, calibration, layout, config)
    initial = Initialisation(problem, TagSlamSettings().initialisation)
    settings = TagSlamSettings(
        solver=SolverConfig(huber_px=config.huber_px), initial_solver=SolverConfig(6, config.huber_px, weakest=0.0)
    )
    initialise(problem, initial, settings, progress)
    if not any(key[:2] == ("body", BODY) for key in initial.poses):
        raise Undetermined(sorted(c.name for c in problem.config.cameras), _nothing_connects(problem, initial))
    graph, index = build_graph(problem, initial.poses)
    order = _order(detections, index)
    drifting = _let_cameras_drift(graph, problem, index, detections, config)
    solution = solve(graph, settings.solver)
    solution, loosened, left, by_chance = _without_wrong_places(
        graph, solution, problem, index, config, settings.solver
    )
    tags_center = np.mean([solution.poses[index[tag_key(i)]][:3, 3] for i in roles.body if tag_key(i) in index], axis=0)
    center = tags_center
    for _ in range(config.flight.rounds):
        center = center_of_mass(solution.poses, order, tags_center, config.flight)
        graph.arcs = arcs_of(solution.poses, order, center, config.flight)
        if not graph.arcs:
            break
        graph.start = list(solution.poses)
        solution = solve(graph, settings.solver)
    found = _solved(problem, detections, graph, index, solution, drifting, center, initial)
    return _widened(replace(found, displaced=loosened, by_chance=by_chance), max(1.0, left.deviations))


def _nothing_connects(problem: Problem, initial: Initialisation) -> str:
    placed = [c.name for c in problem.config.cameras if camera_key(c.name) in initial.poses]
    if not placed:
        return (
            "no camera's place is known and none sees a table tag whose place is known; "
            "run `toss-calibrate cameras SESSION` first"
        )
    return f"of the cameras with a known place ({', '.join(placed)}) none sees the tossed object's tags well enough"


def _noise(sigma: tuple[float, float]) -> Float[Array, "6 6"]:
    return np.diag([1 / sigma[0]] * 3 + [1 / sigma[1]] * 3)


def _problem(
    detections: Detections,
    roles: Roles,
    sizes_m: Mapping[int, float],
    calibration: RigCalibration,
    layout: Mapping[int, Float[Array, "4 4"]] | None,
    config: SolveConfig,
) -> Problem:
    """The session as TagSLAM would see it: a static world with the cameras and the table, a moving tagged body."""
    counts = {i: sum(s.tag.tag_id == i for s in detections.seen) for i in roles.body}
    reference = max(sorted(counts), key=lambda i: counts[i])
    table = {t.tag_id: t for t in calibration.table_tags if t.tag_id in roles.table}
    tags = {
        i: TagEntry(i, t.size_m, NoisyPose(t.world_from_tag.matrix @ FLIP, _noise(config.table_sigma)))
        for i, t in table.items()
    }
    tags |= {i: TagEntry(i, sizes_m[i], None) for i in roles.still if i in sizes_m}
    world = BodyEntry(WORLD, True, NoisyPose(np.eye(4), 1e6 * np.eye(6)), 0.0, tags, frozenset())
    if layout is not None:
        on_body = {
            i: TagEntry(i, sizes_m[i], NoisyPose(layout[i] @ FLIP, _noise(config.layout_sigma))) for i in roles.body
        }
    else:
        on_body = {i: TagEntry(i, sizes_m[i], None) for i in roles.body}
        on_body[reference] = replace(on_body[reference], pose=NoisyPose(FLIP, 1e6 * np.eye(6)))
    body = BodyEntry(BODY, False, None, 0.0, on_body, frozenset())
    names = sorted({camera for cameras in detections.frames.values() for camera in cameras})
    cameras = tuple(_camera(name, calibration, config) for name in names)
    tagslam = TagSlamConfig(cameras, (world, body), None, 0.3, (), (), (), (), (), 2)
    observations = _observations(detections, tagslam, config)
    stamps = tuple(sorted({o.stamp_ns for o in observations}))
    every = {**tags, **on_body}
    owner = {**dict.fromkeys(tags, world), **dict.fromkeys(on_body, body)}
    return Problem(tagslam, stamps, observations, every, owner, {}, 0)


def _camera(name: str, calibration: RigCalibration, config: SolveConfig) -> CameraEntry:
    model = calibration.camera(name)
    place = calibration.find("world", model.frame)
    known = None if place is None else NoisyPose(place.matrix, _noise(config.camera_sigma))
    return CameraEntry(name, model, f"/{name}/image", WORLD, known, (1e-5, 1e-5))


def _observations(detections: Detections, config: TagSlamConfig, settings: SolveConfig) -> tuple[Observation, ...]:
    owner = {i: body for body in config.bodies for i in body.tags}
    out: list[Observation] = []
    for number, camera in enumerate(config.cameras):
        mine = [s for s in detections.seen if s.camera == camera.name and s.tag.tag_id in owner]
        sizes = np.array([owner[s.tag.tag_id].tags[s.tag.tag_id].size_m for s in mine])
        corners = np.array([s.tag.corners_px for s in mine]).reshape(-1, 4, 2)
        for s, (poses, errors) in zip(mine, planar_poses(camera.model, sizes, corners), strict=True):
            body = owner[s.tag.tag_id]
            (ax, ay), (bx, by) = s.tag.corners_px[2] - s.tag.corners_px[0], s.tag.corners_px[3] - s.tag.corners_px[1]
            out.append(
                Observation(
                    s.time_ns,
                    number,
                    config.bodies[0],
                    body,
                    body.tags[s.tag.tag_id],
                    s.tag.corners_px,
                    poses,
                    errors,
                    0.5 * abs(float(ax * by - ay * bx)),
                    float(np.hypot(s.tag.sigma_px, settings.corner_floor_px)),
                )
            )
    return tuple(out)


def _order(detections: Detections, index: Mapping[Key, int]) -> Order:
    toss_of = {s.time_ns: s.toss for s in detections.seen}
    found: dict[int, list[tuple[int, int]]] = {toss: [] for toss in detections.frames}
    for key, number in index.items():
        if key[:2] == ("body", BODY):
            found[toss_of[key[2]]].append((key[2], number))
    return {
        toss: (np.array([t for t, _ in sorted(rows)], np.int64), np.array([n for _, n in sorted(rows)], np.int64))
        for toss, rows in found.items()
    }


def _let_cameras_drift(
    graph: Graph, problem: Problem, index: Mapping[Key, int], detections: Detections, config: SolveConfig
) -> dict[tuple[str, int], int]:
    """Each camera gets a pose of its own in each toss, tied to its place: a bumped one shows."""
    if len(detections.frames) < 2:
        return {}
    toss_of = {s.time_ns: s.toss for s in detections.seen}
    placed = [o for o in problem.observations if all(k in index for k in chain(problem, o))]
    drifting: dict[tuple[str, int], int] = {}
    for i, (o, p) in enumerate(zip(placed, graph.projections, strict=True)):
        camera = problem.config.cameras[o.camera].name
        toss = toss_of[o.stamp_ns]
        if (camera, toss) not in drifting:
            number = graph.add_pose(f"{camera} in toss {toss}", graph.start[p.rig_from_camera], None)
            graph.betweens.append(Between(p.rig_from_camera, number, np.eye(4), _noise(config.drift_sigma)))
            drifting[(camera, toss)] = number
        graph.projections[i] = replace(p, rig_from_camera=drifting[(camera, toss)])
    return drifting


def _without_wrong_places(
    graph: Graph,
    solution: Solution,
    problem: Problem,
    index: Mapping[Key, int],
    config: SolveConfig,
    solver: SolverConfig,
) -> tuple[Solution, tuple[str, ...], Tension, float]:
    """Cameras that what was seen pulls away from their calibrated places: their places hardly count any more, the most
    pulled one first. Two stay as they are, or nothing but the table would hold the world. Also the largest
    contradiction that remains, and how likely it is by chance."""
    names = {index[camera_key(c.name)]: c.name for c in problem.config.cameras if camera_key(c.name) in index}
    loosened: list[str] = []
    while True:
        held = {i: p for i, p in enumerate(graph.priors) if p.pose in names and names[p.pose] not in loosened}
        spread = covariances(solution, [p.pose for p in held.values()])
        pulled = {i: tension(p, solution.poses, C) for (i, p), C in zip(held.items(), spread, strict=True)}
        if not pulled:
            return solution, tuple(loosened), Tension(), 1.0
        worst = min(pulled, key=lambda i: (pulled[i].chance(), -pulled[i].deviations))
        by_chance = pulled[worst].chance(len(held))
        if by_chance > config.false_alarm or len(held) <= 2:
            return solution, tuple(loosened), pulled[worst], by_chance
        prior = graph.priors[worst]
        loosened.append(names[prior.pose])
        graph.priors[worst] = replace(prior, root_information=prior.root_information / config.loose_factor)
        graph.start = list(solution.poses)
        solution = solve(graph, solver)


def _widened(solved: Solved, times: float) -> Solved:
    """Deviations as wide as the calibrated places turn out to be wrong: a bump too small to be named still counts."""
    tracks = {toss: replace(t, covariance=t.covariance * times**2) for toss, t in solved.tracks.items()}
    cameras = {name: C * times**2 for name, C in solved.camera_covariance.items()}
    return replace(solved, tracks=tracks, camera_covariance=cameras, tension=times)


def _solved(
    problem: Problem,
    detections: Detections,
    graph: Graph,
    index: Mapping[Key, int],
    solution: Solution,
    drifting: Mapping[tuple[str, int], int],
    center: Float[Array, "3"],
    initial: Initialisation,
) -> Solved:
    order = _order(detections, index)
    poses = solution.poses
    names = {c.name: index[camera_key(c.name)] for c in problem.config.cameras if camera_key(c.name) in index}
    corners = _corners(problem, detections, graph, index, solution)
    factor = _noise_factor(corners)
    wanted = [int(n) for _, numbers in order.values() for n in numbers] + list(names.values())
    spread = dict(zip(wanted, covariances(solution, wanted) * factor**2, strict=True))
    in_flight = {arc.poses[1] for arc in graph.arcs if min(arc.weight, arc.turn_weight) > 0.4}
    seen_by: dict[int, list[TagSeen]] = {}
    on_body = problem.config.body(BODY).tags
    for s in detections.seen:
        if s.tag.tag_id in on_body:
            seen_by.setdefault(s.time_ns, []).append(s)
    tracks = {
        toss: BodyTrack(
            times,
            poses[numbers],
            np.array([spread[int(n)] for n in numbers]).reshape(-1, 6, 6),
            np.array([int(n) in in_flight for n in numbers], dtype=bool),
            tuple(len({s.tag.tag_id for s in seen_by[int(t)]}) for t in times),
            tuple(len({s.camera for s in seen_by[int(t)]}) for t in times),
        )
        for toss, (times, numbers) in order.items()
    }
    return Solved(
        tracks=tracks,
        layout={i: poses[index[tag_key(i)]] @ FLIP for i in sorted(on_body) if tag_key(i) in index},
        sizes_m={i: tag.size_m for i, tag in problem.tags.items()},
        cameras={name: poses[number] for name, number in names.items()},
        camera_covariance={name: spread[number] for name, number in names.items()},
        moved=_moved({key: poses[number] for key, number in drifting.items()}),
        center_m=center,
        corners=corners,
        unplaced=tuple(" ".join(k[:2]) for k in initial.missing()),
        table_off_m={
            i: float(np.linalg.norm(poses[index[tag_key(i)]][:3, 3] - tag.pose.pose[:3, 3]))
            for i, tag in problem.config.body(WORLD).tags.items()
            if tag.pose is not None and tag_key(i) in index
        },
        arcs=len(in_flight),
    )


def _moved(places: Mapping[tuple[str, int], Float[Array, "4 4"]]) -> dict[tuple[str, int], tuple[float, float]]:
    """How far each camera stood, in each toss, from where it stood in most (the place nearest to all its others)."""
    found: dict[tuple[str, int], tuple[float, float]] = {}
    for camera in sorted({name for name, _ in places}):
        mine = {toss: pose for (name, toss), pose in places.items() if name == camera}
        usual = min(
            mine.values(), key=lambda p: sum(_difference(p, q)[1] + 0.5 * _difference(p, q)[0] for q in mine.values())
        )
        found |= {(camera, toss): _difference(usual, pose) for toss, pose in mine.items()}
    return found


def _difference(a: Float[Array, "4 4"], b: Float[Array, "4 4"]) -> tuple[float, float]:
    xi = se3.log((np.linalg.inv(a) @ b)[None])[0]
    return float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:]))


def _corners(
    problem: Problem, detections: Detections, graph: Graph, index: Mapping[Key, int], solution: Solution
) -> tuple[Corner, ...]:
    toss_of = {s.time_ns: s.toss for s in detections.seen}
    placed = [o for o in problem.observations if all(k in index for k in chain(problem, o))]
    left = -solution.residuals_px
    return tuple(
        Corner(
            toss_of[o.stamp_ns],
            problem.config.cameras[o.camera].name,
            o.stamp_ns,
            o.tag.tag_id,
            o.corners_px,
            left[i],
            graph.projections[i].sigma_px,
        )
        for i, o in enumerate(placed)
    )


def _noise_factor(corners: tuple[Corner, ...]) -> float:
    """By how much the corners' residuals exceed their stated noise: robust, never below 1."""
    scaled = np.concatenate([(c.left_px / c.sigma_px).ravel() for c in corners])
    return max(1.0, MAD_TO_SIGMA * float(np.median(np.abs(scaled))))
