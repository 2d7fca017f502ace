"""First values for every pose, grown outwards from what the configuration knows.

A pose is placed once everything else in some observation's chain is placed: each of the tag's two planar solutions
proposes one, and the proposal under which all its observations project best wins. Poses that only one ambiguous tag
shows wait until the others are there, and then take the solution nearer to their neighbours in time.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from groundtruth import se3
from groundtruth.factors import CORNERS
from groundtruth.problem import Key, Observation, Problem, camera_key, tag_key


@dataclass(frozen=True)
class GrowConfig:
    most_proposers: int = 12
    """Observations that propose a pose, the largest tags first."""
    most_judges: int = 40
    """Observations that a proposal is judged on."""
    accept_px: float = 6.0
    """Median corner error of the best proposal; beyond it the pose waits."""
    clear: float = 0.6
    """A single tag is unambiguous when its better solution's error is below this share of the other's."""
    cap_px: float = 25.0
    """An observation's error counts no more than this."""


class Growth:
    """The poses placed so far, and the observations by the poses in their chains."""

    def __init__(self, problem: Problem, config: GrowConfig) -> None:
        self.problem = problem
        self.config = config
        self.poses: dict[Key, Float[Array, "4 4"]] = {}
        self.touching: dict[Key, list[Observation]] = defaultdict(list)
        for o in problem.observations:
            for key in chain(problem, o):
                self.touching[key].append(o)
        self._place_known()

    def _place_known(self) -> None:
        for body in self.problem.config.bodies:
            if body.is_static:
                self.poses[("body", body.name, 0)] = body.pose.pose if body.pose else np.eye(4)
        for camera in self.problem.config.cameras:
            if camera.pose is not None:
                self.poses[camera_key(camera.name)] = camera.pose.pose
        for tag_id, tag in self.problem.tags.items():
            if tag.pose is not None:
                self.poses[tag_key(tag_id)] = tag.pose.pose

    def missing(self) -> list[Key]:
        return [k for k in self.touching if k not in self.poses]

    def sweep(self, ambiguous_too: bool) -> int:
        """Try to place every missing pose once; how many were."""
        placed = 0
        for key in self.missing():
            ready = [o for o in self.touching[key] if all(k in self.poses or k == key for k in chain(self.problem, o))]
            pose = self._propose(key, ready, ambiguous_too) if ready else None
            if pose is not None:
                self.poses[key] = pose
                placed += 1
        return placed

    def _propose(self, key: Key, ready: list[Observation], ambiguous_too: bool) -> Float[Array, "4 4"] | None:
        ready = sorted(ready, key=lambda o: -o.area_px2)
        candidates = [
            (self._through(key, o, solution), o, i)
            for o in ready[: self.config.most_proposers]
            for i, solution in enumerate(o.candidates)
        ]
        if not candidates:
            return None
        judges = _spread(ready, self.config.most_judges)
        scores = [self._score(key, pose, judges) for pose, _, _ in candidates]
        best = int(np.argmin(scores))
        if scores[best] > self.config.accept_px:
            return None
        if len(ready) == 1 and len(candidates) == 2 and scores[best] > self.config.clear * scores[1 - best]:
            if not ambiguous_too:
                return None
            near = self._neighbour(key)
            if near is not None:
                return min((c[0] for c in candidates), key=lambda pose: _turn(near, pose))
        return candidates[best][0]

    def _through(self, key: Key, o: Observation, camera_from_tag: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
        """The pose of `key` that makes the tag lie at `camera_from_tag`."""
        eye, rig, body, tag = chain(self.problem, o)
        P, inv = self.poses, np.linalg.inv
        if key == tag:
            return inv(P[body]) @ P[rig] @ P[eye] @ camera_from_tag
        world_from_tag_through = {
            rig: lambda: P[body] @ P[tag] @ inv(camera_from_tag) @ inv(P[eye]),
            body: lambda: P[rig] @ P[eye] @ camera_from_tag @ inv(P[tag]),
            eye: lambda: inv(P[rig]) @ P[body] @ P[tag] @ inv(camera_from_tag),
        }
        return world_from_tag_through[key]()

    def _score(self, key: Key, pose: Float[Array, "4 4"], judges: Sequence[Observation]) -> float:
        return float(np.median([self._error_px(o, {key: pose}) for o in judges]))

    def _error_px(self, o: Observation, instead: dict[Key, Float[Array, "4 4"]]) -> float:
        eye, rig, body, tag = (instead[k] if k in instead else self.poses[k] for k in chain(self.problem, o))
        camera_from_tag = se3.inverse(rig @ eye) @ body @ tag
        points = o.tag.size_m * CORNERS @ camera_from_tag[:3, :3].T + camera_from_tag[:3, 3]
        if (points[:, 2] < 1e-2).any():
            return self.config.cap_px
        pixels = self.problem.config.cameras[o.camera].model.project(points)
        return min(float(np.linalg.norm(pixels - o.corners_px, axis=1).mean()), self.config.cap_px)

    def _neighbour(self, key: Key) -> Float[Array, "4 4"] | None:
        """The placed pose of the same body that is nearest in time."""
        same = [k for k in self.poses if k[:2] == key[:2] and k[2] != 0]
        return self.poses[min(same, key=lambda k: abs(k[2] - key[2]))] if same and key[2] else None


def chain(problem: Problem, o: Observation) -> tuple[Key, Key, Key, Key]:
    """Keys of camera, rig, body and tag of an observation."""
    return camera_key(problem.config.cameras[o.camera].name), o.rig_key, o.body_key, tag_key(o.tag.tag_id)


def _turn(a: Float[Array, "4 4"], b: Float[Array, "4 4"]) -> float:
    return float(np.arccos(np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2, -1, 1)))


def _spread(items: list[Observation], most: int) -> list[Observation]:
    return items[:: max(1, len(items) // most)][:most]
