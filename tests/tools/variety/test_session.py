"""Bad presets and bad meshes are named; a session is whole, or nothing is left."""

import argparse
import importlib.util
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from variety import arms, colour, scene, seeds, session, spec, throws
from variety.mesh_files import read_textured, textured_mesh

from recordings.errors import BadInput
from recordings.geometry import rotation_angle_rad

ROOT = Path(__file__).resolve().parents[3]
CASE = seeds.Case("choose", 9, 0)
BLENDER = pytest.mark.skipif(
    not (colour.OWN_PYTHON.exists() or __import__("os").environ.get("VARIETY_BLENDER")),
    reason="no Blender: make blender",
)


def small(**changed):
    """A session of one short toss, quick to make."""
    drawn = spec.draw(CASE, 1)
    camera = replace(drawn.camera, width=424, height=240, focal_px=390.0, center_off_px=(0.0, 0.0), dropped=0.0)
    return replace(drawn, tosses=("good",), camera=camera, clutter=0, table="mat", holder="none", occluder="none",
                   person=False, **changed)  # fmt: skip


def textured_cube(folder, scale=1.0, texture=True, open_=False):
    """An .obj of a 10 cm cube with a picture, or one fault of it."""
    box = trimesh.creation.box((0.1 * scale,) * 3)
    faces = box.faces[:-1] if open_ else box.faces
    lines = ["mtllib cube.mtl", "usemtl skin", *("v {} {} {}".format(*v) for v in box.vertices)]
    lines += ["vt 0.1 0.1", "vt 0.9 0.1", "vt 0.9 0.9"] if texture else []
    lines += ["f " + " ".join(f"{v + 1}/{k + 1}" if texture else f"{v + 1}" for k, v in enumerate(f)) for f in faces]
    (folder / "cube.obj").write_text("\n".join(lines) + "\n")
    (folder / "cube.mtl").write_text("newmtl skin\nKd 1 1 1\n" + ("map_Kd skin.png\n" if texture else ""))
    cv2.imwrite(str(folder / "skin.png"), np.full((32, 32, 3), (40, 80, 200), np.uint8))
    return folder / "cube.obj"


def test_what_crosses_the_line_of_sight_does_so_in_mid_flight() -> None:
    for seed in range(8):
        eye_m = np.array([0.6, -0.3, 0.8])
        at = throws._passing(eye_m, 1.0, np.random.default_rng(seed))
        before, middle, after = (at(t) for t in (0.8, 1.0, 1.2))
        assert before is not None
        assert middle is not None
        assert after is not None
        way = after.translation_m - before.translation_m
        assert abs(way @ eye_m) < 1e-9
        assert 0.3 < np.linalg.norm(way) < 0.7
        assert np.linalg.norm(np.cross(middle.translation_m - [0, 0, 0.05], eye_m)) < 1e-9  # between eye and table
        assert at(1.4) is None


def test_a_good_mesh_keeps_its_size_and_its_picture(tmp_path):
    mesh = read_textured(textured_cube(tmp_path))
    np.testing.assert_allclose(np.ptp(mesh.vertices_m, axis=0), 0.1, rtol=1e-6)
    np.testing.assert_allclose(mesh.atlas[16, 16], [0.578, 0.080, 0.021], atol=2e-3)  # sRGB 200, 80, 40 in linear light


def test_a_mesh_without_texture_is_named(tmp_path):
    with pytest.raises(BadInput, match=r"cube\.obj has no texture"):
        textured_mesh_of(textured_cube(tmp_path, texture=False))


def test_a_mesh_that_is_not_closed_is_named(tmp_path):
    with pytest.raises(BadInput, match=r"cube\.obj is not closed"):
        textured_mesh_of(textured_cube(tmp_path, open_=True))


def test_a_mesh_in_millimetres_is_named_with_the_remedy(tmp_path):
    with pytest.raises(BadInput, match=r"cube\.obj is 100 m long.*in millimetres: scale it by 0\.001"):
        textured_mesh_of(textured_cube(tmp_path, scale=1000.0))


def textured_mesh_of(path):
    return textured_mesh(path.parent, np.random.default_rng(0))


def test_a_folder_without_meshes_is_named(tmp_path):
    with pytest.raises(BadInput, match="holds no mesh"):
        textured_mesh(tmp_path, np.random.default_rng(0))


def test_a_preset_that_puts_the_object_out_of_view_is_named(monkeypatch):
    monkeypatch.setattr(throws, "TRIES", 6)
    far = small()
    away = replace(far, camera=replace(far.camera, focal_px=3000.0))
    with pytest.raises(BadInput, match=r"choose-009, toss 0 \(good\): in none of 6 draws"):
        throws.Thrower(away, scene.build(away)).throw(0)


def test_a_good_toss_is_in_view_all_the_time_and_one_that_rolls_out_is_not_at_its_end():
    drawn = small()
    built = scene.build(drawn)
    thrown = throws.Thrower(drawn, built).throw(0)
    rolling = replace(drawn, tosses=("rolls out",), friction=0.06, table="wood")
    gone = throws.Thrower(rolling, built).throw(0)
    assert seen(built, thrown).all()
    assert seen(built, gone)[0]
    assert not seen(built, gone)[-1]


def seen(built, thrown):
    found = []
    for t in np.linspace(0, thrown.instants.end_s, 25):
        local = built.world_from_camera.inverse().points(thrown.object.at(t).points(built.tossed.hull_m))
        found.append(bool(built.camera.sees(built.camera.project(local)).all()))
    return np.array(found)


def test_an_object_dropped_twice_falls_lies_is_lifted_and_falls_again():
    drawn = replace(small(), tosses=("twice",))
    thrown = throws.Thrower(drawn, scene.build(drawn)).throw(0)
    height = np.array([thrown.object.at(t).translation_m[2] for t in np.linspace(0, thrown.instants.end_s, 200)])
    lowest = int(height[: int(200 * thrown.instants.lead_in_s / thrown.instants.end_s)].argmin())
    assert height[lowest] < height[0] - 0.01
    assert height[lowest:].max() > height[lowest] + 0.08
    assert height[-1] < height[lowest:].max() - 0.08


def bench():
    told = importlib.util.spec_from_file_location("bench_variety", ROOT / "tools" / "bench_variety.py")
    module = importlib.util.module_from_spec(told)
    told.loader.exec_module(module)
    return module


ASKED = argparse.Namespace(tosses=1, objects=None, variant="ours", threads=1, sessions=None)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [(BadInput("object out of view"), "skipped: object out of view"), (ValueError("odd"), "crashed: ValueError: odd")],
)
def test_a_session_that_cannot_be_made_is_a_row_with_its_reason_and_leaves_nothing(monkeypatch, tmp_path, wrong, named):
    program = bench()

    def fail(*_):
        raise wrong

    monkeypatch.setattr(program.session, "make", fail)
    row = program.run_case(CASE, tmp_path / "work", ASKED)
    assert row["failed"].startswith(named)
    assert row["case"] == "choose-009"
    assert not (tmp_path / "work").exists()
    json.dumps(row)


def test_a_kept_session_is_used_again_and_one_of_another_spec_is_made_anew(monkeypatch, tmp_path):
    program, made = bench(), []

    def make(spec, out, *_):
        made.append(spec)
        truth = out.with_name(f"{out.name}_truth")
        out.mkdir(parents=True)
        truth.mkdir()
        (truth / "spec.json").write_text(json.dumps(spec.to_json()))
        return truth

    monkeypatch.setattr(program.session, "make", make)
    asked, drawn = argparse.Namespace(**{**vars(ASKED), "sessions": tmp_path / "kept"}), small()
    for wanted in (drawn, drawn, replace(drawn, tosses=("twice",))):
        folder, truth = program._made(wanted, tmp_path / "work" / drawn.name, asked)
        assert folder == tmp_path / "kept" / drawn.name
        assert json.loads((truth / "spec.json").read_text()) == json.loads(json.dumps(wanted.to_json()))
        assert not list((tmp_path / "work").iterdir())
    assert len(made) == 2
    assert made[0] != made[1]


def test_what_a_run_cost_is_what_its_stages_cost(tmp_path):
    for stage, spent_s in (("track-1", 12.5), ("fuse-2", 3.25)):
        (tmp_path / stage).mkdir()
        (tmp_path / stage / "stage.json").write_text(json.dumps({"stage": stage, "cpu_seconds": spent_s}))
    (tmp_path / "variants").mkdir()
    assert bench().stage_cpu_s(tmp_path) == 15.75
    assert bench().stage_cpu_s(tmp_path / "missing") == 0.0


def test_a_case_is_found_by_its_name_and_nonsense_is_refused():
    program = bench()
    assert program.case_of("judge-007-1") == seeds.Case("judge", 7, 1)
    with pytest.raises(BadInput, match="wanted for example choose-003"):
        program.case_of("7")


def test_without_blender_it_is_said_how_to_get_it(monkeypatch, tmp_path):
    monkeypatch.setenv("VARIETY_BLENDER", str(tmp_path / "none"))
    with pytest.raises(BadInput, match="make blender"):
        colour.blender()


@pytest.mark.slow
@BLENDER
def test_a_session_is_whole_and_the_picture_the_depth_and_the_mask_agree(tmp_path):
    """Path tracer, stereo matcher and ray caster see the object at the same place; the depth there is the object's."""
    drawn = small(wall=True)
    drawn = replace(drawn, wrong=replace(drawn.wrong, depth_scale=1.0, depth_delay_s=0.0, delay_known=False),
                    camera=replace(drawn.camera, readout_s=0.0, jpeg=95, blur_px=0.0))  # fmt: skip
    out = tmp_path / "one"
    truth = session.make(drawn, out, threads=2)
    poses = np.load(truth / "toss_00" / "poses_camera_object.npz")
    frames = sorted((out / "toss_00" / "rgb").glob("*.jpg"))
    assert len(frames) == len(poses["t"]) == len(sorted((out / "toss_00" / "depth").glob("*.png")))
    first, last = (cv2.imread(str(p)).astype(float) for p in (frames[0], frames[-1]))
    masks = [cv2.imread(str(truth / "toss_00" / "masks" / f"{k:06d}.png"), 0) > 0 for k in (0, len(frames) - 1)]
    change = cv2.GaussianBlur(np.abs(first - last).max(axis=-1), (0, 0), 1.0)
    either, still = (
        masks[0] | masks[1],
        ~cv2.dilate((masks[0] | masks[1]).astype(np.uint8), np.ones((25, 25))).astype(bool),
    )
    assert np.median(change[either]) > 3 * np.median(change[still])
    depth = cv2.imread(str(out / "toss_00" / "depth" / "000000.png"), -1) * drawn.depth.unit_m
    inner = cv2.erode(masks[0].astype(np.uint8), np.ones((5, 5))).astype(bool) & (depth > 0)
    expected = float(poses["T_camera_object"][0][2, 3])
    assert np.median(depth[inner]) == pytest.approx(expected, abs=0.06)
    shutil.rmtree(out)


def armed():
    """A session of a slim box that a Panda tosses."""
    drawn = small(arm=True)
    return replace(drawn, family="box", camera=replace(drawn.camera, focal_px=390.0, distance_m=0.9))


@pytest.mark.slow
def test_the_arm_holds_the_object_until_it_opens_and_then_it_flies():
    drawn = armed()
    built = scene.build(drawn)
    assert built.arm is not None
    thrown = throws.Thrower(drawn, built).throw(0)
    from_tool = built.arm.held.object_from_tool
    held, opened = thrown.instants.release_s - 0.3, thrown.instants.release_s + built.arm.config.finger_open_s
    for t in np.linspace(0, held, 5):
        tool = built.arm.world_from_tool(thrown.swing.q_rad(t))
        gap = thrown.object.at(t).points(from_tool.translation_m) - tool.translation_m
        assert np.linalg.norm(gap) < 0.004  # it may slip by 3 mm
    later = thrown.object.at(opened + 0.08).points(from_tool.translation_m)
    tool = built.arm.world_from_tool(thrown.swing.q_rad(opened + 0.08))
    assert np.linalg.norm(later - tool.translation_m) > 0.01


def test_what_is_too_thick_for_the_hand_is_tossed_without_an_arm():
    assert arms.grasp_of(np.array(trimesh.creation.box((0.09, 0.1, 0.12)).vertices)) is None
    assert arms.grasp_of(np.array(trimesh.creation.box((0.06, 0.1, 0.12)).vertices)).width_m == pytest.approx(0.06)


def test_the_session_says_a_hand_eye_that_is_off_by_what_the_spec_says():
    drawn = armed()
    built = scene.build(drawn)
    camera, place = session.believed(drawn, built)
    off = built.world_from_camera.inverse() @ place
    assert np.linalg.norm(off.translation_m) == pytest.approx(drawn.wrong.camera_m, rel=1e-6)
    assert camera.fx / built.camera.fx == pytest.approx(1 + drawn.wrong.focal_share)
    base = session.calibrated_base(drawn, built)
    wrong = built.arm.world_from_base.inverse() @ base
    assert np.linalg.norm(wrong.translation_m) == pytest.approx(drawn.wrong.hand_eye_m, rel=1e-6)
    assert np.degrees(rotation_angle_rad(wrong.rotation)) == pytest.approx(drawn.wrong.hand_eye_deg, rel=1e-4)
