"""The static scene of one toss alone: what the object always covered, and what other tosses of the session show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from processing.config import Config
from processing.pipeline.start import start_run
from processing.run import Run
from processing.segment.background.follow import BackgroundSettings
from processing.segment.background.moving_camera import why_other_scene
from processing.segment.background.segmenter import BackgroundSegmenter
from processing.segment.background.static_scene import (
    SceneSettings,
    StaticScene,
    calibrated_table_depth,
    learn_scene,
    seen_table_depth,
)
from processing.stages.masks.find import find_object
from processing.stages.masks.segment import segment
from processing.stages.recording.rig import refine_rig
from processing.stages.recording.scene import learn_static_scene, scene_notes
from recordings.errors import DamagedFile
from recordings.geometry import rotation_exp
from recordings.progress import Silent
from recordings.records import RgbdFrame
from recordings.results.folder import read_masks
from recordings.session import Session

Record = Callable[..., Path]
HELD, FLIGHT, REST = 8, 4, 14


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max(1, (a | b).sum()))


@pytest.fixture(scope="module")
def falls_back(tiny_world: Any) -> tuple[list[RgbdFrame], list[np.ndarray]]:
    """A box that is held above the very place where it comes to rest: most of what is beneath is never seen."""
    lying = replace(tiny_world.poses(12)[-1], rotation=np.eye(3), translation_m=np.array([0.0, 0.0, 0.03]))
    eye = tiny_world.world_from_camera.translation_m
    held = replace(lying, translation_m=lying.translation_m + 0.25 * (eye - lying.translation_m))
    aside = [
        replace(held, rotation=rotation_exp(np.array([0.3 * i, 0, 0])), translation_m=np.array([x, 0.05, 0.1]))
        for i, x in enumerate((0.04, 0.1, 0.07, 0.03))
    ]
    seen = [tiny_world.see(p, i) for i, p in enumerate([held] * HELD + aside[:FLIGHT] + [lying] * REST)]
    return [f for f, _ in seen], [m for _, m in seen]


@pytest.mark.parametrize(("bare_frames", "calibrated"), [(0, True), (3, True), (0, False)])
def test_an_object_at_rest_is_not_the_scene_whatever_was_seen_beneath(
    tiny_world: Any, falls_back: tuple[list[RgbdFrame], list[np.ndarray]], bare_frames: int, calibrated: bool
) -> None:
    frames, masks = list(falls_back[0]), list(falls_back[1])
    for i in range(bare_frames):
        frames[HELD + i], masks[HELD + i] = tiny_world.see(None, HELD + i)
    table = calibrated_table_depth(tiny_world.calibration, "d455")
    if not calibrated:
        table = seen_table_depth([f.depth_m for f in frames[::4]], tiny_world.camera)
    scene = learn_scene(frames, table, SceneSettings())
    empty, _ = tiny_world.see(None)
    np.testing.assert_allclose(scene.depth_m[masks[-1]], empty.depth_m[masks[-1]], atol=0.004)
    segmenter = BackgroundSegmenter(scene, tiny_world.camera, BackgroundSettings())
    found = sorted(segmenter.masks(frames, {0: masks[0]}, None, None, Silent()), key=lambda m: m.position)
    last = range(len(frames) - REST, len(frames))
    assert min(iou(found[i].mask, masks[i]) for i in last) > 0.9


def test_a_thing_that_always_stood_there_stays_scene(
    tiny_world: Any, falls_back: tuple[list[RgbdFrame], list[np.ndarray]]
) -> None:
    def with_block(frame: RgbdFrame) -> RgbdFrame:
        depth = frame.depth_m.copy()
        block = np.zeros_like(depth, dtype=bool)
        block[10:40, 110:140] = True
        depth[block & (depth > 0.45)] = 0.45
        return replace(frame, depth_m=depth)

    frames = [with_block(f) for f in falls_back[0]]
    scene = learn_scene(frames, calibrated_table_depth(tiny_world.calibration, "d455"), SceneSettings())
    assert scene.known[12:38, 112:138].all()
    np.testing.assert_allclose(scene.depth_m[12:38, 112:138], 0.45, atol=1e-6)


def test_another_camera_place_and_another_room_are_told(tiny_world: Any) -> None:
    rng = np.random.default_rng(0)
    room = np.kron(rng.integers(0, 255, (30, 40, 3)), np.ones((6, 6, 1))).astype(np.uint8)
    depth = np.full(room.shape[:2], 0.8, dtype=np.float32)
    seen = RgbdFrame("d455", 0, 0, 0, room, depth)
    moved = replace(seen, color_rgb=np.roll(room, 3, axis=1))
    assert why_other_scene(seen, [seen, seen], None) is None
    assert "the camera was moved (its picture is shifted by 3" in str(why_other_scene(seen, [moved], None))
    assert "another scene" in str(why_other_scene(seen, [replace(seen, depth_m=depth + 0.3)], None))
    smaller = replace(seen, color_rgb=room[::2, ::2], depth_m=depth[::2, ::2])
    assert "another size" in str(why_other_scene(seen, [smaller], None))
    other_cloth = np.kron(rng.integers(0, 255, (30, 40, 3)), np.ones((6, 6, 1))).astype(np.uint8)
    assert "nothing in common" in str(why_other_scene(seen, [replace(seen, color_rgb=other_cloth)], None))
    coarse = 100 + 60 * np.sin(np.arange(240) / 30) * np.cos(np.arange(180)[:, None] / 30)
    grain = [np.kron(rng.integers(-30, 30, (90, 120)), np.ones((2, 2))) for _ in range(3)]
    dark = [replace(seen, color_rgb=np.repeat((coarse + g).astype(np.uint8)[..., None], 3, axis=2)) for g in grain]
    assert why_other_scene(dark[0], dark[1:], None) is None  # noise is all that could be followed


def _run(session: Path, tosses: list[int], out: Path) -> Run:
    return start_run(Session.open(session), tosses, out, Config(), "multi-hypothesis", lambda name: Silent())


def test_one_toss_has_the_same_scene_and_masks_as_among_the_others(record_tiny: Record, tmp_path: Path) -> None:
    session = record_tiny(tosses=(0, 1, 2))
    alone, among = _run(session, [1], tmp_path / "alone"), _run(session, [0, 1, 2], tmp_path / "among")
    scenes = [learn_static_scene(r) for r in (alone, among)]
    one, all_of_them = (StaticScene.read(s.folder) for s in scenes)
    np.testing.assert_array_equal(one.depth_m, all_of_them.depth_m)
    np.testing.assert_array_equal(one.color_rgb, all_of_them.color_rgb)
    rigs = [refine_rig(r, s) for r, s in zip((alone, among), scenes)]
    found = [find_object(r, s, g) for r, s, g in zip((alone, among), scenes, rigs)]
    masks = [read_masks(segment(r, 1, s, g, f).folder, 1) for r, s, g, f in zip((alone, among), scenes, rigs, found)]
    assert all((a == b).all() for a, b in zip(*masks))
    assert scenes[0].result.tosses == (0, 1, 2)
    assert scene_notes(scenes[0]) == ()


def test_a_damaged_toss_beside_is_left_out_and_said_and_one_of_the_run_ends_it(
    record_tiny: Record, tmp_path: Path
) -> None:
    session = record_tiny(tosses=(0, 1, 2))
    whole = learn_static_scene(_run(session, [0], tmp_path / "out"))
    file = session / "toss_02.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    run = _run(session, [0], tmp_path / "out")
    damaged = learn_static_scene(run)
    assert damaged.key != whole.key  # what was read has changed
    assert damaged.result.tosses == (0, 1)
    assert scene_notes(damaged)[0].startswith("toss 2 gives no frames of the background: it cannot be read")
    assert learn_static_scene(run).reused
    with pytest.raises(DamagedFile):
        learn_static_scene(_run(session, [2], tmp_path / "out"))
    file.unlink()
    assert learn_static_scene(_run(session, [0], tmp_path / "out")).key not in (whole.key, damaged.key)


def test_a_toss_beside_of_another_scene_is_left_out(tiny_world: Any, record_tiny: Record, tmp_path: Path) -> None:
    session = record_tiny(tosses=(0, 1))
    clean = StaticScene.read(learn_static_scene(_run(session, [0], tmp_path / "clean")).folder)
    higher = replace(tiny_world, world_from_camera=replace(
        tiny_world.world_from_camera, translation_m=np.array([0.0, -0.2, 0.8])))  # fmt: skip
    other = higher.record(tmp_path / "bumped", tosses=(0, 1), frames=8)
    (session / "toss_01.mcap").write_bytes((other / "toss_01.mcap").read_bytes())
    run = _run(session, [0], tmp_path / "out")
    done = learn_static_scene(run)
    assert done.result.tosses == (0,)
    assert len(scene_notes(done)) == 1
    np.testing.assert_allclose(StaticScene.read(done.folder).depth_m, clean.depth_m, atol=0.004)


def test_of_many_tosses_only_some_are_looked_at(record_tiny: Record, tmp_path: Path) -> None:
    session = record_tiny(tosses=tuple(range(6)), frames=4)
    settings = Config(scene=SceneSettings(frames=12))
    run = replace(_run(session, [2], tmp_path / "out"), config=settings)
    found = learn_static_scene(run).result
    assert found.tosses == (0, 2, 5)
    assert found.frames <= 12
