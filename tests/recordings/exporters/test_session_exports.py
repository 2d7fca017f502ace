"""Exports of recordings: folder, mcap, lerobot, rrd."""

from __future__ import annotations

import json

import numpy as np
import pytest
from mcap.reader import make_reader

from recordings.exporters.export import export
from recordings.exporters.folder import seconds
from recordings.exporters.lerobot import arm_at, grid
from recordings.importers.folder import import_folder
from recordings.mcap.codec import decode_image
from recordings.records import ArmStates
from recordings.session import Session, Toss


def test_a_recorded_session_goes_out_and_comes_in_again(write_session, tmp_path):
    """Recorded clocks start anywhere and mono cameras have times of their own: differences are kept to the
    nanosecond."""
    source = Session.open(write_session(tosses=2))
    export("folder", source.path, tmp_path / "out")
    import_folder(tmp_path / "out", tmp_path / "again")
    again = Session.open(tmp_path / "again")
    for number in source.tosses:
        one, two = source.toss(number), again.toss(number)
        begin, offset = one.color().times_ns[0], two.info["clock_offset_ns"]
        for stream in ("color", "depth"):
            a, b = getattr(one, stream)(), getattr(two, stream)()
            np.testing.assert_array_equal(a.times_ns - begin, b.times_ns - offset)
        np.testing.assert_array_equal(one.mono("mono0").times_ns - begin, two.mono("mono0").times_ns - offset)
        assert [i.data for i in one.color()] == [i.data for i in two.color()]
        for a, b in zip(one.depth(), two.depth(), strict=True):
            np.testing.assert_array_equal(a.raw, b.raw)
        for a, b in zip(one.mono("mono0"), two.mono("mono0"), strict=True):
            np.testing.assert_array_equal(decode_image(a), decode_image(b))
        np.testing.assert_array_equal(one.masks()[0], two.masks()[0])
        arm_one, arm_two = one.arm_states(), two.arm_states()
        assert arm_one is not None
        assert arm_two is not None
        np.testing.assert_array_equal(arm_one.q_rad, arm_two.q_rad)
        np.testing.assert_array_equal(arm_one.finger_width_m, arm_two.finger_width_m)
        assert arm_one.joint_names == arm_two.joint_names
        release_one, release_two = one.window().release_time_ns, two.window().release_time_ns
        assert release_one is not None
        assert release_two is not None
        assert release_one - begin == release_two - offset
    found, wanted = again.calibration, source.calibration
    np.testing.assert_array_equal(found.camera("d455").K, wanted.camera("d455").K)
    np.testing.assert_array_equal(found.transform("world", "d455").matrix, wanted.transform("world", "d455").matrix)


@pytest.mark.parametrize(
    "time_ns, decimals, text",
    [
        (0, 6, "0.000000"),
        (33_001_000, 6, "0.033001"),
        (1_000_000_001, 6, "1.000000001"),
        (-5_000_000, 6, "-0.005000"),
        (1_000_000, 3, "0.001"),
        (1_500, 3, "0.000001500"),
        (-1, 6, "-0.000000001"),
        (61_999_999_999, 3, "61.999999999"),
    ],
)
def test_times_are_written_without_rounding(time_ns, decimals, text):
    assert seconds(np.array([time_ns]), decimals) == [text]


def test_the_mcap_copy_holds_depth_in_the_standard_schema_and_all_else_as_it_was(write_session, tmp_path):
    source = write_session()
    export("mcap", source, tmp_path / "out")
    with open(source / "toss_00.mcap", "rb") as a, open(tmp_path / "out" / "toss_00.mcap", "rb") as b:
        first, second = make_reader(a), make_reader(b)
        one = {(c.topic, m.sequence, m.log_time, m.publish_time): (s.name, m.data) for s, c, m in first.iter_messages()}
        two = {
            (c.topic, m.sequence, m.log_time, m.publish_time): (s.name, m.data) for s, c, m in second.iter_messages()
        }
        names_one = {x.name: x.data for x in first.iter_attachments()}
        assert {x.name: x.data for x in second.iter_attachments()} == names_one
        compressions = {c.compression for c in second.get_summary().chunk_indexes}
    assert set(one) == set(two)
    for key, (name, data) in one.items():
        if key[0] == "/d455/depth":
            assert (name, two[key][0]) == ("tosslab.DepthImage", "foxglove.RawImage")
        else:
            assert two[key] == (name, data)
    assert "zstd" in compressions
    before, after = Session.open(source).toss(0), Toss(tmp_path / "out" / "toss_00.mcap")
    for a, b in zip(before.depth(), after.depth(), strict=True):
        np.testing.assert_array_equal(a.raw, b.raw)
        assert (a.unit_m, a.time_ns, a.index) == (b.unit_m, b.time_ns, b.index)


def test_a_lerobot_dataset_says_of_itself_what_is_in_it(write_session, tmp_path):
    av, pq = pytest.importorskip("av"), pytest.importorskip("pyarrow.parquet")
    source = write_session(tosses=2)
    export("lerobot", source, tmp_path / "out")
    info = json.loads((tmp_path / "out" / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["fps"]) == ("v3.0", 30)
    assert (info["total_episodes"], info["total_frames"]) == (2, 12)
    place = {"chunk_index": 0, "file_index": 0, "video_key": "observation.images.d455"}
    table = pq.read_table(tmp_path / "out" / info["data_path"].format(**place))
    assert {*table.schema.names, "observation.images.d455"} == set(info["features"])
    assert table.column("index").to_pylist() == list(range(12))
    assert table.column("episode_index").to_pylist() == [0] * 6 + [1] * 6
    np.testing.assert_allclose(table.column("timestamp").to_pylist()[:6], np.arange(6) / 30, rtol=1e-6)
    assert info["features"]["observation.state"]["shape"] == [15]
    assert table.schema.field("observation.state").type.list_size == 15
    with av.open(str(tmp_path / "out" / info["video_path"].format(**place))) as video:
        frames = list(video.decode(video=0))
    assert len(frames) == 12
    np.testing.assert_allclose([float(f.time) for f in frames], np.arange(12) / 30, atol=1e-4)
    wanted = decode_image(Session.open(source).toss(1).color()[3]).astype(float)
    off = [np.abs(f.to_ndarray(format="rgb24") - wanted).mean() for f in frames]
    assert min(off) < 8  # the video halves the colours' resolution, and the images are small
    assert sorted(off)[2] > 30
    assert off[9] == off[3] == min(off)  # both tosses of the small rig show the same images
    episodes = pq.read_table(tmp_path / "out" / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()
    assert [(e["dataset_from_index"], e["dataset_to_index"]) for e in episodes] == [(0, 6), (6, 12)]
    assert episodes[1]["videos/observation.images.d455/from_timestamp"] == pytest.approx(0.2)
    stats = json.loads((tmp_path / "out" / "meta" / "stats.json").read_text())
    assert stats["observation.images.d455"]["count"] == [12]
    assert len(stats["observation.state"]["mean"]) == 15


def test_depth_in_a_lerobot_dataset_is_to_the_last_bit(write_session, tmp_path):
    pq, cv2 = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("cv2")
    pytest.importorskip("av")
    source = write_session()
    export("lerobot", source, tmp_path / "out")
    table = pq.read_table(tmp_path / "out" / "data" / "chunk-000" / "file-000.parquet")
    png = table.column("observation.depth.d455")[4].as_py()["bytes"]
    raw = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(raw, Session.open(source).toss(0).depth()[4].raw)


def test_a_lerobot_dataset_of_results_holds_the_poses_and_nan_where_lost(make_results, tmp_path):
    pq = pytest.importorskip("pyarrow.parquet")
    pytest.importorskip("av")
    export("lerobot", make_results(), tmp_path / "out")
    table = pq.read_table(tmp_path / "out" / "data" / "chunk-000" / "file-000.parquet")
    poses = np.array(table.column("observation.object_pose").to_pylist())
    assert np.isnan(poses[2]).all()
    np.testing.assert_allclose(poses[7, :3], [0.01, -1 / 3, 1.7], rtol=1e-6)


def test_a_missing_frame_is_filled_by_its_neighbour_on_the_grid():
    times_ns = np.array([0, 33_400_000, 100_100_000, 133_300_000]) + 5_000
    assert grid(times_ns, 30).tolist() in ([0, 1, 1, 2, 3], [0, 1, 2, 2, 3])


def test_joint_states_are_interpolated_between_samples():
    times_ns = np.arange(4, dtype=np.int64) * 1_000_000
    ramp = np.arange(4.0)[:, None] * [1.0, 10.0]
    arm = ArmStates(times_ns, ("a", "b"), ramp, 2 * ramp, np.full(4, np.nan))
    names, values = arm_at(arm, np.array([1_500_000, 9_000_000]))
    assert names == ("a.pos", "b.pos", "a.vel", "b.vel")
    np.testing.assert_allclose(values, [[1.5, 15, 3, 30], [3, 30, 6, 60]])


def test_an_rrd_is_what_the_viewer_saves(write_session, tmp_path):
    pytest.importorskip("rerun")
    report = export("rrd", write_session(), tmp_path / "small.rrd")
    assert report.files == 1
    assert (tmp_path / "small.rrd").stat().st_size > 1000
