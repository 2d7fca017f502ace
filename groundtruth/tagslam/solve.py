"""TagSLAM's job: poses of bodies, tags and cameras from tag detections, jointly (Pfrommer and Daniilidis 2019)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from groundtruth import se3
from groundtruth.factors import CORNERS, Between, Coordinate, Distance, Prior, Projection
from groundtruth.graph import Graph, Solution, SolverConfig, Undetermined, solve
from groundtruth.tagslam.config import DEFAULT_WIGGLE, BodyEntry, TagSlamConfig
from groundtruth.tagslam.detections import Recording
from groundtruth.tagslam.initialisation import STAGES, Initialisation, InitialisationConfig, chain
from groundtruth.tagslam.problem import (
    Key,
    Observation,
    Problem,
    body_key,
    camera_key,
    make_problem,
    tag_key,
    unambiguous,
)
from recordings.progress import Progress, Silent


@dataclass(frozen=True)
class TagSlamSettings:
    initialisation: InitialisationConfig = field(default_factory=InitialisationConfig)
    solver: SolverConfig = field(default_factory=lambda: SolverConfig(huber_px=None))
    """Without a robust kernel by default: that is what TagSLAM answers to a configuration of its own."""
    initial_solver: SolverConfig = field(default_factory=lambda: SolverConfig(iterations=6, weakest=0.0, huber_px=3.0))
    """Between sweeps of the initialisation, so that drift does not add up."""
    solve_after_ratio: float = 1.4
    """That is done when this many times as many poses are placed, or no more can be,"""
    solve_after: int = 300
    """or, while there are few poses, when one that does not move is among the new ones, or so many are new."""


@dataclass(frozen=True, eq=False)
class TagSlamResult:
    """`bodies[name]`: stamps and world_from_body (n, 4, 4) of moving bodies; `static[name]`: one pose;
    `tags[id]`: body_from_tag; `cameras[name]`: rig_from_camera. `reprojection_px`: every corner's distance."""

    bodies: Mapping[str, tuple[tuple[int, ...], Float[Array, "n 4 4"]]]
    static: Mapping[str, Float[Array, "4 4"]]
    tags: Mapping[int, Float[Array, "4 4"]]
    owner: Mapping[int, str]
    cameras: Mapping[str, Float[Array, "4 4"]]
    reprojection_px: Float[Array, " m"]
    unplaced: tuple[str, ...]
    solution: Solution
    index: Mapping[Key, int]


def run_tag_slam(
    config: TagSlamConfig,
    recording: Recording,
    settings: TagSlamSettings | None = None,
    progress: Progress | None = None,
    most_frames: int | None = None,
) -> TagSlamResult:
    """Solve a configuration on its recording. Raises BadInput for unusable input, Undetermined for a singular graph."""
    settings, progress = settings or TagSlamSettings(), progress or Silent()
    problem = make_problem(config, recording, most_frames)
    return (
        solve_with_amnesia(problem, settings, progress)
        if config.amnesia
        else solve_at_once(problem, settings, progress)
    )


def solve_at_once(problem: Problem, settings: TagSlamSettings, progress: Progress) -> TagSlamResult:
    """All stamps in one graph."""
    initial = Initialisation(problem, settings.initialisation)
    initialise(problem, initial, settings, progress)
    graph, index = build_graph(problem, initial.poses)
    if not graph.projections:
        raise Undetermined(sorted(_spoken(k) for k in initial.missing())[:3] or ["nothing"], _nothing_placed(problem))
    return _result(problem, initial, index, solve(graph, settings.solver))


def _nothing_placed(problem: Problem) -> str:
    if not problem.observations:
        return "no camera saw a tag of any body at a stamp that all topics share"
    return "no tag is connected to a pose that the configuration knows; give one a pose"


def solve_with_amnesia(problem: Problem, settings: TagSlamSettings, progress: Progress) -> TagSlamResult:
    """Every stamp alone, with what the configuration knows and the moving bodies' poses one stamp before, each held to
    a millimetre and a milliradian. What a stamp finds of tags and cameras is forgotten with it."""
    seen: dict[int, list[Observation]] = {}
    for o in problem.observations:
        seen.setdefault(o.stamp_ns, []).append(o)
    before: dict[Key, Float[Array, "4 4"]] = {}
    answers: list[TagSlamResult] = []
    for done, stamp in enumerate(problem.stamps):
        earlier = problem.stamps[done - 1 : done]
        alone = replace(problem, stamps=(*earlier, stamp), observations=tuple(seen.get(stamp, ())))
        initial = Initialisation(alone, settings.initialisation)
        initial.poses |= before
        initialise(alone, initial, settings, Silent())
        graph, index = build_graph(alone, initial.poses)
        graph.priors += [Prior(index[key], pose, 1e3 * np.eye(6)) for key, pose in before.items()]
        answers.append(_result(replace(alone, stamps=(stamp,)), initial, index, solve(graph, settings.solver)))
        now = {key: answers[-1].solution.poses[number] for key, number in index.items()}
        before = {key: pose for key, pose in now.items() if key[0] == "body" and key[2] == stamp}
        progress.step(done + 1, len(problem.stamps), "stamps solved")
    if not answers or not any(len(a.reprojection_px) for a in answers):
        raise Undetermined(["nothing"], _nothing_placed(problem))
    return _joined(answers)


def _joined(answers: list[TagSlamResult]) -> TagSlamResult:
    """All stamps' bodies; everything else as it was last seen."""
    bodies = {}
    for name in answers[-1].bodies:
        stamps = tuple(s for a in answers for s in a.bodies[name][0])
        bodies[name] = (stamps, np.concatenate([a.bodies[name][1] for a in answers]))
    return replace(
        answers[-1],
        bodies=bodies,
        tags={t: pose for a in answers for t, pose in a.tags.items()},
        reprojection_px=np.concatenate([a.reprojection_px for a in answers]),
        unplaced=tuple(sorted({name for a in answers for name in a.unplaced})),
    )


def initialise(problem: Problem, initial: Initialisation, settings: TagSlamSettings, progress: Progress) -> None:
    """Sweep until nothing more can be placed, bolder from stage to stage. What there is is solved in between."""
    solved_at, fixed_at = 0, initial.fixed()
    for stage in STAGES:
        while not stage.drifted or problem.odometry:
            placed = initial.sweep(stage)
            placed += _carry_odometry(problem, initial)
            placed += _carry_rest(problem, initial) if stage.at_rest and not placed else 0
            progress.step(initial.wanted - len(initial.missing()), initial.wanted, "poses placed")
            new = len(initial.poses) - solved_at
            enough = settings.solve_after if initial.fixed() == fixed_at else 1
            due = not placed or new >= max(enough, (settings.solve_after_ratio - 1) * solved_at)
            if due and new and initial.missing():
                solved_at, fixed_at = len(initial.poses), initial.fixed()
                _settle(problem, initial, settings)
            elif not placed:
                break


def _settle(problem: Problem, initial: Initialisation, settings: TagSlamSettings) -> None:
    """Solve what is placed so far, so that drift does not add up."""
    graph, index = build_graph(problem, initial.poses)
    try:
        solution = solve(graph, settings.initial_solver)
    except Undetermined:
        return  # a part that is still loose: the final solution says so if it stays
    for key, number in index.items():
        if key in initial.poses:
            initial.poses[key] = solution.poses[number]


def build_graph(problem: Problem, poses: Mapping[Key, Float[Array, "4 4"]]) -> tuple[Graph, dict[Key, int]]:
    """All factors whose poses are placed."""
    config = problem.config
    graph = Graph([c.model for c in config.cameras])
    index = {key: graph.add_pose(_spoken(key), pose, key[2] or None) for key, pose in poses.items()}
    _add_priors(problem, graph, index)
    eyes: dict[tuple[int, int], int] = {}
    for o in problem.observations:
        keys = chain(problem, o)
        if all(k in index for k in keys):
            camera, rig, body, tag = (index[k] for k in keys)
            eye = _eye(config, o, camera, graph, eyes)
            graph.projections.append(
                Projection(o.camera, eye, rig, body, tag, o.tag.size_m, o.corners_px, o.sigma_px or config.pixel_noise)
            )
    _add_odometry(problem, graph, index)
    _add_measurements(problem, graph, index)
    return graph, index


def _spoken(key: Key) -> str:
    return f"{key[0]} {key[1]}" + (f" at {key[2]} ns" if key[2] else "")


def _eye(config: TagSlamConfig, o: Observation, camera: int, graph: Graph, eyes: dict[tuple[int, int], int]) -> int:
    """The camera's pose at this stamp: its own variable, tied to the rig, where the configuration lets it wiggle."""
    turn, shift = config.cameras[o.camera].wiggle
    if max(turn, shift) <= DEFAULT_WIGGLE:
        return camera
    at = (o.camera, o.stamp_ns)
    if at not in eyes:
        eyes[at] = graph.add_pose(f"{graph.names[camera]} at {o.stamp_ns} ns", graph.start[camera], o.stamp_ns)
        root = np.diag([1 / turn] * 3 + [1 / shift] * 3)
        graph.betweens.append(Between(camera, eyes[at], np.eye(4), root))
    return eyes[at]


def _add_priors(problem: Problem, graph: Graph, index: Mapping[Key, int]) -> None:
    known: list[tuple[Key, Any]] = []
    known += [(body_key(b, 0), b.pose) for b in problem.config.bodies if b.is_static]
    known += [(camera_key(c.name), c.pose) for c in problem.config.cameras]
    known += [(tag_key(t), entry.pose) for t, entry in problem.tags.items()]
    for key, pose in known:
        if key in index and pose is not None:
            graph.priors.append(Prior(index[key], pose.pose, pose.root_information))


def _with_odometry(problem: Problem) -> list[BodyEntry]:
    return [b for b in problem.config.bodies if b.name in problem.odometry]


def _with_fake_odometry(problem: Problem) -> list[BodyEntry]:
    """Moving bodies that are taken to stay about where they are; nowhere where there is real odometry."""
    if problem.odometry:
        return []
    return [b for b in problem.config.bodies if b.fake_odom_noise is not None and not b.is_static]


def _odometry_steps(problem: Problem, body: BodyEntry) -> list[tuple[int, int, Float[Array, "4 4"], Float[Array, "6"]]]:
    """(stamp before, stamp after, relative pose of the body, standard deviations (6,)) between answered stamps.

    The noise is TagSLAM's: by how much a step departs from constant velocity, within acceleration x dt^2.
    """
    poses, T, out = problem.odometry[body.name], body.body_from_odom, []
    stamps = list(poses)
    last_w, last_v = np.zeros(3), np.zeros(3)
    for before, after in zip(stamps[:-1], stamps[1:], strict=True):
        delta = T @ np.linalg.inv(poses[before]) @ poses[after] @ np.linalg.inv(T)
        dt = max((after - before) / 1e9, 1e-3)
        turn, shift = se3.log(delta[None])[0][:3], delta[:3, 3]
        rotation = _within(np.linalg.norm(turn - last_w * dt) / dt**2, body.odom_angular_acceleration) * dt**2
        position = _within(np.linalg.norm(shift - last_v * dt) / dt**2, body.odom_acceleration) * dt**2
        last_w, last_v = turn / dt, shift / dt
        if body.odom_noise is not None:
            rotation, position = body.odom_noise
        out.append((before, after, delta, np.array([rotation] * 3 + [position] * 3)))
    return out


def _within(value: float | np.floating, least_and_most: tuple[float, float]) -> float:
    return min(max(float(value), least_and_most[0]), least_and_most[1])


def _add_odometry(problem: Problem, graph: Graph, index: Mapping[Key, int]) -> None:
    for body in _with_odometry(problem):
        for before, after, delta, sigma in _odometry_steps(problem, body):
            a, b = index.get(body_key(body, before)), index.get(body_key(body, after))
            if a is not None and b is not None:
                graph.betweens.append(Between(a, b, delta, np.diag(1 / sigma)))
    for body in _with_fake_odometry(problem):
        assert body.fake_odom_noise is not None
        turn, shift = body.fake_odom_noise
        placed = [s for s in problem.stamps if body_key(body, s) in index]
        for before, after in zip(placed[:-1], placed[1:], strict=True):
            a, b = index[body_key(body, before)], index[body_key(body, after)]
            graph.betweens.append(Between(a, b, np.eye(4), np.diag([1 / turn] * 3 + [1 / shift] * 3)))


def _carry_odometry(problem: Problem, initial: Initialisation) -> int:
    """Place poses next to placed ones along the odometry; how many were."""
    placed = 0
    for body in _with_odometry(problem):
        steps = _odometry_steps(problem, body)
        both_ways = [(a, b, d) for a, b, d, _ in steps] + [(b, a, np.linalg.inv(d)) for a, b, d, _ in reversed(steps)]
        for known, new, delta in both_ways:
            before, after = initial.poses.get(body_key(body, known)), body_key(body, new)
            if before is not None and after not in initial.poses:
                initial.poses[after] = before @ delta
                placed += 1
    return placed


def _carry_rest(problem: Problem, initial: Initialisation) -> int:
    """Place a body with fake odometry where it was, or will be, one stamp away; how many poses were placed.

    One pose a body in each direction from every gap's end: what comes after may connect by its tags.
    """
    placed = 0
    for body in _with_fake_odometry(problem):
        keys = [body_key(body, s) for s in problem.stamps]
        known = [k in initial.poses for k in keys]
        for i, key in enumerate(keys):
            neighbours = [j for j in (i - 1, i + 1) if 0 <= j < len(keys) and known[j]]
            if not known[i] and neighbours:
                initial.poses[key] = initial.poses[keys[neighbours[0]]]
                placed += 1
    return placed


def _add_measurements(problem: Problem, graph: Graph, index: Mapping[Key, int]) -> None:
    """Distances, coordinates and planes between corners (or the centre: -1) of tags on static bodies."""

    def place(tag_id: int) -> tuple[int, int] | None:
        owner = problem.owner.get(tag_id)
        if owner is None or tag_key(tag_id) not in index or body_key(owner, 0) not in index:
            return None
        return index[body_key(owner, 0)], index[tag_key(tag_id)]

    def point(tag_id: int, corner: int) -> Float[Array, "3"]:
        return np.zeros(3) if corner < 0 else problem.tags[tag_id].size_m * CORNERS[corner]

    def coordinate(tag_id: int, corner: int, m: Mapping[str, Any], length: float) -> None:
        at = place(tag_id)
        if at is not None:
            direction = np.array(m["direction"], dtype=np.float64)
            graph.coordinates.append(Coordinate(*at, point(tag_id, corner), direction, length, float(m["noise"])))

    for m in problem.config.planes:
        for tag_id in m["tags"]:
            coordinate(int(tag_id), -1, m, float(m["distance"]))
    for m in problem.config.coordinates:
        coordinate(int(m["tag"]), int(m["corner"]), m, float(m["length"]))
    for m in problem.config.distances:
        a, b = int(m["tag1"]), int(m["tag2"])
        first, second = place(a), place(b)
        if first is not None and second is not None:
            points = (point(a, int(m["corner1"])), point(b, int(m["corner2"])))
            graph.distances.append(
                Distance((first[0], second[0]), (first[1], second[1]), points, float(m["distance"]), float(m["noise"]))
            )


def _certain(problem: Problem) -> set[Key]:
    """Moving poses that some unambiguous detection shows. TagSLAM answers no others, unless odometry carries them."""
    return {
        key for o in problem.observations if unambiguous(problem.config, o) for key in (o.rig_key, o.body_key) if key[2]
    }


def _result(problem: Problem, initial: Initialisation, index: Mapping[Key, int], solution: Solution) -> TagSlamResult:
    poses = {key: solution.poses[number] for key, number in index.items()}
    bodies, static = {}, {}
    certain = _certain(problem)
    for body in problem.config.bodies:
        if body.is_static:
            if body_key(body, 0) in poses:
                static[body.name] = poses[body_key(body, 0)]
            continue
        carried = body.name in problem.odometry or body in _with_fake_odometry(problem)
        answered = poses.keys() if carried else poses.keys() & certain
        stamps = tuple(s for s in problem.stamps if body_key(body, s) in answered)
        stack = np.stack([poses[body_key(body, s)] for s in stamps]) if stamps else np.zeros((0, 4, 4))
        bodies[body.name] = (stamps, stack)
    return TagSlamResult(
        bodies=bodies,
        static=static,
        tags={t: poses[tag_key(t)] for t in problem.tags if tag_key(t) in poses},
        owner={t: b.name for t, b in problem.owner.items()},
        cameras={c.name: poses[camera_key(c.name)] for c in problem.config.cameras if camera_key(c.name) in poses},
        reprojection_px=solution.reprojection_px.ravel(),
        unplaced=tuple(_spoken(k) for k in initial.missing()),
        solution=solution,
        index=index,
    )
