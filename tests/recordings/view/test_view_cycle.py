"""The cycle in rerun: passes found by their keys, their poses and shapes, ICP's residual, the learned model's ghost."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recordings.errors import DamagedFile
from recordings.results.folder import Results, TossRecord, VariantRecord, write_shape, write_track, write_variant
from recordings.tracks import ObjectShape, ObjectTrack
from recordings.view.blueprint import about_text, blueprint
from recordings.view.cycle import gap_colors, gap_m
from recordings.view.cycle_steps import read_cycle
from recordings.view.draw import open_scene, save_rrd

NAME, REJECTED = "ours_all", 4
FIRST, VISION, LEARNED, DRAWN, TRACK, SHAPE, JUDGE, JUDGE_2 = (
    f"{stage}-{letter * 8}"
    for stage, letter in (
        ("register", "a"), ("field", "b"), ("contact", "c"), ("reproject", "d"),
        ("track", "e"), ("field", "f"), ("judge", "1"), ("judge", "2"),
    )
)  # fmt: skip


def key(stage: str) -> str:
    return stage[-1] * 64


def write_stage(folder: Path, name: str, inputs: dict[str, str], counts: dict[str, Any] | None = None) -> Path:
    (folder / name).mkdir(parents=True)
    document = {"key": key(name), "inputs": {k: key(v) for k, v in inputs.items()}, "counts": counts or {}}
    (folder / name / "stage.json").write_text(json.dumps(document))
    return folder / name


def grown(shape: ObjectShape, by: float) -> ObjectShape:
    return replace(shape, vertices_m=by * shape.vertices_m)


def make_cycle(folder: Path, session: Path, tiny: Any, drawn_shape: str = LEARNED) -> Path:
    """A whole cycle over one toss: pass 1 is shifted by 1 cm along the camera's x axis, pass 2 is the truth."""
    n, steps_ns = tiny.FRAMES, np.arange(tiny.FRAMES) * tiny.STEP_NS
    down = tiny.rig().transform("d455", "world")
    true = np.array([(down @ tiny.falling(t, 0)).matrix for t in steps_ns])
    true[tiny.LOST] = np.nan
    shifted = true.copy()
    shifted[:, 0, 3] += 0.01
    status: Any = tuple("lost" if i == tiny.LOST else "tracked" for i in range(n))
    track = ObjectTrack(0, "d455", "object", steps_ns, true, status, np.full((n, 6, 6), np.nan))
    first = write_stage(folder, FIRST, {})
    write_track(first, replace(track, camera_from_object=shifted))
    write_shape(write_stage(folder, VISION, {"track_00": FIRST}), tiny.CUBE)
    learned = write_stage(folder, LEARNED, {"shape": VISION, "track_00": FIRST})
    write_shape(learned, grown(tiny.CUBE, 1.02))
    world = np.array([tiny.falling(t, 0).matrix for t in steps_ns[1:4]])
    world[:, 1, 3] += 0.02
    np.savez(
        learned / "rollouts.npz",
        **{"toss": np.array([0]), "toss_00.world_from_object": world, "toss_00.time_s": 1e-9 * steps_ns[1:4]},  # type: ignore[arg-type]
    )
    drawn = write_stage(folder, DRAWN, {"shape": drawn_shape, "track_00": FIRST})
    write_track(drawn, replace(track, camera_from_object=shifted))
    verdict = np.array(["poor fit" if i == REJECTED else "lost" if i == tiny.LOST else "aligned" for i in range(n)])
    rmse_m = np.where(np.arange(n) == tiny.LOST, np.nan, 0.001 + 0.0001 * np.arange(n))
    np.savez(drawn / "toss_00.icp.npz", verdict=verdict, fitness=np.full(n, 0.9), rmse_m=rmse_m, held=np.zeros(n, int))
    write_track(write_stage(folder, TRACK, {"drawn": DRAWN, "shape": drawn_shape}), track)
    write_shape(write_stage(folder, SHAPE, {"drawn": DRAWN, "track_00": TRACK}), grown(tiny.CUBE, 1.01))
    for name, of, shape, depth_m in ((JUDGE, FIRST, VISION, 0.002), (JUDGE_2, TRACK, SHAPE, 0.001)):
        stage = write_stage(folder, name, {"track_00": of, "shape_00": shape})
        np.savez(stage / "residuals.npz", rows=np.array([[0, 0, depth_m, 0.05, 9.0], [0, 4, depth_m, 0.05, 9.0]]))
    record = VariantRecord(
        "ours", "all", "ours", session.name, "block", tiny.rig(), (TossRecord(0, TRACK, SHAPE),), SHAPE, LEARNED,
        session_path=str(session), extra={"contact_of_toss": {"0": LEARNED}},
    )  # fmt: skip
    write_variant(folder, record)
    return folder


@pytest.fixture(scope="module")
def cycled(tiny: Any, session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_cycle(tmp_path_factory.mktemp("cycled") / "results", session, tiny)


@pytest.fixture(scope="module")
def rrd(tiny: Any, cycled: Path) -> Any:
    out = cycled.parent / "cycled.rrd"
    save_rrd(cycled, out)
    return tiny.Rrd(out)


def cycle_of(folder: Path) -> Any:
    results = Results.open(folder)
    return read_cycle(results, results.find())[0]


def test_the_passes_are_found_by_their_keys_the_first_one_first(tiny: Any, cycled: Path) -> None:
    first, second = cycle_of(cycled).steps
    assert (first.label, second.label) == ("first pass", "pass 2")
    np.testing.assert_allclose(
        (first.track.camera_from_object - second.track.camera_from_object)[0, :3, 3], [0.01, 0, 0], atol=1e-12
    )
    ratio = [s.vertices_m[0, 0] / tiny.CUBE.vertices_m[0, 0] for s in (first.shape, first.learned, second.shape)]
    np.testing.assert_allclose(ratio, [1, 1.02, 1.01])
    assert second.learned is None
    assert first.laid.verdict[REJECTED] == "poor fit"
    np.testing.assert_allclose([first.judged.depth_m[0], second.judged.depth_m[0]], [0.002, 0.001])


def test_passes_are_found_through_adjusted_poses_and_through_frames_filled_up(
    tiny: Any, cycled: Path, tmp_path: Path
) -> None:
    own, adjusted, filled = tmp_path / "results", "adjust-33333333", "every-frame-44444444"
    shutil.copytree(cycled, own)
    last = Results.open(own).find()
    for stage, inputs in ((adjusted, {"track_00": DRAWN, "surface": LEARNED}), (filled, {"track_00": adjusted})):
        shutil.copytree(own / TRACK, own / stage, ignore=shutil.ignore_patterns("stage.json"))
        document = {"key": key(stage), "inputs": {k: key(v) for k, v in inputs.items()}, "counts": {}}
        (own / stage / "stage.json").write_text(json.dumps(document))
    shutil.rmtree(own / JUDGE_2)
    judged = write_stage(own, JUDGE_2, {"track_00": adjusted, "shape_00": SHAPE})
    np.savez(judged / "residuals.npz", rows=np.array([[0, 0, 0.001, 0.05, 9.0]]))
    write_variant(own, replace(last, tosses=(replace(last.tosses[0], track=filled),)))
    first, second = cycle_of(own).steps
    assert (first.label, second.label) == ("first pass", "pass 2")
    assert first.laid.verdict[REJECTED] == "poor fit"
    np.testing.assert_allclose([first.judged.depth_m[0], second.judged.depth_m[0]], [0.002, 0.001])


def test_a_contact_shape_that_was_kept_out_is_shown_beside_the_one_that_was_drawn(
    tiny: Any, session: Path, tmp_path: Path
) -> None:
    first, _ = cycle_of(make_cycle(tmp_path / "results", session, tiny, drawn_shape=VISION)).steps
    assert first.shape.vertices_m[0, 0] == tiny.CUBE.vertices_m[0, 0]
    assert first.learned.vertices_m[0, 0] == pytest.approx(1.02 * tiny.CUBE.vertices_m[0, 0])


def test_rollouts_on_the_last_poses_go_before_those_of_contact_learning(cycled: Path, tmp_path: Path) -> None:
    own = tmp_path / "results"
    shutil.copytree(cycled, own)
    stage = write_stage(own, "rollout-99999999", {})
    world = np.tile(np.eye(4), (5, 1, 1))
    np.savez(stage / "rollouts.npz", **{"toss_00.world_from_object": world, "toss_00.time_s": np.arange(5.0)})  # type: ignore[arg-type]
    record = Results.open(own).find()
    write_variant(own, replace(record, extra={**record.extra, "rollout": stage.name}))
    found = cycle_of(own)
    assert len(found.rollout.time_ns) == 5
    assert found.rollout.shape is found.steps[-1].shape


def test_what_an_older_folder_lacks_is_left_out(cycled: Path, tmp_path: Path) -> None:
    old = tmp_path / "results"
    shutil.copytree(cycled, old)
    (old / LEARNED / "rollouts.npz").unlink()
    (old / DRAWN / "toss_00.icp.npz").unlink()
    shutil.rmtree(old / JUDGE)
    cycle = cycle_of(old)
    assert cycle.rollout is None
    assert cycle.steps[0].laid is None
    assert cycle.steps[0].judged is None
    assert len(cycle.steps) == 2
    shutil.rmtree(old / FIRST)
    assert [s.label for s in cycle_of(old).steps] == ["first pass"]  # all that is left of the passes is the last one


def test_a_folder_of_another_key_is_not_taken_for_the_pass_before(cycled: Path, tmp_path: Path) -> None:
    other = tmp_path / "results"
    shutil.copytree(cycled, other)
    document = json.loads((other / FIRST / "stage.json").read_text())
    (other / FIRST / "stage.json").write_text(json.dumps({**document, "key": "a" * 63 + "0"}))
    assert len(cycle_of(other).steps) == 1


def test_a_damaged_file_of_a_stage_is_named(cycled: Path, tmp_path: Path) -> None:
    broken = tmp_path / "results"
    shutil.copytree(cycled, broken)
    (broken / DRAWN / "toss_00.icp.npz").write_bytes(b"PK\x03\x04 torn")
    with pytest.raises(DamagedFile, match=r"toss_00\.icp\.npz cannot be read"):
        cycle_of(broken)


def test_results_without_a_cycle_are_shown_as_they_were(tiny: Any, session: Path, tmp_path: Path) -> None:
    folder = tiny.make_results(tmp_path / "plain", session, names=("bundlesdf-10",), session_path=str(session))
    scene = open_scene(folder)
    assert all(not body.cycle for body in scene.bodies)
    assert "step by step" not in about_text(scene)


def test_every_pass_moves_as_its_own_track_and_is_too_small_to_see_where_it_is_lost(tiny: Any, rrd: Any) -> None:
    for label, shift in (("first_pass", 0.01), ("pass_2", 0.0)):
        entity = f"/world/passes/{NAME}/{label}"
        places = {t: p[0] for t, _, p in rrd.rows(f"{entity}/object", "Transform3D:translation") if p}
        sizes = {t: s[0][0] for t, _, s in rrd.rows(f"{entity}/object", "Transform3D:scale") if s}
        for i in (0, 2, 5):
            wanted = tiny.falling(i * tiny.STEP_NS, 0).translation_m + tiny.DOWN @ [shift, 0, 0]
            np.testing.assert_allclose(places[i * tiny.STEP_NS], wanted, atol=1e-6)
        assert sizes[tiny.LOST * tiny.STEP_NS] < 1e-5 < sizes[0]
        ((_, _, strips),) = rrd.rows(f"{entity}/path", "LineStrips3D:strips")
        assert [len(s) for s in strips] == [tiny.LOST, tiny.FRAMES - tiny.LOST - 1]


def test_the_shapes_stand_side_by_side_and_are_logged_once(rrd: Any) -> None:
    places = []
    for name in ("first_pass/vision", "first_pass/contact", "pass_2/vision"):
        ((_, _, place),) = rrd.rows(f"/steps/{NAME}/{name}", "Transform3D:translation")
        assert len(rrd.rows(f"/steps/{NAME}/{name}/shape", "Mesh3D:vertex_positions")) == 1
        places.append(place[0][0])
    assert places[0] == 0
    assert places[2] == pytest.approx(2 * places[1])
    assert places[1] > 0.1


def test_colours_tell_outwards_from_inwards(tiny: Any) -> None:
    for by, wanted in ((1.02, 0.001), (0.98, -0.001)):
        gap = gap_m(grown(tiny.CUBE, by), tiny.CUBE)
        np.testing.assert_allclose(gap, np.sqrt(3) * wanted, rtol=0.2)  # a corner moves along its own normal
    red, grey, blue = gap_colors(np.array([1.0, 0.0, -1.0]))
    assert red[0] > 2 * red[2]
    assert blue[2] > 2 * blue[0]
    assert len(set(grey)) == 1


def test_the_residual_of_raw_depth_to_the_drawn_one_is_plotted_and_rejections_are_marked(tiny: Any, rrd: Any) -> None:
    values = [v[0] for _, _, v in rrd.rows(f"/cycle/icp_mm/{NAME}/pass_2", "Scalars:scalars")]
    np.testing.assert_allclose(values[:2], [1.0, 1.1])
    assert np.isnan(values[tiny.LOST])
    marked = rrd.rows(f"/cycle/icp_mm/{NAME}/pass_2_rejected", "Scalars:scalars")
    assert [t for t, _, _ in marked] == [tiny.LOST * tiny.STEP_NS, REJECTED * tiny.STEP_NS]
    points = rrd.rows(f"/world/icp_rejected/{NAME}", "Points3D:labels")
    assert [(t, label) for t, _, label in points if label] == [(REJECTED * tiny.STEP_NS, ["ICP: poor fit"])]
    events = [text[0] for _, _, text in rrd.rows("/events", "TextLog:text") if text]
    assert any("frame 4" in e and "rejected: poor fit" in e for e in events)


def test_every_pass_has_its_line_of_residuals_on_the_raw_images(tiny: Any, rrd: Any) -> None:
    for label, depth_mm in (("first_pass", 2.0), ("pass_2", 1.0)):
        found = rrd.rows(f"/cycle/depth_mm/{NAME}/{label}", "Scalars:scalars")
        assert [t for t, _, _ in found[:2]] == [0, 4 * tiny.STEP_NS]
        assert found[0][2][0] == pytest.approx(depth_mm)


def test_the_ghost_moves_at_the_rollouts_times_and_is_gone_when_the_toss_ends(tiny: Any, rrd: Any) -> None:
    entity = f"/world/ghost/{NAME}"
    places = {t: p[0] for t, _, p in rrd.rows(f"{entity}/object", "Transform3D:translation") if p}
    wanted = tiny.falling(tiny.STEP_NS, 0).translation_m + [0, 0.02, 0]
    np.testing.assert_allclose(places[tiny.STEP_NS], wanted, atol=1e-6)
    sizes = sorted((t, s[0][0]) for t, _, s in rrd.rows(f"{entity}/object", "Transform3D:scale") if s)
    assert sizes[0][1] < 1e-5
    assert sizes[-1][1] < 1e-5
    apart = [v[0] for _, _, v in rrd.rows(f"/cycle/ghost_mm/{NAME}", "Scalars:scalars")]
    np.testing.assert_allclose(apart[:2], [20, 20], atol=1e-6)


def test_the_window_has_a_tab_for_the_shapes_and_the_words_a_line_per_pass(cycled: Path) -> None:
    scene = open_scene(cycled)
    views = [v.name for v in blueprint(scene).root_container.contents[0].contents]
    assert "The shape, step by step" in views
    text = about_text(scene)
    assert "| first pass | 2.000 | 0.050 | 1 | 2 of 6 |" in text
    assert "| pass 2 | 1.000 | 0.050 | 1 | - |" in text
    assert "White ghost" in text
