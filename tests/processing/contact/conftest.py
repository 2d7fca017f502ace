"""Tosses of a box simulated with the project's own step, and the real ones where they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from processing.contact.physics.geometry import CORNERS
from processing.contact.physics.inertia import Physics, known_physics
from processing.contact.physics.loss import Body
from processing.contact.physics.rollout import Start, simulate
from processing.motion.trajectory import PoseSeries, rotation_matrices

HALF_M = np.array([0.05, 0.04, 0.03])
STEP_S = 1 / 148


@pytest.fixture(autouse=True)
def _one_thread():
    torch.set_num_threads(1)


def physics_of_the_box() -> Physics:
    square = (2 * HALF_M) ** 2
    return known_physics(0.37, np.diag(0.37 / 12 * (square.sum() - square)), source="the test's box")


def the_body() -> Body:
    def number(value):
        return torch.as_tensor(value, dtype=torch.float64)

    points = number(CORNERS * HALF_M)
    inertia = number(physics_of_the_box().inertia_kgm2)
    return Body(points, number(0.25), inertia)


@pytest.fixture
def box_physics() -> Physics:
    """Of the simulated box: 0.37 kg, uniform."""
    return physics_of_the_box()


@pytest.fixture
def box_body() -> Body:
    return the_body()


@pytest.fixture(scope="session")
def _all_tosses() -> list[PoseSeries]:
    rng, count, frames = np.random.default_rng(0), 10, 130
    rotation = rotation_matrices(rng.uniform(-2, 2, (count, 3)))
    position = np.column_stack([np.zeros((count, 2)), rng.uniform(0.13, 0.17, count)])
    spin = rng.uniform(-7, 7, (count, 3))
    velocity = np.column_stack([rng.uniform(-1, 1, (count, 2)), rng.uniform(-0.6, 0.2, count)])
    done = simulate(the_body(), 8, Start(rotation, position, spin, velocity), frames - 1, STEP_S)
    return [
        PoseSeries(
            i,
            STEP_S * np.arange(frames),
            np.concatenate([rotation[i : i + 1], done.rotation[i]]),
            np.concatenate([position[i : i + 1], done.position_m[i]]),
        )
        for i in range(count)
    ]


@pytest.fixture
def simulated_tosses(_all_tosses) -> Callable[..., list[PoseSeries]]:
    """`simulated_tosses(count)`, up to 10, of 130 frames: a box of friction 0.25 falls, bounces, slides and rests,
    at 148 Hz."""

    def some(count: int, frames: int = 100) -> list[PoseSeries]:
        return [t.part(slice(0, frames)) for t in _all_tosses[:count]]

    return some


@pytest.fixture
def real_tosses(data) -> Callable[[Sequence[int]], list[PoseSeries]]:
    """Real cube tosses (ContactNets) by number, with the velocities that the recording claims."""

    def load(numbers: Sequence[int]) -> list[PoseSeries]:
        folder: Path = data("contactnets/tosses_processed")
        found = []
        for n in numbers:
            table = torch.load(folder / f"{n}.pt", weights_only=True)[0].numpy()
            found.append(
                PoseSeries.from_quaternions(
                    n, STEP_S, table[:, 3:7], table[:, :3] * 0.0524, table[:, 7:10] * 0.0524, table[:, 10:13]
                )
            )
        return found

    return load


@pytest.fixture
def cube_physics() -> Physics:
    return known_physics(0.37, 0.00081 * np.eye(3))
