"""How a track came about, as rerun shows it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from recordings.results.folder import Results, TossRecord, write_masks, write_variant
from recordings.results.track_notes import Matches, Rejected, write_notes
from recordings.view.blueprint import about_text, blueprint
from recordings.view.draw import Choice, open_scene, save_rrd
from recordings.view.track import mask_png, spanned

IMAGE, NAME = "/world/cameras/d455/image", "ours_all"


@pytest.fixture(scope="module")
def tracked(tiny: Any, session: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Results that keep how toss 0 was tracked: keyframes 0, 1 and the lost one; masks of 16x16 pixels."""
    folder = tmp_path_factory.mktemp("tracked") / "results"
    tiny.make_results(folder, session, names=("ours",), session_path=str(session))
    stage, n = folder / "track-00000000", tiny.FRAMES
    cost = np.where(np.arange(n) == tiny.LOST, np.nan, 0.1)
    np.savez(stage / "toss_00.fit.npz", cost=cost, on_surface=1 - cost, keyframes=np.array([0, 1, tiny.LOST]))
    mask = np.zeros((tiny.HEIGHT, tiny.WIDTH), dtype=bool)
    mask[16:32, 24:40] = True
    write_masks(stage, 0, [mask] * n, np.linspace(0.5, 1, n))
    pose = Results.open(folder).tracks()[0].camera_from_object[1]
    points = np.array([[[0.0, 0, 1], [0.1, 0, 1]], [[0, 0.1, 1], [0, 0, 1]]])
    matches = Matches(np.array([[1, 0], [1, 0]]), points, np.array([True, False]))
    write_notes(stage, 0, Rejected(np.array([1]), pose[None], np.array([0.4])), matches)
    record = Results.open(folder).find()
    tosses = (TossRecord(0, stage.name, masks=stage.name), record.toss(1))
    write_variant(folder, type(record)(**{**vars(record), "tosses": tosses}))
    return folder


@pytest.fixture(scope="module")
def rrd(tiny: Any, tracked: Any) -> Any:
    out = tracked.parent / "tracked.rrd"
    save_rrd(tracked, out)
    return tiny.Rrd(out)


def test_the_mask_lies_over_every_colour_image(tiny: Any, rrd: Any) -> None:
    rows = rrd.rows(f"{IMAGE}/mask_{NAME}", "EncodedImage:blob")
    assert [t for t, _, _ in rows] == [i * tiny.STEP_NS for i in range(tiny.FRAMES)]
    shown = cv2.imdecode(np.array(rows[0][2][0], dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    assert (shown[..., 3] > 0).sum() == 256


def test_the_tint_is_the_bodys_colour_and_nothing_elsewhere() -> None:
    mask = np.eye(4, dtype=bool)
    bgra = cv2.imdecode(np.frombuffer(mask_png(mask, (255, 140, 0)), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(bgra[..., 3] > 0, mask)
    np.testing.assert_array_equal(bgra[0, 0, :3], (0, 140, 255))


def test_figures_of_every_frame_are_plotted(tiny: Any, rrd: Any) -> None:
    for name in ("residual", "on_surface", "mask_confidence"):
        rows = rrd.rows(f"/track/{name}/{NAME}", "Scalars:scalars")
        assert len(rows) == tiny.FRAMES + 1  # and a NaN that ends the line
    residual = [value[0] for _, _, value in rrd.rows(f"/track/residual/{NAME}", "Scalars:scalars")]
    assert np.isnan(residual[tiny.LOST])
    assert residual[0] == pytest.approx(0.1)


def test_keyframes_look_at_the_object_from_where_the_camera_was(tiny: Any, tracked: Any, rrd: Any) -> None:
    rows = [r for r in rrd.rows(f"/model/{NAME}/keyframes", "Arrows3D:origins") if r[2]]
    assert [t for t, _, _ in rows] == [0, tiny.STEP_NS]  # the lost one has no pose
    assert [len(origins) for _, _, origins in rows] == [1, 2]
    pose = Results.open(tracked).tracks()[0].camera_from_object[1]
    camera = np.linalg.inv(pose)[:3, 3]
    np.testing.assert_allclose(
        rows[1][2][1] / np.linalg.norm(rows[1][2][1]), camera / np.linalg.norm(camera), atol=1e-6
    )


def test_what_was_seen_grows_with_the_keyframes_in_the_objects_frame(tiny: Any, tracked: Any, rrd: Any) -> None:
    assert {e for e in rrd.entities() if e.startswith(f"/model/{NAME}/seen/")} == {
        f"/model/{NAME}/seen/0",
        f"/model/{NAME}/seen/1",
    }
    ((time_ns, _, vertices),) = rrd.rows(f"/model/{NAME}/seen/1", "Mesh3D:vertex_positions")
    assert time_ns == tiny.STEP_NS
    world = tiny.falling(tiny.STEP_NS, 0).points(np.array(vertices, dtype=np.float64))
    np.testing.assert_allclose(world[:, 2], 0, atol=1e-3)  # the camera saw the table, 1 m below it


def test_matches_are_lines_between_their_two_places_and_red_where_poses_disagree(tiny: Any, rrd: Any) -> None:
    entity = f"{IMAGE}/matches_{NAME}"
    shown = {t: strips for t, _, strips in rrd.rows(entity, "LineStrips2D:strips")}
    assert [len(shown[i * tiny.STEP_NS] or []) for i in range(tiny.FRAMES)] == [0, 2, 0, 0, 0, 0]
    lens = tiny.rig().camera("d455")
    ends = lens.project(np.array([[0.1, 0, 1], [0.0, 0, 1]]))
    np.testing.assert_allclose(shown[tiny.STEP_NS][0], ends, atol=1e-3)
    colors = next(c for t, _, c in rrd.rows(entity, "LineStrips2D:colors") if t == tiny.STEP_NS)
    green, red = ((c >> np.array([24, 16, 8])) & 255 for c in colors)
    assert green[1] > green[0]
    assert red[0] > red[1]


def test_rejected_poses_are_axes_with_their_cost_in_their_own_frame_only(tiny: Any, rrd: Any) -> None:
    entity = f"/world/rejected/{NAME}"
    origins = {t: o for t, _, o in rrd.rows(entity, "Arrows3D:origins")}
    np.testing.assert_allclose(origins[tiny.STEP_NS], [tiny.falling(tiny.STEP_NS, 0).translation_m] * 3, atol=1e-6)
    assert not origins[2 * tiny.STEP_NS]
    labels = next(text for t, _, text in rrd.rows(entity, "Arrows3D:labels") if t == tiny.STEP_NS)
    assert labels[0] == "0.40"


def test_the_words_tell_of_what_is_shown_and_a_second_tab_of_the_model(tracked: Any, session: Any) -> None:
    scene = open_scene(tracked)
    text = about_text(scene)
    for words in ("Tint over the colour image", "Second tab in 3D", "red ones do not fit", "Grey axes"):
        assert words in text
    plain = open_scene(session, Choice(toss=0))
    assert "Tint" not in about_text(plain)
    assert "as seen so far" in str([v.name for v in blueprint(scene).root_container.contents[0].contents])


def test_triangles_span_no_step_and_no_hole() -> None:
    rays = np.dstack([*np.meshgrid(np.linspace(-0.1, 0.1, 4), np.linspace(-0.1, 0.1, 3)), np.ones((3, 4))])
    depth = np.ones((3, 4), dtype=np.float32)
    points, faces, pixels = spanned(rays, depth)
    assert len(faces) == 12
    np.testing.assert_array_equal(pixels, np.arange(12))
    np.testing.assert_allclose(points, rays.reshape(-1, 3))
    depth[:, 2:] = 2
    assert len(spanned(rays, depth)[1]) == 8
    depth[0, 0] = 0
    points, faces, pixels = spanned(rays, depth)
    assert 0 not in pixels
    assert faces.max() == len(points) - 1
