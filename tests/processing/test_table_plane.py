"""The table found in depth: a known plane comes back, and a scene without one is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from processing.config import Config
from processing.pipeline.start import start_run, with_table
from processing.sensor.table_plane import fitted_plane, with_table_from_depth
from recordings.errors import BadInput
from recordings.progress import Silent
from recordings.records import RgbdFrame
from recordings.session import Session
from recordings.tracks import RigCalibration


def test_a_plane_among_outliers_is_found_to_its_noise() -> None:
    rng = np.random.default_rng(1)
    flat = np.c_[rng.uniform(-0.5, 0.5, (4000, 2)), np.full(4000, 0.8)] + rng.normal(0, 0.001, (4000, 3))
    normal, offset, share = fitted_plane(np.concatenate([flat, rng.uniform(-1, 1, (2500, 3))]))
    assert abs(normal[2]) > 0.99999
    assert abs(abs(offset) - 0.8) < 2e-4
    assert share > 0.6


def test_the_world_that_depth_gives_is_level_with_the_table(tiny_world: Any) -> None:
    frame, _ = tiny_world.see(None)
    calibration, found = with_table_from_depth(RigCalibration({"d455": tiny_world.camera}), "d455", frame.depth_m)
    world = calibration.transform("world", "d455")
    assert world.translation_m[2] == pytest.approx(tiny_world.world_from_camera.translation_m[2], abs=5e-4)
    up_in_camera = world.rotation[2]
    assert up_in_camera @ tiny_world.world_from_camera.rotation[2] > np.cos(np.radians(0.1))
    assert found["source"] == "depth of the empty scene"


def test_a_known_world_keeps_its_axes_and_gets_the_plane(tiny_world: Any) -> None:
    frame, _ = tiny_world.see(None)
    calibration, _ = with_table_from_depth(tiny_world.calibration, "d455", frame.depth_m)
    assert calibration.transforms == tiny_world.calibration.transforms
    assert abs(calibration.residuals["table"]["offset_m"]) < 5e-4
    assert calibration.residuals["table"]["normal_world"][2] > 0.9999


def test_the_plane_lies_where_the_object_is_tracked_whatever_the_depth_cameras_scale(
    record_tiny: Callable[..., Path],
) -> None:
    """Depth that reads 1 % too far has the table 6 mm too deep; with the scale taken out it is where it is."""

    def too_far(frames: list[RgbdFrame]) -> list[RgbdFrame]:
        return [replace(f, depth_m=(1.01 * f.depth_m).astype(np.float32)) for f in frames]

    with Session.open(record_tiny(frames=12, tosses=(0,), seen_again=too_far)) as session:
        run = start_run(session, session.tosses, session.path / "results", Config(), "multi-hypothesis",
                        lambda label: Silent())  # fmt: skip
        table = with_table(run).session.calibration.residuals["table"]
        assert abs(table["offset_m"]) < 1e-3


def test_a_scene_without_a_plane_is_refused_with_what_to_do(tiny_world: Any) -> None:
    depth = np.random.default_rng(0).uniform(0.3, 2.0, (120, 160)).astype(np.float32)
    with pytest.raises(BadInput, match="toss-calibrate table"):
        with_table_from_depth(RigCalibration({"d455": tiny_world.camera}), "d455", depth)
