"""report.html: self-contained, and what it shows is what was found."""

from __future__ import annotations

import base64
import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image

from processing.cli import _parser
from processing.evaluate.metrics import FrameErrors
from processing.evaluate.report import write_report
from processing.evaluate.report_loops import SLOWED, chosen_frames, flight_cut, loop_images, toss_loops
from processing.evaluate.report_mesh import MOST_FACES, thinned
from processing.evaluate.report_shapes import UNSEEN_RGB, Shown
from processing.evaluate.report_worst import TossDiagnostics, reasons, worst_frames
from processing.evaluate.score import TossScore, VariantScore
from processing.evaluate.table import Row, table_document
from recordings.film.film import STATUS_RGB
from recordings.results.folder import (
    Results,
    TossRecord,
    VariantRecord,
    write_masks,
    write_shape,
    write_track,
    write_variant,
)
from recordings.session import Session
from recordings.tracks import ObjectShape, ObjectTrack, runs

FRAMES, LOST, GUESSED, WORST = 8, 3, 4, 6
STATUS = tuple("lost" if i == LOST else "interpolated" if i == GUESSED else "tracked" for i in range(FRAMES))
PHASES = ("held", *["flight"] * 4, "impact", "impact", "rest")


@pytest.fixture
def made(tiny_world, record_tiny, tmp_path):
    """A session of two tosses with the true poses as its result, one lost and one interpolated in each."""
    path, out = record_tiny(frames=FRAMES), tmp_path / "results"
    box = trimesh.creation.box([0.10, 0.08, 0.06])
    rgb = np.full((len(box.vertices), 3), (10, 200, 30), dtype=np.uint8)
    observed = np.array(box.vertices[:, 2] > 0)
    shape = ObjectShape("object", "test", np.array(box.vertices), np.array(box.faces).astype(np.int64), rgb, observed)
    session = Session.open(path)
    for toss in (0, 1):
        stage = out / f"track-{toss}"
        stage.mkdir(parents=True)
        times_ns = session.toss(toss).color().times_ns
        true = [tiny_world.world_from_camera.inverse() @ p for p in tiny_world.poses(FRAMES, toss)]
        poses = np.stack([p.matrix for p in true])
        poses[LOST] = np.nan
        write_track(
            stage, ObjectTrack(toss, "d455", "object", times_ns, poses, STATUS, np.full((FRAMES, 6, 6), np.nan))
        )
        masks = [tiny_world.see(p, i)[1] for i, p in enumerate(tiny_world.poses(FRAMES, toss))]
        write_masks(stage, toss, masks, np.ones(FRAMES))
        write_shape(stage, shape)
        (stage / "stage.json").write_text(json.dumps({"key": "k"}))
    tosses = tuple(TossRecord(t, f"track-{t}", "track-0", f"track-{t}") for t in (0, 1))
    words = ("ours", "all", "ours <more>", "tiny", "box")
    write_variant(out, VariantRecord(*words, session.calibration, tosses, "track-0", shared_object_frame=True))
    results = Results.open(out)
    yield results, Row(results.find(), results.tracks(), _score(results)), session
    session.close()


def _score(results):
    """Every frame 1 mm and 1 deg off, frame WORST of toss 1 by far the worst; a lost one infinitely."""
    tosses = []
    for toss, track in results.tracks().items():
        error = np.full(FRAMES, 0.001)
        error[WORST] = 0.003 + 0.020 * toss
        error[LOST] = np.inf
        errors = FrameErrors(error, error, 1000 * error, error)
        tosses.append(TossScore(toss, errors, 1, 1e-9 * (track.time_ns - track.time_ns[0]), PHASES))  # type: ignore[arg-type]
    return VariantScore({}, tuple(tosses))


def page_of(made, **values):
    results, row, session = made
    document = table_document(results, [row])
    document["rows"][0]["values"] |= values
    write_report(results, document, [row], session)
    return (results.path / "report.html").read_text()


def test_the_page_loads_nothing_from_anywhere_and_escapes_what_others_wrote(made):
    page = page_of(made)
    assert not re.search(r"https?://|//[a-z]+\.[a-z]|@import|fetch\(|XMLHttp", page)
    sources = re.findall(r"(?:src|href)\s*=\s*['\"]?([^'\" >]{0,20})", page)
    assert sources
    assert all(s.startswith("data:image/") for s in sources)
    assert "ours &lt;more&gt;" in page
    assert "<more>" not in page
    assert len(page) < 3_000_000


def test_the_turning_shape_is_the_shape_and_marks_what_no_camera_saw(made):
    page = page_of(made)
    data = json.loads(re.search(r"<script type=application/json id=shapes>(.*?)</script>", page, re.S).group(1))
    (shape,) = data
    points = np.frombuffer(base64.b64decode(shape["vertices"]), "<i2").reshape(-1, 3).astype(float)
    faces = np.frombuffer(base64.b64decode(shape["faces"]), "<u2").reshape(-1, 3)
    rgb = np.frombuffer(base64.b64decode(shape["colors"]["seen"]), np.uint8).reshape(-1, 3)
    assert len(points) == 8
    assert len(faces) == 12
    edges = np.linalg.norm(points[:, None] - points[None], axis=-1)
    size_m = np.linalg.norm([0.10, 0.08, 0.06])
    np.testing.assert_allclose(np.unique(edges.round(-2))[1] / 32767 * 0.55 * size_m, 0.06, rtol=0.01)
    assert (rgb == UNSEEN_RGB).all(axis=1).sum() == 4
    assert (rgb == (10, 200, 30)).all(axis=1).sum() == 4
    assert "<canvas id=turn>" in page
    assert 'getContext("webgl"' in page


def test_a_large_mesh_is_thinned_and_keeps_its_form_and_colors():
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.05)
    rgb = np.where(ball.vertices[:, [2]] > 0, (255, 0, 0), (0, 0, 255)).astype(np.uint8)
    shape = ObjectShape("object", "test", np.array(ball.vertices), np.array(ball.faces).astype(np.int64), rgb)
    found = thinned(Shown("ball", shape, np.eye(4))).shape
    assert len(shape.faces) > MOST_FACES >= len(found.faces) > MOST_FACES / 2
    np.testing.assert_allclose(np.linalg.norm(found.vertices_m, axis=1), 0.05, atol=2e-4)
    upper = found.vertices_m[:, 2] > 0.002
    assert (found.vertex_rgb[upper] == (255, 0, 0)).all()


def test_every_toss_has_a_loop_with_a_frame_for_every_moment_of_its_motion(made):
    results, row, session = made
    loops = toss_loops(results, row, session)
    assert [loop.toss for loop in loops] == [0, 1]
    for loop in loops:
        with Image.open(io.BytesIO(loop.webp)) as picture:
            assert picture.format == "WEBP"
            assert loop.frames == len(chosen_frames(row.tracks[loop.toss], 99))
            picture.seek(picture.n_frames - 1)  # neighbours that are the same are one frame, shown for longer
            picture.load()
            shown_ms = picture.info["timestamp"] + picture.info["duration"]
        assert shown_ms == pytest.approx(SLOWED * loop.frames * 1000 / 30, abs=2)
    assert page_of(made).count("src='data:image/webp;base64,") == 2


def test_a_loop_shows_the_outline_in_the_color_of_the_status(made):
    results, row, session = made
    track = row.tracks[0]
    images = loop_images(session, row, track, results.shape(), 99)
    assert len(images) == FRAMES
    for image, status in zip(images, STATUS, strict=True):
        for name, color in STATUS_RGB.items():
            assert (image == np.array(color)).all(axis=-1).any() == (name == status), (name, status)


def test_loops_of_many_frames_are_thinned_evenly_and_rest_is_left_out(made):
    track = made[1].tracks[0]
    n = 300
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[100:200, 0, 3] = 0.01 * np.arange(100)
    poses[200:, 0, 3] = 1.0
    times_ns = np.arange(n) * 33_000_000
    long = ObjectTrack(0, "d455", "object", times_ns, poses, ("tracked",) * n, np.full((n, 6, 6), np.nan))
    chosen = chosen_frames(long, 20)
    assert len(chosen) == 20
    assert 90 <= chosen[0] <= 100
    assert 200 <= chosen[-1] <= 210
    assert np.ptp(np.diff(chosen)) <= 1
    assert chosen_frames(track, 3).tolist() == [0, 4, 7]


def test_what_is_cut_out_holds_the_object_at_every_pose(made, tiny_world):
    results, row, _ = made
    rows, columns = flight_cut(row.tracks[0], results.shape(), tiny_world.camera)
    for i, pose in enumerate(tiny_world.poses(FRAMES, 0)):
        if i != LOST:
            seen = np.nonzero(tiny_world.see(pose, i)[1])
            assert rows.start <= seen[0].min()
            assert seen[0].max() < rows.stop
            assert columns.start <= seen[1].min()
            assert seen[1].max() < columns.stop


def test_the_worst_frames_are_the_lost_ones_and_those_with_the_largest_error(made):
    found = worst_frames(made[0], made[1])
    assert {(w.toss, w.position) for w in found[:2]} == {(0, LOST), (1, LOST)}
    assert found[0].what == "frame 3 is lost"
    assert (found[2].toss, found[2].position) == (1, WORST)
    assert found[2].what == "23.0 mm and 23.0 deg off the truth"
    assert any("impact" in r for r in found[2].reasons)
    page = page_of(made)
    assert "The worst frames, and why" in page
    assert "toss 1, frame 6: 23.0 mm and 23.0 deg off the truth" in page


def test_without_a_truth_the_frames_with_the_worst_fit_are_shown(made):
    results, row, _ = made
    for toss in row.tracks:
        cost = np.full(FRAMES, 0.05)
        cost[WORST] = 0.4
        path = results.path / f"track-{toss}" / f"toss_{toss:02d}.fit.npz"
        np.savez(path, cost=cost, on_surface=np.full(FRAMES, 0.9), keyframes=np.array([0]))
    found = [w for w in worst_frames(results, replace(row, score=None)) if "lost" not in w.what]
    assert {(w.toss, w.position) for w in found[:2]} == {(0, WORST), (1, WORST)}
    assert found[0].what == "fits worst: residual 0.40"
    assert any("residual 0.40, usually 0.05" in r for r in found[0].reasons)


@pytest.mark.parametrize(
    "name, value, said",
    [
        ("mask_px", 0.0, "nothing of the object was found"),
        ("mask_px", 100.0, "little of it is seen: 100 pixels, usually 900"),
        ("at_edge", 1.0, "the image's edge cuts it off"),
        ("mask_confidence", 0.2, "its mask is unsure (0.20 of 1)"),
        ("residual", 0.5, "residual 0.50, usually 0.10"),
        ("on_surface", 0.3, "only 30 % of its points lie on the surface, usually 90 %"),
    ],
)
def test_a_reason_names_what_is_unusual_and_nothing_else(made, name, value, said):
    track = made[1].tracks[0]
    usual = {"residual": 0.1, "on_surface": 0.9, "mask_px": 900.0, "mask_confidence": 0.9, "at_edge": 0.0}
    arrays = {k: np.full(FRAMES, v) for k, v in usual.items()}
    calm = TossDiagnostics(track, np.full(FRAMES, np.nan), np.full(FRAMES, np.nan), **arrays)
    assert reasons(calm, 1) == ("nothing that was measured is unusual in it",)
    arrays[name][1] = value
    assert len(found := reasons(calm, 1)) == 1
    assert said in found[0]
    assert reasons(calm, GUESSED)[0] == "its pose is not sure, or one between its neighbours"


def test_runs_of_lost_frames_are_found(made):
    track = made[1].tracks[0]
    assert runs(track.lost) == [(LOST, LOST + 1)]
    assert runs(ObjectTrack.nowhere(0, "d455", track.time_ns).lost) == [(0, FRAMES)]


def test_friction_restitution_and_rollouts_stand_in_one_table_with_their_intervals(made):
    values = {
        "friction": {"value": 0.1775, "unit": "", "n": 4, "aligned": "nothing", "low": 0.06, "high": 0.295},
        "restitution": {"value": 0.11, "unit": "", "n": 4, "aligned": "nothing"},
        "rollout_position": {"value": 16.42, "unit": "mm", "n": 4, "aligned": "truth", "low": 2.04, "high": 30.8},
    }
    page = page_of(made, **values)
    table = re.search(r"<h2>What was learned of contact</h2><table>(.*?)</table>", page, re.S).group(1)
    cells = re.findall(r"<td>(.*?)</td>", table)
    assert cells == ["ours (all)", "0.177 [0.060, 0.295]", "0.110", "16.4 [2.0, 30.8]"]
    assert re.findall(r"<th>(.*?)</th>", table) == ["variant", "friction", "restitution", "rollout mm, truth"]
    assert "Of restitution's, +-0.20 of it is assumed, not measured." in page
    assert "What was learned of contact" not in page_of(made)


def test_help_lists_the_everyday_options_before_the_papers_and_the_developers():
    text = _parser().format_help()
    everyday = ["SESSION  ", "  --toss", "  --out", "  --truth", "  --model"]
    paper = ["the paper's table:", "  --variant", "the paper's second pass:", "  --redraw"]
    order = [*everyday, *paper, "contact from poses alone", "for developers:", "  --tracker"]
    body = text[text.index("positional") :]
    places = [body.index(word) for word in order]
    assert places == sorted(places)
    assert len(text.split("\n\n")[0].splitlines()) <= 2  # the usage is a line, not a screen
