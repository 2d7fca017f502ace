"""TagSLAM's job: poses of bodies, tags and cameras from tag detections, jointly (Pfrommer and Daniilidis 2019)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from groundtruth import se3
from groundtruth.detections import Recording
from groundtruth.factors import CORNERS, Between, Coordinate, Distance, Prior, Projection
from groundtruth.graph import Graph, Solution, SolverConfig, Undetermined, solve
from groundtruth.grow import GrowConfig, Growth, chain
from groundtruth.problem import (
    Key,
    Observation,
    Problem,
    body_key,
    camera_key,
    make_problem,
    moving_with_odometry,
    tag_key,
)
from groundtruth.tagslam_config import DEFAULT_WIGGLE, BodyEntry, TagSlamConfig
from recordings.progress import Progress, Silent


@dataclass(frozen=True)
class TagSlamSettings:
    grow: GrowConfig = field(default_factory=GrowConfig)
    solver: SolverConfig = field(default_factory=lambda: SolverConfig(huber_px=None))
    """Without a robust kernel by default: that is what TagSLAM answers to a configuration of its own."""
    growing_solver: SolverConfig = field(default_factory=lambda: SolverConfig(iterations=6, weakest=0.0))
    """Between sweeps of growing, so that drift does not add up."""
    corner_sigma_px: float | None = None
    """Standard deviation of a corner; None takes the configuration's `pixel_noise`."""


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
    growth = Growth(problem, settings.grow)
    _grow(problem, growth, settings, recording, progress)
    graph, index = build_graph(problem, growth.poses, recording, settings)
    solution = solve(graph, settings.solver)
    return _result(problem, growth, index, solution)


def _grow(
    problem: Problem, growth: Growth, settings: TagSlamSettings, recording: Recording, progress: Progress
) -> None:
    """Sweep until nothing more can be placed, solving what there is in between."""
    everything = len(growth.touching)
    for ambiguous_too in (False, True):
        while True:
            placed = growth.sweep(ambiguous_too)
            placed += _carry_odometry(problem, growth, recording)
            progress.step(everything - len(growth.missing()), everything, "poses placed")
            if not placed:
                break
            graph, index = build_graph(problem, growth.poses, recording, settings)
            try:
                solution = solve(graph, settings.growing_solver)
            except Undetermined:
                continue  # a part that is still loose: the final solution says so if it stays
            for key, number in index.items():
                if key in growth.poses:
                    growth.poses[key] = solution.poses[number]


def build_graph(
    problem: Problem, poses: Mapping[Key, Float[Array, "4 4"]], recording: Recording, settings: TagSlamSettings
) -> tuple[Graph, dict[Key, int]]:
    """All factors whose poses are placed."""
    config = problem.config
    graph = Graph([c.model for c in config.cameras])
    index = {key: graph.add_pose(_spoken(key), pose, key[2] or None) for key, pose in poses.items()}
    _add_priors(problem, graph, index)
    eyes: dict[tuple[int, int], int] = {}
    sigma = settings.corner_sigma_px or config.pixel_noise
    for o in problem.observations:
        keys = chain(problem, o)
        if all(k in index for k in keys):
            camera, rig, body, tag = (index[k] for k in keys)
            eye = _eye(config, o, camera, graph, eyes)
            graph.projections.append(Projection(o.camera, eye, rig, body, tag, o.tag.size_m, o.corners_px, sigma))
    _add_odometry(problem, graph, index, recording)
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
    for body in problem.config.bodies:
        if body.is_static:
            known.append((("body", body.name, 0), body.pose))
    known += [(camera_key(c.name), c.pose) for c in problem.config.cameras]
    known += [(tag_key(t), entry.pose) for t, entry in problem.tags.items()]
    for key, pose in known:
        if key in index and pose is not None:
            graph.priors.append(Prior(index[key], pose.pose, pose.root_information))


def _odometry_steps(
    problem: Problem, body: BodyEntry, odometry: Any
) -> list[tuple[int, int, Float[Array, "4 4"], Array]]:
    """(stamp before, stamp after, relative pose of the body, standard deviations (6,)) between answered stamps.

    The noise is TagSLAM's: by how much a step departs from constant velocity, at least acceleration x dt^2.
    """
    stamps, poses = odometry
    place = {int(s): i for i, s in enumerate(stamps)}
    here = [s for s in problem.stamps if s in place]
    T, out = body.body_from_odom, []
    last_w, last_v = np.zeros(3), np.zeros(3)
    for before, after in zip(here[:-1], here[1:], strict=True):
        delta = T @ np.linalg.inv(poses[place[before]]) @ poses[place[after]] @ np.linalg.inv(T)
        dt = max((after - before) / 1e9, 1e-3)
        turn, shift = se3.log(delta[None])[0][:3], delta[:3, 3]
        rotation = max(float(np.linalg.norm(turn - last_w * dt)), body.odom_angular_acceleration * dt**2)
        position = max(float(np.linalg.norm(shift - last_v * dt)), body.odom_acceleration * dt**2)
        last_w, last_v = turn / dt, shift / dt
        if body.odom_noise is not None:
            rotation, position = body.odom_noise
        out.append((before, after, delta, np.array([rotation] * 3 + [position] * 3)))
    return out


def _add_odometry(problem: Problem, graph: Graph, index: Mapping[Key, int], recording: Recording) -> None:
    for body, odometry in moving_with_odometry(problem.config, recording):
        for before, after, delta, sigma in _odometry_steps(problem, body, odometry):
            a, b = index.get(body_key(body, before)), index.get(body_key(body, after))
            if a is not None and b is not None:
                graph.betweens.append(Between(a, b, delta, np.diag(1 / sigma)))
    for body in problem.config.bodies:
        if body.fake_odom_noise is None or body.is_static:
            continue
        turn, shift = body.fake_odom_noise
        placed = [s for s in problem.stamps if body_key(body, s) in index]
        for before, after in zip(placed[:-1], placed[1:], strict=True):
            a, b = index[body_key(body, before)], index[body_key(body, after)]
            graph.betweens.append(Between(a, b, np.eye(4), np.diag([1 / turn] * 3 + [1 / shift] * 3)))


def _carry_odometry(problem: Problem, growth: Growth, recording: Recording) -> int:
    """Place poses next to placed ones along the odometry; how many were."""
    placed = 0
    for body, odometry in moving_with_odometry(problem.config, recording):
        steps = _odometry_steps(problem, body, odometry)
        both_ways = [(a, b, d) for a, b, d, _ in steps] + [(b, a, np.linalg.inv(d)) for a, b, d, _ in reversed(steps)]
        for known, new, delta in both_ways:
            before, after = growth.poses.get(body_key(body, known)), body_key(body, new)
            if before is not None and after not in growth.poses:
                growth.poses[after] = before @ delta
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


def _result(problem: Problem, growth: Growth, index: Mapping[Key, int], solution: Solution) -> TagSlamResult:
    poses = {key: solution.poses[number] for key, number in index.items()}
    bodies, static = {}, {}
    for body in problem.config.bodies:
        if body.is_static:
            static[body.name] = poses[("body", body.name, 0)]
            continue
        stamps = tuple(s for s in problem.stamps if body_key(body, s) in poses)
        stack = np.stack([poses[body_key(body, s)] for s in stamps]) if stamps else np.zeros((0, 4, 4))
        bodies[body.name] = (stamps, stack)
    return TagSlamResult(
        bodies=bodies,
        static=static,
        tags={t: poses[tag_key(t)] for t in problem.tags if tag_key(t) in poses},
        owner={t: b.name for t, b in problem.owner.items()},
        cameras={c.name: poses[camera_key(c.name)] for c in problem.config.cameras if camera_key(c.name) in poses},
        reprojection_px=solution.reprojection_px.ravel(),
        unplaced=tuple(_spoken(k) for k in growth.missing()),
        solution=solution,
        index=index,
    )
