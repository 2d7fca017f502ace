"""The cycle: what moves shapes between frames, what a second pass is given, what counts as better, and its rows."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from processing.cli import config_of, main
from processing.config import Config, CycleConfig
from processing.evaluate.table import said
from processing.field.learn import LearnConfig
from processing.field.train import FieldConfig
from processing.pipeline.passes import Pass
from processing.pipeline.start import start_run
from processing.refine.icp import IcpConfig, ShapeSurface, align_frame
from processing.refine.image_residuals import JudgeConfig, ShapeDrawer, explain
from processing.refine.redrawn_frames import RedrawConfig, SecondFrames, redraw
from processing.sensor.render import RaycastRenderer
from processing.stages.place import placement
from processing.variants import TRACKERS, find_variant
from recordings.geometry import rotation_exp
from recordings.notices import Notice
from recordings.progress import Silent
from recordings.results.folder import Results
from recordings.session import Session
from recordings.tracks import ObjectShape, ObjectTrack, RigCalibration

BOX_M = (0.10, 0.08, 0.06)
SAMPLE = Path(__file__).resolve().parents[2] / "recordings" / "samples" / "box_toss"


def box_shape() -> ObjectShape:
    box = trimesh.creation.box(BOX_M).subdivide().subdivide()
    grey = np.full((len(box.vertices), 3), 128, dtype=np.uint8)
    return ObjectShape("object", "test", np.asarray(box.vertices), np.asarray(box.faces), grey)


def track_of(poses: np.ndarray, frame: str = "object") -> ObjectTrack:
    n = len(poses)
    status: Any = tuple("tracked" if np.isfinite(p).all() else "lost" for p in poses)
    times_ns = np.arange(n) * 33_333_333
    return ObjectTrack(0, "d455", frame, times_ns, poses, status, np.full((n, 6, 6), np.nan))


def motion(turn: tuple[float, float, float], shift: tuple[float, float, float]) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation_exp(np.array(turn, dtype=np.float64)), shift
    return out


def test_two_tracks_of_one_motion_give_the_motion_between_their_frames_despite_a_bad_frame() -> None:
    rng = np.random.default_rng(2)
    shared = np.stack([motion(tuple(rng.normal(0, 1, 3)), tuple(rng.normal(0, 0.1, 3))) for _ in range(12)])
    own_from_shared = motion((0.3, -0.2, 0.9), (0.02, 0.01, -0.03))
    own = shared @ np.linalg.inv(own_from_shared)
    own[4] = own[4] @ motion((0.5, 0, 0), (0.05, 0, 0))
    own[7] = np.nan
    found, residual = placement(track_of(own), track_of(shared))
    np.testing.assert_allclose(found, own_from_shared, atol=1e-9)
    assert residual.frames == 11
    assert residual.rotation_deg < 1e-5


def test_a_drawn_frame_keeps_the_cameras_depth_where_it_agrees_and_fills_the_rest(tiny_world: Any) -> None:
    pose = tiny_world.poses(3)[1]
    frame, mask = tiny_world.see(pose, 1)
    camera_from_object = (tiny_world.world_from_camera.inverse() @ pose).matrix
    holes = frame.depth_m.copy()
    inside = np.argwhere(mask)[::7]
    holes[inside[:, 0], inside[:, 1]] = 0
    raw = replace(frame, depth_m=holes)
    renderer = RaycastRenderer(box_shape(), tiny_world.camera)
    drawn = redraw(raw, mask, camera_from_object, renderer, RedrawConfig("filled"))
    kept = mask & (holes > 0) & drawn.mask
    assert (drawn.frame.depth_m[kept] == holes[kept]).mean() > 0.98
    filled = mask & (holes == 0) & drawn.mask
    np.testing.assert_allclose(drawn.frame.depth_m[filled], frame.depth_m[filled], atol=0.002)
    papers = redraw(raw, mask, camera_from_object, renderer, RedrawConfig("rendered"))
    assert (papers.frame.depth_m[drawn.mask] == renderer.depth(camera_from_object)[drawn.mask]).all()


def test_missing_depth_beside_the_mask_does_not_make_the_object_grow(tiny_world: Any) -> None:
    pose = tiny_world.poses(3)[1]
    frame, mask = tiny_world.see(pose, 1)
    camera_from_object = (tiny_world.world_from_camera.inverse() @ pose).matrix
    raw = replace(frame, depth_m=np.where(mask, frame.depth_m, 0).astype(np.float32))
    swollen = replace(box_shape(), vertices_m=1.1 * box_shape().vertices_m)
    drawn = redraw(raw, mask, camera_from_object, RaycastRenderer(swollen, tiny_world.camera), RedrawConfig())
    assert (drawn.mask == mask).all()


def test_what_a_hand_hides_is_filled_without_colour_or_cut_out(tiny_world: Any) -> None:
    pose = tiny_world.poses(3)[1]
    frame, mask = tiny_world.see(pose, 1, hand=True)
    camera_from_object = (tiny_world.world_from_camera.inverse() @ pose).matrix
    renderer = RaycastRenderer(box_shape(), tiny_world.camera)
    whole = renderer.depth(camera_from_object) > 0
    hidden = whole & ~mask
    assert hidden.sum() > 30
    filled = redraw(frame, mask, camera_from_object, renderer, RedrawConfig())
    assert (filled.mask & hidden).sum() > 0.9 * hidden.sum()
    assert (filled.mask & ~mask == filled.colorless).all()
    cut = redraw(frame, mask, camera_from_object, renderer, RedrawConfig(occlusion="subtract"))
    assert (cut.mask & hidden).sum() < 0.1 * hidden.sum()


def test_a_frame_without_a_pose_is_given_to_the_second_pass_as_it_was_taken(tiny_world: Any) -> None:
    frame, mask = tiny_world.see(tiny_world.poses(3)[1], 1)
    renderer = RaycastRenderer(box_shape(), tiny_world.camera)
    seen = SecondFrames([frame], np.array([0]), [mask], np.full((1, 4, 4), np.nan), renderer, RedrawConfig())
    assert (seen[0].depth_m == frame.depth_m).all()
    assert (seen.masks[0] == mask).all()
    assert not seen.colorless[0].any()


@pytest.mark.parametrize("error", [motion((0.05, 0, 0), (0, 0, 0)), motion((0, 0, 0), (0.004, 0, 0.003))])
def test_a_worse_pose_explains_the_raw_images_worse(tiny_world: Any, error: np.ndarray) -> None:
    world_poses = tiny_world.poses(4)
    seen = [tiny_world.see(p, i) for i, p in enumerate(world_poses)]
    poses = np.stack([(tiny_world.world_from_camera.inverse() @ p).matrix for p in world_poses])
    frames, masks = [f for f, _ in seen], [m for _, m in seen]
    true, wrong = (
        explain(box_shape(), track_of(p), frames, masks, tiny_world.camera, JudgeConfig(every=1)).means()
        for p in (poses, poses @ error)
    )
    assert true.frames == wrong.frames == 4
    assert true.depth_m < 0.6 * wrong.depth_m
    assert true.mask < wrong.mask


def test_colours_are_compared_after_the_light_on_each_face(tiny_world: Any) -> None:
    """A grey box whose faces the light makes differently bright: nothing of that is a wrong pose."""
    pose = tiny_world.poses(4)[1]
    _, mask = tiny_world.see(pose, 1)
    camera_from_object = (tiny_world.world_from_camera.inverse() @ pose).matrix
    drawn = ShapeDrawer(box_shape(), tiny_world.camera).draw(camera_from_object)
    lit = np.clip(128 * (0.5 + drawn.normal @ np.array([0.3, -0.2, 0.4])), 0, 255)
    frame, _ = tiny_world.see(pose, 1)
    shown = replace(frame, color_rgb=np.repeat(lit[..., None], 3, -1).astype(np.uint8))
    found = explain(
        box_shape(), track_of(camera_from_object[None]), [shown], [mask], tiny_world.camera, JudgeConfig(every=1)
    ).means()
    assert found.color < 1.0
    assert len(np.unique(lit[drawn.depth_m > 0].round())) > 1


def test_chromaticity_is_left_by_the_light_and_its_tint_and_tells_print(tiny_world: Any) -> None:
    pose = tiny_world.poses(4)[1]
    frame, mask = tiny_world.see(pose, 1)
    camera_from_object = (tiny_world.world_from_camera.inverse() @ pose).matrix
    box = box_shape()
    printed = np.random.default_rng(0).integers(40, 220, box.vertices_m.shape).astype(np.uint8)
    shape = replace(box, vertex_rgb=printed)
    drawn = ShapeDrawer(shape, tiny_world.camera).draw(camera_from_object)
    assert drawn.rgb is not None
    light = (0.7 + 0.3 * drawn.normal @ np.array([0.3, -0.2, 0.4]))[..., None] * np.array([1.0, 0.97, 0.92])

    def chroma(rgb: np.ndarray) -> float:
        shown = replace(frame, color_rgb=np.clip(light * rgb, 0, 255).astype(np.uint8))
        track = track_of(camera_from_object[None])
        return float(explain(shape, track, [shown], [mask], tiny_world.camera, JudgeConfig(every=1)).rows[0, 5])

    own, others = chroma(drawn.rgb), chroma(drawn.rgb[..., [1, 2, 0]])
    assert own < 0.03 < 0.2 < others
    plain = replace(box, vertex_rgb=None)
    assert np.isnan(explain(plain, track_of(camera_from_object[None]), [frame], [mask], tiny_world.camera,
                            JudgeConfig(every=1)).rows[0, 5])  # fmt: skip


def test_a_lost_frame_counts_as_lost_and_never_as_explained(tiny_world: Any) -> None:
    world_poses = tiny_world.poses(4)
    seen = [tiny_world.see(p, i) for i, p in enumerate(world_poses)]
    poses = np.stack([(tiny_world.world_from_camera.inverse() @ p).matrix for p in world_poses])
    poses[2] = np.nan
    found = explain(
        box_shape(),
        track_of(poses),
        [f for f, _ in seen],
        [m for _, m in seen],
        tiny_world.camera,
        JudgeConfig(every=1),
    ).means()
    assert (found.frames, found.lost) == (3, 1)


def test_what_the_track_knows_well_and_depth_badly_stays_with_the_track() -> None:
    surface = ShapeSurface(box_shape())
    rng = np.random.default_rng(0)
    face = np.c_[rng.uniform(-0.05, 0.05, 600), rng.uniform(-0.04, 0.04, 600), np.full(600, -0.03)]
    pose = motion((0, 0, 0), (0, 0, 0.6))
    points = face + [0.006, 0, 0.6 + 0.004]  # moved along the face, which cannot be seen, and away, which can
    points += rng.normal(0, 0.0005, points.shape)
    free = align_frame(surface, points, pose, IcpConfig(least_fitness=0.3)).camera_from_object
    tight = np.diag([1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4]) ** 2
    held = align_frame(surface, points, pose, IcpConfig(least_fitness=0.3), tight).camera_from_object
    fixed = align_frame(surface, points, pose, IcpConfig(least_fitness=0.3), np.zeros((6, 6))).camera_from_object
    assert abs(fixed[2, 3] - 0.6) < 0.5 * abs(free[2, 3] - 0.6)  # held so that others had a frame: not unknown
    assert free[2, 3] == pytest.approx(0.604, abs=5e-4)
    assert abs(held[2, 3] - 0.6) < 0.5 * abs(free[2, 3] - 0.6)
    assert np.abs(held[:2, 3]).max() < 1e-3


def processed(tiny_world: Any, folder: Path, variant: str) -> Results:
    """A tiny session whose table nobody calibrated, through one variant: contact has no plane to learn against."""
    blind = replace(tiny_world, calibration=RigCalibration({"d455": tiny_world.camera}))
    session = blind.record(folder / "tiny", frames=6)
    few = LearnConfig(most_views=6, field=FieldConfig(steps=3, rays=128, pose_rounds=0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("processing.cli.config_of", lambda args: replace(config_of(args), shape=few))
        truth = tiny_world.truth_folder(folder / "tiny_truth", frames=6)
        code = main([str(session), "--variant", variant, "--out", str(folder / "out"), "--truth", str(truth)])
    assert code == 0
    return Results.open(folder / "out")


@pytest.fixture(scope="module")
def whole_table(tiny_world: Any, tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Every row in both scopes."""
    return processed(tiny_world, tmp_path_factory.mktemp("table"), "table")


@pytest.fixture(scope="module")
def ours(tiny_world: Any, tmp_path_factory: pytest.TempPathFactory) -> Results:
    """The default row."""
    return processed(tiny_world, tmp_path_factory.mktemp("ours"), "ours")


@pytest.mark.slow
def test_the_table_holds_every_row_of_both_scopes(whole_table: Results) -> None:
    document = json.loads((whole_table.path / "table.json").read_text())
    rows = {(r["variant"], r["scope"]) for r in document["rows"]}
    paper = ("bundlesdf-1", "bundlesdf-10", "no-cycle", "no-contact", "no-icp", "ours")
    assert rows == {*((v, s) for v in paper for s in ("one", "all")), ("converged", "all"), ("joint", "all")}
    assert all(r["values"]["add_auc"]["value"] > 80 for r in document["rows"])


@pytest.mark.slow
@pytest.mark.parametrize(("scope", "vision"), [("one", "bundlesdf-1"), ("all", "bundlesdf-10")])
def test_contact_without_the_cycle_leaves_the_poses_as_vision_had_them(
    whole_table: Results, scope: str, vision: str
) -> None:
    tracks = [[t.track for t in whole_table.find(name, scope).tosses] for name in ("no-cycle", vision)]
    assert tracks[0] == tracks[1]


def test_passes_go_on_while_the_raw_images_are_explained_better_and_the_best_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from processing.pipeline import cycle

    judged = iter([0.001, -0.02, -0.01, 0.0005])
    count = iter(range(2, 9))

    def another(run: Any, best: Pass, *_: Any, **__: Any) -> tuple[Pass, Pass, dict[str, Any]]:
        after = Pass({}, {}, shared_frame=True, notes=(f"made by pass {next(count)}",))
        told = {"of": "x", "before": {}, "worse_share": next(judged), "rotation_deg": 0.5, "same": False}
        return best, after, told

    monkeypatch.setattr(cycle, "once_more", another)
    session = Session.open(SAMPLE)
    run = start_run(session, session.tosses, tmp_path, Config(), TRACKERS[0], lambda _: Silent())
    ended = cycle.run_cycle(run, find_variant("converged"), Pass({}, {}, shared_frame=True), {}, "x")
    assert ended.notes[0] == "made by pass 4"
    assert "pass 5 explains the raw images no better" in ended.notes[-1]
    assert [p["worse_share"] for p in ended.passes] == [0.001, -0.02, -0.01, 0.0005]


@pytest.mark.parametrize(
    ("told", "start", "kept"),
    [
        ({"worse_share": 0.019, "rotation_deg": 1.9}, "shape", None),
        ({"worse_share": 0.021, "rotation_deg": 0.1}, "shape", "explains the raw images 2.1 % worse"),
        ({"worse_share": -0.05, "rotation_deg": 2.4}, "shape", "turns the poses by 2.4 deg"),
        ({"worse_share": -0.05, "rotation_deg": 70.0}, "anew", None),
    ],
)
def test_a_second_pass_that_explains_less_or_turns_the_poses_it_refines_far_is_left_out_and_said_to_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: dict[str, float], start: Any, kept: str | None
) -> None:
    from processing.pipeline import cycle

    after = Pass({}, {}, shared_frame=True, notes=("made by pass 2",))
    change = {"of": "x", "before": {}, "same": False, **told}
    monkeypatch.setattr(cycle, "once_more", lambda run, first, *_, **__: (first, after, change))
    session = Session.open(SAMPLE)
    config = replace(Config(), cycle=CycleConfig(start=start))
    run = start_run(session, session.tosses, tmp_path, config, TRACKERS[0], lambda _: Silent())
    ended = cycle.run_cycle(run, find_variant("ours"), Pass({}, {}, shared_frame=True), {}, "x")
    assert ("made by pass 2" in ended.notes) == (kept is None)
    assert [kept in w.seen for w in ended.warnings] == ([True] if kept else [])


@pytest.mark.slow
def test_rows_share_their_stages(whole_table: Results) -> None:
    stages = [p.name.split("-")[0] for p in whole_table.path.iterdir() if (p / "stage.json").exists()]
    assert stages.count("segment") == 2
    assert stages.count("scene") == 1
    first_passes = {t.track for t in whole_table.find("bundlesdf-1", "one").tosses}
    assert len(first_passes) == 2


def test_what_contact_could_not_learn_is_said_and_the_rest_is_delivered(ours: Results) -> None:
    warnings = ours.find("ours", "all").warnings
    assert any("contact learning was kept out" in w.text for w in warnings)
    assert len(ours.shape("ours", "all").faces) > 100
    page = (ours.path / "report.html").read_text()
    assert page.index("kept out") < page.index("<h2>Scores")
    assert page.count("data:image/") >= 2


def test_the_second_pass_says_what_it_changed(ours: Results) -> None:
    passes = ours.find("ours", "all").extra["passes"]
    assert passes[0]["before"]["frames"] == passes[0]["after"]["frames"] > 0
    assert passes[0]["rotation_deg"] >= 0


def test_what_is_said_of_several_rows_is_said_once() -> None:
    lost, bare = Notice("s", "high", "toss 2 is lost").to_json(), Notice("s", "low", "no rollouts").to_json()
    rows: list[dict[str, Any]] = [
        {"variant": "ours", "scope": "all", "warnings": [lost], "notes": ["tracker: x"]},
        {"variant": "no-icp", "scope": "all", "warnings": [bare, lost], "notes": ["tracker: x"]},
        {"variant": "ours", "scope": "one", "warnings": [], "notes": ["tracker: x"]},
    ]
    assert said(rows, "warnings") == ["ours (all), no-icp (all): toss 2 is lost", "no-icp (all): no rollouts"]
    assert said(rows, "notes") == ["every row: tracker: x"]
