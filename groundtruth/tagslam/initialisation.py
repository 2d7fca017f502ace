"""First values for every pose, initialised incrementally from what the configuration knows.

A pose is placed once everything else in some observation's chain is placed. The chain of an observation is

    camera_from_tag = eye^-1 rig^-1 body tag = L X R

with X the missing pose or its inverse. Each of a tag's two planar solutions proposes an X; the proposal under which all
observations of the pose project best wins, and is then refined on all of them. Poses that only one ambiguous tag shows
wait until the others are there, and then take the solution nearer to their neighbours in time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from calibration.cameras.poses import inverse_poses
from groundtruth import se3
from groundtruth.factors import CORNERS
from groundtruth.tagslam.problem import Key, Observation, Problem, camera_key, tag_key
from recordings.estimation.levenberg_marquardt import Expansion, minimised
from recordings.estimation.robust import huber_cost, huber_weight

EYE, RIG, BODY, TAG = range(4)


@dataclass(frozen=True)
class InitialisationConfig:
    most_proposers: int = 12
    """Observations that propose a pose, the largest tags first."""
    most_judges: int = 40
    """Observations that a proposal is judged on."""
    accept_px: float = 6.0
    """Median corner error of the best proposal; beyond it the pose waits."""
    accept_rad: float = 0.005
    """The same as an angle, for long lenses; the larger of the two counts."""
    clear: float = 0.6
    """A single tag is unambiguous when its better solution's error is below this share of the other's."""
    cap_px: float = 25.0
    """An observation's error counts no more than this."""
    refinements: int = 4
    """Gauss-Newton steps on a proposal."""


@dataclass(frozen=True)
class Stage:
    """How bold initialisation is: first what is certain, the rest only where nothing else is left."""

    ambiguous_too: bool = False
    """Also what a single tag shows whose two solutions are alike."""
    strictness: float = 1.0
    """Accept only errors this many times smaller."""
    agreeing: float = 0.5
    """Share of the observations that must agree with a proposal."""
    drifted: bool = False
    """Only where there is odometry: it drifts, so early and late detections of a tag disagree until it is placed."""
    at_rest: bool = False
    """Place a body with fake odometry where it was one stamp away."""


STAGES = (
    Stage(strictness=3.0),
    Stage(),
    Stage(ambiguous_too=True),
    Stage(ambiguous_too=True, agreeing=0.2),
    Stage(ambiguous_too=True, agreeing=0.05, drifted=True),
    Stage(ambiguous_too=True, at_rest=True),
)


@dataclass(frozen=True, eq=False)
class _Ready:
    """Observations of one missing pose: camera_from_tag = left X right."""

    left: Float[Array, "n 4 4"]
    right: Float[Array, "n 4 4"]
    inverted: bool
    corners_px: Float[Array, "n 4 2"]
    corners_tag_m: Float[Array, "n 4 3"]
    camera: Int[Array, " n"]
    candidates: tuple[Float[Array, "k 4 4"], ...]


class Initialisation:
    """The poses placed so far, and the observations by the poses in their chains."""

    def __init__(self, problem: Problem, config: InitialisationConfig) -> None:
        self.problem = problem
        self.config = config
        self.poses: dict[Key, Float[Array, "4 4"]] = {}
        chains = [chain(problem, o) for o in problem.observations]
        self._keys: list[Key] = list(dict.fromkeys(key for keys in chains for key in keys))
        number = {key: i for i, key in enumerate(self._keys)}
        self._chains = np.array([[number[k] for k in keys] for keys in chains], dtype=np.int64).reshape(-1, 4)
        self._corners_px = np.array([o.corners_px for o in problem.observations]).reshape(-1, 4, 2)
        self._sizes_m = np.array([o.tag.size_m for o in problem.observations])
        self._cameras = np.array([o.camera for o in problem.observations], dtype=np.int64)
        self._areas = np.array([o.area_px2 for o in problem.observations])
        self._place_known()

    def fixed(self) -> int:
        """How many poses that do not move are placed."""
        return sum(not key[2] for key in self.poses)

    @property
    def wanted(self) -> int:
        """How many poses the observations touch."""
        return len(self._keys)

    def _place_known(self) -> None:
        for body in self.problem.config.bodies:
            if body.is_static and body.pose is not None:
                self.poses[("body", body.name, 0)] = body.pose.pose
        for camera in self.problem.config.cameras:
            if camera.pose is not None:
                self.poses[camera_key(camera.name)] = camera.pose.pose
        for tag_id, tag in self.problem.tags.items():
            if tag.pose is not None:
                self.poses[tag_key(tag_id)] = tag.pose.pose

    def missing(self) -> list[Key]:
        return [k for k in self._keys if k not in self.poses]

    def sweep(self, stage: Stage) -> int:
        """Try to place, once, every pose that is all that is missing in some chain; how many were."""
        placed = 0
        stack, known = self._stacked()
        for number, place, observations in self._groups(known):
            key = self._keys[number]
            observations = observations[np.argsort(-self._areas[observations], kind="stable")]
            pose = self._propose(key, self._ready(observations, place, stack), stage)
            if pose is not None:
                self.poses[key] = pose
                placed += 1
        return placed

    def _stacked(self) -> tuple[Float[Array, "k 4 4"], Bool[Array, " k"]]:
        known = np.array([k in self.poses for k in self._keys], dtype=bool)
        nothing = np.eye(4)
        return np.array([self.poses.get(k, nothing) for k in self._keys]).reshape(-1, 4, 4), known

    def _groups(self, known: Bool[Array, " k"]) -> Iterator[tuple[int, int, Int[Array, " n"]]]:
        """(missing pose, its place in the chain, observations) for every pose that is the only missing one there."""
        have = known[self._chains] if len(self._chains) else np.zeros((0, 4), dtype=bool)
        ready = np.flatnonzero(have.sum(axis=1) == 3)
        place = np.argmin(have[ready], axis=1)
        missing = self._chains[ready, place]
        order = np.argsort(missing, kind="stable")
        for part in np.split(order, np.flatnonzero(np.diff(missing[order])) + 1):
            if len(part):
                yield int(missing[part[0]]), int(place[part[0]]), ready[part]

    def _ready(self, observations: Int[Array, " n"], place: int, poses: Float[Array, "k 4 4"]) -> _Ready:
        chosen = np.unique(np.concatenate([observations[: self.config.most_proposers], self._judges(observations)]))
        chosen = chosen[np.argsort(-self._areas[chosen], kind="stable")]
        eye, rig, body, tag = (poses[self._chains[chosen, i]] for i in range(4))
        same = np.broadcast_to(np.eye(4), eye.shape)
        left, right = {
            EYE: lambda: (same, inverse_poses(rig) @ body @ tag),
            RIG: lambda: (inverse_poses(eye), body @ tag),
            BODY: lambda: (inverse_poses(rig @ eye), tag),
            TAG: lambda: (inverse_poses(rig @ eye) @ body, same),
        }[place]()
        return _Ready(
            left,
            right,
            place in (EYE, RIG),
            self._corners_px[chosen],
            self._sizes_m[chosen, None, None] * CORNERS,
            self._cameras[chosen],
            tuple(self.problem.observations[i].candidates for i in chosen),
        )

    def _judges(self, observations: Int[Array, " n"]) -> Int[Array, " m"]:
        return observations[:: max(1, len(observations) // self.config.most_judges)][: self.config.most_judges]

    def _propose(self, key: Key, ready: _Ready, stage: Stage) -> Float[Array, "4 4"] | None:
        proposers = range(min(len(ready.candidates), self.config.most_proposers))
        candidates = [
            inverse_poses(ready.left[i]) @ c @ inverse_poses(ready.right[i])
            for i in proposers
            for c in ready.candidates[i]
        ]
        if not candidates:
            return None
        proposals = np.stack(candidates)
        scores = self._scores(ready, proposals, stage.agreeing)
        best = int(np.argmin(scores))
        x, score = proposals[best], scores[best]
        if (
            len(ready.camera) == 1
            and len(candidates) == 2
            and stage.strictness * score > self.config.clear * scores[1 - best]
        ):
            if not stage.ambiguous_too:
                return None
            near = self._neighbour(key)
            if near is not None:
                near = inverse_poses(near) if ready.inverted else near
                x = min(proposals, key=lambda pose: _turn(near, pose))
        elif len(ready.camera) > 1:
            x, score = self._refined(ready, x, float(score), stage.agreeing)
        focal_px = self.problem.config.cameras[ready.camera[0]].model.fx
        if stage.strictness * score > max(self.config.accept_px, self.config.accept_rad * focal_px):
            return None
        return inverse_poses(x) if ready.inverted else x

    def _scores(self, ready: _Ready, proposals: Float[Array, "m 4 4"], agreeing: float) -> Float[Array, " m"]:
        """The mean corner error (capped) that this share of the observations does not exceed."""
        camera_from_tag = ready.left[None] @ proposals[:, None] @ ready.right[None]
        points = (
            ready.corners_tag_m @ np.swapaxes(camera_from_tag[..., :3, :3], -1, -2) + camera_from_tag[..., None, :3, 3]
        )
        errors = np.linalg.norm(self._project(points, ready.camera) - ready.corners_px, axis=-1).mean(axis=-1)
        behind = (points[..., 2] < 1e-2).any(axis=-1)
        return np.quantile(
            np.where(behind, self.config.cap_px, np.minimum(errors, self.config.cap_px)), agreeing, axis=1
        )

    def _project(self, points: Float[Array, "*m n 4 3"], camera: Int[Array, " n"]) -> Float[Array, "*m n 4 2"]:
        safe = points.copy()
        safe[..., 2] = np.maximum(safe[..., 2], 1e-2)
        out = np.empty((*points.shape[:-1], 2))
        for number in np.unique(camera):
            mine = camera == number
            out[..., mine, :, :] = self.problem.config.cameras[number].model.project(safe[..., mine, :, :])
        return out

    def _refined(
        self, ready: _Ready, x: Float[Array, "4 4"], score: float, agreeing: float
    ) -> tuple[Float[Array, "4 4"], float]:
        """X refined with Huber's kernel at three times the agreeing ones' error; never a worse score."""
        in_x = ready.corners_tag_m @ np.swapaxes(ready.right[:, :3, :3], -1, -2) + ready.right[:, None, :3, 3]
        arm = np.concatenate([-se3.skew(in_x), np.broadcast_to(np.eye(3), (*in_x.shape, 3))], -1)

        def left(at: Array) -> tuple[Array, Array, Array]:
            camera_from_x = ready.left @ at
            points = in_x @ np.swapaxes(camera_from_x[:, :3, :3], -1, -2) + camera_from_x[:, None, :3, 3]
            return camera_from_x, points, self._project(points, ready.camera) - ready.corners_px

        def expanded(at: Array, reach: float) -> Expansion:
            camera_from_x, points, residual = left(at)
            size = np.linalg.norm(residual, axis=-1)
            root = np.sqrt(huber_weight(size, reach))[..., None]
            J = self._by_point(points, ready.camera) @ camera_from_x[:, None, :3, :3] @ arm
            return Expansion.of_residuals(residual * root, J * root[..., None], float(huber_cost(size, reach).sum()))

        best = x
        for _ in range(2):  # the reach follows what agrees
            size = np.linalg.norm(left(best)[2], axis=-1)
            cost = partial(expanded, reach=3 * max(float(np.quantile(size, agreeing)), 0.3))
            found = minimised(best, cost, lambda at, step: at @ se3.exp(step[None])[0], self.config.refinements, 1e-6)
            best = found.state
        refined = float(self._scores(ready, best[None], agreeing)[0])
        return (best, refined) if refined <= score else (x, score)

    def _by_point(self, points: Float[Array, "n 4 3"], camera: Int[Array, " n"]) -> Float[Array, "n 4 2 3"]:
        h = 1e-6 * np.maximum(points[..., 2:], 0.05)
        ahead, behind = (np.stack([points + s * h * axis for axis in np.eye(3)]) for s in (1, -1))
        change = self._project(ahead, camera) - self._project(behind, camera)
        return np.moveaxis(change / (2 * h), 0, -1)

    def _neighbour(self, key: Key) -> Float[Array, "4 4"] | None:
        """The placed pose of the same body that is nearest in time."""
        if not key[2]:
            return None
        same = [k for k in self.poses if k[:2] == key[:2] and k[2] != 0]
        return self.poses[min(same, key=lambda k: abs(k[2] - key[2]))] if same else None


def chain(problem: Problem, o: Observation) -> tuple[Key, Key, Key, Key]:
    """Keys of camera, rig, body and tag of an observation."""
    return camera_key(problem.config.cameras[o.camera].name), o.rig_key, o.body_key, tag_key(o.tag.tag_id)


def _turn(a: Float[Array, "4 4"], b: Float[Array, "4 4"]) -> float:
    return float(np.arccos(np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2, -1, 1)))
