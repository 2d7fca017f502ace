"""`export video`: what the films show, and how they are written."""

from __future__ import annotations

import json
from fractions import Fraction

import av
import numpy as np
import pytest
from PIL import Image

from recordings.cli_session import main
from recordings.errors import BadInput
from recordings.exporters.export import export
from recordings.exporters.video import SLOWED
from recordings.film import file as film_file
from recordings.film.file import durations_ms, looping_webp, write_gif, write_mp4
from recordings.film.film import STATUS_RGB, Film
from recordings.film.raster import covered_pixels
from recordings.film.scene import Stage
from recordings.geometry import Transform
from recordings.results.folder import Results, write_track
from recordings.session import Session
from recordings.tracks import ObjectShape, ObjectTrack

STATUS = ["tracked", "tracked", "lost", "interpolated", "tracked", "tracked"]


@pytest.fixture
def seen_results(make_results):
    """Results whose object stands in the middle of every image, 0.7 m before the camera; frame 2 is lost."""
    path = make_results()
    results = Results.open(path)
    for toss, track in results.tracks().items():
        poses = np.tile(np.eye(4), (len(STATUS), 1, 1))
        poses[:, :3, 3] = [0.0, -0.02, 0.7]
        poses[2] = np.nan
        write_track(path / results.find().toss(toss).track, ObjectTrack(
            toss, track.camera, track.object_frame, track.time_ns, poses, tuple(STATUS), track.covariance))  # fmt: skip
    return path


@pytest.fixture
def film(seen_results):
    results = Results.open(seen_results)
    session = Session.open(results.session_path())
    yield Film(session.toss(0), results.find().calibration, results.tracks()[0], results.shape(), "4 times slower")
    session.close()


def pixels_of(image, color):
    return (image == np.array(color)).all(axis=-1)


def test_the_outline_has_the_color_of_the_status_and_a_lost_frame_has_none(film):
    for i, status in enumerate(STATUS):
        image = film.color(i)
        for name, color in STATUS_RGB.items():
            assert pixels_of(image, color).any() == (name == status and status != "lost"), (i, name)


def test_the_outline_is_the_border_of_what_the_shape_covers(film):
    camera = film.track.camera
    model = film._calibration.camera(camera).scaled(float(film.factor))
    covered = covered_pixels(film.shape, film.track.pose(0), model)
    rows, columns = np.nonzero(covered)
    drawn = np.nonzero(pixels_of(film.color(0), STATUS_RGB["tracked"]))
    for inside, found in zip((rows, columns), drawn, strict=True):
        assert abs(inside.min() - found.min()) <= 2
        assert abs(inside.max() - found.max()) <= 2


def test_a_film_has_as_many_frames_as_the_toss_and_keeps_its_times(seen_results, tmp_path):
    export("video", seen_results, tmp_path / "out")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["toss_00.mp4", "toss_01.mp4"]
    track = Results.open(seen_results).tracks()[1]
    with av.open(str(tmp_path / "out" / "toss_01.mp4")) as container:
        times_s = [float(frame.pts * frame.time_base) for frame in container.decode(video=0)]
    assert len(times_s) == len(track.time_ns)
    np.testing.assert_allclose(times_s, SLOWED * 1e-9 * (track.time_ns - track.time_ns[0]), atol=1e-4)


@pytest.mark.parametrize("codec", film_file.CODECS)
def test_either_codec_gives_the_picture_back(tmp_path, codec):
    if codec not in av.codecs_available:
        pytest.skip(f"this FFmpeg has no {codec}")
    images = [np.full((64, 96, 3), value, dtype=np.uint8) for value in (20, 120, 220)]
    assert write_mp4(tmp_path / "a.mp4", images, np.array([0.0, 0.1, 0.3]), codec) == 3
    with av.open(str(tmp_path / "a.mp4")) as container:
        found = [frame.to_ndarray(format="rgb24").mean() for frame in container.decode(video=0)]
    np.testing.assert_allclose(found, [20, 120, 220], atol=4)


def test_without_pyav_the_films_are_gifs_and_that_is_said(seen_results, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(film_file, "find_spec", lambda name: None)
    assert main(["export", "video", str(seen_results), str(tmp_path / "out")]) == 0
    assert "GIF, because PyAV is not installed; for MP4: pip install av" in capsys.readouterr().out
    with Image.open(tmp_path / "out" / "toss_00.gif") as gif:
        assert gif.format == "GIF"
        assert gif.n_frames == len(STATUS)


def test_the_codec_is_said(seen_results, tmp_path, capsys):
    assert main(["export", "video", str(seen_results), str(tmp_path / "out")]) == 0
    assert "H.264; 4 times slower than it was" in capsys.readouterr().out


def test_without_the_session_the_film_is_refused(seen_results, tmp_path, capsys):
    variant = seen_results / "variants" / "bundlesdf-1.all.json"
    document = json.loads(variant.read_text())
    variant.write_text(json.dumps({**document, "session_path": "gone"}))
    assert main(["export", "video", str(seen_results), str(tmp_path / "out")]) == 2
    assert "the session that" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_recording_of_another_length_is_refused(seen_results):
    results = Results.open(seen_results)
    track = results.tracks()[0]
    shorter = ObjectTrack(0, "d455", "object", track.time_ns[:4], track.camera_from_object[:4], tuple(STATUS[:4]),
                          track.covariance[:4])  # fmt: skip
    with Session.open(results.session_path()) as session, pytest.raises(BadInput, match="6 colour frames.*has 4"):
        Film(session.toss(0), results.find().calibration, shorter, None)


def test_the_scene_shows_the_object_where_it_is_and_the_way_it_came(film):
    """The eye sees every pose; a lost frame shows the way alone."""
    last, lost = film.scene(5), film.scene(2)
    assert last.shape == lost.shape
    assert last.shape[0] == last.shape[1]
    assert (last != lost).any()
    stage: Stage = film._stage
    place = (stage.eye_from_root @ stage.root_from_camera).points(film._path[[0]])
    u, v = stage.eye.project(place)[0].round().astype(int)
    assert (last[v - 3 : v + 4, u - 3 : u + 4] != stage.background[v - 3 : v + 4, u - 3 : u + 4]).any()


def test_a_square_covers_the_pixels_that_its_corners_say(film):
    """A square of 0.2 m at 1 m covers 2 * 0.1 * f pixels, and nothing behind the camera is drawn."""
    model = film._calibration.camera("d455")
    corners = np.array([[x, y, 0.0] for x in (-0.1, 0.1) for y in (-0.1, 0.1)])
    square = ObjectShape("object", "test", corners, np.array([[0, 1, 2], [1, 3, 2]]))
    at = Transform("d455", "object", np.eye(3), np.array([0, 0, 1.0]))
    covered = covered_pixels(square, at, model)
    assert covered.sum() == pytest.approx(0.04 * model.fx * model.fy, rel=0.2)
    behind = Transform("d455", "object", np.eye(3), np.array([0, 0, -1.0]))
    assert not covered_pixels(square, behind, model).any()


def test_the_nearer_of_two_surfaces_is_seen_whichever_is_drawn_first(film):
    from recordings.film.raster import Canvas

    model = film._calibration.camera("d455")
    corners = np.array([[x, y, 0.0] for x in (-0.2, 0.2) for y in (-0.2, 0.2)])
    faces, at = np.array([[0, 1, 2], [1, 3, 2]]), [np.array([0, 0, z]) for z in (0.5, 1.0)]
    shapes = [ObjectShape("object", "test", corners, faces, np.tile(np.array(c, dtype=np.uint8), (4, 1)))
              for c in ((255, 0, 0), (0, 0, 255))]  # fmt: skip
    middle = []
    for order in ((0, 1), (1, 0)):
        canvas = Canvas.on(model, np.zeros((model.height, model.width, 3), dtype=np.uint8))
        for k in order:
            canvas.draw(shapes[k], Transform("d455", "object", np.eye(3), at[k]))
        middle.append(canvas.image()[int(model.cy), int(model.cx)])
    np.testing.assert_array_equal(middle[0], middle[1])
    assert middle[0][0] > 100
    assert middle[0][2] == 0


def test_durations_follow_the_times():
    times_s = np.arange(31) * float(Fraction(1, 30))
    assert sum(durations_ms(times_s, 10)[:-1]) == 1000
    assert durations_ms(np.array([0.5])) == [100]


def test_pictures_in_time_hold_every_frame(tmp_path):
    images = [np.full((20, 30, 3), value, dtype=np.uint8) for value in (0, 80, 160, 240)]
    assert write_gif(tmp_path / "a.gif", images, np.arange(4) * 0.1) == 4
    (tmp_path / "a.webp").write_bytes(looping_webp(images, np.arange(4) * 0.1, 60))
    for name in ("a.gif", "a.webp"):
        with Image.open(tmp_path / name) as found:
            assert found.n_frames == 4
            assert found.info.get("loop", 0) == 0
