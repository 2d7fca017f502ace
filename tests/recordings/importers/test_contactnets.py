"""Toss files of ContactNets and dair_pll: units from the parameters, meanings checked, no answer taken along."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings.errors import BadInput
from recordings.importers.contactnets import import_contactnets
from recordings.session import Session

torch = pytest.importorskip("torch")
DT, SCALE, STEPS = 1 / 148, 0.05, 40


def flight(seed: int) -> dict[str, np.ndarray]:
    """A cube in free fall, spinning about its own z: position, quaternion wxyz, velocity, spin (SI)."""
    rng = np.random.default_rng(seed)
    t = np.arange(STEPS)[:, None] * DT
    start, v0 = rng.normal(size=3) + [0, 0, 1], rng.normal(size=3)
    position = start + v0 * t - np.array([0, 0, 0.5 * 9.81]) * t**2
    velocity = np.vstack([v0, np.diff(position, axis=0) / DT])
    half = 0.5 * 6.0 * t[:, 0]
    base = np.array([np.cos(0.4), np.sin(0.4), 0, 0])  # leans, so that object and world spins differ
    turn = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], -1)
    w, x = base[0], base[1]
    quaternion = np.stack([w * turn[:, 0], x * turn[:, 0], -x * turn[:, 3], w * turn[:, 3]], -1)
    return {"p": position, "q": quaternion, "v": velocity, "w": np.tile([0, 0, 6.0], (STEPS, 1))}


def save_contactnets(path: Path, toss: dict[str, np.ndarray], scale: float = SCALE) -> None:
    table = np.hstack([toss["p"] / scale, toss["q"], toss["v"] / scale, toss["w"], np.zeros((STEPS, 6))])
    torch.save(torch.tensor(table[None]), path)


def save_dair(path: Path, toss: dict[str, np.ndarray]) -> None:
    torch.save(torch.tensor(np.hstack([toss["q"], toss["p"], toss["w"], toss["v"]])), path)


@pytest.fixture
def tosses(tmp_path: Path) -> Path:
    """A parent with tosses 4, 7 and 12 (a copy of 4, turned about z) in contact-nets' format, and its parameters."""
    folder = tmp_path / "cn" / "tosses_processed"
    folder.mkdir(parents=True)
    (tmp_path / "cn" / "params_processed").mkdir()
    document = {"dt": DT, "g": 9.81 / SCALE, "mass": 0.37, "inertia": 0.3, "mu": 0.18, "vertices": [[1, 1, 1]]}
    (tmp_path / "cn" / "params_processed" / "experiment.json").write_text(json.dumps(document))
    for number in (4, 7):
        save_contactnets(folder / f"{number}.pt", flight(number))
    turned = flight(4)
    turned["p"], turned["v"] = (turned[k][:, [1, 0, 2]] * [-1, 1, 1] for k in ("p", "v"))
    turned["q"] = turned["q"] @ (np.sqrt(0.5) * np.array([[1, 0, 0, 1], [0, 1, 1, 0], [0, -1, 1, 0], [-1, 0, 0, 1]]))
    save_contactnets(folder / "12.pt", turned)
    return tmp_path / "cn"


def test_poses_come_in_with_their_numbers_in_metres_and_seconds(tosses, tmp_path):
    report = import_contactnets(tosses, tmp_path / "session")
    assert report.tosses == (4, 7, 12)
    session = Session.open(tmp_path / "session")
    poses, wanted = session.toss(7).poses(), flight(7)
    np.testing.assert_allclose([p.matrix[:3, 3] for p in poses], wanted["p"], atol=1e-12)
    offset_ns = session.toss(7).info["clock_offset_ns"]
    assert [p.time_ns - offset_ns for p in poses] == [round(k * DT * 1e9) for k in range(STEPS)]
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_quat(wanted["q"][:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose([p.matrix[:3, :3] for p in poses], turns, atol=1e-12)
    assert {(p.target, p.source, p.status) for p in poses} == {("world", "object", "tracked")}


def test_mass_and_inertia_come_along_and_friction_and_shape_do_not(tosses, tmp_path):
    import_contactnets(tosses, tmp_path / "session")
    physics = Session.open(tmp_path / "session").start["object"]["physics"]
    assert physics["mass_kg"] == 0.37
    np.testing.assert_allclose(physics["inertia_kgm2"], np.eye(3) * 0.3 * SCALE**2)
    said = (tmp_path / "session" / "session.json").read_text()
    assert "0.18" not in said
    assert "vertices" not in said
    assert not (tmp_path / "session" / "truth").exists()


def test_the_same_recording_twice_is_kept_and_named(tosses, tmp_path):
    report = import_contactnets(tosses, tmp_path / "session")
    session = Session.open(tmp_path / "session")
    assert session.start["import"]["duplicates"] == [[4, 12]]
    assert session.toss(12).info["same_recording_as"] == [4]
    assert any("4=12" in w for w in report.warnings)


def test_what_the_columns_say_of_each_other_is_kept(tosses, tmp_path):
    import_contactnets(tosses, tmp_path / "session")
    checks = Session.open(tmp_path / "session").start["import"]["checks"]
    assert checks["step_ratio"] == pytest.approx(1, abs=1e-9)
    assert checks["fall_m_s2"] == pytest.approx(-9.81, abs=1e-6)
    assert checks["spin_mismatch_rad_s"] == pytest.approx(0, abs=1e-9)
    assert checks["spin_mismatch_world_rad_s"] > 1
    assert checks["spin_mismatch_xyzw_rad_s"] > 1


@pytest.mark.parametrize("path", ["tosses_processed", "tosses_processed/7.pt"])
def test_a_folder_and_one_file_find_their_parameters_beside_them(tosses, tmp_path, path):
    import_contactnets(tosses / path, tmp_path / "session")
    assert Session.open(tmp_path / "session").start["import"]["scale_m"] == pytest.approx(SCALE)


def test_the_metres_of_dair_pll_are_not_scaled_again(tosses, tmp_path):
    (tosses / "dair_pll_format").mkdir()
    save_dair(tosses / "dair_pll_format" / "3.pt", flight(3))
    import_contactnets(tosses / "dair_pll_format", tmp_path / "session")
    poses = Session.open(tmp_path / "session").toss(3).poses()
    np.testing.assert_allclose([p.matrix[:3, 3] for p in poses], flight(3)["p"], atol=1e-12)
    report = import_contactnets(tosses, tmp_path / "parent")
    assert report.tosses == (4, 7, 12)
    assert any("dair_pll_format beside it was not" in w for w in report.warnings)


def test_without_parameters_scale_and_step_must_be_given(tosses, tmp_path):
    (tosses / "params_processed" / "experiment.json").unlink()
    with pytest.raises(BadInput, match="--scale METRES and --dt SECONDS must be given"):
        import_contactnets(tosses, tmp_path / "session")
    with pytest.raises(BadInput, match="so --scale METRES must be given"):
        import_contactnets(tosses, tmp_path / "session", dt_s=DT)
    import_contactnets(tosses, tmp_path / "session", SCALE, DT)
    assert "physics" not in Session.open(tmp_path / "session").start["object"]


@pytest.mark.parametrize(
    "scale, dt, message",
    [
        (2 * SCALE, DT, "fall at 19.6 m/s"),
        (SCALE / 2, DT, "fall at 4.9"),
        (SCALE, 2 * DT, "--dt 0.0067567"),
        (SCALE, 0.0, "step 0 s"),
        (-1.0, DT, "scale -1 m"),
    ],
)
def test_a_scale_or_a_step_that_contradicts_the_numbers_is_refused(tosses, tmp_path, scale, dt, message):
    with pytest.raises(BadInput, match=message):
        import_contactnets(tosses, tmp_path / "session", scale, dt)
    assert not (tmp_path / "session").exists()


def test_a_step_that_is_a_little_off_is_warned_of(tosses, tmp_path):
    report = import_contactnets(tosses, tmp_path / "session", SCALE, 0.0068)
    assert any("off the given 0.0068 s" in w for w in report.warnings)


def test_quaternions_in_another_order_are_refused(tosses, tmp_path):
    for number in (4, 7, 12):
        toss = flight(number)
        toss["q"] = np.roll(toss["q"], -1, axis=1)
        save_contactnets(tosses / "tosses_processed" / f"{number}.pt", toss)
    with pytest.raises(BadInput, match="read as x y z w"):
        import_contactnets(tosses, tmp_path / "session")


@pytest.mark.parametrize(
    "column, change, words",
    [
        ("w", lambda toss, turn: turn.apply(toss["w"]), "spins fit the quaternions when read in the world frame"),
        ("v", lambda toss, turn: turn.inv().apply(toss["v"]), "velocities fit the positions when read in the object"),
    ],
)
def test_velocities_in_another_frame_are_named(tmp_path, column, change, words):
    folder = tmp_path / "data" / "tosses_processed"
    folder.mkdir(parents=True)
    for number in range(3):
        toss = flight(number)
        turn = Rotation.from_quat(toss["q"][:, [1, 2, 3, 0]])
        save_contactnets(folder / f"{number}.pt", toss | {column: change(toss, turn)})
    report = import_contactnets(folder, tmp_path / "out", scale_m=SCALE, dt_s=DT)
    assert any(words in w for w in report.warnings)


@pytest.mark.parametrize(
    "table, message",
    [
        (np.zeros((121, 15)), "articulated"),
        (np.zeros((10, 5)), r"shape \(10, 5\)"),
        (np.zeros((40, 13)), "no unit quaternions"),
        (np.full((40, 13), np.nan), "NaN"),
    ],
)
def test_files_of_other_contents_are_refused(tosses, tmp_path, table, message):
    (tosses / "other").mkdir()
    torch.save(torch.tensor(table), tosses / "other" / "0.pt")
    with pytest.raises(BadInput, match=message):
        import_contactnets(tosses / "other", tmp_path / "session")
    assert not (tmp_path / "session").exists()


def test_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(BadInput, match=r"holds no \.pt files"):
        import_contactnets(tmp_path, tmp_path / "session")
    with pytest.raises(BadInput, match="does not exist"):
        import_contactnets(tmp_path / "nowhere", tmp_path / "session")


def check_published(session: Path, count: int, duplicates: int) -> None:
    start = Session.open(session).start
    assert len(Session.open(session).tosses) == count
    assert len(start["import"]["duplicates"]) == duplicates
    assert start["import"]["scale_m"] == pytest.approx(0.0524)
    assert start["import"]["checks"]["spin_mismatch_rad_s"] < 0.1
    assert start["import"]["checks"]["fall_m_s2"] == pytest.approx(-9.67, abs=0.3)
    assert start["object"]["physics"]["inertia_kgm2"][0][0] == pytest.approx(0.00081, rel=1e-3)


def test_some_published_tosses_are_what_their_page_says(data, tmp_path):
    """Two pairs of one recording among ten files; gravity and spins fit."""
    source = data("contactnets")
    shutil.copytree(source / "params_processed", tmp_path / "cn" / "params_processed")
    (tmp_path / "cn" / "tosses_processed").mkdir()
    pairs = [39, 368, 56, 140]
    others = [p for p in sorted((source / "tosses_processed").glob("*.pt")) if int(p.stem) not in pairs][:6]
    for path in [*others, *(source / "tosses_processed" / f"{n}.pt" for n in pairs)]:
        shutil.copy(path, tmp_path / "cn" / "tosses_processed")
    import_contactnets(tmp_path / "cn", tmp_path / "session")
    check_published(tmp_path / "session", 10, 2)


@pytest.mark.slow
def test_the_published_tosses_are_what_their_page_says(data, tmp_path):
    """Eleven pairs of the 377 files here are one recording."""
    import_contactnets(data("contactnets"), tmp_path / "session")
    check_published(tmp_path / "session", 377, 11)
